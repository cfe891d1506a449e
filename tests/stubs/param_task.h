#pragma once
#include <stdbool.h>
bool paramTest(void);
