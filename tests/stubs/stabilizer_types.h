#pragma once
#include <stdbool.h>
#include <stdint.h>
#include "imu_types.h"
typedef uint32_t stabilizerStep_t; /* how often the loop has run, at 1000 Hz */
typedef struct attitude_s {
  uint32_t timestamp;
  float roll, pitch, yaw;
} attitude_t;
struct vec3_s {
  uint32_t timestamp;
  float x, y, z;
};
typedef struct vec3_s point_t;
typedef struct vec3_s velocity_t;
typedef struct vec3_s acc_t;
typedef struct quaternion_s {
  union {
    struct {
      float q0, q1, q2, q3;
    };
    struct {
      float x, y, z, w;
    };
  };
} quaternion_t;
typedef struct state_s {
  attitude_t attitude;
  quaternion_t attitudeQuaternion;
  point_t position;
  velocity_t velocity;
  acc_t acc;
} state_t;
typedef struct sensorData_s {
  Axis3f acc, gyro, mag;
  uint64_t interruptTimestamp;
} sensorData_t;
typedef enum control_mode_e { controlModeLegacy = 0 } control_mode_t;
typedef struct control_s {
  union {
    struct {
      int16_t roll, pitch, yaw;
      float thrust;
    };
    float normalizedForces[4];
  };
  control_mode_t controlMode;
} control_t;
typedef struct setpoint_s {
  uint32_t timestamp;
} setpoint_t;
typedef struct poseMeasurement_s {
  float pos[3];
  quaternion_t quat;
  float stdDevPos, stdDevQuat;
} poseMeasurement_t;
