/* FreeRTOS V10 as the Crazyflie configures it: 32-bit ticks of 1 ms. */
#pragma once
#include <stddef.h>
#include <stdint.h>
typedef long BaseType_t;
typedef unsigned long UBaseType_t;
typedef uint32_t TickType_t;
#define pdFALSE ((BaseType_t)0)
#define pdTRUE ((BaseType_t)1)
#define M2T(X) ((unsigned int)(X))
typedef struct {
  void *opaque[20];
} StaticQueue_t;
