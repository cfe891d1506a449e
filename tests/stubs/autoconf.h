/* Written by Kconfig in a real build. */
#pragma once
#define CONFIG_APP_ENABLE 1
#define CONFIG_CONTROLLER_OOT 1
#define CONFIG_ESTIMATOR_KALMAN_ENABLE 1
#define CONFIG_ESTIMATOR_OOT 1
