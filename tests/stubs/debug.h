#pragma once
void consoleLine(const char *format, ...) __attribute__((format(printf, 1, 2)));
#define DEBUG_PRINT(fmt, ...) consoleLine(DEBUG_MODULE ": " fmt, ##__VA_ARGS__)
