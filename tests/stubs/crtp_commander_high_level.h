#pragma once
#include "planner.h"
enum trajectory_state crtpCommanderHighLevelGetPlannerState();
int crtpCommanderHighLevelStop();
