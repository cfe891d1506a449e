#pragma once
#include <stdbool.h>
void crtpSupervisorSetEmergencyStop(void);
void crtpSupervisorNotifyEmergencyStopWatchdog(void);
bool crtpSupervisorIsEmergencyStopRequested(void);
