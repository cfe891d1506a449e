"""The BMI088 on the virtual board: angular rate and specific force at the centre of mass to int16 counts at 1 kHz.

One `sample` is one data-ready: call it once per millisecond, after `plant.advance`. Chain: second-order low pass, bias,
white noise, rounding, saturation (`hil.devices.imu_counts`).
"""

import math

import numpy as np

from firmware_py.board import ImuCounts
from firmware_py.elementary import tan
from hil.devices import imu_counts as at
from hil.devices.config import ImuConfig
from hil.devices.imu_counts import COS, SIN, View, channels
from hil.errors import LabError
from hil.world.motion import GRAVITY
from hil.world.noise import normal
from hil.world.plant import Plant

SAMPLE_RATE = 1000.0  # [Hz]
GYRO_COUNTS = 32768 / math.radians(2000)  # per rad/s; data sheet, range +-2000 deg/s
ACCEL_COUNTS = 32768 / (24 * GRAVITY)  # per m/s2; data sheet, range +-24 g
COUNTS = 32768.0  # of int16, one more below zero than above
NOISE_ROWS = 2048  # samples of noise drawn at once


def low_pass(bandwidth: float) -> tuple[float, float, float]:
    """Return b0, a1, a2 of the second-order Butterworth low pass of `bandwidth` [Hz] at the sample rate (bilinear)."""
    k = tan(math.pi * bandwidth / SAMPLE_RATE)
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    return k * k * norm, 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm


class VirtualImu:
    """One specimen of the sensor: its biases are drawn from `rng` when it is made.

    `noise_scale`, `rate_bias` (p, q, r [rad/s] in B), `rate_range` [rad/s], `frozen` and `silent` hold the values last
    set.
    """

    def __init__(self, config: ImuConfig, rng: np.random.Generator) -> None:
        self._rng = rng
        self._rows = rows = np.zeros((6, at.FIELDS))
        self._noise = np.repeat([config.gyro_noise, config.accel_noise], 3)
        rows[:, at.SCALE] = np.repeat([GYRO_COUNTS, ACCEL_COUNTS], 3)
        rows[:, at.BIAS] = normal(rng, 6) * np.repeat([config.gyro_bias, config.accel_bias], 3)
        rows[:3, [at.B0, at.A1, at.A2]] = low_pass(config.gyro_bandwidth)
        rows[3:, [at.B0, at.A1, at.A2]] = low_pass(config.accel_bandwidth)
        self._draws: list[View] = []
        rows[:, at.RANGE] = COUNTS
        self.rate_range: float = COUNTS / GYRO_COUNTS
        self.frozen: bool = False
        self.silent: bool = False
        self.set_noise_scale(1.0)
        self.set_rate_bias(0.0, 0.0, 0.0)

    def sample(self, plant: Plant) -> ImuCounts:
        """Return gyro x y z and accelerometer x y z counts, in S, of the plant as it is now."""
        if not self._draws:
            self._draws = list(normal(self._rng, (NOISE_ROWS, 6)))
        return channels(self._rows, plant.truth, self._draws.pop())

    def set_noise_scale(self, scale: float) -> None:
        """Scale the white noise of all channels; 1 as configured."""
        if not 0.0 <= scale <= 1000.0:
            raise LabError(f"IMU noise scale = {scale}: outside 0..1000")
        self.noise_scale: float = scale
        self._rows[:, at.NOISE] = scale * self._noise

    def set_rate_bias(self, p: float, q: float, r: float) -> None:
        """Move the gyro's zero, on top of the specimen's own bias [rad/s, B]."""
        self.rate_bias = (p, q, r)
        self._rows[:3, at.FAULT_BIAS] = COS * p + SIN * q, COS * q - SIN * p, r

    def set_rate_range(self, rate: float) -> None:
        """Make the gyro saturate at +-`rate` [rad/s, about the axes of S] or, if that is less, at its full scale."""
        self.rate_range = rate
        self._rows[:3, at.RANGE] = min(max(round(rate * GYRO_COUNTS), 1), COUNTS)

    def freeze(self, frozen: bool) -> None:
        """Repeat the last sample from now on, or end that."""
        self.frozen = frozen
        self._rows[:, at.STUCK] = float(frozen)

    def silence(self, silent: bool) -> None:
        """Raise no data-ready interrupt from now on, or end that."""
        self.silent = silent
