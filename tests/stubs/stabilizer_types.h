#pragma once
#include <stdbool.h>
#include <stdint.h>
typedef uint32_t stabilizerStep_t; /* how often the loop has run, at 1000 Hz */
typedef struct {
  uint32_t timestamp;
  float roll, pitch, yaw;
} attitude_t; /* [deg], pitch nose up positive */
typedef struct {
  uint32_t timestamp;
  float x, y, z;
} point_t;
typedef struct {
  float x, y, z, w;
} quaternion_t;
typedef struct {
  attitude_t attitude;
  quaternion_t attitudeQuaternion;
  point_t position, velocity, acc;
} state_t;
typedef struct {
  uint32_t opaque[5];
} control_t;
typedef enum { modeDisable = 0, modeAbs, modeVelocity } stab_mode_t;
typedef struct {
  stab_mode_t x, y, z, roll, pitch, yaw, quat;
} setpoint_mode_t;
typedef struct {
  uint32_t timestamp;
  attitude_t attitude, attitudeRate;
  quaternion_t attitudeQuaternion;
  float thrust;
  point_t position, velocity, acceleration, jerk;
  bool velocity_body;
  setpoint_mode_t mode;
} setpoint_t;
typedef struct sensorData_s sensorData_t;
