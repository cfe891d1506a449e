"""The virtual board's BMI088: converts angular rate and specific force at the centre of mass to int16 counts at 1 kHz.

One `sample` is one data-ready: call it once per millisecond, after `body.advance`. Compiled chain: second-order low pass,
bias, white noise of sensor and motors, rounding, saturation. Sensor frame S is B turned about z by `azimuth`; counts are
in S.
"""

import math
from collections.abc import Callable
from copy import copy, deepcopy
from typing import Annotated

import numpy as np

from firmware_py.board import ImuCounts
from firmware_py.compiling import bound
from firmware_py.core.subset import F64s, I32s, Integer, Struct, f64, i32
from firmware_py.elementary import cos, sin, tan
from hil.board.config import S_AZIMUTH, ImuConfig
from hil.errors import LabError
from hil.world.body import Motion
from hil.world.fixed_order import compiled, normal
from hil.world.motion import GRAVITY

SAMPLE_RATE = 1000.0  # [Hz]
GYRO_COUNTS = 32768 / math.radians(2000)  # per rad/s; data sheet, range +-2000 deg/s
ACCEL_COUNTS = 32768 / (24 * GRAVITY)  # per m/s2; data sheet, range +-24 g
COUNTS = 32768.0  # of int16, one more below zero than above
NOISE_ROWS = 2048  # samples of noise drawn at once
COS, SIN = cos(S_AZIMUTH), sin(S_AZIMUTH)  # of the default


class Imu(Struct):
    """The sensor's memory; arrays of six have a number for each of gyro x y z, accelerometer x y z."""

    first: Annotated[F64s, 6]  # memory of the filters
    second: Annotated[F64s, 6]
    count: Annotated[I32s, 6]  # of the last sample
    rows_left: i32  # of noise
    # Constants, and values that faults change
    b0: Annotated[F64s, 6]  # of the filters
    a1: Annotated[F64s, 6]
    a2: Annotated[F64s, 6]
    scale: Annotated[F64s, 6]  # [counts] per rad/s or m/s2
    bias: Annotated[F64s, 6]
    fault_bias: Annotated[F64s, 6]
    noise: Annotated[F64s, 6]  # rms
    limit: Annotated[F64s, 6]  # [counts]
    frozen: i32  # 1: the counts stay
    axis_cos: f64  # of the azimuth of S
    axis_sin: f64


@compiled
def channel(imu: Imu, i: Integer, truth: float, shaken: float, draw: float) -> None:
    """Filter (transposed form II, b = b0 (1, 2, 1)), disturb and round one channel.

    `shaken`: vibration noise, added to the sensor's own.
    """
    low = imu.b0[i] * truth + imu.first[i]
    imu.first[i] = 2.0 * imu.b0[i] * truth - imu.a1[i] * low + imu.second[i]
    imu.second[i] = imu.b0[i] * truth - imu.a2[i] * low
    if imu.frozen == 0:
        noise = imu.noise[i]
        if shaken != 0.0:
            noise = math.sqrt(noise * noise + shaken * shaken)
        value = imu.scale[i] * (low + imu.bias[i] + imu.fault_bias[i] + noise * draw)
        imu.count[i] = i32(min(max(math.floor(value + 0.5), -imu.limit[i]), imu.limit[i] - 1.0))


@compiled
def channels(imu: Imu, omega_B: F64s, specific_force_B: F64s, vibration: F64s, draws: F64s) -> None:
    """Turn rates and specific force into S and then into counts, with the next row of noise."""
    ox, oy, fx, fy = omega_B[0], omega_B[1], specific_force_B[0], specific_force_B[1]
    c, s, turned, pushed = imu.axis_cos, imu.axis_sin, vibration[0], vibration[1]
    imu.rows_left = i32(imu.rows_left - 1)
    row = imu.rows_left
    channel(imu, 0, c * ox + s * oy, turned, draws[row, 0])
    channel(imu, 1, c * oy - s * ox, turned, draws[row, 1])
    channel(imu, 2, omega_B[2], turned, draws[row, 2])
    channel(imu, 3, c * fx + s * fy, pushed, draws[row, 3])
    channel(imu, 4, c * fy - s * fx, pushed, draws[row, 4])
    channel(imu, 5, specific_force_B[2], pushed, draws[row, 5])


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
        self._memory = Imu.allocate()
        imu = self._memory.fields
        self._noise = np.repeat([config.gyro_noise, config.accel_noise], 3)
        imu.scale[:3], imu.scale[3:] = GYRO_COUNTS, ACCEL_COUNTS
        imu.bias[:] = normal(rng, 6) * np.repeat([config.gyro_bias, config.accel_bias], 3)
        for part, bandwidth in ((slice(3), config.gyro_bandwidth), (slice(3, 6), config.accel_bandwidth)):
            imu.b0[part], imu.a1[part], imu.a2[part] = low_pass(bandwidth)
        self.count = imu.count  # (6,) of the last sample
        self._draws = np.zeros((NOISE_ROWS, 6))
        self._rows_left = self._memory.cell("rows_left")
        self._measure: Callable[[], object]
        self._body: Motion | None = None  # sampled last
        imu.limit[:] = COUNTS
        imu.axis_cos, imu.axis_sin = cos(config.azimuth), sin(config.azimuth)
        self.rate_range: float = COUNTS / GYRO_COUNTS
        self.frozen: bool = False
        self.silent: bool = False
        self.set_noise_scale(1.0)
        self.set_rate_bias(0.0, 0.0, 0.0)

    def sample(self, body: Motion) -> ImuCounts:
        """Return gyro x y z and accelerometer x y z counts, in S, of the body as it moves now."""
        self.measure(body)
        return tuple(self.count.tolist())

    def measure(self, body: Motion) -> None:
        """Take a sample into `count`."""
        if self._body is not body:
            self._body = body
            felt = body.omega_B, body.specific_force_B, body.vibration
            self._measure = bound(channels, self._memory, *felt, self._draws)
        if self._rows_left[0] == 0:
            self._draws[:] = normal(self._rng, (NOISE_ROWS, 6))
            self._rows_left[0] = NOISE_ROWS
        self._measure()

    def twin(self) -> "VirtualImu":
        """Return an independent copy of this specimen, which draws the same noise."""
        twin = copy(self)
        twin._memory, twin._rng, twin._draws = self._memory.copy(), deepcopy(self._rng), self._draws.copy()
        twin._rows_left, twin._body = twin._memory.cell("rows_left"), None
        twin.count = twin._memory.fields.count
        return twin

    def continue_from(self, earlier: "VirtualImu") -> None:
        """Take over the memory of the filters of the same specimen, which was sampled before."""
        ours, theirs = self._memory.fields, earlier._memory.fields
        ours.first[:], ours.second[:] = theirs.first, theirs.second

    def set_noise_scale(self, scale: float) -> None:
        """Scale the white noise of all channels; 1 as configured."""
        if not 0.0 <= scale <= 1000.0:
            raise LabError(f"IMU noise scale = {scale}: outside 0..1000")
        self.noise_scale: float = scale
        self._memory.fields.noise[:] = scale * self._noise

    def set_rate_bias(self, p: float, q: float, r: float) -> None:
        """Move the gyro's zero, on top of the specimen's own bias [rad/s, B]."""
        self.rate_bias = (p, q, r)
        imu = self._memory.fields
        c, s = imu.axis_cos, imu.axis_sin
        imu.fault_bias[:3] = c * p + s * q, c * q - s * p, r

    def set_rate_range(self, rate: float) -> None:
        """Make the gyro saturate at +-`rate` [rad/s, about the axes of S] or, if that is less, at its full scale."""
        self.rate_range = rate
        self._memory.fields.limit[:3] = min(max(round(rate * GYRO_COUNTS), 1), COUNTS)

    def freeze(self, frozen: bool) -> None:
        """Start or stop repeating the last sample."""
        self.frozen = frozen
        self._memory.fields.frozen = i32(frozen)

    def silence(self, silent: bool) -> None:
        """Suppress the data-ready interrupt, or raise it again."""
        self.silent = silent
