#pragma once
#include <stdbool.h>
bool supervisorIsLocked();
bool supervisorIsArmed();
bool supervisorCanArm();
bool supervisorCanFly();
bool supervisorRequestArming(const bool);
