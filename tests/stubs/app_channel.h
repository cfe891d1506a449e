#pragma once
#include <stdbool.h>
#include <stddef.h>
#include "crtp.h"
#define APPCHANNEL_MTU (30)
size_t appchannelReceiveDataPacket(void *buffer, size_t max_length, int timeout_ms);
