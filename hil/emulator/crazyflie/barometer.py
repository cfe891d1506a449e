"""The BMP388 of a Crazyflie 2.1: converts the body's height to counts of pressure, with noise and its own filter.

It measures 50 times per second, as set by Bitcraze's firmware. With this specimen's calibration the data sheet's
compensation is linear to 1e-4 over the heights of a room. The temperature is constant.
"""

import numpy as np
from numpy.typing import NDArray

from hil.world.motion import GRAVITY

PERIOD_US = 20_000
IDENTITY, STATUS, DATA, CONFIG, CALIBRATION = 0x00, 0x03, 0x04, 0x1F, 0x31  # registers
READY = 0x70  # command, pressure and temperature
SPECIMEN = bytes.fromhex("0a6bb848f9ba06e80f1ef9d4619c77f3f610440c00")
TEMPERATURE = 0x80_0000  # counts: 23.77 degrees Celsius
HOME_COUNTS, COUNTS_PER_PA = (
    7_848_541,
    -73.87,
)  # of the specimen, at 101,570 Pa: there Bitcraze's driver reads 0 m
PA_PER_M = -1.1917 * GRAVITY  # air of that pressure and temperature
# Data sheet, table 9, "drone": 11 cm rms with the filter's coefficient 3, which passes 1/7 of the variance of white noise.
NOISE_PA = 0.11 * abs(PA_PER_M) * 7.0**0.5


class Barometer:
    """`registers` are what the microcontroller reads and writes."""

    def __init__(self, registers: NDArray[np.uint8]) -> None:
        self._registers = registers
        self._filtered: float | None = None  # [counts]
        registers[IDENTITY], registers[STATUS] = 0x50, READY
        registers[CALIBRATION : CALIBRATION + len(SPECIMEN)] = np.frombuffer(SPECIMEN, np.uint8)
        self._show(HOME_COUNTS)

    def measure(self, height: float, draw: float) -> None:
        """Measure at a height [m] in W; `draw` is the noise over its standard deviation."""
        pressure = PA_PER_M * height + NOISE_PA * draw  # [Pa] above that at a height of 0
        counts = HOME_COUNTS + COUNTS_PER_PA * pressure
        before = counts if self._filtered is None else self._filtered
        coefficient = (1 << (int(self._registers[CONFIG]) >> 1 & 7)) - 1
        self._filtered = (coefficient * before + counts) / (coefficient + 1)
        self._show(round(self._filtered))

    def _show(self, counts: int) -> None:
        data = counts.to_bytes(3, "little") + TEMPERATURE.to_bytes(3, "little")
        self._registers[DATA : DATA + 6] = np.frombuffer(data, np.uint8)
