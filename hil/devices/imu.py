"""The virtual board's BMI088: converts angular rate and specific force at the centre of mass to int16 counts at 1 kHz.

One `sample` is one data-ready: call it once per millisecond, after `body.advance`. Compiled chain: second-order low pass,
bias, white noise of sensor and motors, rounding, saturation. Sensor frame S is B turned about z by `azimuth`; counts are
in S.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from firmware_py.board import ImuCounts
from firmware_py.compiling import bound
from firmware_py.elementary import cos, sin, tan
from hil.devices.config import S_AZIMUTH, ImuConfig
from hil.errors import LabError
from hil.world.body import Motion
from hil.world.fixed_order import compiled, normal
from hil.world.motion import GRAVITY

View = NDArray[np.float64]
Counts = NDArray[np.int64]  # (7,) of a sample, then the number of noise rows left
LEFT = 6
SAMPLE_RATE = 1000.0  # [Hz]
GYRO_COUNTS = 32768 / math.radians(2000)  # per rad/s; data sheet, range +-2000 deg/s
ACCEL_COUNTS = 32768 / (24 * GRAVITY)  # per m/s2; data sheet, range +-24 g
COUNTS = 32768.0  # of int16, one more below zero than above
NOISE_ROWS = 2048  # samples of noise drawn at once
COS, SIN = cos(S_AZIMUTH), sin(S_AZIMUTH)  # of the default
# Layout of the sensor's array: for each of six channels (gyro x y z, accelerometer x y z) a row of
NOW_1, NOW_2, B0, A1, A2, SCALE, BIAS, NOISE, FAULT_BIAS, STUCK, RANGE, COUNT, AXIS_COS, AXIS_SIN = range(14)
FIELDS = 14


@compiled
def channel(row: View, truth: float, shaken: float, draw: float) -> int:
    """Filter (transposed form II, b = B0 (1, 2, 1)), disturb and round one channel; returns counts.

    `shaken`: vibration noise, added to the sensor's own.
    """
    low = row[B0] * truth + row[NOW_1]
    row[NOW_1] = 2.0 * row[B0] * truth - row[A1] * low + row[NOW_2]
    row[NOW_2] = row[B0] * truth - row[A2] * low
    if row[STUCK] == 0.0:
        noise = row[NOISE] if shaken == 0.0 else math.sqrt(row[NOISE] * row[NOISE] + shaken * shaken)
        value = row[SCALE] * (low + row[BIAS] + row[FAULT_BIAS] + noise * draw)
        row[COUNT] = min(max(math.floor(value + 0.5), -row[RANGE]), row[RANGE] - 1.0)
    return int(row[COUNT])


@compiled
def channels(
    rows: View, omega_B: View, specific_force_B: View, vibration: View, draws: View, counts: Counts
) -> None:
    """Turn rates and specific force into S and then into counts, with the next row of noise."""
    ox, oy, fx, fy = omega_B[0], omega_B[1], specific_force_B[0], specific_force_B[1]
    c, s = rows[0, AXIS_COS], rows[0, AXIS_SIN]
    turned, pushed = vibration[0], vibration[1]
    counts[LEFT] -= 1
    noise = draws[counts[LEFT]]
    counts[0] = channel(rows[0], c * ox + s * oy, turned, noise[0])
    counts[1] = channel(rows[1], c * oy - s * ox, turned, noise[1])
    counts[2] = channel(rows[2], omega_B[2], turned, noise[2])
    counts[3] = channel(rows[3], c * fx + s * fy, pushed, noise[3])
    counts[4] = channel(rows[4], c * fy - s * fx, pushed, noise[4])
    counts[5] = channel(rows[5], specific_force_B[2], pushed, noise[5])


def low_pass(bandwidth: float) -> tuple[float, float, float]:
    """Return b0, a1, a2 of the second-order Butterworth low pass of `bandwidth` [Hz] at the sample rate (bilinear)."""
    k = tan(math.pi * bandwidth / SAMPLE_RATE)
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    return k * k * norm, 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm


class VirtualImu:
    """One specimen of the sensor: its biases are drawn from `rng` when it is made.

    `noise_scale`, `rate_bias` (p, q, r [rad/s] in B), `rate_range` [rad/s], `frozen` and `silent` are the last values set.
    """

    def __init__(self, config: ImuConfig, rng: np.random.Generator) -> None:
        self._rng = rng
        self._rows = rows = np.zeros((6, FIELDS))
        self._noise = np.repeat([config.gyro_noise, config.accel_noise], 3)
        rows[:, SCALE] = np.repeat([GYRO_COUNTS, ACCEL_COUNTS], 3)
        rows[:, BIAS] = normal(rng, 6) * np.repeat([config.gyro_bias, config.accel_bias], 3)
        rows[:3, [B0, A1, A2]] = low_pass(config.gyro_bandwidth)
        rows[3:, [B0, A1, A2]] = low_pass(config.accel_bandwidth)
        self._draws: View = np.zeros((NOISE_ROWS, 6))
        self._counts: Counts = np.zeros(7, np.int64)
        self._left = 0  # rows of noise
        self._measure: Callable[[], object]
        self._body: Motion | None = None  # sampled last
        rows[:, RANGE] = COUNTS
        rows[:, AXIS_COS], rows[:, AXIS_SIN] = cos(config.azimuth), sin(config.azimuth)
        self.rate_range: float = COUNTS / GYRO_COUNTS
        self.frozen: bool = False
        self.silent: bool = False
        self.set_noise_scale(1.0)
        self.set_rate_bias(0.0, 0.0, 0.0)

    def sample(self, body: Motion) -> ImuCounts:
        """Return gyro x y z and accelerometer x y z counts, in S, of the body as it moves now."""
        if self._body is not body:
            self._body = body
            felt = body.omega_B, body.specific_force_B, body.vibration
            self._measure = bound(channels, self._rows, *felt, self._draws, self._counts)
        if self._left == 0:
            self._draws[:] = normal(self._rng, (NOISE_ROWS, 6))
            self._counts[LEFT] = NOISE_ROWS
        self._measure()
        *counts, self._left = self._counts.tolist()
        return tuple(counts)

    def continue_from(self, earlier: "VirtualImu") -> None:
        """Take over the memory of the filters of the same specimen, which was sampled before."""
        memory = [NOW_1, NOW_2]
        self._rows[:, memory] = earlier._rows[:, memory]

    def set_noise_scale(self, scale: float) -> None:
        """Scale the white noise of all channels; 1 as configured."""
        if not 0.0 <= scale <= 1000.0:
            raise LabError(f"IMU noise scale = {scale}: outside 0..1000")
        self.noise_scale: float = scale
        self._rows[:, NOISE] = scale * self._noise

    def set_rate_bias(self, p: float, q: float, r: float) -> None:
        """Move the gyro's zero, on top of the specimen's own bias [rad/s, B]."""
        self.rate_bias = (p, q, r)
        c, s = self._rows[0, [AXIS_COS, AXIS_SIN]].tolist()
        self._rows[:3, FAULT_BIAS] = c * p + s * q, c * q - s * p, r

    def set_rate_range(self, rate: float) -> None:
        """Make the gyro saturate at +-`rate` [rad/s, about the axes of S] or, if that is less, at its full scale."""
        self.rate_range = rate
        self._rows[:3, RANGE] = min(max(round(rate * GYRO_COUNTS), 1), COUNTS)

    def freeze(self, frozen: bool) -> None:
        """Start or stop repeating the last sample."""
        self.frozen = frozen
        self._rows[:, STUCK] = float(frozen)

    def silence(self, silent: bool) -> None:
        """Suppress the data-ready interrupt, or raise it again."""
        self.silent = silent
