#pragma once
#include <stdbool.h>
#include <stdint.h>
typedef uint32_t stabilizerStep_t; /* how often the loop has run, at 1000 Hz */
typedef struct {
  struct {
    uint32_t timestamp;
    float roll, pitch, yaw;
  } attitude; /* [deg], pitch nose up positive */
  struct {
    float x, y, z, w;
  } attitudeQuaternion;
  struct {
    uint32_t timestamp;
    float x, y, z;
  } position, velocity, acc;
} state_t;
typedef struct {
  uint32_t opaque[5];
} control_t;
typedef struct sensorData_s sensorData_t;
typedef struct setpoint_s setpoint_t;
