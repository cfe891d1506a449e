#pragma once
typedef enum {
  SensorImplementation_bmi088_bmp3xx, /* CF2 builds it and the older boards' sensors */
  SensorImplementation_mpu9250_lps25h,
} SensorImplementation_t;
SensorImplementation_t platformConfigGetSensorImplementation();
