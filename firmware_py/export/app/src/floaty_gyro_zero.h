/* The gyro's zero in counts: the mean of 512 samples during which the robot was still; firmware_py/drivers/imu.py. */
#pragma once

#include <stdbool.h>
#include <stdint.h>

typedef struct {
  int64_t squares[3];
  int32_t sums[3];
  int32_t samples;
  int32_t windows_refused; /* because the robot moved */
  bool found;
} FloatyGyroZero;

/* Takes a sample; true when the zero has just been found, and is in `bias` [counts, sensor frame]. */
bool floaty_gyro_zero_add(FloatyGyroZero *self, const int32_t counts[3], float bias[3]);
