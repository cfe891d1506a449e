#pragma once
#include <stdbool.h>
bool supervisorIsLocked();
