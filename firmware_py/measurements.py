"""What travels in the measurement queue, from the sensors and the radio to the estimator."""

from typing import Final, Literal

from firmware_py.board import ImuCounts
from firmware_py.planner import Motion
from firmware_py.wire.crtp import Correction

GYRO: Final = 0
ACCELEROMETER: Final = 1  # not used by the filter, as in the original, but it takes its place in the queue
POSE: Final = 2

# When a pose arrived on board [us], the pose, whether it is absolute, and the goal at the instant at which it was true, in
# the frame of the pose; None: the goal is not known.
Arrived = tuple[int, Correction, bool, Motion | None]
# Kind and value; plain tuples, because two are made every millisecond.
Measurement = tuple[Literal[0, 1], ImuCounts] | tuple[Literal[2], Arrived]
