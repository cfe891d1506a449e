"""An image that flies: the chip and a Crazyflie's parts around it, with the face of `firmware_py.firmware.Firmware`.

Power comes on `WARM_UP_US` before the laboratory's time begins, because an image needs seconds to start;
the robot rests in its holder meanwhile. A reset in flight takes as long as it takes.

Of the robot's state there is what the exported app has, found by symbols; an image without the app has none of it.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.board import Board, ImuCounts
from firmware_py.config import FirmwareConfig, parameters_of
from firmware_py.signals import CONTROL, COUNTERS, ESTIMATOR
from firmware_py.wire.supervisor import Cause, State
from hil.devices.stm32f405 import syslink
from hil.devices.stm32f405.chip import SOFTWARE, WATCHDOG, Chip, Why, build_machine
from hil.devices.stm32f405.crash import CrashReports
from hil.devices.stm32f405.crazyflie import RADIO_BUSY, SYSLINK_USART, CrazyflieBoard
from hil.devices.stm32f405.freertos import HEAP, HEAP_LEAST
from hil.devices.stm32f405.gdb import DebuggedChip, GdbServer
from hil.devices.stm32f405.image import Image
from hil.devices.stm32f405.log_table import LogVariable, log_table, parameter_table
from hil.devices.stm32f405.processor import ImageStatistics, Processor
from hil.errors import LabError

# The stock firmware's self-test and gyro calibration take 3.06 s. The rest lets the app's estimator step at the phase of the
# cameras' frames at which ours does, 2 to 3 ms after a pose: in reality it is any.
WARM_UP_US = 3_104_000
BATTERY_PERIOD_US = 100_000
POLL_PERIOD_US = 2_000  # of an idle radio link: the nRF51 hands every packet on, also empty ones
IMU_PERIOD_US = 1_000
CONSOLE, CONSOLE_MASK = 0x00, 0xF3
CLOCK_HIGH, TIM7_COUNT = "usecTimerHighCount", 0x4000_1424  # of the firmware's usec_time.c
OWN_LOGIC = "floaty_guard"  # there is one in images with logic of the user's own
SERVOS = ((4, 2), (2, 0), (2, 1), (4, 3))  # M1 to M4: TIM5_CH3, TIM3_CH1, TIM3_CH2, TIM5_CH4, counted from 0


class ChipSupervisor:
    """State and cause of the app's supervisor, calibrating for ever without the app."""

    def __init__(self, variables: dict[str, LogVariable]) -> None:
        self._state, self._cause = (variables.get(f"supervisor.{name}") for name in ("state", "cause"))

    @property
    def state(self) -> State:
        """What it does."""
        return State(int(self._state.read())) if self._state else State.CALIBRATING

    @property
    def cause(self) -> Cause:
        """Why it is in its failsafe."""
        return Cause(int(self._cause.read())) if self._cause else Cause.NONE


@dataclass(frozen=True, slots=True)
class ChipSignals:
    """As `firmware_py.signals.Signals`: views on the chip's memory."""

    estimate: NDArray[np.float32]
    counters: NDArray[np.int32]
    u: NDArray[np.float32]
    flap: NDArray[np.float32]
    count: NDArray[np.int32]
    supervisor: ChipSupervisor


@dataclass(frozen=True, slots=True)
class NoQueue:
    """The app's queue of poses counts nothing that could be read."""

    high_water: int = 0
    dropped: int = 0


@dataclass(frozen=True, slots=True)
class ChipImage:
    """What is flashed, and the compiled machine that executes it."""

    image: Image
    library: Path
    debugger: GdbServer | None = None

    @classmethod
    def load(cls, path: Path, elf: Path | None, folder: Path, debugger: GdbServer | None = None) -> ChipImage:
        """Read an image and compile the machine into a folder. Raises `LabError` and `ExportError`."""
        return cls(Image(path, elf), build_machine(folder), debugger)


class ImageFirmware:
    """An image at power-on. `rest` gives the IMU's counts while the robot is at rest, before the laboratory's time begins.

    `polls`: whether radio packets without contents come by themselves, as with a host that only listens.
    """

    runner = None
    mavlink = None

    def __init__(
        self, flashed: ChipImage, board: Board, rest: Callable[[], ImuCounts] | None, polls: bool = True
    ) -> None:
        self.image = image = flashed.image
        self._board = board
        self.chip = Chip(image.code, image.base, flashed.library, image.constants)
        self.parts = CrazyflieBoard(self.chip, np.frombuffer(board.eeprom, np.uint8))
        self.kernel = Processor(self.chip, image, self._act)
        self._crashes = CrashReports(image, self.chip, self.kernel.kernel)
        self.chip.breakpoints |= self._crashes.addresses
        if flashed.debugger is not None:
            self.kernel.run_chip = DebuggedChip(self.chip, flashed.debugger).run
        self._decoder = syslink.Decoder()
        self._waiting: list[bytes] = []  # for the nRF51, whose queue is full
        self._line = b""
        self._counts: tuple[int, ...] = ()
        self._unknown = 0
        self.resets = {WATCHDOG: 0, SOFTWARE: 0}  # by cause, since power-on
        self.kernel.every(BATTERY_PERIOD_US, self._report_battery)
        if polls:
            self.kernel.every(POLL_PERIOD_US, lambda now_us: self.radio_polled())
        table = {variable.name: variable for variable in log_table(image, self.chip)}
        self.variables = [v for v in table.values() if v.name.startswith("excite.")]
        self.parameters = parameter_table(image, self.chip)
        self.measurements = NoQueue()
        self.signals = self._signals(table)
        self.statistics = ImageStatistics(self.kernel)
        if rest is not None:
            self._warm_up(rest)

    def _warm_up(self, rest: Callable[[], ImuCounts]) -> None:
        for now_us in range(IMU_PERIOD_US, WARM_UP_US + 1, IMU_PERIOD_US):
            self.kernel.run(now_us)
            self.parts.sample(rest())
        self.kernel.begin(WARM_UP_US)

    def differences(self, config: FirmwareConfig) -> str:
        """Return in what the core of an image with the app differs from a profile, in one line; empty if in nothing."""
        if not self.image.has("floaty_parameters"):
            return ""
        parameters = parameters_of(config).memory
        built = self._struct("floaty_parameters", parameters.dtype)
        found = [
            f"{name} = {built[name][0].tolist()}, in the profile {parameters[name][0].tolist()}"
            for name in parameters.dtype.names or ()
            if not np.array_equal(built[name], parameters[name])
        ]
        own = bool(config.logic.controller or config.logic.estimator)
        if own != self.image.has(OWN_LOGIC):
            found.append("control law, the profile has " + ("one of the user's" if own else "the core's"))
        return "; ".join(found)

    # Interrupts and time

    def imu_ready(self) -> None:
        """The IMU has a new sample."""
        self.parts.sample(self._board.read_imu())

    def radio_received(self, data: bytes, broadcast: bool = False) -> None:
        """The radio chip has a packet: it comes over the serial line, and fetches one."""
        self._flush()
        kind = syslink.RAW_BROADCAST if broadcast else syslink.RAW
        self.chip.feed(SYSLINK_USART, syslink.encode(kind, data))

    def radio_polled(self) -> None:
        """The radio chip has an empty packet."""
        self._flush()
        self.chip.feed(SYSLINK_USART, syslink.encode(syslink.RAW, syslink.EMPTY))

    def uart_ready(self) -> None:
        """Nothing: no serial line leads to the image."""

    def check_watchdog(self) -> None:
        """Say which peripherals the image has used that are not there; the watchdog acts by itself."""
        state = self.chip.state
        for address in state.unknown[self._unknown : state.unknown_count]:
            self._board.debug_write(
                f"the image uses a peripheral that is not modelled, at 0x{address:08x}: it reads as 0"
            )
        self._unknown = state.unknown_count

    def stacks_left(self) -> dict[str, int]:
        """Return how many bytes of each task's stack were never used; nothing for an image without FreeRTOS."""
        kernel = self.kernel.kernel
        return {
            task.name: task.stack_free_bytes
            for task in (() if kernel is None or not kernel.running else kernel.tasks())
        }

    @property
    def clock_us(self) -> int:
        """Return the microseconds of the firmware's own clock, a 16-bit timer and how often it has overflowed."""
        high = self.chip.read(self.image.symbol(CLOCK_HIGH).address, 4)
        return (int.from_bytes(high, "little") << 16) + int.from_bytes(
            self.chip.read(TIM7_COUNT, 4), "little"
        )

    @property
    def has_clock(self) -> bool:
        """Whether it has the Crazyflie's."""
        return self.image.has(CLOCK_HIGH)

    def heap_left(self) -> tuple[int | None, int | None]:
        """Return the free bytes of the heap, now and at its fullest; None where FreeRTOS keeps none."""
        kernel = self.kernel.kernel
        if kernel is None or not (self.image.has(HEAP) and self.image.has(HEAP_LEAST)):
            return None, None
        return kernel.heap_free_bytes, kernel.heap_least_free_bytes

    def add_thief(self) -> Any:
        """Raise `LabError`: nobody can add a task to an image."""
        raise LabError(f"--board {self.image.path}: cpu.load adds a task, which an image cannot get")

    # What the chip does to the outside

    def _act(self, why: Why) -> None:
        if why & Why.SERIAL:
            for kind, data in self._decoder.take(self.chip.sent(SYSLINK_USART)):
                self._answer(kind, data)
        if why & Why.COMPARE:
            counts = tuple(self.chip.state.compare[timer][channel] for timer, channel in SERVOS)
            if all(counts) and counts != self._counts:
                self._counts = counts
                self._board.write_compare(counts)
        if why & Why.BREAK:
            self._board.debug_write(str(self._crashes.here()))
            self.chip.breakpoints -= self._crashes.addresses  # a handler may be a loop of one instruction
        if why & Why.LOCKUP:
            self._board.debug_write(str(self._crashes.lockup()))
        if why & Why.WATCHDOG:
            self._board.debug_write(str(self._crashes.watchdog()))
            self._reset(WATCHDOG)
        elif why & Why.RESET:
            self._board.debug_write("reset by software")
            self._reset(SOFTWARE)

    def _reset(self, cause: int) -> None:
        self.resets[cause] += 1
        self.chip.reset(cause)
        self.chip.breakpoints |= self._crashes.addresses

    def _answer(self, kind: int, data: bytes) -> None:
        """Do what the nRF51 does with a frame of the STM32."""
        if kind == syslink.RAW and data:
            if data[0] & CONSOLE_MASK == CONSOLE:
                self._print(data[1:])
            self._waiting.append(data)
            self._flush()
        elif kind == syslink.SCAN_MEMORIES:
            self.chip.feed(SYSLINK_USART, syslink.encode(kind, b"\0"))
        elif kind == syslink.VERSION:
            self.chip.feed(SYSLINK_USART, syslink.encode(kind, b"\0emulated\0"))

    def _flush(self) -> None:
        """Hand packets to the radio; while its queue is full it takes no more bytes of the STM32."""
        while self._waiting and self._board.radio_send(self._waiting[0]):
            self._waiting.pop(0)
        self.chip.pin(*RADIO_BUSY, bool(self._waiting))

    def _print(self, text: bytes) -> None:
        *lines, self._line = (self._line + text).split(b"\n")
        for line in lines:
            self._board.debug_write(line.decode(errors="replace"))

    def _report_battery(self, now_us: int) -> None:
        volts = self._board.read_battery_mv() / 1000
        self.chip.feed(
            SYSLINK_USART, syslink.encode(syslink.BATTERY, struct.pack("<Bfff", 0, volts, 0.0, 25.0))
        )

    # What is read of the app

    def _signals(self, table: dict[str, LogVariable]) -> ChipSignals:
        estimator, control = (
            self._struct("floaty_estimator", ESTIMATOR),
            self._struct("floaty_control", CONTROL),
        )
        start = dict(ESTIMATOR.fields or {})[COUNTERS[0]][1]
        counters = np.ndarray(len(COUNTERS), np.int32, estimator.view(np.uint8).data, start)
        return ChipSignals(
            estimator["now"][0],
            counters,
            control["u"][0],
            control["flap"][0],
            control["count"][0],
            ChipSupervisor(table if self.image.has("floaty_supervisor") else {}),
        )

    def _struct(self, name: str, layout: np.dtype[Any]) -> NDArray[Any]:
        """Return a view on a struct of the core, (1,); one of zeros for an image without the app."""
        if not self.image.has(name):
            return np.zeros(1, layout)
        symbol = self.image.symbol(name)
        if symbol.size != layout.itemsize:
            raise LabError(
                f"{self.image.path}: {name} has {symbol.size} bytes where this laboratory's core has "
                f"{layout.itemsize}: it was exported by another version"
            )
        return self.chip.view(symbol.address, symbol.size).view(layout)
