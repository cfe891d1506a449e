"""What travels in the measurement queue, from the sensors and the radio to the estimator."""

from dataclasses import dataclass
from typing import Any

from firmware_py.wire.crtp import PoseMessage

GYRO = 0
ACCELEROMETER = 1  # not used by the filter, as in the original, but it takes its place in the queue
POSE = 2


@dataclass(frozen=True, slots=True)
class PoseMeasurement:
    """A pose and when it arrived on board."""

    t_us: int
    message: PoseMessage


Measurement = tuple[int, Any]  # kind, and ImuCounts or PoseMeasurement; a plain tuple: two are made every ms
