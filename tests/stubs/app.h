#pragma once
void appInit();
void appMain();
