/* FreeRTOS V10 as the Crazyflie configures it: 32-bit ticks of 1 ms. */
#pragma once
#include <stddef.h>
#include <stdint.h>
typedef long BaseType_t;
typedef unsigned long UBaseType_t;
typedef uint32_t TickType_t;
typedef uint32_t StackType_t;
size_t xPortGetFreeHeapSize(void);
#define pdFALSE ((BaseType_t)0)
#define pdTRUE ((BaseType_t)1)
#define M2T(X) ((unsigned int)(X))
typedef struct {
  void *opaque[20];
} StaticQueue_t;
typedef struct {
  uint32_t opaque[24];
} StaticTask_t;
