"""The BMI088: its mounting, and the scale of a count.

Counts are in the sensor frame S, which is turned by -45 deg about z in the body B. The flight core, which is flashed,
turns the gyro's counts itself; the tests compare it with `body_of`.
"""

from collections.abc import Sequence
from math import pi, sqrt

from firmware_py.geometry import Vector

GYRO_SCALE = 2000.0 / 32768.0 * pi / 180.0  # [rad/s per count] at +-2000 deg/s
ACCELEROMETER_SCALE = 24 / 32768  # [g per count] at +-24 g
COS_45 = sqrt(0.5)


def body_of(v_S: Vector) -> Vector:
    """Return a vector of the sensor frame in the body frame."""
    x, y, z = v_S
    return COS_45 * (x + y), COS_45 * (y - x), z


def rates(counts: Sequence[int], zero: Sequence[float]) -> Vector:
    """Return the body rates p, q, r [rad/s, B]; `zero` is the gyro's [counts, S]."""
    x, y, z = (GYRO_SCALE * (count - at_rest) for count, at_rest in zip(counts[:3], zero, strict=True))
    return body_of((x, y, z))


def acceleration(counts: Sequence[int]) -> Vector:
    """Return the specific force [g, B]."""
    x, y, z = (ACCELEROMETER_SCALE * count for count in counts[3:])
    return body_of((x, y, z))
