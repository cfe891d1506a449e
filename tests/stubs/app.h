#pragma once
void appInit();
