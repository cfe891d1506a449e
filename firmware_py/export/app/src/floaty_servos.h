/* Four servo outputs at 400 Hz: one timer count is 1/21 us, a pulse 21000..42000 counts, the period 52501. */
#pragma once

#include <stdint.h>

/* Starts the timers with these pulses. */
void floaty_servos_init(const int32_t count[4]);

/* Loads the compare registers; they act from the next period on. */
void floaty_servos_write(const int32_t count[4]);
