"""Emulates a microcontroller that runs any image, and the parts of a Crazyflie around it; it knows no laboratory."""
