"""A Crazyflie from power-on: the microcontroller with an image, the parts around it, and the serial line to its radio chip.

It uses only what all of Bitcraze's firmware has: a console, the clock of usec_time.c, `assertFail`.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from hil.emulator.crazyflie import barometer
from hil.emulator.crazyflie.decks import Decks
from hil.emulator.crazyflie.parts import BRUSHED, BRUSHLESS, Parts
from hil.emulator.crazyflie.radio_line import Outside, RadioLine
from hil.emulator.stm32f405.chip import SOFTWARE, WATCHDOG, Chip, StopReason
from hil.emulator.stm32f405.crash import Crash, CrashReports
from hil.emulator.stm32f405.debugged_chip import DebuggedChip
from hil.emulator.stm32f405.freertos import FreeRtos
from hil.emulator.stm32f405.gdb import GdbServer
from hil.emulator.stm32f405.image import Image
from hil.emulator.stm32f405.processor import ChipProcessor
from hil.emulator.stm32f405.stopped_tasks import TaskWatch
from hil.emulator.stm32f405.unnamed_freertos import UnnamedFreeRtos
from hil.errors import LabError
from hil.world.body import Carrier

LOOK_PERIOD_US = 100_000  # for tasks that do not wait, or wait for ever
# Busy for HANG_US: report a hang (a start waits busily for 0.2 s). Busy for AT_CRASH_US: the explanation of a crash.
HANG_US, AT_CRASH_US = 1_000_000, 5_000
# Functions of Bitcraze's firmware, and the low address that each writes to without effect, on every board.
KNOWN_WRITES = {("ledInit", 0x1A)}
CLOCK_HIGH, TIM7_COUNT = "usecTimerHighCount", 0x4000_1424  # of the firmware's usec_time.c
ASSERTION = "assertFail"
PLATFORM = "platformInit"  # refuses to start on a board whose device type its table lacks
PROFILES = {BRUSHED: "crazyflie", BRUSHLESS: "crazyflie-brushless"}  # that ship, by device type
# Other boards by the device types in their images, and what of them is not modelled.
OTHER_BOARDS = {
    "CB11": "a Crazyflie Bolt, whose IMU on SPI and ESCs for PWM are not modelled",
    "CB10": "a Crazyflie Bolt, whose IMU on SPI and ESCs for PWM are not modelled",
    "RR10": "a Roadrunner (platform tag), whose radio for positioning is not modelled",
    "CF20": "a Crazyflie 2.0, whose IMU MPU9250 is not modelled",
}
FLAPPER = "a Flapper, whose servos, ESCs and measurement of current (ADC) are not modelled"
FLAPPER_NAME = b"Flapper ("  # begins the names of its boards, which have the device types of others
POLES = 12  # of a brushless motor; MOTORS_NBR_OF_POLES of Bitcraze's firmware


class Surroundings(Outside, Protocol):
    """Where the board's pins lead to."""

    eeprom: bytearray

    def write_compare(self, counts: Sequence[int]) -> None:
        """Take the compare counts of the timers that drive the robot."""


class Crazyflie:
    """One board; `polls`: radio packets without contents come by themselves, as with a host that only listens.

    `outputs` are timer and channel, counted from 0, of what drives the robot.
    """

    def __init__(
        self,
        image: Image,
        library: Path,
        outside: Surroundings,
        polls: bool,
        debugger: GdbServer | None = None,
        outputs: Sequence[tuple[int, int]] = (),
        carrier: Carrier | None = None,
    ) -> None:
        self.image = image
        self.chip = chip = Chip(image.code, image.base, library, image.constants)
        self.parts = Parts(chip, np.frombuffer(outside.eeprom, np.uint8), carrier)
        _check_board(image, self.parts.device_type)
        if carrier is not None and carrier.escs is not None:
            for motor, (timer, channel) in enumerate(outputs):
                chip.add_esc(timer, channel, carrier.escs[motor : motor + 1], POLES)
        kernel = FreeRtos if image.named else UnnamedFreeRtos
        self.tasks = kernel.of(image, chip.read)
        run = chip.run
        if debugger is not None:
            run = DebuggedChip(chip, debugger, self.tasks, lambda: self.processor.ahead_us).run
        self.processor = ChipProcessor(chip, self.tasks, self._act, run)
        decks = Decks(chip, self.processor, carrier)
        self.radio = RadioLine(chip, self.processor, decks, outside, polls)
        self.resets = {WATCHDOG: 0, SOFTWARE: 0}  # by cause, since power-on
        self._outside, self._outputs = outside, outputs
        self._crashes = CrashReports(image, chip, self.tasks, ASSERTION)
        chip.crash_points |= self._crashes.addresses
        self.failures: list[str] = []  # since power-on: what stopped the firmware or one of its tasks
        self.known: list[str] = []  # since power-on: harmless mistakes of Bitcraze's firmware
        self._crashed = False  # since the reset
        self._watch = None if self.tasks is None else TaskWatch(chip, self.tasks)
        self._hanging: set[int] = set()  # tasks, since the reset
        self._counts: tuple[int, ...] = ()
        self._unknown = 0
        self.processor.every(barometer.PERIOD_US, lambda now_us: self.parts.measure_pressure())
        self.processor.every(LOOK_PERIOD_US, lambda now_us: self._look_at_tasks(HANG_US))

    def report_unknown(self) -> None:
        """Say which peripherals the image has used that are not there."""
        state = self.chip.state
        for address in state.unknown[self._unknown : state.unknown_count]:
            clocked = not address & 1
            what = "that is not modelled" if clocked else "whose clock is off (RCC)"
            effect = "it reads as 0" if clocked else "it reads as 0 and keeps nothing"
            self._outside.debug_write(
                f"the image uses a peripheral {what}, at 0x{address & ~1:08x}: {effect}"
            )
        self._unknown = state.unknown_count

    @property
    def clock_us(self) -> int | None:
        """Return the firmware's own microseconds, a 16-bit timer and how often it has overflowed; None without it.

        A read while the timer carries may be 65 ms short.
        """
        if not self.image.has(CLOCK_HIGH):
            return None
        high, low = (self.chip.read(at, 4) for at in (self.image.symbol(CLOCK_HIGH).address, TIM7_COUNT))
        return (int.from_bytes(high, "little") << 16) + int.from_bytes(low, "little")

    # What the chip does to the outside

    def _act(self, reason: int) -> None:
        if reason & StopReason.SERIAL:
            self.radio.sent()
        if reason & StopReason.DEVICE:
            self.chip.tell_devices()
        if reason & StopReason.COMPARE:
            counts = tuple(self.chip.state.compare[timer][channel] for timer, channel in self._outputs)
            if counts != self._counts:
                self._counts = counts
                self._outside.write_compare(counts)
        if reason & (StopReason.LOW_READ | StopReason.LOW_WRITE):
            address = self.chip.state.fault_address
            self._report_access(
                address, self._crashes.low_access(address, bool(reason & StopReason.LOW_WRITE))
            )
        if reason & StopReason.DIVISION:
            self._outside.debug_write(str(self._crashes.division()))
        if reason & StopReason.OVERFLOW:
            self._report(self._crashes.overflow(self.chip.state.overflow))
        if reason & StopReason.BREAK:
            self._look_at_tasks(AT_CRASH_US)
            self._report(self._crashes.here())
            self._crashed = True
            self.chip.crash_points.clear()  # a handler may be a loop of one instruction
        if reason & StopReason.LOCKUP:
            self._report(self._crashes.lockup())
            self._crashed = True
        if reason & StopReason.WATCHDOG:
            self._look_at_tasks(AT_CRASH_US)
            self._report(self._crashes.watchdog())
            self._reset(WATCHDOG)
        elif reason & StopReason.RESET:
            self._report(self._crashes.software_reset())
            self._reset(SOFTWARE)

    def _report(self, crash: Crash) -> None:
        self.failures.append(str(crash))
        self._outside.debug_write(str(crash))

    def _report_access(self, address: int, crash: Crash) -> None:
        """Report an access that has no effect; keep one that Bitcraze's firmware is known for."""
        names = {place.split()[0] for place in crash.trace}
        if any(at == address and (name in names or not self.image.named) for name, at in KNOWN_WRITES):
            self.known.append(str(crash))
        else:
            self._outside.debug_write(str(crash))

    def _look_at_tasks(self, least_us: int) -> None:
        """Report tasks that stopped, or keep the others from running, once, before anything else has gone wrong."""
        if self._crashed:
            return
        if not self.image.named:
            self.processor.find_kernel()
        busy = self.processor.longest_busy(least_us)
        if busy is not None and busy[0] not in self._hanging:
            self._hanging.add(busy[0])
            self._report(self._crashes.hang(*busy))
        for task in self._watch.newly_stopped() if self._watch is not None else ():
            self._report(self._crashes.stopped(task.block, task.silent_us, task.period_us, task.reason))

    def _reset(self, cause: int) -> None:
        self._crashed = False
        if self._watch is not None:
            self._watch.restart()
        self._hanging.clear()
        self.resets[cause] += 1
        self.chip.reset(cause)
        self.radio.reset(self.chip.now_us)
        self.chip.crash_points |= self._crashes.addresses


def _check_board(image: Image, device_type: str) -> None:
    """Raise `LabError` for Bitcraze's firmware that would not start on a board of this type, or drives another robot.

    Firmware without symbols is Bitcraze's if it has one of the device types.
    """
    found = [one for one in (*PROFILES, *OTHER_BOARDS) if f"{one}\0".encode() in image.code]
    if not (image.has(PLATFORM) if image.named else found):
        return
    if FLAPPER_NAME in image.code:
        raise LabError(f"{image.path}: built for {FLAPPER}")
    if device_type in found:
        return
    known = [one for one in PROFILES if one in found]
    if found and not known:
        raise LabError(f"{image.path}: built for {OTHER_BOARDS[found[0]]}")
    fitting = "".join(f"; --profile {PROFILES[one]}" for one in known)
    raise LabError(
        f"{image.path}: built for boards of device type {' and '.join(known) or 'unknown here'}, but this robot's is "
        f"{device_type}{fitting}"
    )
