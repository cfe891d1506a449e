#pragma once
#include <stdbool.h>
#include <stddef.h>
#include "crtp.h"
#define APPCHANNEL_MTU (30)
size_t appchannelReceiveDataPacket(void *, size_t, int);
