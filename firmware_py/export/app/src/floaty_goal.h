/* Absolute poses: where to fly as the stock commander says it, and the error that is left to there.
 *
 * Frames as in the laboratory: W world, G goal (upright at the goal, turned by its yaw), B body. Pure but for the types.
 */
#pragma once

#include <stdbool.h>

#include "stabilizer_types.h"

#include "floaty_poses.h"

typedef struct {
  float position[3]; /* [m] p_WG */
  float yaw;         /* [rad] */
  bool known;        /* false: the next pose becomes the goal, so that Floaty holds where it is */
} FloatyGoal;

typedef enum {
  FLOATY_SETPOINT_NONE = 0,     /* nothing is commanded, the goal stays */
  FLOATY_SETPOINT_POSITION = 1, /* a position, perhaps with a yaw */
  FLOATY_SETPOINT_OTHER = 2,    /* attitude, rates, velocity, thrust: Floaty cannot follow */
  FLOATY_SETPOINT_OUTSIDE = 3,  /* a position outside the box */
} FloatySetpoint;

/* Where goals may be, an upright cylinder around home; firmware_py/box.py. */
typedef struct {
  float radius, below, above; /* [m] */
  float home[3];              /* [m] W */
} FloatyBox;

FloatySetpoint floaty_setpoint_kind(const setpoint_t *setpoint);

/* Moves the goal to a set-point that is FLOATY_SETPOINT_POSITION; a yaw that it does not command stays. False, and the goal
 * stays, when that would be further outside the box than the goal is. */
bool floaty_goal_move(FloatyGoal *goal, const setpoint_t *setpoint, const FloatyBox *box);

/* Turns a pose in W into the pose in G; geometry.in_goal_frame. */
void floaty_goal_see(FloatyGoal *goal, FloatyPose *pose);

/* Turns a vector from G into W. */
void floaty_goal_turn(const FloatyGoal *goal, const float vector_G[3], float vector_W[3]);
