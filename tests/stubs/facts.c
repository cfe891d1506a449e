/* What the real headers state of every name that the stubs declare.
 *
 * Compiled for ARM against the stubs by the tests, and once by hand against crazyflie-firmware 2a18fc29, as one more
 * object of the app: there it compiles as well. So what the app may use is what the firmware has.
 */
#define DEBUG_MODULE "FACTS"

#include <stddef.h>

#include "FreeRTOS.h"
#include "queue.h"
#include "task.h"

#include "app.h"
#include "app_channel.h"
#include "autoconf.h"
#include "cfassert.h"
#include "commander.h"
#include "configblock.h"
#include "controller.h"
#include "crc32.h"
#include "crtp.h"
#include "crtp_commander_high_level.h"
#include "crtp_supervisor.h"
#include "debug.h"
#include "estimator.h"
#include "log.h"
#include "motors.h"
#include "param.h"
#include "param_task.h"
#include "planner.h"
#include "platform.h"
#include "pm.h"
#include "power_distribution.h"
#include "stm32fxxx.h"
#include "supervisor.h"
#include "system.h"
#include "usec_time.h"
#include "watchdog.h"

#define SAME(A, B) __builtin_types_compatible_p(A, B)
#define VALUE(EXPRESSION, EXPECTED) _Static_assert((EXPRESSION) == (EXPECTED), #EXPRESSION);
#define TYPE(EXPRESSION, EXPECTED) _Static_assert(SAME(__typeof__(EXPRESSION), EXPECTED), #EXPRESSION);
#define SIZE(OF, BYTES) VALUE(sizeof(OF), BYTES)
#define FIELD(OF, NAME, EXPECTED, OFFSET) TYPE(((OF *)0)->NAME, EXPECTED) VALUE(offsetof(OF, NAME), OFFSET)
#define FUNCTION(NAME, RESULT, ...) TYPE(NAME, RESULT(__VA_ARGS__))

/* FreeRTOS.h, queue.h, task.h */
_Static_assert(SAME(BaseType_t, long) && SAME(UBaseType_t, unsigned long) && SAME(TickType_t, uint32_t), "FreeRTOS");
FUNCTION(xPortGetFreeHeapSize, size_t, void)
VALUE(pdFALSE, 0)
VALUE(pdTRUE, 1)
TYPE(M2T(20), unsigned)
VALUE(M2T(20), 20)
SIZE(StaticQueue_t, 80)
_Static_assert(SAME(StackType_t, uint32_t), "stack");
SIZE(StaticTask_t, 96)
_Static_assert(SAME(TaskHandle_t, struct tskTaskControlBlock *) && SAME(TaskFunction_t, void (*)(void *)), "task");
_Static_assert(SAME(QueueHandle_t, struct QueueDefinition *), "queue");
VALUE(queueSEND_TO_BACK, 0)
FUNCTION(xQueueGenericCreateStatic, QueueHandle_t, UBaseType_t, UBaseType_t, uint8_t *, StaticQueue_t *, uint8_t)
FUNCTION(xQueueGenericSend, BaseType_t, QueueHandle_t, const void *, TickType_t, BaseType_t)
FUNCTION(xQueueGenericReset, BaseType_t, QueueHandle_t, BaseType_t)
TYPE(xQueueReset(NULL), BaseType_t)
FUNCTION(xQueueReceive, BaseType_t, QueueHandle_t, void *, TickType_t)
TYPE(xQueueCreateStatic(1, 1, NULL, NULL), QueueHandle_t)
TYPE(xQueueSend(NULL, NULL, 0), BaseType_t)
FUNCTION(xTaskGetTickCount, TickType_t, void)
FUNCTION(vTaskDelay, void, TickType_t)
FUNCTION(vPortYield, void, void)
TYPE(taskYIELD(), void)
FUNCTION(vTaskSuspendAll, void, void)
FUNCTION(xTaskResumeAll, BaseType_t, void)
FUNCTION(xTaskCreateStatic, TaskHandle_t, TaskFunction_t, const char *, uint32_t, void *, UBaseType_t, StackType_t *,
         StaticTask_t *)

/* app.h, app_channel.h, crtp.h, debug.h, pm.h, system.h and others of one or two names */
FUNCTION(appInit, void, void)
FUNCTION(systemWaitStart, void, void)
FUNCTION(cfAssertNormalStartTest, bool, void)
FUNCTION(watchdogNormalStartTest, bool, void)
FUNCTION(crc32CalculateBuffer, uint32_t, const void *, size_t)
FUNCTION(crtpSupervisorSetEmergencyStop, void, void)
FUNCTION(crtpSupervisorNotifyEmergencyStopWatchdog, void, void)
FUNCTION(crtpSupervisorIsEmergencyStopRequested, bool, void)
VALUE(MOTOR_M4, 3)
FUNCTION(motorsSetRatio, void, uint32_t, uint16_t)
FUNCTION(powerDistributionGetIdleThrust, uint32_t, void)
VALUE(SensorImplementation_bmi088_bmp3xx, 0)
VALUE(SensorImplementation_mpu9250_lps25h, 1)
FUNCTION(platformConfigGetSensorImplementation, SensorImplementation_t, void)
VALUE(APPCHANNEL_MTU, 30)
FUNCTION(appchannelReceiveDataPacket, size_t, void *, size_t, int)
VALUE(CRTP_MAX_DATA_SIZE, 30)
VALUE(CRTP_PORT_LOCALIZATION, 6)
VALUE(CRTP_PORT_SETPOINT_HL, 8)
FUNCTION(crtpReceivePacket, int, CRTPPort, CRTPPacket *)
SIZE(CRTPPacket, 32)
FIELD(CRTPPacket, size, uint8_t, 0)
FIELD(CRTPPacket, header, uint8_t, 1)
FIELD(CRTPPacket, data, uint8_t[CRTP_MAX_DATA_SIZE], 2)
static const CRTPPacket port_6_channel_1 __attribute__((unused)) = {.port = 6, .reserved = 0, .channel = 1};
_Static_assert(SAME(CrtpCallback, void (*)(CRTPPacket *)), "CRTP");
FUNCTION(crtpRegisterPortCB, void, int, CrtpCallback)
FUNCTION(crtpIsConnected, bool, void)
FUNCTION(crtpSendPacket, int, CRTPPacket *)
FUNCTION(consolePutchar, int, int)
FUNCTION(eprintf, int, int (*)(int), const char *, ...)
TYPE(DEBUG_PRINT("%s %d\n", "", 0), int)
FUNCTION(pmGetBatteryVoltage, float, void)
FUNCTION(supervisorIsLocked, bool, void)
VALUE(COMMANDER_PRIORITY_HIGHLEVEL, 1)
FUNCTION(commanderGetActivePriority, int, void)
FUNCTION(supervisorIsArmed, bool, void)
FUNCTION(supervisorCanArm, bool, void)
FUNCTION(supervisorCanFly, bool, void)
FUNCTION(supervisorRequestArming, bool, const bool)
FUNCTION(crtpCommanderHighLevelGetPlannerState, enum trajectory_state, void)
FUNCTION(crtpCommanderHighLevelStop, int, void)
VALUE(TRAJECTORY_STATE_IDLE, 0)
VALUE(TRAJECTORY_STATE_FLYING, 1)
VALUE(TRAJECTORY_STATE_LANDING, 3)
VALUE(TRAJECTORY_STATE_DISABLED, 4)
FUNCTION(usecTimestamp, uint64_t, void)
FUNCTION(configblockGetRadioAddress, uint64_t, void)

/* autoconf.h, estimator.h, controller.h, stabilizer_types.h */
VALUE(CONFIG_APP_ENABLE, 1)
VALUE(CONFIG_APP_PRIORITY, 2)
VALUE(CONFIG_APP_STACKSIZE, 300)
VALUE(CONFIG_SENSORS_BMI088_BMP3XX, 1)
VALUE(CONFIG_CONTROLLER_OOT, 1)
VALUE(CONFIG_ESTIMATOR_KALMAN_ENABLE, 1)
VALUE(CONFIG_ESTIMATOR_OOT, 1)
_Static_assert(SAME(stabilizerStep_t, uint32_t), "step");
SIZE(state_t, 80)
FIELD(state_t, attitude.timestamp, uint32_t, 0)
FIELD(state_t, attitude.roll, float, 4)
FIELD(state_t, attitude.pitch, float, 8)
FIELD(state_t, attitude.yaw, float, 12)
FIELD(state_t, attitudeQuaternion.x, float, 16)
FIELD(state_t, attitudeQuaternion.y, float, 20)
FIELD(state_t, attitudeQuaternion.z, float, 24)
FIELD(state_t, attitudeQuaternion.w, float, 28)
FIELD(state_t, position.timestamp, uint32_t, 32)
FIELD(state_t, position.x, float, 36)
FIELD(state_t, position.y, float, 40)
FIELD(state_t, position.z, float, 44)
FIELD(state_t, velocity.timestamp, uint32_t, 48)
FIELD(state_t, velocity.x, float, 52)
FIELD(state_t, velocity.y, float, 56)
FIELD(state_t, velocity.z, float, 60)
FIELD(state_t, acc.x, float, 68)
_Static_assert(SAME(__typeof__(((state_t *)0)->attitude), attitude_t), "attitude");
SIZE(control_t, 20)
SIZE(setpoint_t, 128)
FIELD(setpoint_t, timestamp, uint32_t, 0)
FIELD(setpoint_t, attitude, attitude_t, 4)
FIELD(setpoint_t, attitudeRate, attitude_t, 20)
FIELD(setpoint_t, attitudeQuaternion, quaternion_t, 36)
FIELD(setpoint_t, thrust, float, 52)
FIELD(setpoint_t, position, point_t, 56)
FIELD(setpoint_t, velocity.x, float, 76)
FIELD(setpoint_t, acceleration.x, float, 92)
FIELD(setpoint_t, jerk.x, float, 108)
FIELD(setpoint_t, velocity_body, bool, 120)
FIELD(setpoint_t, mode, setpoint_mode_t, 121)
SIZE(setpoint_mode_t, 7)
FIELD(setpoint_mode_t, x, stab_mode_t, 0)
FIELD(setpoint_mode_t, y, stab_mode_t, 1)
FIELD(setpoint_mode_t, z, stab_mode_t, 2)
FIELD(setpoint_mode_t, roll, stab_mode_t, 3)
FIELD(setpoint_mode_t, pitch, stab_mode_t, 4)
FIELD(setpoint_mode_t, yaw, stab_mode_t, 5)
FIELD(setpoint_mode_t, quat, stab_mode_t, 6)
VALUE(modeDisable, 0)
VALUE(modeAbs, 1)
VALUE(modeVelocity, 2)
SIZE(measurement_t, 48)
VALUE(StateEstimatorTypeAutoSelect, 0)
VALUE(StateEstimatorTypeOutOfTree, 3)
FUNCTION(stateEstimatorGetType, StateEstimatorType, void)
FUNCTION(estimatorDequeue, bool, measurement_t *)
FUNCTION(estimatorOutOfTreeInit, void, void)
FUNCTION(estimatorOutOfTreeTest, bool, void)
FUNCTION(estimatorOutOfTree, void, state_t *, stabilizerStep_t)
FUNCTION(controllerOutOfTreeInit, void, void)
FUNCTION(controllerOutOfTreeTest, bool, void)
FUNCTION(controllerOutOfTree, void, control_t *, const setpoint_t *, const sensorData_t *, const state_t *, stabilizerStep_t)

/* log.h, param.h */
_Static_assert(SAME(logVarId_t, uint16_t), "log");
FUNCTION(logGetVarId, logVarId_t, const char *, const char *)
FUNCTION(logVarIdIsValid, bool, logVarId_t)
FUNCTION(logGetInt, int, logVarId_t)
SIZE(struct log_s, 12)
FIELD(struct log_s, type, uint8_t, 0)
FIELD(struct log_s, name, char *, 4)
FIELD(struct log_s, address, void *, 8)
VALUE(LOG_UINT8, 1)
VALUE(LOG_UINT16, 2)
VALUE(LOG_UINT32, 3)
VALUE(LOG_INT32, 6)
VALUE(LOG_FLOAT, 7)
VALUE(LOG_GROUP, 0x80)
VALUE(LOG_START, 1)
VALUE(LOG_STOP, 0)
SIZE(paramVarId_t, 4)
FIELD(paramVarId_t, id, uint16_t, 0)
FIELD(paramVarId_t, index, uint16_t, 2)
FUNCTION(paramGetVarId, paramVarId_t, const char *, const char *)
FUNCTION(paramGetInt, int, paramVarId_t)
FUNCTION(paramTest, bool, void)
SIZE(struct param_s, 20)
FIELD(struct param_s, type, uint8_t, 0)
FIELD(struct param_s, extended_type, uint8_t, 1)
FIELD(struct param_s, name, char *, 4)
FIELD(struct param_s, address, void *, 8)
FIELD(struct param_s, callback, void (*)(void), 12)
FIELD(struct param_s, getter, void *(*)(void), 16)
VALUE(PARAM_UINT8, 0x08)
VALUE(PARAM_UINT16, 0x09)
VALUE(PARAM_INT16, 0x01)
VALUE(PARAM_INT32, 0x02)
VALUE(PARAM_FLOAT, 0x06)
VALUE(PARAM_GROUP, 0x80)
VALUE(PARAM_EXTENDED, 0x10)
VALUE(PARAM_PERSISTENT, 0x100)
VALUE(PARAM_START, 1)
VALUE(PARAM_STOP, 0)

static float logged;
LOG_GROUP_START(facts)
LOG_ADD(LOG_FLOAT, logged, &logged)
LOG_GROUP_STOP(facts)
TYPE(__logs_facts, const struct log_s[3])

static uint8_t written;
static void on_write(void) {}
PARAM_GROUP_START(facts)
PARAM_ADD_WITH_CALLBACK(PARAM_UINT8 | PARAM_PERSISTENT, written, &written, on_write)
PARAM_GROUP_STOP(facts)
TYPE(__params_facts, struct param_s[3])

/* stm32fxxx.h: ST's StdPeriph library */
VALUE(DISABLE, 0)
VALUE(ENABLE, 1)
VALUE(GPIOA_BASE, 0x40020000)
VALUE(GPIOB_BASE, 0x40020400)
VALUE(TIM3_BASE, 0x40000400)
VALUE(TIM5_BASE, 0x40000C00)
_Static_assert(SAME(__typeof__(GPIOA), GPIO_TypeDef *) && SAME(__typeof__(GPIOB), GPIO_TypeDef *), "ports");
_Static_assert(SAME(__typeof__(TIM3), TIM_TypeDef *) && SAME(__typeof__(TIM5), TIM_TypeDef *), "timers");
/* ARM's CMSIS */
VALUE(DWT_BASE, 0xE0001000)
VALUE(CoreDebug_BASE, 0xE000EDF0)
_Static_assert(SAME(__typeof__(DWT), DWT_Type *) && SAME(__typeof__(CoreDebug), CoreDebug_Type *), "debug");
VALUE(offsetof(DWT_Type, CTRL), 0)
VALUE(offsetof(DWT_Type, CYCCNT), 4)
VALUE(offsetof(CoreDebug_Type, DHCSR), 0)
VALUE(offsetof(CoreDebug_Type, DCRSR), 4)
VALUE(offsetof(CoreDebug_Type, DCRDR), 8)
VALUE(offsetof(CoreDebug_Type, DEMCR), 12)
VALUE(DWT_CTRL_CYCCNTENA_Msk, 1)
VALUE(CoreDebug_DEMCR_TRCENA_Msk, 1 << 24)
VALUE(GPIO_Mode_AF, 2)
VALUE(GPIO_OType_OD, 1)
VALUE(GPIO_Speed_2MHz, 0)
VALUE(GPIO_PuPd_NOPULL, 0)
SIZE(GPIO_InitTypeDef, 8)
FIELD(GPIO_InitTypeDef, GPIO_Pin, uint32_t, 0)
FIELD(GPIO_InitTypeDef, GPIO_Mode, GPIOMode_TypeDef, 4)
FIELD(GPIO_InitTypeDef, GPIO_Speed, GPIOSpeed_TypeDef, 5)
FIELD(GPIO_InitTypeDef, GPIO_OType, GPIOOType_TypeDef, 6)
FIELD(GPIO_InitTypeDef, GPIO_PuPd, GPIOPuPd_TypeDef, 7)
SIZE(TIM_TimeBaseInitTypeDef, 12)
FIELD(TIM_TimeBaseInitTypeDef, TIM_Prescaler, uint16_t, 0)
FIELD(TIM_TimeBaseInitTypeDef, TIM_CounterMode, uint16_t, 2)
FIELD(TIM_TimeBaseInitTypeDef, TIM_Period, uint32_t, 4)
FIELD(TIM_TimeBaseInitTypeDef, TIM_ClockDivision, uint16_t, 8)
FIELD(TIM_TimeBaseInitTypeDef, TIM_RepetitionCounter, uint8_t, 10)
SIZE(TIM_OCInitTypeDef, 20)
FIELD(TIM_OCInitTypeDef, TIM_OCMode, uint16_t, 0)
FIELD(TIM_OCInitTypeDef, TIM_OutputState, uint16_t, 2)
FIELD(TIM_OCInitTypeDef, TIM_OutputNState, uint16_t, 4)
FIELD(TIM_OCInitTypeDef, TIM_Pulse, uint32_t, 8)
FIELD(TIM_OCInitTypeDef, TIM_OCPolarity, uint16_t, 12)
FIELD(TIM_OCInitTypeDef, TIM_OCNPolarity, uint16_t, 14)
FIELD(TIM_OCInitTypeDef, TIM_OCIdleState, uint16_t, 16)
FIELD(TIM_OCInitTypeDef, TIM_OCNIdleState, uint16_t, 18)
VALUE(GPIO_Pin_2, 1 << 2)
VALUE(GPIO_Pin_3, 1 << 3)
VALUE(GPIO_Pin_4, 1 << 4)
VALUE(GPIO_Pin_5, 1 << 5)
VALUE(GPIO_PinSource2, 2)
VALUE(GPIO_PinSource3, 3)
VALUE(GPIO_PinSource4, 4)
VALUE(GPIO_PinSource5, 5)
VALUE(GPIO_AF_TIM3, 2)
VALUE(GPIO_AF_TIM5, 2)
VALUE(RCC_AHB1Periph_GPIOA, 1)
VALUE(RCC_AHB1Periph_GPIOB, 2)
VALUE(RCC_APB1Periph_TIM3, 2)
VALUE(RCC_APB1Periph_TIM5, 8)
VALUE(TIM_CounterMode_Up, 0)
VALUE(TIM_OCMode_PWM1, 0x60)
VALUE(TIM_OutputState_Enable, 1)
VALUE(TIM_OCPolarity_High, 0)
VALUE(TIM_OCPreload_Enable, 8)
FUNCTION(RCC_AHB1PeriphClockCmd, void, uint32_t, FunctionalState)
FUNCTION(RCC_APB1PeriphClockCmd, void, uint32_t, FunctionalState)
FUNCTION(GPIO_StructInit, void, GPIO_InitTypeDef *)
FUNCTION(GPIO_Init, void, GPIO_TypeDef *, GPIO_InitTypeDef *)
FUNCTION(GPIO_PinAFConfig, void, GPIO_TypeDef *, uint16_t, uint8_t)
FUNCTION(TIM_TimeBaseStructInit, void, TIM_TimeBaseInitTypeDef *)
FUNCTION(TIM_TimeBaseInit, void, TIM_TypeDef *, TIM_TimeBaseInitTypeDef *)
FUNCTION(TIM_ARRPreloadConfig, void, TIM_TypeDef *, FunctionalState)
FUNCTION(TIM_OCStructInit, void, TIM_OCInitTypeDef *)
FUNCTION(TIM_OC1Init, void, TIM_TypeDef *, TIM_OCInitTypeDef *)
FUNCTION(TIM_OC2Init, void, TIM_TypeDef *, TIM_OCInitTypeDef *)
FUNCTION(TIM_OC3Init, void, TIM_TypeDef *, TIM_OCInitTypeDef *)
FUNCTION(TIM_OC4Init, void, TIM_TypeDef *, TIM_OCInitTypeDef *)
FUNCTION(TIM_OC1PreloadConfig, void, TIM_TypeDef *, uint16_t)
FUNCTION(TIM_OC2PreloadConfig, void, TIM_TypeDef *, uint16_t)
FUNCTION(TIM_OC3PreloadConfig, void, TIM_TypeDef *, uint16_t)
FUNCTION(TIM_OC4PreloadConfig, void, TIM_TypeDef *, uint16_t)
FUNCTION(TIM_SetCompare1, void, TIM_TypeDef *, uint32_t)
FUNCTION(TIM_SetCompare2, void, TIM_TypeDef *, uint32_t)
FUNCTION(TIM_SetCompare3, void, TIM_TypeDef *, uint32_t)
FUNCTION(TIM_SetCompare4, void, TIM_TypeDef *, uint32_t)
FUNCTION(TIM_Cmd, void, TIM_TypeDef *, FunctionalState)
