/* FreeRTOS V10 as the Crazyflie configures it: 32-bit ticks of 1 ms. */
#pragma once
#include <stddef.h>
#include <stdint.h>
typedef long BaseType_t;
typedef unsigned long UBaseType_t;
typedef uint32_t TickType_t;
#define pdFALSE ((BaseType_t)0)
#define pdTRUE ((BaseType_t)1)
#define portMAX_DELAY ((TickType_t)0xffffffffUL)
#define M2T(X) ((unsigned int)(X))
typedef struct {
  void *dummy[3];
  uintptr_t more[17];
} StaticQueue_t;
