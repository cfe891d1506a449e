/* Floaty as out-of-tree estimator and controller of the Crazyflie firmware.
 *
 * The stabilizer task calls both 1000 times per second, after each IMU sample, and all of the core from there. The core
 * makes all decisions in flight; it gets samples, poses, requests and the time here, and its counts go to the timers.
 *
 * Gyro: the core takes raw counts. The BMI088 driver shows them as the log variables gyro.xRaw, yRaw, zRaw, which are
 * new in each step; neither the firmware's low-pass nor its bias is in between. So the same counts, poses and instants
 * give the same results as in the laboratory, bit for bit.
 *
 * Time: timeouts count ticks, which nobody can set. The wait of a pose is measured in microseconds,
 * by a clock that the parameter usec.reset sets to zero. Both are passed as 32 bits, which wrap. With hardware in the
 * loop, both stop while a sample of the host is missing: floaty_hil.c.
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
#include "crtp_commander_high_level.h"
#include "crtp_supervisor.h"
#include "debug.h"
#include "estimator.h"
#include "log.h"
#include "motors.h"
#include "planner.h"
#include "platform.h"
#include "pm.h"
#include "power_distribution.h"
#include "supervisor.h"
#include "usec_time.h"

#include "floaty_settings.h"

#define STEP_US 1000
#define BATTERY_STEPS 100
#define POSE_QUEUE 8
#define DEGREES 57.2957795f /* per radian */
#define RADIANS 0.0174532925f /* per degree */

FloatyParameters floaty_parameters;
FloatyInput floaty_input;
FloatyEstimator floaty_estimator;
FloatyControl floaty_control;
FloatySampling floaty_sampling;
FloatySupervisor floaty_supervisor;
FloatyReport floaty_report;
FloatyObserved floaty_observed;
volatile bool floaty_requests[FLOATY_REQUEST_DISARM + 1];

static logVarId_t gyro_raw[3];
static bool gyro_found;
static bool controlled; /* the controller runs in this step */

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
  floaty_input.absolute = 1; /* as Bitcraze's programs send poses */
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

void floaty_queue_pose(const FloatyPose *pose) {
  FloatyPose oldest;
  while (xQueueSend(pose_queue, pose, 0) != pdTRUE) {
    if (xQueueReceive(pose_queue, &oldest, 0) == pdTRUE) {
      floaty_observed.overflows += 1;
    }
  }
}

int32_t floaty_pose_clock_us(void) {
  return (int32_t)((uint32_t)usecTimestamp() - floaty_hil_held * STEP_US);
}

int32_t floaty_loop_us(void) {
  return (int32_t)((xTaskGetTickCount() - floaty_hil_held) * STEP_US);
}

/* The estimator, in the stabilizer task */

/* Disarm and arm together with the firmware's supervisor, which arms itself: a client's disarming lasts until it arms. */
static void match_arming(void) {
  static bool held, waits; /* the firmware's supervisor is kept disarmed, and waits for the request to arm */
  const bool armed = supervisorIsArmed();
  if (floaty_supervisor.armed && armed) {
    held = waits = false;
  } else if (floaty_supervisor.armed && held) {
    supervisorRequestArming(true);
  } else if (floaty_supervisor.armed && (supervisorCanFly() || supervisorCanArm())) {
    request(FLOATY_REQUEST_DISARM);
  } else if (armed && waits) {
    request(FLOATY_REQUEST_ARM);
  }
  if (!floaty_supervisor.armed) {
    supervisorRequestArming(false);
    held = true;
    waits = supervisorCanArm();
  }
}

/* A path that gives no position silences the firmware's commander, which would lock the board: end it. */
static void end_silent_path(void) {
  if (crtpCommanderHighLevelGetPlannerState() == TRAJECTORY_STATE_DISABLED) {
    crtpCommanderHighLevelStop();
  }
}

static bool take_request(int32_t wanted) {
  const bool was = floaty_requests[wanted];
  floaty_requests[wanted] = false;
  return was;
}

static void hand_pose_to_core(const FloatyPose *pose) {
  memcpy(floaty_input.pose_position, pose->position, sizeof floaty_input.pose_position);
  memcpy(floaty_input.pose_quaternion, pose->quaternion, sizeof floaty_input.pose_quaternion);
  floaty_input.pose_age_us = pose->age_us;
  floaty_input.pose_waited_us = (int32_t)((uint32_t)floaty_pose_clock_us() - (uint32_t)pose->arrival_us);
  floaty_input.now_us = floaty_loop_us();
  const int32_t answer = call_file_pose();
  if (answer == FLOATY_POSE_NO_CORRECTION) {
    memcpy(floaty_observed.no_correction, pose->position, sizeof floaty_observed.no_correction);
  } else if (answer == FLOATY_POSE_TOO_OLD && floaty_input.pose_age_us > FLOATY_HORIZON_LIMIT * FLOATY_TICK_US) {
    floaty_observed.too_old_us = floaty_input.pose_age_us;
    floaty_observed.too_old += 1;
  }
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
  floaty_input.tick = (int32_t)step;
  controlled = call_begin_step() != 0;
  call_take_sample();
  if (controlled) {
    return; /* poses wait until the controller has run, as in the laboratory: they take effect in 1 to 11 ms */
  }
  while (xQueueReceive(pose_queue, &pose, 0) == pdTRUE) {
    hand_pose_to_core(&pose);
  }
}

/* For the firmware's commander and its log variables: in degrees, pitch positive with the nose up. */
static void publish_state(state_t *state, stabilizerStep_t step) {
  const FloatyReport *r = &floaty_report;
  state->position = (point_t){step, r->position[0], r->position[1], r->position[2]};
  state->velocity = (point_t){step, r->velocity[0], r->velocity[1], r->velocity[2]};
  state->attitude = (attitude_t){step, DEGREES * r->attitude[0], -DEGREES * r->attitude[1], DEGREES * r->attitude[2]};
  const float *q = r->quaternion;
  state->attitudeQuaternion = (quaternion_t){.x = q[1], .y = q[2], .z = q[3], .w = q[0]};
}

static bool find_gyro(void) {
  gyro_raw[0] = logGetVarId("gyro", "xRaw");
  gyro_raw[1] = logGetVarId("gyro", "yRaw");
  gyro_raw[2] = logGetVarId("gyro", "zRaw");
  /* With another sensor on board the variables exist, too, but stay zero. */
  return platformConfigGetSensorImplementation() == SensorImplementation_bmi088_bmp3xx && logVarIdIsValid(gyro_raw[0]) &&
         logVarIdIsValid(gyro_raw[1]) && logVarIdIsValid(gyro_raw[2]);
}

/* The firmware calls this at start, when the EEPROM has been read, and whenever a client writes stabilizer.estimator,
 * although the build forces this estimator: the flight goes on. */
void estimatorOutOfTreeInit(void) {
  if (stateEstimatorGetType() == StateEstimatorTypeOutOfTree) {
    return;
  }
  gyro_found = find_gyro();
  floaty_requests[FLOATY_RESET] = true;
  floaty_toc_apply();
  floaty_hover(); /* with the trims of the EEPROM */
}

/* When this fails the firmware starts neither the stabilizer nor the app: so it is reported here. */
bool estimatorOutOfTreeTest(void) {
  if (!gyro_found) {
    DEBUG_PRINT("no raw counts of a BMI088: flaps stay at hover\n");
  }
  return gyro_found;
}

/* Start again for another gyro, and forget the last flight. */
static void restart(void) {
  xQueueReset(pose_queue);
  call_restart();
  call_reset();
  floaty_hover();
}

void estimatorOutOfTree(state_t *state, const stabilizerStep_t stabilizerStep) {
  measurement_t measurement;
  while (estimatorDequeue(&measurement)) {
    /* Drop them: the firmware's filtered gyro and accelerometer, and measurements of decks. */
  }
  if (!gyro_found) {
    return; /* without a gyro Floaty stays calibrating, flaps at hover */
  }
  match_arming();
  end_silent_path();
  if (floaty_hil_switched()) {
    restart();
  }
  controlled = false;
  if (floaty_hil_holds()) {
    return;
  }
  if (take_request(FLOATY_RESET)) {
    call_reset();
  }
  floaty_input.poses_absolute = floaty_input.absolute && floaty_hil_mode == FLOATY_HIL_OFF; /* a host sends corrections */
  /* The firmware's supervisor reads this next and counts more than the idle thrust as a flight; otherwise it would
   * disarm and stop its commander 30 s after arming. One more is less than a step of the motors' PWM: no pulse. */
  motorsSetRatio(MOTOR_M4, (uint16_t)(floaty_supervisor.led ? powerDistributionGetIdleThrust() + 1 : 0));
  take_measurements(stabilizerStep - floaty_hil_held);
  if (floaty_sampling.estimate_due) {
    call_estimate();
    publish_state(state, stabilizerStep);
  }
}

/* The controller, in the stabilizer task */

static void serve_requests(void) {
  static const int32_t ORDER[] = {FLOATY_REQUEST_RECOVER, FLOATY_REQUEST_ARM, FLOATY_REQUEST_DISARM, FLOATY_REQUEST_STOP};
  for (unsigned i = 0; i < sizeof ORDER / sizeof ORDER[0]; i++) {
    if (take_request(ORDER[i])) {
      request(ORDER[i]);
    }
  }
  /* The firmware's own stop, by ports 6 and 9, their watchdogs or stabilizer.stop. */
  if (crtpSupervisorIsEmergencyStopRequested() || supervisorIsLocked()) {
    request(FLOATY_REQUEST_LOCK);
  }
}

/* The stock commander's set-point in the core's terms. */
static void read_setpoint(const setpoint_t *setpoint) {
  const setpoint_mode_t *mode = &setpoint->mode;
  const quaternion_t *q = &setpoint->attitudeQuaternion;
  const bool place = mode->x == modeAbs && mode->y == modeAbs && mode->z == modeAbs;
  const bool any = mode->x || mode->y || mode->z || mode->roll || mode->pitch || mode->yaw || mode->quat;
  float yaw = mode->yaw == modeAbs ? RADIANS * setpoint->attitude.yaw : NAN;
  if (mode->quat == modeAbs) {
    yaw = atan2f(2.0f * (q->w * q->z + q->x * q->y), q->w * q->w + q->x * q->x - q->y * q->y - q->z * q->z);
  }
  if (place) {
    memcpy(floaty_commanded, (float[4]){setpoint->position.x, setpoint->position.y, setpoint->position.z, yaw},
           sizeof floaty_commanded);
  }
  floaty_input.setpoint_kind = place ? FLOATY_SETPOINT_POSITION : any ? FLOATY_SETPOINT_OTHER : FLOATY_SETPOINT_NONE;
  memcpy(floaty_input.setpoint, (float[4]){setpoint->position.x, setpoint->position.y, setpoint->position.z, yaw},
         sizeof floaty_input.setpoint);
  memcpy(floaty_input.setpoint_velocity, (float[3]){setpoint->velocity.x, setpoint->velocity.y, setpoint->velocity.z},
         sizeof floaty_input.setpoint_velocity);
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
  floaty_input.now_us = floaty_loop_us();
  serve_requests();
  read_setpoint(setpoint);
  floaty_observed.followed = call_follow();
  if (controlled) {
    floaty_input.connected = crtpIsConnected();
    call_sense();
    call_supervise();
    call_control();
    if (floaty_hil_mode != FLOATY_HIL_STILL) {
      floaty_servos_write(floaty_control.count);
    }
    floaty_hil_report(true);
  }
  if (stabilizerStep % BATTERY_STEPS == 0) {
    floaty_input.battery_mv = (int32_t)(1000.0f * pmGetBatteryVoltage());
  }
}
