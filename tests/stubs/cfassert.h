#pragma once
#include <stdbool.h>
bool cfAssertNormalStartTest(void);
