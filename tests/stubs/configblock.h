#pragma once
#include <stdint.h>
uint64_t configblockGetRadioAddress(void);
