"""A board as the laboratory knows it: how it boots, what interrupts it, what it shows and counts.

The firmware in Python, an image on the emulated chip and a real board in the loop are such boards. What one of them cannot
report is None or empty. All its instants count from its boot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol

from firmware_py.board import Board, ImuCounts
from firmware_py.config import FirmwareConfig
from firmware_py.core_runner import PythonRunner, RunnerFactory
from firmware_py.export.usage import Usage
from firmware_py.firmware import Firmware
from firmware_py.rtos import TaskReport
from firmware_py.signals import Signals
from firmware_py.wire.scalars import Scalar
from hil.crazyflie.shockburst import syslink_us
from hil.world.body import Carrier
from hil.world.servos import OUTPUTS

if TYPE_CHECKING:
    from hil.crazyflie.log_table import ImageParameter

Trace = Callable[
    [int, str, str, int, int], None
]  # (us, event, who, a, b), in the words of tests/vectors/README.md


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
        """Reads it now."""


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
    """The time of a booted processor."""

    @property
    def now_us(self) -> int:
        """The present instant."""

    @property
    def next_wake_us(self) -> int | None:
        """The next instant at which it acts without an interrupt."""

    def advance(self, now_us: int) -> None:
        """Bring its clock to an instant before which nothing is due."""

    def run(self, now_us: int, until_us: int = 0) -> None:
        """Run up to an instant until all is blocked or busy, and on to a later one, if given."""

    def stop_before(self, us: int) -> None:
        """Limit the run to the instants before this one."""


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
        """Let something outside take the processor at every tick. Raises `LabError` where it cannot be taken."""

    @property
    def trace(self) -> Trace | None:
        """Who gets every switch of tasks."""

    def set_trace(self, trace: Trace | None) -> None:
        """Report every switch of tasks from now on, or no more."""


class BoardStatistics(Protocol):
    """Timing of the tasks."""

    def reports(self) -> Sequence[TaskReport]:
        """Return it so far, task by task."""


class FrameCounts(Protocol):
    """What the board counts of the frames on its serial line."""

    @property
    def bad(self) -> int:
        """Frames that were refused."""

    @property
    def lost(self) -> int:
        """Frames that were missing between others."""


@dataclass(frozen=True, slots=True)
class ImageReport:
    """What an image left unused at the end of its flight, and how often it began anew."""

    sha256: str  # of what is in flash
    stack_free_bytes: Mapping[str, int]  # of each task, never used since its creation
    heap_free_bytes: int | None  # None: it has no heap of FreeRTOS
    heap_least_free_bytes: int | None  # when it was fullest
    watchdog_resets: int
    software_resets: int


class Flashed(Protocol):
    """A board whose constants were compiled long before; a profile reaches it over the radio."""

    @property
    def parameters(self) -> Mapping[str, ImageParameter]:
        """What can be set, by name."""

    @property
    def resets(self) -> int:
        """How often it has begun anew by itself since power-on."""

    def differences(self, config: FirmwareConfig) -> str:
        """Return in one line in what its core differs from a profile; empty if in nothing."""

    def report(self) -> ImageReport:
        """Return what it has used so far."""


class BoardFirmware(Protocol):
    """A booted board."""

    def imu_ready(self) -> None:
        """The IMU has a new sample."""

    def radio_received(self, data: bytes, broadcast: bool = False) -> None:
        """The radio chip has a packet."""

    def radio_polled(self) -> None:
        """The radio chip has an empty packet."""

    def uart_ready(self) -> None:
        """The UART has bytes."""

    @property
    def kernel(self) -> Processor:
        """Its time."""

    @property
    def scheduler(self) -> BoardScheduler | None:
        """Its tasks, where they can be watched."""

    @property
    def signals(self) -> Signals:
        """Views on its estimate, counters, inputs, counts and supervisor; NaN where it does not report a number."""

    @property
    def variables(self) -> Sequence[BoardVariable]:
        """Its log variables, as far as they can be read at any time."""

    @property
    def log_numbers(self) -> Mapping[str, int]:
        """The numbers of its log variables in its table of contents, by name; empty where no log service answers."""

    @property
    def statistics(self) -> BoardStatistics:
        """Timing of its tasks."""

    @property
    def overrun(self) -> str:
        """Which loop of own logic first exceeded the budget of its call, as one line; empty: none, or not reported."""

    @property
    def usage(self) -> Usage | None:
        """What the core takes of the processor, where it is measured."""

    @property
    def clock_us(self) -> int | None:
        """The time of the board's clock [us]; None if it is the laboratory's."""

    @property
    def mavlink(self) -> FrameCounts | None:
        """The counters of its serial line, if one leads to it."""

    @property
    def flashed(self) -> Flashed | None:
        """What is in its flash, where that was compiled before the profile was known."""

    def check_watchdog(self) -> None:
        """Raise `WatchdogError` or `LinkError` when nothing has been heard of its tasks for too long."""


@dataclass(frozen=True, slots=True)
class PowerOn:
    """What a board is powered on with: its pins and its profile.

    `serial`: its UART leads somewhere. `polled`: a host polls its radio chip, also when it has nothing to send. `rest` gives
    the IMU's counts while the robot is at rest, before the laboratory's time begins; None for a reboot. `outputs` are
    timer and channel, counted from 0, of what drives the robot. `carrier` is what its other sensors measure.
    """

    board: Board
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
        """Whether its packets leave only when something polls its radio chip."""

    def wire_us(self, data: bytes) -> int:
        """Return how long a packet takes from its radio chip to it, or back, where it does not simulate that itself."""

    def boot(self, start: PowerOn) -> BoardFirmware:
        """Return the firmware of a new boot."""


@dataclass(frozen=True, slots=True)
class PythonBoard:
    """Executes the firmware in Python; `runner` its flight core."""

    runner: RunnerFactory = PythonRunner
    needs_polls: ClassVar[bool] = False

    def wire_us(self, data: bytes) -> int:
        """Return what the serial line between the two chips takes."""
        return syslink_us(data)

    def boot(self, start: PowerOn) -> Firmware:
        return Firmware(start.config, start.board, start.serial, self.runner)
