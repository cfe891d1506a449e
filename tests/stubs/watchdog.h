#pragma once
#include <stdbool.h>
bool watchdogNormalStartTest(void);
