/* Reads the pose of the body in the goal frame from the data of a packet; firmware_py/wire/crtp.py. */
#pragma once

#include <stdbool.h>
#include <stdint.h>

#define FLOATY_EXT_POSE 8 /* first byte of the data */
#define FLOATY_AGE_UNKNOWN (-1)

typedef struct {
  int32_t arrival_us; /* wraps */
  float position[3];   /* [m] p_GB */
  float quaternion[4]; /* q_GB, Hamilton, w x y z */
  int32_t age_us;      /* at arrival; FLOATY_AGE_UNKNOWN: the sender does not know */
} FloatyPose;

/* Data: FLOATY_EXT_POSE, x y z [m], qx qy qz qw as little-endian float32, and perhaps the age in units of 0.5 ms (255:
 * unknown). False for what is no pose: `pose` is then not to be used. */
bool floaty_pose_decode(const uint8_t *data, uint32_t length, int32_t arrival_us, FloatyPose *pose);

/* False for a pose that cannot be a correction, because the robot cannot be there from its goal; firmware_py/box.py. */
bool floaty_pose_is_correction(const FloatyPose *pose);
