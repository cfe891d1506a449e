"""The BMI088: how it is mounted, what a count is, and the gyro's zero, found at start while the robot is held still.

Counts come in the sensor frame S, which lies at -45 deg about z in the body B. The flight core turns the gyro's counts
itself, because it is what is flashed; the tests hold it to `body_of`.
"""

from collections.abc import Sequence
from math import pi, sqrt

from firmware_py.board import ImuCounts
from firmware_py.geometry import Vector

GYRO_SCALE = 2000.0 / 32768.0 * pi / 180.0  # [rad/s per count] at +-2000 deg/s
ACCELEROMETER_SCALE = 24 / 32768  # [g per count] at +-24 g
COS_45 = sqrt(0.5)

SAMPLES = 512  # original firmware
# [counts^2] 0.1 rad/s rms: more than sensor noise in the flow, less than a moving robot.
VARIANCE_LIMIT = 10_000.0


def body_of(v_S: Vector) -> Vector:
    """Return a vector of the sensor frame in the body frame."""
    x, y, z = v_S
    return COS_45 * (x + y), COS_45 * (y - x), z


def rates(counts: ImuCounts, zero: Sequence[float]) -> Vector:
    """Return the body rates p, q, r [rad/s, B]; `zero` is the gyro's [counts, S]."""
    x, y, z = (GYRO_SCALE * (count - at_rest) for count, at_rest in zip(counts[:3], zero, strict=True))
    return body_of((x, y, z))


def acceleration(counts: ImuCounts) -> Vector:
    """Return the specific force [g, B]."""
    x, y, z = (ACCELEROMETER_SCALE * count for count in counts[3:])
    return body_of((x, y, z))


class GyroZero:
    """Averages 512 samples; a window in which the robot moved is thrown away and the next one begins."""

    def __init__(self) -> None:
        self.bias: tuple[float, float, float] | None = None  # [counts] sensor frame; None while searching
        self.variance = (0.0, 0.0, 0.0)  # [counts^2] sensor frame, of the last window
        self.windows_refused = 0
        self._window: list[ImuCounts] = []

    def add(self, counts: ImuCounts) -> bool:
        """Take a sample; True when the zero has just been found."""
        self._window.append(counts)
        if len(self._window) < SAMPLES:
            return False
        window, self._window = self._window, []
        sums = [sum(sample[axis] for sample in window) for axis in range(3)]
        squares = [sum(sample[axis] ** 2 for sample in window) for axis in range(3)]
        x, y, z = (
            (square * SAMPLES - total * total) / (SAMPLES * SAMPLES)
            for total, square in zip(sums, squares, strict=True)
        )
        self.variance = (x, y, z)
        if max(self.variance) > VARIANCE_LIMIT:
            self.windows_refused += 1
            return False
        self.bias = (sums[0] / SAMPLES, sums[1] / SAMPLES, sums[2] / SAMPLES)
        return True
