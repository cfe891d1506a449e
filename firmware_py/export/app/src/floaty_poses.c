/* See floaty_poses.h. */
#include "floaty_poses.h"

#include <math.h>
#include <string.h>

#define POSE_SIZE (1 + 7 * 4)
#define AGE_UNIT_US 500
#define AGE_UNKNOWN_CODE 255
#define FAR 1000.0f /* [m] no pose, and false for NaN, too */
#define SIDEWAYS 0.9f /* [m] from the goal */
#define BELOW 2.0f
#define ABOVE 1.0f
#define NORM2_MIN (0.9f * 0.9f)
#define NORM2_MAX (1.1f * 1.1f)

bool floaty_pose_decode(const uint8_t *data, uint32_t length, int32_t arrival_us, FloatyPose *pose) {
  float value[7];
  if ((length != POSE_SIZE && length != POSE_SIZE + 1) || data[0] != FLOATY_EXT_POSE) {
    return false;
  }
  memcpy(value, data + 1, sizeof value);
  float norm2 = 0.0f;
  for (int i = 0; i < 3; i++) {
    if (!(fabsf(value[i]) <= FAR)) {
      return false;
    }
    pose->position[i] = value[i];
  }
  for (int i = 0; i < 4; i++) {
    norm2 += value[3 + i] * value[3 + i];
    pose->quaternion[(i + 1) % 4] = value[3 + i]; /* x y z w on the wire */
  }
  if (!(norm2 >= NORM2_MIN && norm2 <= NORM2_MAX)) {
    return false;
  }
  const uint8_t code = length > POSE_SIZE ? data[POSE_SIZE] : AGE_UNKNOWN_CODE;
  pose->age_us = code == AGE_UNKNOWN_CODE ? FLOATY_AGE_UNKNOWN : code * AGE_UNIT_US;
  pose->arrival_us = arrival_us;
  return true;
}

bool floaty_pose_is_correction(const FloatyPose *pose) {
  const float x = pose->position[0], y = pose->position[1], z = pose->position[2];
  return sqrtf(x * x + y * y) <= SIDEWAYS && -BELOW <= z && z <= ABOVE;
}
