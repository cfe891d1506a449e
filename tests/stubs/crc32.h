#pragma once
#include <stddef.h>
#include <stdint.h>
uint32_t crc32CalculateBuffer(const void *, size_t); /* as of zlib */
