"""The parts of a Crazyflie around its microcontroller, and its radio chip, as hardware that any firmware may use."""
