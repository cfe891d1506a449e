"""What travels in the measurement queue, from the sensors and the radio to the estimator."""

from typing import Final, Literal

from firmware_py.board import ImuCounts
from firmware_py.wire.crtp import Correction

GYRO: Final = 0
ACCELEROMETER: Final = 1  # not used by the filter, as in the original, but it takes its place in the queue
POSE: Final = 2


# Kind and value; plain tuples, because two are made every millisecond. A pose comes with the instant of its arrival.
Measurement = tuple[Literal[0, 1], ImuCounts] | tuple[Literal[2], tuple[int, Correction]]
