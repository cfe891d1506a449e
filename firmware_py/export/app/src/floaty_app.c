/* Floaty as out-of-tree estimator and controller of the Crazyflie firmware.
 *
 * The stabilizer task calls both 1000 times per second, after each IMU sample, and all of the core from there. What is decided
 * in flight the core decides; here it gets samples, poses, requests and the time, and its counts go to the timers.
 *
 * Gyro: the core takes raw counts. The BMI088 driver shows them as the log variables gyro.xRaw, yRaw, zRaw, of which
 * there is a new one in each step; neither the firmware's low-pass nor its bias is in between, so that the core computes
 * what it computes in the laboratory, bit for bit, from the same counts, poses and instants.
 *
 * Time: what is decided by time counts ticks, which nobody can set. How long a pose waited is measured in microseconds,
 * by a clock that the parameter usec.reset sets to zero. Both are handed on as 32 bits, which wrap. With hardware in the loop, neither counts while a sample of the
 * host is missing: floaty_hil.h.
 *
 * What receives poses and requests, and talks on the console, is floaty_task.c.
 */
#define DEBUG_MODULE "FLOATY"

#include "floaty_calls.h"

#include <math.h>
#include <string.h>

#include "FreeRTOS.h"
#include "queue.h"
#include "task.h"

#include "controller.h"
#include "crtp.h"
#include "crtp_supervisor.h"
#include "debug.h"
#include "estimator.h"
#include "log.h"
#include "motors.h"
#include "platform.h"
#include "pm.h"
#include "power_distribution.h"
#include "supervisor.h"
#include "usec_time.h"

#include "floaty_hil.h"
#include "floaty_servos.h"
#include "floaty_settings.h"

#define STEP_US 1000
#define BATTERY_STEPS 100
#define POSE_QUEUE 8
#define DEGREES 57.2957795f /* per radian */
#define TURN 6.28318531f

FloatyParameters floaty_parameters;
FloatyInput floaty_input;
FloatyEstimator floaty_estimator;
FloatyControl floaty_control;
FloatySampling floaty_sampling;
FloatySupervisor floaty_supervisor;
FloatyObserved floaty_observed;
FloatyRequests floaty_requests;
uint8_t floaty_absolute = 1;
FloatyBox floaty_box = {FLOATY_BOX_RADIUS, FLOATY_BOX_BELOW, FLOATY_BOX_ABOVE, FLOATY_HOME};

static logVarId_t gyro_raw[3];
static bool gyro_found;
static FloatyGoal goal;  /* of absolute poses */
static FloatyGoal frame; /* that the estimate is in: the last pose's goal; W itself for corrections */
static volatile TickType_t controlled_tick;
static bool holding;    /* in this step the flight stands still */
static bool controlled; /* in this step the controller runs */

/* In ordinary memory: the macros of static_mem.h would put it into CCM, which is full. */
static StaticQueue_t pose_queue_buffer;
static uint8_t pose_queue_storage[POSE_QUEUE * sizeof(FloatyPose)];
static QueueHandle_t pose_queue;

static void request(int32_t wanted) {
  floaty_input.request = wanted;
  call_request();
}

void floaty_begin(void) {
  pose_queue = xQueueCreateStatic(POSE_QUEUE, sizeof(FloatyPose), pose_queue_storage, &pose_queue_buffer);
  floaty_core_init(&floaty_parameters);
  call_reset();
  request(FLOATY_REQUEST_ARM);
  call_control(); /* mode 0: hover */
  floaty_servos_init(floaty_control.count);
}

void floaty_hover(void) {
  FloatyControl control;
  memset(&control, 0, sizeof control);
  call_hover(&control);
  floaty_servos_write(control.count);
}

void floaty_lose_control(void) {
  call_lose_control();
  floaty_hover();
}

uint32_t floaty_controlled_tick(void) {
  return controlled_tick;
}

void floaty_queue_pose(const FloatyPose *pose) {
  FloatyPose oldest;
  while (xQueueSend(pose_queue, pose, 0) != pdTRUE) {
    if (xQueueReceive(pose_queue, &oldest, 0) == pdTRUE) {
      floaty_observed.overflows += 1;
    }
  }
}

bool floaty_poses_absolute(void) {
  return floaty_absolute && floaty_hil_mode() == FLOATY_HIL_OFF; /* a host in the loop sends corrections */
}

int32_t floaty_pose_clock_us(void) {
  return (int32_t)((uint32_t)usecTimestamp() - floaty_hil_held() * STEP_US);
}

static int32_t loop_us(void) {
  return (int32_t)((xTaskGetTickCount() - floaty_hil_held()) * STEP_US);
}

/* The estimator, in the stabilizer task */

static bool asked(volatile bool *request) {
  const bool was = *request;
  *request = false;
  return was;
}

static void hand_pose_to_core(FloatyPose *pose) {
  if (floaty_poses_absolute()) {
    floaty_goal_see(&goal, pose);
    frame = goal;
  } else {
    memset(&goal, 0, sizeof goal); /* not known */
    memset(&frame, 0, sizeof frame);
  }
  memcpy(floaty_input.pose_position, pose->position, sizeof floaty_input.pose_position);
  memcpy(floaty_input.pose_quaternion, pose->quaternion, sizeof floaty_input.pose_quaternion);
  floaty_input.pose_age_us = pose->age_us;
  floaty_input.pose_waited_us = (int32_t)((uint32_t)floaty_pose_clock_us() - (uint32_t)pose->arrival_us);
  floaty_input.now_us = loop_us();
  call_file_pose();
}

void floaty_gyro(int32_t counts[3]) {
  for (int axis = 0; axis < 3; axis++) {
    counts[axis] = gyro_found ? logGetInt(gyro_raw[axis]) : 0;
  }
}

static void take_measurements(stabilizerStep_t step) {
  FloatyPose pose;
  floaty_gyro(floaty_input.gyro);
  floaty_input.gyro_again = !floaty_hil_sample(floaty_input.gyro);
  memcpy(floaty_input.gyro_sample, floaty_input.gyro, sizeof floaty_input.gyro_sample);
  floaty_input.tick = (int32_t)step;
  controlled = call_begin_step() != 0;
  call_take_sample();
  if (controlled) {
    return; /* poses wait until the controller has run, as they do in the laboratory: it may see them in 1 to 11 ms */
  }
  while (xQueueReceive(pose_queue, &pose, 0) == pdTRUE) {
    hand_pose_to_core(&pose);
  }
}

/* For the firmware's commander and its log variables: in W when poses are, in degrees, pitch positive with the nose up. */
static void tell_state(state_t *state, stabilizerStep_t step) {
  const float *now = floaty_estimator.now;
  const float yaw = remainderf(now[8] + frame.yaw, TURN);
  const float cr = cosf(0.5f * now[6]), sr = sinf(0.5f * now[6]);
  const float cp = cosf(0.5f * now[7]), sp = sinf(0.5f * now[7]);
  const float cy = cosf(0.5f * yaw), sy = sinf(0.5f * yaw);
  float p[3], v[3];
  floaty_goal_turn(&frame, now, p);
  floaty_goal_turn(&frame, now + FLOATY_VELOCITY, v);
  state->position.timestamp = step;
  state->position.x = frame.position[0] + p[0];
  state->position.y = frame.position[1] + p[1];
  state->position.z = frame.position[2] + p[2];
  state->velocity.timestamp = step;
  state->velocity.x = v[0];
  state->velocity.y = v[1];
  state->velocity.z = v[2];
  state->attitude.timestamp = step;
  state->attitude.roll = DEGREES * now[6];
  state->attitude.pitch = -DEGREES * now[7];
  state->attitude.yaw = DEGREES * yaw;
  state->attitudeQuaternion.w = cr * cp * cy + sr * sp * sy;
  state->attitudeQuaternion.x = sr * cp * cy - cr * sp * sy;
  state->attitudeQuaternion.y = cr * sp * cy + sr * cp * sy;
  state->attitudeQuaternion.z = cr * cp * sy - sr * sp * cy;
}

static void observe(void) {
  const FloatyEstimator *e = &floaty_estimator;
  const int32_t rejected = e->refused + e->too_old + e->invalid;
  for (int i = 0; i < 4; i++) {
    floaty_observed.flap[i] = e->now[12 + i] + (floaty_control.flap[i] - floaty_control.command[i]);
  }
  const int32_t age = e->pose_age_us / 100;
  floaty_observed.age = (uint16_t)(age < UINT16_MAX ? age : UINT16_MAX);
  floaty_observed.rejected = (uint16_t)rejected;
  floaty_observed.poses = (uint16_t)(e->fused + e->jumps + rejected);
}

static bool find_gyro(void) {
  gyro_raw[0] = logGetVarId("gyro", "xRaw");
  gyro_raw[1] = logGetVarId("gyro", "yRaw");
  gyro_raw[2] = logGetVarId("gyro", "zRaw");
  /* The variables are there with another sensor on board, too, and then stay at zero. */
  return platformConfigGetSensorImplementation() == SensorImplementation_bmi088_bmp3xx && logVarIdIsValid(gyro_raw[0]) &&
         logVarIdIsValid(gyro_raw[1]) && logVarIdIsValid(gyro_raw[2]);
}

/* The firmware calls this at start, when the EEPROM has been read, and whenever a client writes stabilizer.estimator,
 * although the build forces this estimator: then it flies on. */
void estimatorOutOfTreeInit(void) {
  if (stateEstimatorGetType() == StateEstimatorTypeOutOfTree) {
    return;
  }
  gyro_found = find_gyro();
  floaty_requests.reset = true;
  floaty_toc_apply();
  floaty_hover(); /* with the trims of the EEPROM */
}

/* When this fails the firmware starts neither the stabilizer nor the app: the console has to hear of it here. */
bool estimatorOutOfTreeTest(void) {
  if (!gyro_found) {
    DEBUG_PRINT("no raw counts of a BMI088: flaps stay at hover\n");
  }
  return gyro_found;
}

/* Another gyro measures from now on, and what was flown before is over. */
static void begin_afresh(void) {
  FloatyPose pose;
  while (xQueueReceive(pose_queue, &pose, 0) == pdTRUE) {
    /* of another flight */
  }
  call_begin_afresh();
  call_reset();
  floaty_hover();
}

void estimatorOutOfTree(state_t *state, const stabilizerStep_t stabilizerStep) {
  measurement_t measurement;
  while (estimatorDequeue(&measurement)) {
    /* Gyro and accelerometer as the firmware filters them, and whatever a deck measures: not needed here. */
  }
  if (!gyro_found) {
    return; /* without a gyro Floaty stays calibrating, flaps at hover */
  }
  if (floaty_hil_switched()) {
    begin_afresh();
  }
  holding = floaty_hil_holds();
  if (holding) {
    return;
  }
  if (asked(&floaty_requests.reset)) {
    call_reset();
  }
  if (floaty_poses_absolute() && floaty_supervisor.state == FLOATY_STATE_FLYING) {
    /* The firmware's supervisor, which looks at this next, takes more than the idle thrust for a flight; else it would
     * disarm and stop its commander 30 s after arming. One more is less than a step of the motors' PWM: no pulse. */
    const uint32_t idle = powerDistributionGetIdleThrust();
    motorsSetRatio(MOTOR_M4, (uint16_t)(idle < UINT16_MAX ? idle + 1 : UINT16_MAX));
  }
  take_measurements(stabilizerStep - floaty_hil_held());
  if (floaty_sampling.estimate_due) {
    call_estimate();
    tell_state(state, stabilizerStep);
    observe();
  }
}

/* The controller, in the stabilizer task */

static void serve_requests(void) {
  if (asked(&floaty_requests.recover)) {
    request(FLOATY_REQUEST_RECOVER);
  }
  if (asked(&floaty_requests.arm)) {
    request(FLOATY_REQUEST_ARM);
  }
  if (asked(&floaty_requests.disarm)) {
    request(FLOATY_REQUEST_DISARM);
  }
  if (asked(&floaty_requests.stop)) {
    request(FLOATY_REQUEST_STOP);
  }
  /* The firmware's own stop, by ports 6 and 9, their watchdogs or stabilizer.stop. */
  if (crtpSupervisorIsEmergencyStopRequested() || supervisorIsLocked()) {
    request(FLOATY_REQUEST_LOCK);
  }
}

void controllerOutOfTreeInit(void) {}

bool controllerOutOfTreeTest(void) {
  return true;
}

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const stabilizerStep_t stabilizerStep) {
  (void)sensors;
  (void)state;
  memset(control, 0, sizeof *control); /* no motors */
  floaty_input.now_us = loop_us();
  serve_requests();
  floaty_observed.setpoint = floaty_setpoint_kind(setpoint);
  if (floaty_observed.setpoint == FLOATY_SETPOINT_POSITION && !floaty_goal_move(&goal, setpoint, &floaty_box)) {
    floaty_observed.setpoint = FLOATY_SETPOINT_OUTSIDE;
  }
  if (holding) {
    controlled_tick = xTaskGetTickCount(); /* nothing is wrong with the loop */
  } else if (controlled) {
    floaty_input.connected = crtpIsConnected();
    call_supervise();
    call_control();
    if (floaty_hil_mode() != FLOATY_HIL_STILL) {
      floaty_servos_write(floaty_control.count);
    }
    floaty_hil_tell(true);
    controlled_tick = xTaskGetTickCount();
  }
  if (stabilizerStep % BATTERY_STEPS == 0) {
    floaty_input.battery_mv = (int32_t)(1000.0f * pmGetBatteryVoltage());
  }
}
