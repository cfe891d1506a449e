#pragma once
int consolePutchar(int);
int eprintf(int (*)(int), const char *, ...) __attribute__((format(printf, 2, 3)));
#define DEBUG_PRINT(FORMAT, ...) eprintf(consolePutchar, DEBUG_MODULE ": " FORMAT, ##__VA_ARGS__)
