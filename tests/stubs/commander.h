#pragma once
#define COMMANDER_PRIORITY_HIGHLEVEL 1
int commanderGetActivePriority(void);
