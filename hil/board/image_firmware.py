"""A firmware image in flight: the Crazyflie that executes it, and the exported app's values in its memory.

Power comes on `WARM_UP_US` before the laboratory's time begins, because an image needs seconds to start; the robot rests
in its holder meanwhile. A reset in flight takes its real time.

The robot's state is read from the exported app by symbols, or from the log variables of an image without it: the stock
firmware's own estimate (in W), motors and supervisor; missing values are empty.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from math import nan, radians
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_py.board import ImuCounts
from firmware_py.config import FirmwareConfig, parameters_of
from firmware_py.export.elf import ERASED, FLASH, read
from firmware_py.logic.loading import Logic, SensedField, load_logic, sensed_by
from firmware_py.rtos import TaskReport
from firmware_py.signals import CONTROL, ESTIMATOR, INPUT, Signals
from firmware_py.wire.supervisor import LOCKED, Cause, State
from firmware_py.wire.telemetry import LEGACY_DEGREES
from hil.board.board_firmware import ImageReport, Pins, PowerOn
from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.crazyflie import Crazyflie
from hil.emulator.crazyflie.log_table import ImageVariable, log_numbers, log_table, parameter_table
from hil.emulator.crazyflie.release_file import is_release, released_firmware
from hil.emulator.stm32f405.chip import SOFTWARE, WATCHDOG, build_machine
from hil.emulator.stm32f405.gdb import GdbServer
from hil.emulator.stm32f405.image import Image
from hil.errors import LabError
from hil.world.body import Carrier
from hil.world.servos import OUTPUTS

# The stock firmware's self-test and gyro calibration take 3.06 s. The rest gives the app's estimator the phase that ours
# has, 2 to 3 ms after a camera pose: a real one has any phase.
WARM_UP_US = 3_104_000
IMU_PERIOD_US = 1_000
OWN_LOGIC = "floaty_guard"  # exists in images with the user's own logic
FLYING, TUMBLED, CRASHED = 1 << 4, 1 << 5, 1 << 7  # of `supervisor.info`, beside LOCKED
DEGREE = radians(1.0)
# Name and factor to SI of the estimate's twelve numbers.
ESTIMATE = (
    *((f"stateEstimate.{name}", 1.0) for name in ("x", "y", "z", "vx", "vy", "vz")),
    *((f"stateEstimate.{name}", 1.0 / scale) for name, scale in zip(("roll", "pitch", "yaw"), LEGACY_DEGREES, strict=True)),
    *((f"gyro.{name}", DEGREE) for name in "xyz"),
)  # fmt: skip
MOTORS = tuple(f"motor.m{number}" for number in (1, 2, 3, 4))
FLASHED = Path("flashed image")
NO_SYMBOLS = (
    "no symbols: tasks, log variables and parameters are found by the shape of their tables; functions, source lines, "
    "queues, the heap and assertions have no names (--elf FILE, from which it was made, has them)"
)
NO_FLOATS, NO_COUNTS = np.empty(0, np.float32), np.empty(0, np.int32)


class ChipSupervisor:
    """State and cause of the app's supervisor; without the app it calibrates for ever."""

    def __init__(self, variables: dict[str, ImageVariable]) -> None:
        self._state, self._cause = (variables.get(f"supervisor.{name}") for name in ("state", "cause"))

    @property
    def state(self) -> State:
        number = int(self._state.read()) if self._state else State.CALIBRATING
        # A crash may have overwritten it.
        return State(number) if number in tuple(State) else State.CALIBRATING

    @property
    def cause(self) -> Cause:
        number = int(self._cause.read()) if self._cause else Cause.NONE
        return Cause(number) if number in tuple(Cause) else Cause.NONE


@dataclass(frozen=True, slots=True)
class StockSupervisor:
    """`bits` are those of `supervisor.info`."""

    bits: int

    @property
    def state(self) -> State:
        """Our name for its state: failsafe once it stops all motors."""
        if self.bits & (LOCKED | TUMBLED | CRASHED):
            return State.FAILSAFE
        return State.FLYING if self.bits & FLYING else State.WAITING

    @property
    def cause(self) -> Cause:
        return Cause.EMERGENCY_STOP if self.bits & LOCKED else Cause.NONE


def stock_signals(table: Mapping[str, ImageVariable]) -> Signals:
    """Return the current values; NaN for a variable that the image lacks."""

    def read(name: str, missing: float) -> float:
        return table[name].read() if name in table else missing

    estimate = np.array([factor * read(name, nan) for name, factor in ESTIMATE], np.float32)
    motors = np.array([read(name, 0.0) for name in MOTORS], np.int32)
    supervisor = StockSupervisor(int(read("supervisor.info", 0.0)))
    return Signals(estimate, NO_COUNTS, NO_FLOATS, NO_FLOATS, motors, supervisor)


def differences(built: NDArray[Any], config: FirmwareConfig, has: Callable[[str], bool]) -> str:
    """Return what an app's parameters, (1,), and its symbols are not as in a profile; empty: nothing."""
    parameters = parameters_of(config).memory
    found = [
        f"{name} = {built[name][0].tolist()}, in the profile {parameters[name][0].tolist()}"
        for name in parameters.dtype.names or ()
        if not np.array_equal(built[name], parameters[name])
    ]
    own = bool(config.logic.controller or config.logic.estimator)
    if own != has(OWN_LOGIC):
        found.append("control law, the profile has " + ("one of the user's" if own else "the core's"))
    for block in sorted({field.block for field in sensed_by(load_logic(config.logic))}):
        if not has(f"floaty_{block}"):
            found.append(f"own sensors, the image has no floaty_{block}")
    return "; ".join(found)


def read_image(path: Path, elf: Path | None) -> tuple[Image, list[str]]:
    """Return the image of a file, or that of a release's zip, and what was taken. Raises `LabError` and `ExportError`."""
    content = read(path)
    if not is_release(path, content):
        return Image(path, elf, content), []
    taken = released_firmware(path, content)
    return Image(path / taken.name, elf, taken.content), [taken.note]


class ImageObserver(Protocol):
    """Watches an image from power-on to the end of its flight; what it counts is memory of the chip (`Chip.save`)."""

    def begin(self, firmware: ImageFirmware) -> None:
        """Begin before the first instruction. Raises `LabError` if there is no place for the report."""

    def report(self, firmware: ImageFirmware, folder: Path) -> None:
        """Report a flight, whose run folder is given. Raises `LabError`."""


@dataclass(frozen=True, slots=True)
class ChipImage:
    """The flashed image and the compiled machine that executes it."""

    image: Image
    library: Path
    notes: tuple[str, ...] = ()  # what was taken of a release, and what is unknown without symbols
    debugger: GdbServer | None = None
    observers: tuple[ImageObserver, ...] = ()
    needs_polls: ClassVar[bool] = True

    @classmethod
    def load(cls, path: Path, elf: Path | None) -> ChipImage:
        """Read an image, or that of a release's zip, and compile the machine. Raises `LabError` and `ExportError`."""
        image, notes = read_image(path, elf)
        return cls.flashed(image, build_machine(), notes)

    @classmethod
    def flashed(cls, image: Image, library: Path, notes: Sequence[str] = ()) -> ChipImage:
        """Return an image that has been read."""
        unnamed = () if image.named else (f"{image.path}: {NO_SYMBOLS}",)
        return cls(image, library, (*notes, *unnamed))

    @property
    def in_flash(self) -> bytes:
        """The content of the flash up to the image's end; what lies before the image is erased."""
        return ERASED * (self.image.base - FLASH) + self.image.code

    def flashed_with(self, flash: bytes) -> ChipImage:
        """Return the image in a flash that was written to: this one, if it is the same. Raises `LabError`."""
        content = flash[self.image.base - FLASH :].rstrip(ERASED)
        if content == self.image.code.rstrip(ERASED):
            return self
        written = ChipImage.flashed(Image(FLASHED, None, content), self.library)
        return replace(written, debugger=self.debugger)

    def wire_us(self, data: bytes) -> int:
        return 0  # the chip simulates its serial line itself

    def boot(self, start: PowerOn) -> ImageFirmware:
        logic = load_logic(start.config.logic)
        return ImageFirmware(
            self, start.board, start.rest, not start.polled, start.outputs, start.carrier, logic
        )


class ImageFirmware:
    """An image at power-on. `rest` gives the IMU's counts while the robot is at rest, before the laboratory's time begins.

    `polls`: whether empty radio packets arrive by themselves, as from a host that only listens. `outputs`: the timer
    outputs that drive the robot, by default the servos'. `logic` is that of the profile: what it reads of the robot's own
    sensors is written into the app's memory.
    """

    usage: ClassVar[None] = None
    mavlink: ClassVar[None] = None
    flight_tasks: ClassVar[None] = None
    overrun: ClassVar[str] = ""

    def __init__(
        self,
        flashed: ChipImage,
        board: Pins,
        rest: Callable[[], ImuCounts] | None,
        polls: bool = True,
        outputs: Sequence[tuple[int, int]] = OUTPUTS,
        carrier: Carrier | None = None,
        logic: Logic | None = None,
    ) -> None:
        self._crazyflie = Crazyflie(
            flashed.image, flashed.library, board, polls, flashed.debugger, outputs, carrier
        )
        self.notes = flashed.notes
        self.image, self.chip, self.parts = flashed.image, self._crazyflie.chip, self._crazyflie.parts
        self.kernel = self.scheduler = self._crazyflie.processor
        self._observers = flashed.observers
        for observer in self._observers:
            observer.begin(self)
        self._board = board
        self._table = {variable.name: variable for variable in log_table(self.image, self.chip)}
        self.variables = [one for name, one in self._table.items() if name.startswith("excite.")]
        self.log_numbers = log_numbers(self.image, self.chip)
        self.parameters = parameter_table(self.image, self.chip)
        self._sensed = [(self._sensed_field(logic, field), field.name) for field in sensed_by(logic)]
        self._app = self._signals_of_app() if self.image.has("floaty_estimator") else None
        if rest is not None:
            for now_us in range(IMU_PERIOD_US, WARM_UP_US + 1, IMU_PERIOD_US):
                self.kernel.run(now_us)
                self.parts.sample(rest())
            self.kernel.begin(WARM_UP_US)

    def reports(self) -> list[TaskReport]:
        kernel = self.kernel
        counted = zip(kernel.tasks, kernel.run_times_us(), kernel.activations(), strict=True)
        return [
            TaskReport(
                name=task.name, priority=task.priority, run_time_us=run_time_us, activations=activations,
                worst_response_us=0, worst_latency_us=0, latency_histogram=(), deadline_us=None, deadline_misses=0,
            )
            for task, run_time_us, activations in counted
        ]  # fmt: skip

    def report_observed(self, folder: Path) -> None:
        for observer in self._observers:
            observer.report(self, folder)

    def differences(self, config: FirmwareConfig) -> str:
        if not self.image.has("floaty_parameters"):
            return ""
        built = self._struct("floaty_parameters", parameters_of(config).memory.dtype)
        return differences(built, config, self.image.has)

    # Interrupts and time

    def imu_ready(self) -> None:
        self.parts.sample(self._board.imu.tolist())
        for field, name in self._sensed:
            field[:] = self._board.sensors[name]

    def radio_received(self, data: bytes, broadcast: bool = False) -> None:
        self._crazyflie.radio.received(data, broadcast)

    def radio_polled(self) -> None:
        self.radio_received(syslink.EMPTY)

    def uart_ready(self) -> None: ...  # the image has no serial line

    def check_watchdog(self) -> None:
        """Report the missing peripherals that the image has used; its watchdog acts by itself."""
        self._crazyflie.report_unknown()

    @property
    def clock_us(self) -> int | None:
        return self._crazyflie.clock_us

    @property
    def flashed(self) -> ImageFirmware:
        """This image: its constants were compiled."""
        return self

    @property
    def resets(self) -> int:
        return sum(self._crazyflie.resets.values())

    @property
    def failures(self) -> Sequence[str]:
        return self._crazyflie.failures

    @property
    def known_findings(self) -> Sequence[str]:
        return self._crazyflie.known

    def report(self) -> ImageReport:
        kernel, resets = self._crazyflie.tasks, self._crazyflie.resets
        stacks: dict[str, int] = {}
        with suppress(LabError):  # it may have overwritten its own lists
            if kernel is not None and kernel.running:
                stacks = {task.name: task.stack_free_bytes for task in kernel.tasks()}
        free, least = (None, None) if kernel is None else kernel.heap_bytes
        return ImageReport(self.image.sha256, stacks, free, least, resets[WATCHDOG], resets[SOFTWARE])

    # Values read from the app

    @property
    def signals(self) -> Signals:
        """Views on the app's core; without the app, the stock firmware's current values."""
        return self._app or stock_signals(self._table)

    @property
    def parameter_numbers(self) -> dict[str, int]:
        return {name: parameter.number for name, parameter in self.parameters.items()}

    @property
    def inputs(self) -> NDArray[Any] | None:
        """The input of the app's core, (1,); None without the app."""
        return self._struct("floaty_input", INPUT) if self.image.has("floaty_input") else None

    def _signals_of_app(self) -> Signals:
        supervisor = ChipSupervisor(self._table if self.image.has("floaty_supervisor") else {})
        memories = self._struct("floaty_estimator", ESTIMATOR), self._struct("floaty_control", CONTROL)
        return Signals.of(*memories, supervisor)

    def _sensed_field(self, logic: Logic | None, field: SensedField) -> NDArray[Any]:
        """Return a view on what the app's law reads of a sensor."""
        assert logic is not None
        return self._struct(f"floaty_{field.block}", logic.loaded.structs[field.block].dtype)[field.name]

    def _struct(self, name: str, layout: np.dtype[Any]) -> NDArray[Any]:
        """Return a view on a struct of the core, (1,); zeros for an image without the app."""
        if not self.image.has(name):
            return np.zeros(1, layout)
        symbol = self.image.symbol(name)
        if symbol.size != layout.itemsize:
            raise LabError(
                f"{self.image.path}: {name} has {symbol.size} bytes where this laboratory's core has "
                f"{layout.itemsize}: it was exported by another version"
            )
        return self.chip.view(symbol.address, symbol.size).view(layout)
