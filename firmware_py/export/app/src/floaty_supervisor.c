/* See floaty_supervisor.h. */
#include "floaty_supervisor.h"

#include <string.h>

#define BATTERY_LOW_US 5000000
#define EPISODE_GAP_US 50000 /* two bounded steps closer than this belong to one episode */
#define EPISODE_LIMIT_US 200000
#define BOUNDS_RECOVERY_US 500000
#define NEVER_US (-((int64_t)1 << 40))

#define MODE_HOVER 0
#define MODE_FLY 1
#define MODE_MANUAL 2

void floaty_supervisor_init(FloatySupervisor *self, int32_t pose_timeout_us, int32_t low_battery_mv) {
  memset(self, 0, sizeof *self);
  self->pose_timeout_us = pose_timeout_us;
  self->low_battery_mv = low_battery_mv;
  self->armed = true;
  self->episode_start_us = NEVER_US;
  self->bounded_us = NEVER_US;
  self->outside_until_us = NEVER_US;
}

static void watch_bounds(FloatySupervisor *self, int64_t now_us, int32_t bounded) {
  if (bounded == self->bounded) {
    return;
  }
  self->bounded = bounded;
  if (now_us - self->bounded_us > EPISODE_GAP_US) {
    self->episode_start_us = now_us;
  }
  self->bounded_us = now_us;
  if (now_us - self->episode_start_us >= EPISODE_LIMIT_US || now_us < self->outside_until_us) {
    self->outside_until_us = now_us + BOUNDS_RECOVERY_US;
  }
}

static FloatyCause cause_of_failsafe(const FloatySupervisor *self, int64_t now_us) {
  if (self->stopped) {
    return FLOATY_EMERGENCY_STOP;
  }
  if (self->not_finite != FLOATY_NONE) {
    return (FloatyCause)self->not_finite;
  }
  if (self->battery_empty) {
    return FLOATY_LOW_BATTERY;
  }
  if (!self->armed) {
    return FLOATY_DISARMED;
  }
  if (!self->calibrated || !self->pose_seen) {
    return FLOATY_NONE;
  }
  if (now_us - self->last_pose_us >= self->pose_timeout_us) {
    return FLOATY_SILENCE;
  }
  return now_us < self->outside_until_us ? FLOATY_OUT_OF_BOUNDS : FLOATY_NONE;
}

int32_t floaty_supervisor_mode(FloatySupervisor *self, int64_t now_us, int32_t bounded) {
  watch_bounds(self, now_us, bounded);
  self->cause = cause_of_failsafe(self, now_us);
  if (self->cause != FLOATY_NONE) {
    self->state = FLOATY_FAILSAFE;
  } else if (!self->calibrated) {
    self->state = FLOATY_CALIBRATING;
  } else {
    self->state = self->pose_seen ? FLOATY_FLYING : FLOATY_WAITING;
  }
  if (self->cause > FLOATY_OUT_OF_BOUNDS || self->manual == FLOATY_MANUAL_HOVER) {
    return MODE_HOVER;
  }
  if (self->manual == FLOATY_MANUAL_ANGLES) {
    return MODE_MANUAL;
  }
  return self->state == FLOATY_FLYING ? MODE_FLY : MODE_HOVER;
}

bool floaty_supervisor_arm(FloatySupervisor *self, bool armed) {
  if (armed && (self->stopped || self->battery_empty || self->not_finite != FLOATY_NONE)) {
    return false;
  }
  self->armed = armed;
  return true;
}

bool floaty_supervisor_recover(FloatySupervisor *self, int64_t now_us) {
  self->stopped = false;
  self->not_finite = FLOATY_NONE;
  if (self->battery_mv >= self->low_battery_mv) {
    self->battery_empty = false;
    self->battery_good_us = now_us;
  }
  return !self->battery_empty;
}

void floaty_supervisor_see_logic(FloatySupervisor *self, int32_t controller_faults, int32_t estimator_faults) {
  if (estimator_faults > self->estimator_faults) {
    self->not_finite = FLOATY_ESTIMATOR_NOT_FINITE;
  } else if (controller_faults > self->controller_faults) {
    self->not_finite = FLOATY_CONTROLLER_NOT_FINITE;
  }
  self->controller_faults = controller_faults;
  self->estimator_faults = estimator_faults;
}

void floaty_supervisor_see_battery(FloatySupervisor *self, int64_t now_us, int32_t battery_mv) {
  self->battery_mv = battery_mv;
  if (battery_mv >= self->low_battery_mv) {
    self->battery_good_us = now_us;
  } else if (now_us - self->battery_good_us >= BATTERY_LOW_US) {
    self->battery_empty = true;
  }
}

void floaty_supervisor_lose_control(FloatySupervisor *self) {
  self->state = FLOATY_FAILSAFE;
  self->cause = FLOATY_NO_CONTROL;
}
