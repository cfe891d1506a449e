"""The laboratory's interface to a board: boot, interrupts, signals and counters.

The firmware in Python, an image on the emulated chip and a real board in the loop implement it. What a board cannot
report is None or empty. All its times count from its boot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

from numpy.typing import NDArray

from firmware_py.board import Board, ImuCounts
from firmware_py.config import FirmwareConfig
from firmware_py.core_runner import RunnerFactory, default_runner
from firmware_py.export.usage import Usage
from firmware_py.firmware import Firmware
from firmware_py.rtos import TaskReport
from firmware_py.signals import Signals
from firmware_py.tasks import FlightTasks
from firmware_py.wire.scalars import Scalar
from hil.emulator.crazyflie.shockburst import syslink_us
from hil.world.body import Carrier
from hil.world.servos import OUTPUTS

if TYPE_CHECKING:
    from hil.emulator.crazyflie.log_table import ImageParameter

# (us, event, who, a, b), in the words of tests/vectors/README.md
Trace = Callable[[int, str, str, int, int], None]


class Pins(Board, Protocol):
    """A board's pins; a processor may also command its radio chip."""

    def radio_command(self, kind: int, data: bytes) -> None:
        """Take a command to the radio chip, as in syslink."""


class BoardVariable(Protocol):
    @property
    def name(self) -> str:
        """Its group and name."""

    @property
    def scalar(self) -> Scalar:
        """Its type on the wire."""

    @property
    def unit(self) -> str:
        """Its unit, empty for a pure number."""

    @property
    def read(self) -> Callable[[], float]:
        """Read its current value."""


class BoardTask(Protocol):
    """A task of the board's scheduler."""

    name: str
    priority: int  # now
    deadline_misses: int


class TaskQueue(Protocol):
    """A queue of the board's scheduler."""

    name: str
    length: int  # its capacity
    high_water: int  # how full it has been at most
    dropped: int


class Processor(Protocol):
    """The clock of a booted processor."""

    @property
    def now_us(self) -> int:
        """The current time."""

    def advance(self, now_us: int) -> None:
        """Advance its clock to a time before which nothing is due."""

    def run(self, now_us: int, until_us: int = 0) -> None:
        """Run to a time until all tasks are blocked or busy, then on to a later one, if given."""

    def stop_before(self, us: int) -> None:
        """Stop the run before this time."""


class BoardScheduler(Protocol):
    """The tasks of a board."""

    @property
    def tasks(self) -> Sequence[BoardTask]:
        """All tasks, in the order in which they were created or first ran."""

    @property
    def queues(self) -> Sequence[TaskQueue]:
        """All queues."""

    @property
    def current(self) -> BoardTask:
        """The task that has the processor."""

    def run_times_us(self) -> list[int]:
        """Return how long each task has had the processor."""

    def occupy(self, name: str, taken_us: Callable[[], int]) -> None:
        """Take processor time at every tick. Raises `LabError` on a board that does not allow it."""

    @property
    def trace(self) -> Trace | None:
        """The receiver of every task switch."""

    def set_trace(self, trace: Trace | None) -> None:
        """Start or stop reporting every task switch."""


class FrameCounts(Protocol):
    """The board's counters of frames on its serial line."""

    @property
    def bad(self) -> int:
        """Rejected frames."""

    @property
    def lost(self) -> int:
        """Missing frames, by gaps in the sequence."""


class FrameReader(Protocol):
    @property
    def counters(self) -> FrameCounts:
        """The counters of what it has read."""


@dataclass(frozen=True, slots=True)
class ImageReport:
    """The memory that an image never used in its flight, and its restarts."""

    sha256: str  # of what is in flash
    stack_free_bytes: Mapping[str, int]  # of each task, never used since its creation
    heap_free_bytes: int | None  # None: it has no heap of FreeRTOS
    heap_least_free_bytes: int | None  # when it was fullest
    watchdog_resets: int
    software_resets: int


class Flashed(Protocol):
    """A board with compiled constants; a profile reaches it over the radio."""

    @property
    def notes(self) -> Sequence[str]:
        """What was taken of a release, and what is unknown of an image without symbols, each as one line."""

    @property
    def parameters(self) -> Mapping[str, ImageParameter]:
        """Its parameters, by name."""

    @property
    def resets(self) -> int:
        """How often it has restarted by itself since power-on."""

    @property
    def failures(self) -> Sequence[str]:
        """What stopped it or one of its tasks since power-on, in order, each as one line."""

    @property
    def known_findings(self) -> Sequence[str]:
        """Harmless mistakes that its makers' firmware is known for, each as one line."""

    def report_observed(self, folder: Path) -> None:
        """Let its observers report a flight, whose run folder is given. Raises `LabError`."""

    def differences(self, config: FirmwareConfig) -> str:
        """Return the differences between its core and a profile in one line; empty if none."""

    def report(self) -> ImageReport:
        """Return its memory use so far."""


class BoardFirmware(Protocol):
    """A booted board."""

    def imu_ready(self) -> None:
        """Interrupt: the IMU has a new sample."""

    def radio_received(self, data: bytes, broadcast: bool = False) -> None:
        """Interrupt: the radio chip has a packet."""

    def radio_polled(self) -> None:
        """Interrupt: the radio chip has an empty packet."""

    def uart_ready(self) -> None:
        """Interrupt: the UART has bytes."""

    @property
    def kernel(self) -> Processor:
        """Its clock."""

    @property
    def scheduler(self) -> BoardScheduler | None:
        """Its tasks, if they can be observed."""

    @property
    def signals(self) -> Signals:
        """Views on its estimate, counters, inputs, counts and supervisor; NaN for numbers it does not report."""

    @property
    def flight_tasks(self) -> FlightTasks | None:
        """The tasks that may take the beats of the hardware by themselves; None for other firmware."""

    @property
    def variables(self) -> Sequence[BoardVariable]:
        """The log variables that can be read at any time."""

    @property
    def log_numbers(self) -> Mapping[str, int]:
        """The numbers of its log variables in its table of contents, by name; empty without a log service."""

    @property
    def parameter_numbers(self) -> Mapping[str, int]:
        """The same for its parameters."""

    @property
    def inputs(self) -> NDArray[Any] | None:
        """A view on the flight core's input, (1,); None for a board without the core or one that does not show it."""

    def reports(self) -> Sequence[TaskReport]:
        """Return the timing of its tasks so far, in the order of their first run."""

    @property
    def overrun(self) -> str:
        """The first loop of user logic that exceeded the budget of its call, in one line; empty: none or not reported."""

    @property
    def usage(self) -> Usage | None:
        """The core's processor load, if it is measured."""

    @property
    def clock_us(self) -> int | None:
        """The time of the board's clock [us]; None if it is the laboratory's."""

    @property
    def mavlink(self) -> FrameReader | None:
        """The counters of its serial line, if it has one."""

    @property
    def flashed(self) -> Flashed | None:
        """What is in its flash, if that was compiled without the profile."""

    def check_watchdog(self) -> None:
        """Raise `WatchdogError` or `LinkError` when its tasks have been silent for too long."""


@dataclass(frozen=True, slots=True)
class PowerOn:
    """The inputs of a power-on: the board's pins and profile.

    `serial`: its UART is connected. `polled`: a host polls its radio chip, also when it has nothing to send. `rest` gives
    the IMU's counts while the robot is at rest, before the laboratory's time begins; None for a reboot. `outputs` are
    timer and channel, from 0, of the robot's actuators. `carrier` is what its other sensors measure.
    """

    board: Pins
    config: FirmwareConfig
    serial: bool
    polled: bool
    rest: Callable[[], ImuCounts] | None
    outputs: Sequence[tuple[int, int]] = OUTPUTS
    carrier: Carrier | None = None


class Executor(Protocol):
    """Executes the firmware of a board, boot by boot."""

    @property
    def needs_polls(self) -> bool:
        """Whether its packets leave only when its radio chip is polled."""

    def wire_us(self, data: bytes) -> int:
        """Return a packet's time between its radio chip and it, unless it simulates that itself."""

    @property
    def in_flash(self) -> bytes:
        """The content of its flash from the start on, as a boot loader reads it; empty: unknown."""

    def flashed_with(self, flash: bytes) -> Executor:
        """Return what executes a flash that was written to; itself if nothing changes. Raises `LabError`."""

    def boot(self, start: PowerOn) -> BoardFirmware:
        """Return the firmware of a new boot."""


@dataclass(frozen=True, slots=True)
class PythonBoard:
    """Executes the firmware in Python, with its flight core in `runner`; what is flashed is not executed."""

    runner: RunnerFactory = default_runner
    needs_polls: ClassVar[bool] = False
    wire_us = staticmethod(syslink_us)

    in_flash: ClassVar[bytes] = b""

    def flashed_with(self, flash: bytes) -> PythonBoard:
        return self

    def boot(self, start: PowerOn) -> Firmware:
        return Firmware(start.config, start.board, start.serial, self.runner)
