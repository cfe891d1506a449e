/* The app beside the stabilizer task: start, received poses and requests, the console, detection of a stopped loop.
 *
 * appInit is the firmware's weak hook for an app's task. It runs some 0.1 s after a reset, before decks, sensors and
 * self-test: from then on the servos get pulses, and the self-test no longer sees the cause of a restart.
 *
 * Poses: packets of port 6 come here instead of to the firmware's own localisation service, because that ignores
 * the age behind an external pose. The app channel takes the bytes of one pose.
 */
#define DEBUG_MODULE "FLOATY"

#include "floaty_calls.h"

#include <math.h>
#include <string.h>

#include "FreeRTOS.h"
#include "task.h"

#include "app.h"
#include "app_channel.h"
#include "autoconf.h"
#include "cfassert.h"
#include "configblock.h"
#include "crtp.h"
#include "crtp_supervisor.h"
#include "debug.h"
#include "param.h"
#include "param_task.h"
#include "system.h"
#include "watchdog.h"

#include "floaty_settings.h"

#define POSE_SIZE (1 + 7 * sizeof(float))
#define PACKED_SIZE 11 /* last byte of the receiver's address, x y z [mm] as int16, quaternion in 32 bits */
#define PACKED_SHARE 1.3837706e-3f /* of one step in a component: 1 / (511 * sqrt(2)) */
#define LOOK_MS 20 /* between two checks that the controller runs */
#define POSE_LINE_MS 10000 /* between lines about refused poses */
#define SELF_TEST_MS 100
#define SELF_TEST_LOOKS 50 /* 5 s; the self-test ends 2.4 s after a reset, later with decks */

static bool restarted; /* by the watchdog or a failed assert */
static StackType_t stack[CONFIG_APP_STACKSIZE]; /* in ordinary memory: CCM is full */
static StaticTask_t task;

/* EXT_POSE, x y z [m], qx qy qz qw as little-endian float32, and perhaps the age in units of 0.5 ms: firmware_py/wire/crtp.py. */
static void receive_pose(const uint8_t *data, uint32_t length) {
  FloatyPose pose = {.arrival_us = floaty_pose_clock_us(), .age_us = -1}; /* unknown */
  if ((length != POSE_SIZE && length != POSE_SIZE + 1) || data[0] != FLOATY_EXT_POSE) {
    floaty_observed.malformed += 1;
    return;
  }
  memcpy(pose.position, data + 1, sizeof pose.position);
  memcpy(pose.quaternion + 1, data + 1 + sizeof pose.position, 3 * sizeof(float));
  memcpy(pose.quaternion, data + POSE_SIZE - sizeof(float), sizeof(float)); /* x y z w on the wire */
  if (length > POSE_SIZE && data[POSE_SIZE] != FLOATY_AGE_UNKNOWN_CODE) {
    pose.age_us = data[POSE_SIZE] * FLOATY_AGE_UNIT_US;
  }
  floaty_queue_pose(&pose);
}

/* "Smallest three", in the arithmetic of firmware_py/wire/localisation.py. */
static void unpack_quaternion(uint32_t packed, float wxyz[4]) {
  const int largest = (int)(packed >> 30); /* of x y z w */
  float squares = 0.0f;
  for (int i = 3; i >= 0; i--) {
    if (i != largest) {
      const float value = (float)(packed & 0x1FF) * PACKED_SHARE;
      wxyz[(i + 1) % 4] = (packed & 0x200) != 0 ? -value : value;
      squares += value * value;
      packed >>= 10;
    }
  }
  wxyz[(largest + 1) % 4] = sqrtf(fmaxf(0.0f, 1.0f - squares));
}

static void receive_packed_poses(const uint8_t *data, uint32_t length) {
  const uint8_t address = (uint8_t)configblockGetRadioAddress();
  if (length == 1 || (length - 1) % PACKED_SIZE != 0) {
    floaty_observed.malformed += 1;
    return;
  }
  for (const uint8_t *item = data + 1; item < data + length; item += PACKED_SIZE) {
    FloatyPose pose = {.arrival_us = floaty_pose_clock_us(), .age_us = -1}; /* unknown */
    int16_t millimetres[3];
    uint32_t packed;
    if (item[0] != address) {
      continue;
    }
    memcpy(millimetres, item + 1, sizeof millimetres);
    memcpy(&packed, item + 1 + sizeof millimetres, sizeof packed);
    for (int axis = 0; axis < 3; axis++) {
      pose.position[axis] = (float)millimetres[axis] / 1000.0f;
    }
    unpack_quaternion(packed, pose.quaternion);
    floaty_queue_pose(&pose);
  }
}

static void receive_localisation(CRTPPacket *packet) {
  if (packet->channel != FLOATY_CHANNEL_GENERIC || packet->size < 1) {
    return; /* a position without attitude is no pose */
  }
  if (packet->data[0] == FLOATY_EMERGENCY_STOP && packet->size == 1) {
    crtpSupervisorSetEmergencyStop(); /* as port 9 */
  } else if (packet->data[0] == FLOATY_EMERGENCY_STOP_WATCHDOG && packet->size == 1) {
    crtpSupervisorNotifyEmergencyStopWatchdog();
  } else if (packet->data[0] == FLOATY_EXT_POSE_PACKED) {
    receive_packed_poses(packet->data, packet->size);
  } else {
    receive_pose(packet->data, packet->size);
  }
}

static void announce_state(void) {
  static const char *const STATES[] = FLOATY_STATE_TEXTS, *const CAUSES[] = FLOATY_CAUSE_TEXTS;
  static int32_t state = FLOATY_STATE_CALIBRATING, cause = FLOATY_CAUSE_NONE;
  const int32_t new_state = floaty_supervisor.state, new_cause = floaty_supervisor.cause;
  if (new_state != state || new_cause != cause) {
    state = new_state;
    cause = new_cause;
    DEBUG_PRINT("supervisor: %s%s\n", STATES[state], CAUSES[cause]);
  }
}

static void announce_setpoint(void) {
  static const char *const REASONS[] = {
      [FLOATY_SETPOINT_OTHER] = "only positions are",
      [FLOATY_SETPOINT_OUTSIDE] = "it leaves the box, see box.radius, box.below and box.above",
      [FLOATY_SETPOINT_OF_CORRECTIONS] = "poses are corrections, see extPose.absolute",
  };
  static const char *refused;
  const char *why = REASONS[floaty_observed.followed];
  if (why != NULL && why != refused) {
    DEBUG_PRINT("set-point not followed: %s\n", why);
  }
  refused = why;
}

typedef struct {
  TickType_t announced;
  int32_t refused;
} PoseLine;

static bool line_is_due(PoseLine *line, int32_t refused) {
  const TickType_t now = xTaskGetTickCount();
  const bool due = refused != line->refused && (line->announced == 0 || now - line->announced >= M2T(POSE_LINE_MS));
  line->refused = refused;
  if (due) {
    line->announced = now;
  }
  return due;
}

static int centimetres(float length) {
  return (int)lrintf(100.0f * length);
}

/* The lines are those of the firmware in Python: firmware_py/firmware.py. */
static void announce_poses(void) {
  static PoseLine no_corrections, too_old, frozen, gated;
  const float *p = floaty_observed.no_correction;
  if (line_is_due(&no_corrections, floaty_estimator.no_corrections)) {
    DEBUG_PRINT("pose refused: %d %d %d cm is no correction; for absolute poses set extPose.absolute 1\n",
                centimetres(p[0]), centimetres(p[1]), centimetres(p[2]));
  }
  if (line_is_due(&too_old, floaty_observed.too_old)) {
    DEBUG_PRINT("poses %d ms old: at most %d ms\n", (int)((floaty_observed.too_old_us + 500) / 1000),
                FLOATY_HORIZON_LIMIT * FLOATY_TICK_US / 1000);
  }
  if (line_is_due(&frozen, floaty_estimator.frozen)) {
    DEBUG_PRINT("poses frozen: they stay the same although the robot turns\n");
  }
  if (line_is_due(&gated, floaty_estimator.refused)) {
    DEBUG_PRINT("pose refused: it is too far from the estimate\n");
  }
}

/* Detect a stopped loop, or a controller that is not Floaty's, which no other task would. */
static void watch_control(void) {
  floaty_input.now_us = floaty_loop_us();
  if (call_watch_control()) {
    floaty_observed.stale_hovers += 1;
    floaty_hover();
  }
}

static void wait_for_self_test(void) {
  while (!paramTest()) { /* the table of parameters is not ready yet */
    vTaskDelay(M2T(2));
  }
  const paramVarId_t passed = paramGetVarId("system", "selftestPassed");
  for (int looks = 1; paramGetInt(passed) != 1; looks++) {
    if (looks == SELF_TEST_LOOKS) {
      DEBUG_PRINT("self-test has not passed: flaps stay at hover, see above\n");
    }
    vTaskDelay(M2T(SELF_TEST_MS));
  }
  systemWaitStart();
}

static void app_task(void *unused) {
  uint8_t data[APPCHANNEL_MTU];
  (void)unused;

  wait_for_self_test();
  crtpRegisterPortCB(CRTP_PORT_LOCALIZATION, receive_localisation);
  floaty_commands_init();
  floaty_port_init();
  DEBUG_PRINT("core %s, profile %s %s\n", FLOATY_CORE_VERSION, FLOATY_PROFILE_NAME, floaty_profile_hash);
  floaty_toc_report();
  if (restarted) {
    DEBUG_PRINT("restarted by watchdog or assert, see above: flies on when the gyro has been still\n");
  }
  while (true) {
    const size_t length = appchannelReceiveDataPacket(data, sizeof data, LOOK_MS);
    if (length > 0) {
      receive_pose(data, (uint32_t)length);
    }
    watch_control();
    announce_state();
    announce_setpoint();
    announce_poses();
  }
}

void appInit(void) {
  floaty_begin();
  /* Each prints its warning and clears it; else the self-test would fail, and Floaty would never fly. */
  const bool after_watchdog = !watchdogNormalStartTest();
  const bool after_assert = !cfAssertNormalStartTest();
  restarted = after_watchdog || after_assert;
  floaty_supervisor.flown = restarted; /* perhaps in the air */
  xTaskCreateStatic(app_task, "APP", CONFIG_APP_STACKSIZE, NULL, CONFIG_APP_PRIORITY, stack, &task);
}
