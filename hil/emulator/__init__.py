"""The emulator: a microcontroller that runs any image, and the parts of a Crazyflie around it. It knows no laboratory."""
