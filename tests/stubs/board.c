/* A board of memory: what the app calls of the firmware, in as few lines as tell the app nothing wrong.
 *
 * The test sets the clock, the sensor and the battery, runs the hooks, and reads the timers' registers. Parameters and
 * log variables are found through the app's own tables.
 */
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "FreeRTOS.h"
#include "app.h"
#include "app_channel.h"
#include "cfassert.h"
#include "crc32.h"
#include "crtp.h"
#include "commander.h"
#include "configblock.h"
#include "crtp_commander_high_level.h"
#include "crtp_supervisor.h"
#include "debug.h"
#include "estimator.h"
#include "log.h"
#include "motors.h"
#include "param.h"
#include "param_task.h"
#include "platform.h"
#include "pm.h"
#include "power_distribution.h"
#include "queue.h"
#include "stm32fxxx.h"
#include "supervisor.h"
#include "system.h"
#include "task.h"
#include "usec_time.h"
#include "watchdog.h"

uint64_t stub_now_us;
uint64_t stub_usec_reset_us; /* when usec.reset was written */
TickType_t stub_first_tick;
int32_t stub_gyro[3];
float stub_battery = 3.9f;
int32_t stub_armed = 1, stub_can_arm, stub_can_fly = 1, stub_planner; /* of the firmware's supervisor and commander */
int32_t stub_locked, stub_stop_requested, stub_watchdog_fed;
int32_t stub_gyro_known = 1;
int32_t stub_sensors = SensorImplementation_bmi088_bmp3xx;
int32_t stub_estimator = StateEstimatorTypeAutoSelect; /* what the stabilizer starts with */
int32_t stub_connected = 1;
int32_t stub_after_watchdog, stub_after_assert, stub_self_test_passed;
int32_t stub_ratios[4];
uint32_t stub_idle_thrust;
char stub_console[4096];
uint32_t stub_cycles = 1000; /* that the processor counts from one look at the counter to the next */
int32_t stub_suspended;
int32_t stub_transmit_full;
CoreDebug_Type stub_core_debug;

uint64_t configblockGetRadioAddress(void) { return 0xE7E7E7E7E7; }
uint64_t usecTimestamp(void) { return stub_now_us - stub_usec_reset_us; }
TickType_t xTaskGetTickCount(void) { return stub_first_tick + (TickType_t)(stub_now_us / 1000); }
float pmGetBatteryVoltage(void) { return stub_battery; }
bool supervisorIsLocked() { return stub_locked != 0; }
bool supervisorIsArmed() { return stub_armed != 0; }
bool supervisorCanArm() { return stub_can_arm != 0; }
bool supervisorCanFly() { return stub_can_fly != 0; }
bool supervisorRequestArming(const bool armed) {
  stub_armed = armed && (stub_armed || stub_can_arm);
  return stub_armed == armed;
}
enum trajectory_state crtpCommanderHighLevelGetPlannerState() { return (enum trajectory_state)stub_planner; }
int crtpCommanderHighLevelStop() { return stub_planner = 0; }
int commanderGetActivePriority(void) { return COMMANDER_PRIORITY_HIGHLEVEL; }
void vPortYield(void) {}
void crtpSupervisorSetEmergencyStop(void) { stub_stop_requested = 1; }
void crtpSupervisorNotifyEmergencyStopWatchdog(void) { stub_watchdog_fed += 1; }
bool crtpSupervisorIsEmergencyStopRequested(void) { return stub_stop_requested != 0; }
bool crtpIsConnected(void) { return stub_connected != 0; }
uint32_t powerDistributionGetIdleThrust() { return stub_idle_thrust; }
void motorsSetRatio(uint32_t id, uint16_t ratio) { stub_ratios[id] = ratio; }
SensorImplementation_t platformConfigGetSensorImplementation() { return (SensorImplementation_t)stub_sensors; }
bool paramTest(void) { return true; }
void systemWaitStart(void) {}

/* What made the board start again is told once, in words on the console, as the firmware does. */
static bool normal(int32_t *abnormal, const char *warning) {
  const bool was_normal = *abnormal == 0;
  if (!was_normal) {
    eprintf(consolePutchar, "%s", warning);
  }
  *abnormal = 0;
  return was_normal;
}
bool watchdogNormalStartTest(void) { return normal(&stub_after_watchdog, "SYS: after watchdog\n"); }
bool cfAssertNormalStartTest(void) { return normal(&stub_after_assert, "SYS: after assert\n"); }
StateEstimatorType stateEstimatorGetType(void) { return (StateEstimatorType)stub_estimator; }
paramVarId_t paramGetVarId(const char *group, const char *name) {
  const bool known = strcmp(group, "system") == 0 && strcmp(name, "selftestPassed") == 0;
  return (paramVarId_t){known ? 1 : 0xffff, 0};
}
int paramGetInt(paramVarId_t varid) { return varid.id == 1 ? stub_self_test_passed : -1; }
bool estimatorDequeue(measurement_t *measurement) { (void)measurement; return false; }

int consolePutchar(int c) { return c; }
int eprintf(int (*put)(int), const char *format, ...) {
  const size_t used = strlen(stub_console);
  va_list arguments;
  (void)put;
  va_start(arguments, format);
  const int length = vsnprintf(stub_console + used, sizeof stub_console - used, format, arguments);
  va_end(arguments);
  return length;
}

/* Timers and pins */

struct stub_port {
  volatile uint32_t MODER, OTYPER, OSPEEDR, PUPDR, IDR, ODR, BSRR, LCKR, AFR[2];
} stub_gpio_a, stub_gpio_b;
struct stub_timer {
  volatile uint32_t CR1, CR2, SMCR, DIER, SR, EGR, CCMR1, CCMR2, CCER, CNT, PSC, ARR, RCR, CCR1, CCR2, CCR3, CCR4;
} stub_tim3, stub_tim5;
static uint32_t ahb1, apb1;

void RCC_AHB1PeriphClockCmd(uint32_t peripheral, FunctionalState state) { ahb1 = state ? ahb1 | peripheral : ahb1 & ~peripheral; }
void RCC_APB1PeriphClockCmd(uint32_t peripheral, FunctionalState state) { apb1 = state ? apb1 | peripheral : apb1 & ~peripheral; }
static int clocked(const TIM_TypeDef *timer) { return (apb1 & (timer == TIM3 ? RCC_APB1Periph_TIM3 : RCC_APB1Periph_TIM5)) != 0; }
void GPIO_StructInit(GPIO_InitTypeDef *init) { memset(init, 0, sizeof *init); init->GPIO_Pin = 0xffff; }
void GPIO_Init(GPIO_TypeDef *port, GPIO_InitTypeDef *init) {
  for (uint32_t pin = 0; pin < 16; pin++) {
    if (init->GPIO_Pin & (1u << pin)) {
      port->MODER = (port->MODER & ~(3u << 2 * pin)) | (uint32_t)init->GPIO_Mode << 2 * pin;
      port->OTYPER = (port->OTYPER & ~(1u << pin)) | (uint32_t)init->GPIO_OType << pin;
      port->PUPDR = (port->PUPDR & ~(3u << 2 * pin)) | (uint32_t)init->GPIO_PuPd << 2 * pin;
    }
  }
}
void GPIO_PinAFConfig(GPIO_TypeDef *port, uint16_t source, uint8_t function) {
  volatile uint32_t *afr = &port->AFR[source >> 3];
  *afr = (*afr & ~(15u << 4 * (source & 7))) | (uint32_t)function << 4 * (source & 7);
}
void TIM_TimeBaseStructInit(TIM_TimeBaseInitTypeDef *init) { memset(init, 0, sizeof *init); init->TIM_Period = 0xffffffff; }
void TIM_TimeBaseInit(TIM_TypeDef *timer, TIM_TimeBaseInitTypeDef *init) {
  if (clocked(timer)) {
    timer->PSC = init->TIM_Prescaler;
    timer->ARR = init->TIM_Period;
  }
}
void TIM_ARRPreloadConfig(TIM_TypeDef *timer, FunctionalState state) { timer->CR1 |= state ? 0x80u : 0; }
void TIM_OCStructInit(TIM_OCInitTypeDef *init) { memset(init, 0, sizeof *init); }
static void output(TIM_TypeDef *timer, uint32_t channel, const TIM_OCInitTypeDef *init) {
  volatile uint32_t *mode = channel < 2 ? &timer->CCMR1 : &timer->CCMR2;
  *mode |= (uint32_t)init->TIM_OCMode << 8 * (channel & 1);
  timer->CCER |= ((uint32_t)init->TIM_OutputState | init->TIM_OCPolarity) << 4 * channel;
  (&timer->CCR1)[channel] = init->TIM_Pulse;
}
static void preload(TIM_TypeDef *timer, uint32_t channel, uint16_t bit) {
  volatile uint32_t *mode = channel < 2 ? &timer->CCMR1 : &timer->CCMR2;
  *mode |= (uint32_t)bit << 8 * (channel & 1);
}
void TIM_OC1Init(TIM_TypeDef *timer, TIM_OCInitTypeDef *init) { output(timer, 0, init); }
void TIM_OC2Init(TIM_TypeDef *timer, TIM_OCInitTypeDef *init) { output(timer, 1, init); }
void TIM_OC3Init(TIM_TypeDef *timer, TIM_OCInitTypeDef *init) { output(timer, 2, init); }
void TIM_OC4Init(TIM_TypeDef *timer, TIM_OCInitTypeDef *init) { output(timer, 3, init); }
void TIM_OC1PreloadConfig(TIM_TypeDef *timer, uint16_t bit) { preload(timer, 0, bit); }
void TIM_OC2PreloadConfig(TIM_TypeDef *timer, uint16_t bit) { preload(timer, 1, bit); }
void TIM_OC3PreloadConfig(TIM_TypeDef *timer, uint16_t bit) { preload(timer, 2, bit); }
void TIM_OC4PreloadConfig(TIM_TypeDef *timer, uint16_t bit) { preload(timer, 3, bit); }
void TIM_SetCompare1(TIM_TypeDef *timer, uint32_t compare) { timer->CCR1 = compare; }
void TIM_SetCompare2(TIM_TypeDef *timer, uint32_t compare) { timer->CCR2 = compare; }
void TIM_SetCompare3(TIM_TypeDef *timer, uint32_t compare) { timer->CCR3 = compare; }
void TIM_SetCompare4(TIM_TypeDef *timer, uint32_t compare) { timer->CCR4 = compare; }
void TIM_Cmd(TIM_TypeDef *timer, FunctionalState state) { timer->CR1 |= state ? 1u : 0; }

/* One queue is all that the app has */

struct QueueDefinition {
  uint8_t *storage;
  UBaseType_t length, size, first, used;
};
static struct QueueDefinition queue_of_the_app;

QueueHandle_t xQueueGenericCreateStatic(const UBaseType_t length, const UBaseType_t item_size, uint8_t *storage,
                                        StaticQueue_t *queue, const uint8_t type) {
  (void)queue;
  (void)type;
  queue_of_the_app = (struct QueueDefinition){storage, length, item_size, 0, 0};
  return &queue_of_the_app;
}
BaseType_t xQueueGenericSend(QueueHandle_t q, const void *const item, TickType_t ticks, const BaseType_t position) {
  (void)ticks;
  (void)position;
  if (q->used == q->length) {
    return pdFALSE;
  }
  memcpy(q->storage + (q->first + q->used) % q->length * q->size, item, q->size);
  q->used += 1;
  return pdTRUE;
}
BaseType_t xQueueGenericReset(QueueHandle_t q, BaseType_t new) {
  (void)new;
  q->first = q->used = 0;
  return pdTRUE;
}
BaseType_t xQueueReceive(QueueHandle_t q, void *const item, TickType_t ticks) {
  (void)ticks;
  if (q->used == 0) {
    return pdFALSE;
  }
  memcpy(item, q->storage + q->first * q->size, q->size);
  q->first = (q->first + 1) % q->length;
  q->used -= 1;
  return pdTRUE;
}

/* Radio, and the app's task, which runs from its begin until it has looked `looks` times */

static CrtpCallback callbacks[16];
static uint8_t app_packet[APPCHANNEL_MTU];
static size_t app_length;
static int app_looks;
static jmp_buf app_leave;
static TaskFunction_t app_task;

void crtpRegisterPortCB(int port, CrtpCallback cb) { callbacks[port] = cb; }

/* The last packets, which wait for the task of their port unless they are taken back, the oldest first. */
#define RECEIVE_QUEUE 16
static CRTPPacket waiting[RECEIVE_QUEUE];
static unsigned received;
int32_t stub_waits;

int crtpReceivePacket(CRTPPort port, CRTPPacket *packet) {
  *packet = waiting[(received - (unsigned)stub_waits) % RECEIVE_QUEUE];
  const bool there = stub_waits && packet->port == port;
  stub_waits -= there;
  return there ? pdTRUE : pdFALSE;
}

void stub_radio(int port, int channel, const uint8_t *data, int length) {
  CRTPPacket packet;
  memset(&packet, 0, sizeof packet);
  packet.size = (uint8_t)length;
  packet.port = (uint8_t)(port & 15);
  packet.channel = (uint8_t)(channel & 3);
  memcpy(packet.data, data, (size_t)length);
  waiting[received++ % RECEIVE_QUEUE] = packet;
  stub_waits += 1;
  if (callbacks[port]) {
    callbacks[port](&packet);
  }
}

/* Packets to the ground wait until the test takes them. */
#define TRANSMIT_QUEUE 200
static CRTPPacket transmitted[TRANSMIT_QUEUE];
static int first_transmitted, count_transmitted;

int crtpSendPacket(CRTPPacket *packet) {
  if (stub_transmit_full || count_transmitted == TRANSMIT_QUEUE) {
    return pdFALSE;
  }
  transmitted[(first_transmitted + count_transmitted++) % TRANSMIT_QUEUE] = *packet;
  return pdTRUE;
}

/* Takes the next packet, header and data; returns its length, 0 when there is none. */
int stub_transmitted(uint8_t *data) {
  if (count_transmitted == 0) {
    return 0;
  }
  const CRTPPacket *packet = &transmitted[first_transmitted];
  data[0] = packet->header;
  memcpy(data + 1, packet->data, packet->size);
  first_transmitted = (first_transmitted + 1) % TRANSMIT_QUEUE;
  count_transmitted -= 1;
  return packet->size + 1;
}

size_t xPortGetFreeHeapSize(void) { return 7000; }

/* Cycles are counted when both have been switched on. */
DWT_Type *stub_dwt(void) {
  static DWT_Type dwt;
  if ((stub_core_debug.DEMCR & CoreDebug_DEMCR_TRCENA_Msk) && (dwt.CTRL & DWT_CTRL_CYCCNTENA_Msk)) {
    dwt.CYCCNT += stub_cycles;
  }
  return &dwt;
}

void vTaskSuspendAll(void) { stub_suspended += 1; }
BaseType_t xTaskResumeAll(void) {
  stub_suspended -= 1;
  return pdTRUE;
}

static void look(void) {
  if (app_looks-- == 0) {
    longjmp(app_leave, 1);
  }
}

TaskHandle_t xTaskCreateStatic(TaskFunction_t function, const char *name, uint32_t depth, void *parameters,
                               UBaseType_t priority, StackType_t *stack, StaticTask_t *task) {
  (void)name;
  (void)depth;
  (void)parameters;
  (void)priority;
  (void)stack;
  app_task = function;
  return (TaskHandle_t)task;
}

void vTaskDelay(TickType_t ticks) {
  (void)ticks;
  look();
}

size_t appchannelReceiveDataPacket(void *buffer, size_t max_length, int timeout_ms) {
  (void)timeout_ms;
  look();
  const size_t length = app_length < max_length ? app_length : max_length;
  memcpy(buffer, app_packet, length);
  app_length = 0;
  return length;
}

void stub_app_packet(const uint8_t *data, int length) {
  memcpy(app_packet, data, (size_t)length);
  app_length = (size_t)length;
}

void stub_run_app(int looks) {
  app_looks = looks;
  if (setjmp(app_leave) == 0) {
    app_task(NULL);
  }
}

/* Tables of log variables and parameters */

extern struct log_s __start_log_table[], __stop_log_table[];
extern struct param_s __start_param_table[], __stop_param_table[];

logVarId_t logGetVarId(const char *group, const char *name) {
  if (!stub_gyro_known || strcmp(group, "gyro") != 0 || strcmp(name + 1, "Raw") != 0) {
    return 0xffffu;
  }
  return (logVarId_t)(name[0] - 'x');
}
int logGetInt(logVarId_t varid) { return stub_gyro[varid]; }

/* The name of entry `i` as group.name, empty for the entries that begin and end a group; NULL after the last one. */
const char *stub_log_name(int i) {
  static char name[64];
  static const char *group;
  if (i >= __stop_log_table - __start_log_table) {
    return NULL;
  }
  const struct log_s *entry = &__start_log_table[i];
  name[0] = 0;
  if (entry->type == (LOG_GROUP | LOG_START)) {
    group = entry->name;
  } else if (!(entry->type & LOG_GROUP)) {
    snprintf(name, sizeof name, "%s.%s", group, entry->name);
  }
  return name;
}
double stub_log_value(int i) {
  const struct log_s *entry = &__start_log_table[i];
  switch (entry->type) {
    case LOG_UINT8: return *(uint8_t *)entry->address;
    case LOG_UINT16: return *(uint16_t *)entry->address;
    case LOG_UINT32: return *(uint32_t *)entry->address;
    case LOG_INT32: return *(int32_t *)entry->address;
    case LOG_FLOAT: return (double)*(float *)entry->address;
    default: return (double)NAN;
  }
}
const char *stub_param_name(int i) {
  static char name[64];
  static const char *group;
  if (i >= __stop_param_table - __start_param_table) {
    return NULL;
  }
  const struct param_s *entry = &__start_param_table[i];
  name[0] = 0;
  if (entry->type == (PARAM_GROUP | PARAM_START)) {
    group = entry->name;
  } else if (!(entry->type & PARAM_GROUP)) {
    snprintf(name, sizeof name, "%s.%s", group, entry->name);
  }
  return name;
}
int stub_param_type(int i) { return __start_param_table[i].type & 15; }
int stub_param_persistent(int i) { return __start_param_table[i].extended_type & 1; }
double stub_param_get(int i) {
  const struct param_s *entry = &__start_param_table[i];
  switch (entry->type & 15) {
    case PARAM_UINT8: return *(uint8_t *)entry->address;
    case PARAM_UINT16: return *(uint16_t *)entry->address;
    case PARAM_INT16: return *(int16_t *)entry->address;
    case PARAM_INT32: return *(int32_t *)entry->address;
    case PARAM_FLOAT: return (double)*(float *)entry->address;
    default: return (double)NAN;
  }
}
/* A value from the EEPROM is written without a call of the parameter's callback. */
void stub_param_load(int i, double value) {
  const struct param_s *entry = &__start_param_table[i];
  switch (entry->type & 15) {
    case PARAM_UINT8: *(uint8_t *)entry->address = (uint8_t)value; break;
    case PARAM_UINT16: *(uint16_t *)entry->address = (uint16_t)value; break;
    case PARAM_INT16: *(int16_t *)entry->address = (int16_t)value; break;
    case PARAM_INT32: *(int32_t *)entry->address = (int32_t)value; break;
    case PARAM_FLOAT: *(float *)entry->address = (float)value; break;
  }
}
void stub_param_set(int i, double value) {
  stub_param_load(i, value);
  if (__start_param_table[i].callback) {
    __start_param_table[i].callback();
  }
}

uint32_t crc32CalculateBuffer(const void *buffer, size_t size) {
  uint32_t crc = 0xffffffff;
  for (const uint8_t *byte = buffer; size > 0; byte++, size--) {
    crc ^= *byte;
    for (int bit = 0; bit < 8; bit++) {
      crc = crc & 1 ? crc >> 1 ^ 0xedb88320 : crc >> 1;
    }
  }
  return ~crc;
}
