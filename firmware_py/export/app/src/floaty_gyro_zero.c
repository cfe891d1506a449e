/* See floaty_gyro_zero.h. */
#include "floaty_gyro_zero.h"

#include <string.h>

#define SAMPLES 512
#define VARIANCE_LIMIT 10000 /* [counts^2] */

bool floaty_gyro_zero_add(FloatyGyroZero *self, const int32_t counts[3], float bias[3]) {
  if (self->found) {
    return false;
  }
  for (int axis = 0; axis < 3; axis++) {
    self->sums[axis] += counts[axis];
    self->squares[axis] += counts[axis] * counts[axis];
  }
  self->samples += 1;
  if (self->samples < SAMPLES) {
    return false;
  }
  bool still = true;
  for (int axis = 0; axis < 3; axis++) {
    const int64_t sum = self->sums[axis];
    /* squares / SAMPLES - (sum / SAMPLES)^2 > VARIANCE_LIMIT, in whole numbers */
    if (SAMPLES * self->squares[axis] - sum * sum > (int64_t)VARIANCE_LIMIT * SAMPLES * SAMPLES) {
      still = false;
    }
    bias[axis] = still ? (float)self->sums[axis] / SAMPLES : 0.0f;
  }
  const int32_t refused = self->windows_refused + (still ? 0 : 1);
  memset(self, 0, sizeof *self);
  self->windows_refused = refused;
  self->found = still;
  return still;
}
