/* See floaty_goal.h. */
#include "floaty_goal.h"

#include <math.h>

#define RADIANS 0.0174532925f /* per degree */

static float yaw_of(float w, float x, float y, float z) {
  return atan2f(2.0f * (w * z + x * y), w * w + x * x - y * y - z * z);
}

FloatySetpoint floaty_setpoint_kind(const setpoint_t *setpoint) {
  const setpoint_mode_t *mode = &setpoint->mode;
  if (mode->x == modeAbs && mode->y == modeAbs && mode->z == modeAbs) {
    const point_t *p = &setpoint->position;
    const bool finite = isfinite(p->x) && isfinite(p->y) && isfinite(p->z);
    return finite ? FLOATY_SETPOINT_POSITION : FLOATY_SETPOINT_OTHER;
  }
  const bool none = mode->x == modeDisable && mode->y == modeDisable && mode->z == modeDisable &&
                    mode->roll == modeDisable && mode->pitch == modeDisable && mode->yaw == modeDisable &&
                    mode->quat == modeDisable;
  return none ? FLOATY_SETPOINT_NONE : FLOATY_SETPOINT_OTHER;
}

static float excess(const FloatyBox *box, const float place[3]) {
  const float x = place[0] - box->home[0], y = place[1] - box->home[1], z = place[2] - box->home[2];
  return fmaxf(fmaxf(sqrtf(x * x + y * y) - box->radius, 0.0f), fmaxf(-z - box->below, z - box->above));
}

bool floaty_goal_move(FloatyGoal *goal, const setpoint_t *setpoint, const FloatyBox *box) {
  const float place[3] = {setpoint->position.x, setpoint->position.y, setpoint->position.z};
  if (excess(box, place) > (goal->known ? excess(box, goal->position) : 0.0f)) {
    return false;
  }
  const quaternion_t *q = &setpoint->attitudeQuaternion;
  float yaw = goal->yaw;
  if (setpoint->mode.quat == modeAbs) {
    yaw = yaw_of(q->w, q->x, q->y, q->z);
  } else if (setpoint->mode.yaw == modeAbs) {
    yaw = RADIANS * setpoint->attitude.yaw;
  }
  for (int i = 0; i < 3; i++) {
    goal->position[i] = place[i];
  }
  goal->yaw = isfinite(yaw) ? yaw : goal->yaw;
  goal->known = true;
  return true;
}

void floaty_goal_see(FloatyGoal *goal, FloatyPose *pose) {
  float *p = pose->position, *q = pose->quaternion;
  if (!goal->known) {
    for (int i = 0; i < 3; i++) {
      goal->position[i] = p[i];
    }
    goal->yaw = yaw_of(q[0], q[1], q[2], q[3]);
    goal->known = true;
  }
  const float dx = p[0] - goal->position[0], dy = p[1] - goal->position[1];
  const float c = cosf(goal->yaw), s = sinf(goal->yaw);
  p[0] = c * dx + s * dy; /* Rz(-yaw) (p_WB - p_WG) */
  p[1] = c * dy - s * dx;
  p[2] -= goal->position[2];
  const float ch = cosf(0.5f * goal->yaw), sh = sinf(0.5f * goal->yaw);
  const float w = q[0], x = q[1], y = q[2], z = q[3];
  q[0] = ch * w + sh * z; /* conjugate of q_WG, times q_WB */
  q[1] = ch * x + sh * y;
  q[2] = ch * y - sh * x;
  q[3] = ch * z - sh * w;
}

void floaty_goal_turn(const FloatyGoal *goal, const float vector_G[3], float vector_W[3]) {
  const float c = cosf(goal->yaw), s = sinf(goal->yaw);
  vector_W[0] = c * vector_G[0] - s * vector_G[1];
  vector_W[1] = s * vector_G[0] + c * vector_G[1];
  vector_W[2] = vector_G[2];
}
