"""A VL53L1X, ST's laser ranger: registers on I2C, at an address that can be changed, and a distance when its time is over.

Registers as in ST's driver (VL53L1, "bare" API) and its data sheet; only those that make it measure act. It measures once
per start, and in timed mode again and again. Its time and reach follow from the registers that set them.
"""

from collections.abc import Callable
from functools import partial

import numpy as np

from hil.emulator.stm32f405.chip import NOWHERE, Chip

Later = Callable[[int, Callable[[int], object]], object]  # (delay [us], what is to be done at that instant)

ADDRESS = 0x29  # after power-on
DEVICE_ADDRESS, FAST_OSCILLATOR, INTERRUPT_POLARITY, INTERRUPT = 0x01, 0x06, 0x30, 0x31
TIMEOUT_A, PERIOD_A, TIMEOUT_B, PERIOD_B, INTERVAL = 0x5E, 0x60, 0x61, 0x63, 0x6C
CLEAR_INTERRUPT, START = 0x86, 0x87
RANGE_STATUS, STREAM_COUNT, SPADS, SIGNAL, AMBIENT, RANGE, CORRECTED_SIGNAL = (
    0x89, 0x8B, 0x8C, 0x8E, 0x90, 0x96, 0x98
)  # fmt: skip
OSCILLATOR, SYSTEM_STATUS, MODEL = 0xDE, 0xE5, 0x10F
IDENTITY = bytes((0xEA, 0xCC, 0x10))
ACTIVE_LOW = 0x10
ABORT, TIMED, MODES = 0x80, 0x40, 0x70
VALID, NO_TARGET = 9, 4  # in RANGE_STATUS
FAST_COUNTS, SLOW_KHZ = (
    0xBCCC,
    600,
)  # of this specimen's oscillators; the PLL makes the first 64 counts per us
MACRO_PERIODS = 2304  # of the laser in one step of a timeout
# Of the two ranges of a measurement, as ST's driver counts them (VL53L1_SetMeasurementTimingBudgetMicroSeconds).
BEFORE_US, BETWEEN_US = 1448, 2100
REACH = {0x07: 1.36, 0x0B: 2.90, 0x0F: 3.60}  # [m] in the dark, by PERIOD_A: short, medium, long; data sheet
NOTHING_MM = 8190  # what it shows without a target
GAIN = 2011 / 2048  # by which ST's driver multiplies a range
NOISE = 0.0025  # [m] standard deviation; chosen: that of Bitcraze's Kalman filter up to 2.5 m


class Ranger:
    """`measure` returns the true distance [m], `draw` a unit normal number. It is off until `switch`."""

    def __init__(
        self, chip: Chip, bus: int, later: Later, measure: Callable[[], float], draw: Callable[[], float]
    ) -> None:
        self._chip, self._later, self._measure, self._draw = chip, later, measure, draw
        self._registers = np.zeros(4096, np.uint8)
        self._device = chip.add_device(bus, NOWHERE, self._registers, address_bytes=2)
        self._on = False
        self._run = 0  # counts starts and stops: a measurement of an earlier one is dropped
        chip.on_write(self._device, self._obey)

    def switch(self, on: bool) -> None:
        """Turn it on, at its first address, or off (XSHUT)."""
        if on == self._on:
            return
        self._on = on
        self._run += 1
        self._chip.move_device(self._device, ADDRESS if on else NOWHERE)
        self._registers[:] = 0
        self._registers[[DEVICE_ADDRESS, INTERRUPT_POLARITY, SYSTEM_STATUS]] = ADDRESS, ACTIVE_LOW, 1
        self._registers[MODEL : MODEL + 3] = np.frombuffer(IDENTITY, np.uint8)
        self._put(FAST_OSCILLATOR, FAST_COUNTS)
        self._put(OSCILLATOR, SLOW_KHZ)
        self._interrupt(False)

    def _obey(self) -> None:
        """Do what has been written."""
        registers = self._registers
        self._chip.move_device(self._device, int(registers[DEVICE_ADDRESS]) & 0x7F)
        clear, mode = int(registers[CLEAR_INTERRUPT]) & 1, int(registers[START])
        registers[[CLEAR_INTERRUPT, START]] = 0  # they are commands
        if clear or mode & ABORT:
            self._interrupt(False)
        if mode & (ABORT | MODES):
            self._run += 1
        if mode & MODES and not mode & ABORT:
            self._later(self._duration_us(), partial(self._finish, self._run, bool(mode & TIMED)))

    def _finish(self, run: int, timed: bool, now_us: int) -> None:
        if run != self._run:
            return
        distance = self._measure() + NOISE * self._draw()
        seen = distance <= REACH.get(int(self._registers[PERIOD_A]), 0.0)
        self._registers[RANGE_STATUS] = VALID if seen else NO_TARGET
        count = int(self._registers[STREAM_COUNT]) + 1
        self._registers[STREAM_COUNT] = count if count < 256 else 128
        self._put(RANGE, round(1000.0 * max(distance, 0.0) / GAIN) if seen else NOTHING_MM)
        for register, value in ((SPADS, 16 << 8), (SIGNAL, 8 << 7), (CORRECTED_SIGNAL, 8 << 7), (AMBIENT, 1)):
            self._put(register, value)
        self._interrupt(True)
        if timed:
            pause_us = 1000 * int.from_bytes(self._registers[INTERVAL : INTERVAL + 4].tobytes()) // SLOW_KHZ
            self._later(max(pause_us, self._duration_us()), partial(self._finish, run, timed))

    def _duration_us(self) -> int:
        """Return how long a measurement takes."""
        clocks = 0
        for timeout, period in ((TIMEOUT_A, PERIOD_A), (TIMEOUT_B, PERIOD_B)):
            shift, low = self._registers[timeout : timeout + 2].tolist()
            clocks += ((low << shift) + 1) * MACRO_PERIODS * 2 * (int(self._registers[period]) + 1)
        return BEFORE_US + BETWEEN_US + 64 * clocks // FAST_COUNTS

    def _interrupt(self, ready: bool) -> None:
        self._registers[INTERRUPT] = ready != bool(self._registers[INTERRUPT_POLARITY] & ACTIVE_LOW)

    def _put(self, register: int, value: int) -> None:
        """Put a number of 16 bits into the registers, the high byte first."""
        self._registers[register : register + 2] = value >> 8, value & 0xFF
