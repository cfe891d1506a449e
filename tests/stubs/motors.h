#pragma once
#include <stdint.h>
#define MOTOR_M4 3
void motorsSetRatio(uint32_t, uint16_t);
