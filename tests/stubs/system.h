#pragma once
void systemWaitStart(void);
