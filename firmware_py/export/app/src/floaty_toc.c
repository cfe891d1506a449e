/* Parameters and log variables, with the names of the laboratory's board (firmware_py/parameters.py, variables.py).
 *
 * A client writes into a variable of this file; only a value inside the limits goes on to the core or the supervisor, any
 * other is put back. Names that the firmware has already are left to it; Floaty's own are then in the group `floaty` or
 * `FloatyKalm`. Their angles are radians.
 */
#define DEBUG_MODULE "FLOATY"

#include "floaty_calls.h"

#include "debug.h"
#include "log.h"
#include "param.h"

#include "floaty_settings.h"

typedef enum { KIND_F32, KIND_I32, KIND_U16, KIND_I16, KIND_U8 } Kind;

typedef struct {
  const char *name;
  void *seen;     /* what the client reads and writes */
  void *target;   /* what it stands for: target = scale * seen */
  float scale;
  float low, high; /* inclusive, of `seen` */
  float initial;   /* of `seen`: from the profile */
  uint8_t seen_kind, target_kind;
} Parameter;

/* The profile's values are the defaults that clients see. */
/* @variables */

static const Parameter PARAMETERS[] = {
/* @table */
};

#define COUNT (sizeof PARAMETERS / sizeof PARAMETERS[0])

static float in_force[COUNT]; /* of `seen`, as last applied */

static float get(const void *variable, uint8_t kind) {
  switch (kind) {
    case KIND_F32: return *(const float *)variable;
    case KIND_I32: return (float)*(const int32_t *)variable;
    case KIND_U16: return (float)*(const uint16_t *)variable;
    case KIND_I16: return (float)*(const int16_t *)variable;
    default: return (float)*(const uint8_t *)variable;
  }
}

static void put(void *variable, uint8_t kind, float value) {
  switch (kind) {
    case KIND_F32: *(float *)variable = value; break;
    case KIND_I32: *(int32_t *)variable = (int32_t)value; break;
    case KIND_U16: *(uint16_t *)variable = (uint16_t)value; break;
    case KIND_I16: *(int16_t *)variable = (int16_t)value; break;
    default: *(uint8_t *)variable = (uint8_t)value; break;
  }
}

/* In the task that writes parameters. Two names may stand for the same target: the one that changed wins. */
void floaty_toc_apply(void) {
  static bool started;
  for (unsigned i = 0; i < COUNT; i++) {
    const Parameter *p = &PARAMETERS[i];
    if (!started) {
      in_force[i] = p->initial;
    }
    const float value = get(p->seen, p->seen_kind);
    if (value != in_force[i] && value >= p->low && value <= p->high) {
      put(p->target, p->target_kind, p->scale * value);
    }
  }
  started = true;
  for (unsigned i = 0; i < COUNT; i++) {
    const Parameter *p = &PARAMETERS[i];
    put(p->seen, p->seen_kind, get(p->target, p->target_kind) / p->scale);
    in_force[i] = get(p->seen, p->seen_kind);
  }
}

void floaty_toc_report(void) {
  int different = 0;
  for (unsigned i = 0; i < COUNT; i++) {
    different += in_force[i] != PARAMETERS[i].initial;
  }
  if (different == 0) {
    return;
  }
  DEBUG_PRINT("%d parameters from the EEPROM, not from profile %s:", different, FLOATY_PROFILE_NAME);
  for (unsigned i = 0; i < COUNT; i++) {
    if (in_force[i] != PARAMETERS[i].initial) {
      eprintf(consolePutchar, " %s", PARAMETERS[i].name);
    }
  }
  eprintf(consolePutchar, "\n");
}

static uint8_t stop_wanted, armed_wanted = 1, reset_wanted;

/* Hands a switch on as one of two requests; what is neither 0 nor 1 is put back. */
static void switch_written(uint8_t *wanted, uint8_t *before, volatile bool *on, volatile bool *off) {
  if (*wanted > 1) {
    *wanted = *before;
    return;
  }
  *before = *wanted;
  *(*wanted ? on : off) = true;
}

static void stop_written(void) {
  static uint8_t before;
  switch_written(&stop_wanted, &before, &floaty_requests.stop, &floaty_requests.recover);
}

static void armed_written(void) {
  static uint8_t before = 1;
  switch_written(&armed_wanted, &before, &floaty_requests.arm, &floaty_requests.disarm);
}

static void reset_written(void) {
  if (reset_wanted) {
    floaty_requests.reset = true;
  }
  reset_wanted = 0;
}

/* @groups */

PARAM_GROUP_START(floaty)
/* 1: emergency stop. 0: leave it. */
PARAM_ADD_WITH_CALLBACK(PARAM_UINT8, stop, &stop_wanted, stop_written)
/* 0: flaps to hover until 1 is written. */
PARAM_ADD_WITH_CALLBACK(PARAM_UINT8, armed, &armed_wanted, armed_written)
/* 1: start the estimator afresh. */
PARAM_ADD_WITH_CALLBACK(PARAM_UINT8, reset, &reset_wanted, reset_written)
PARAM_GROUP_STOP(floaty)

/* The firmware itself logs stateEstimate.x y z vx vy vz roll pitch yaw qx qy qz qw, and motor.m1..m4 of its own motors. */
LOG_GROUP_START(stateEstimate)
LOG_ADD(LOG_FLOAT, roll_rate, &floaty_estimator.now[FLOATY_RATE])
LOG_ADD(LOG_FLOAT, pitch_rate, &floaty_estimator.now[FLOATY_RATE + 1])
LOG_ADD(LOG_FLOAT, yaw_rate, &floaty_estimator.now[FLOATY_RATE + 2])
LOG_ADD(LOG_FLOAT, flap_1, &floaty_observed.flap[0])
LOG_ADD(LOG_FLOAT, flap_2, &floaty_observed.flap[1])
LOG_ADD(LOG_FLOAT, flap_3, &floaty_observed.flap[2])
LOG_ADD(LOG_FLOAT, flap_4, &floaty_observed.flap[3])
LOG_GROUP_STOP(stateEstimate)

LOG_GROUP_START(floaty)
LOG_ADD(LOG_UINT16, m1, &floaty_control.count[0])
LOG_ADD(LOG_UINT16, m2, &floaty_control.count[1])
LOG_ADD(LOG_UINT16, m3, &floaty_control.count[2])
LOG_ADD(LOG_UINT16, m4, &floaty_control.count[3])
LOG_ADD(LOG_UINT32, malformed, &floaty_observed.malformed)
LOG_ADD(LOG_UINT32, overflows, &floaty_observed.overflows)
LOG_ADD(LOG_UINT32, staleHovers, &floaty_observed.stale_hovers)
LOG_ADD(LOG_UINT8, stopped, &floaty_supervisor.stopped)
LOG_ADD(LOG_UINT8, armed, &floaty_supervisor.armed)
LOG_ADD(LOG_UINT8, calibrated, &floaty_supervisor.calibrated)
LOG_GROUP_STOP(floaty)

LOG_GROUP_START(controller)
LOG_ADD(LOG_FLOAT, u1, &floaty_control.u[0])
LOG_ADD(LOG_FLOAT, u2, &floaty_control.u[1])
LOG_ADD(LOG_FLOAT, u3, &floaty_control.u[2])
LOG_ADD(LOG_FLOAT, u4, &floaty_control.u[3])
LOG_ADD(LOG_FLOAT, m1, &floaty_control.command[0])
LOG_ADD(LOG_FLOAT, m2, &floaty_control.command[1])
LOG_ADD(LOG_FLOAT, m3, &floaty_control.command[2])
LOG_ADD(LOG_FLOAT, m4, &floaty_control.command[3])
LOG_GROUP_STOP(controller)

LOG_GROUP_START(motors_ctrp)
LOG_ADD(LOG_FLOAT, m1, &floaty_control.flap[0])
LOG_ADD(LOG_FLOAT, m2, &floaty_control.flap[1])
LOG_ADD(LOG_FLOAT, m3, &floaty_control.flap[2])
LOG_ADD(LOG_FLOAT, m4, &floaty_control.flap[3])
LOG_GROUP_STOP(motors_ctrp)

LOG_GROUP_START(excite)
LOG_ADD(LOG_FLOAT, u1, &floaty_control.excitation[0])
LOG_ADD(LOG_FLOAT, u2, &floaty_control.excitation[1])
LOG_ADD(LOG_FLOAT, u3, &floaty_control.excitation[2])
LOG_ADD(LOG_FLOAT, u4, &floaty_control.excitation[3])
LOG_GROUP_STOP(excite)

LOG_GROUP_START(Error)
LOG_ADD(LOG_FLOAT, int_z_err, &floaty_control.integral_z)
LOG_GROUP_STOP(Error)

LOG_GROUP_START(supervisor)
LOG_ADD(LOG_UINT8, state, &floaty_supervisor.state)
LOG_ADD(LOG_UINT8, cause, &floaty_supervisor.cause)
LOG_GROUP_STOP(supervisor)

LOG_GROUP_START(locSrv)
LOG_ADD(LOG_UINT16, age, &floaty_observed.age)
LOG_ADD(LOG_UINT16, poses, &floaty_observed.poses)
LOG_ADD(LOG_UINT16, rejected, &floaty_observed.rejected)
LOG_GROUP_STOP(locSrv)

LOG_GROUP_START(kalman)
LOG_ADD(LOG_UINT32, fused, &floaty_estimator.fused)
LOG_ADD(LOG_UINT32, refused, &floaty_estimator.refused)
LOG_ADD(LOG_UINT32, jumps, &floaty_estimator.jumps)
LOG_ADD(LOG_UINT32, too_old, &floaty_estimator.too_old)
LOG_ADD(LOG_UINT32, invalid, &floaty_estimator.invalid)
LOG_ADD(LOG_UINT32, bounded, &floaty_estimator.bounded)
LOG_ADD(LOG_UINT32, resets, &floaty_estimator.resets)
LOG_GROUP_STOP(kalman)

LOG_GROUP_START(Uncertainty)
LOG_ADD(LOG_FLOAT, P_x_x, &floaty_estimator.P[0][0])
LOG_ADD(LOG_FLOAT, P_x_vx, &floaty_estimator.P[0][FLOATY_VELOCITY])
LOG_ADD(LOG_FLOAT, P_vx_vx, &floaty_estimator.P[FLOATY_VELOCITY][FLOATY_VELOCITY])
LOG_GROUP_STOP(Uncertainty)

/* @logs */

LOG_GROUP_START(delayComp)
LOG_ADD(LOG_UINT8, horizon, &floaty_estimator.horizon)
LOG_GROUP_STOP(delayComp)
