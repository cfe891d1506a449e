"""The BMI088's measurement of rates and specific force: filtered, disturbed and rounded to int16 counts; compiled.

Sensor frame S is B turned about z, as the chip is soldered on the original board; counts come in S.
"""

import math

import numpy as np
from numpy.typing import NDArray

from firmware_py.board import ImuCounts
from firmware_py.elementary import cos, sin
from hil.world import layout as at
from hil.world.compiled import compiled

S_AZIMUTH = -math.pi / 4  # [rad] of S's x axis in B: then p = (gx + gy)/sqrt2, q = (gy - gx)/sqrt2, r = gz

View = NDArray[np.float64]


# Layout of the sensor's array: for each of six channels (gyro x y z, accelerometer x y z) a row of
NOW_1, NOW_2, B0, A1, A2, SCALE, BIAS, NOISE, FAULT_BIAS, STUCK, RANGE, COUNT, FIELDS = range(13)
COS, SIN = cos(S_AZIMUTH), sin(S_AZIMUTH)


@compiled
def channel(row: View, truth: float, draw: float) -> int:
    """Filter (transposed form II, b = B0 (1, 2, 1)), disturb and round one channel; returns counts."""
    low = row[B0] * truth + row[NOW_1]
    row[NOW_1] = 2.0 * row[B0] * truth - row[A1] * low + row[NOW_2]
    row[NOW_2] = row[B0] * truth - row[A2] * low
    if row[STUCK] == 0.0:
        value = row[SCALE] * (low + row[BIAS] + row[FAULT_BIAS] + row[NOISE] * draw)
        row[COUNT] = min(max(math.floor(value + 0.5), -row[RANGE]), row[RANGE] - 1.0)
    return int(row[COUNT])


@compiled
def channels(rows: View, truth: View, draws: View) -> ImuCounts:
    """Turn rates and specific force of the plant's array, in B, into S and then into counts."""
    ox, oy, fx, fy = (
        truth[at.OMEGA],
        truth[at.OMEGA + 1],
        truth[at.SPECIFIC_FORCE],
        truth[at.SPECIFIC_FORCE + 1],
    )
    return (
        channel(rows[0], COS * ox + SIN * oy, draws[0]),
        channel(rows[1], COS * oy - SIN * ox, draws[1]),
        channel(rows[2], truth[at.OMEGA + 2], draws[2]),
        channel(rows[3], COS * fx + SIN * fy, draws[3]),
        channel(rows[4], COS * fy - SIN * fx, draws[4]),
        channel(rows[5], truth[at.SPECIFIC_FORCE + 2], draws[5]),
    )
