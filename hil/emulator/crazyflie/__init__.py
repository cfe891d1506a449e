"""The parts of a Crazyflie around its microcontroller, and its radio chip, as hardware for any firmware."""
