/* Decides, before every controller step, whether the loop may be closed; the same machine as firmware_py/supervisor.py,
 * but for the watchdog of the emergency stop, which is the firmware's.
 *
 * Pure: no firmware API. Time is int64 microseconds and arrives as an argument; it never runs back.
 */
#pragma once

#include <stdbool.h>
#include <stdint.h>

typedef enum {
  FLOATY_CALIBRATING = 0, /* the gyro's zero is unknown: flaps at hover */
  FLOATY_WAITING = 1,     /* no pose has come yet: flaps at hover */
  FLOATY_FLYING = 2,      /* loop closed */
  FLOATY_FAILSAFE = 3,    /* flaps at hover, see the cause */
} FloatyState;

typedef enum {
  FLOATY_NONE = 0,
  FLOATY_SILENCE = 1,
  FLOATY_OUT_OF_BOUNDS = 2,
  FLOATY_EMERGENCY_STOP = 3,
  FLOATY_LOW_BATTERY = 4,
  FLOATY_DISARMED = 5,
  FLOATY_NO_CONTROL = 6, /* no controller step comes: the loop stands still, or another controller runs */
  FLOATY_CONTROLLER_NOT_FINITE = 7, /* own logic put out NaN or infinity */
  FLOATY_ESTIMATOR_NOT_FINITE = 8,
} FloatyCause;

typedef enum {
  FLOATY_MANUAL_OFF = 0,
  FLOATY_MANUAL_ANGLES = 1, /* angles from outside, whether poses come or not */
  FLOATY_MANUAL_HOVER = 2,
} FloatyManual;

typedef struct {
  int64_t last_pose_us; /* meaningless until `pose_seen` */
  int64_t battery_good_us;
  int64_t episode_start_us;
  int64_t bounded_us;
  int64_t outside_until_us;
  int32_t pose_timeout_us;
  int32_t low_battery_mv;
  int32_t battery_mv;
  int32_t bounded; /* the estimator's counter when it was last looked at */
  int32_t controller_faults; /* of own logic, when they were last looked at */
  int32_t estimator_faults;
  uint8_t state;   /* FloatyState */
  uint8_t cause;   /* FloatyCause */
  uint8_t manual;  /* FloatyManual */
  bool calibrated;
  bool armed;
  bool pose_seen;
  bool stopped;
  bool battery_empty;
  uint8_t not_finite; /* FloatyCause */
} FloatySupervisor;

/* Starts calibrating and armed. */
void floaty_supervisor_init(FloatySupervisor *self, int32_t pose_timeout_us, int32_t low_battery_mv);

/* Returns the core's mode: 0 hover, 1 fly, 2 manual. `bounded` counts how often the estimator was held at a bound. */
int32_t floaty_supervisor_mode(FloatySupervisor *self, int64_t now_us, int32_t bounded);

/* Arms or disarms; false when the request to arm was refused. */
bool floaty_supervisor_arm(FloatySupervisor *self, bool armed);

/* Leaves what lasts: stop, logic that failed, and with a good voltage the low battery; false when one remains. */
bool floaty_supervisor_recover(FloatySupervisor *self, int64_t now_us);

/* Takes in how often own logic has put out NaN or infinity. */
void floaty_supervisor_see_logic(FloatySupervisor *self, int32_t controller_faults, int32_t estimator_faults);

/* Takes in the supply voltage. */
void floaty_supervisor_see_battery(FloatySupervisor *self, int64_t now_us, int32_t battery_mv);

/* Says that nobody asks for the mode any more; the next call of floaty_supervisor_mode says otherwise. */
void floaty_supervisor_lose_control(FloatySupervisor *self);
