"""The checks of `floaty deploy check --elf` on everything linked around the core, and their limits.

On the bench the emulated chip is at rest, with a client on its radio and access to its memory. The parameters that a client
can write are compared with the table that the profile exports, the servo outputs with the registers for 400 Hz. Then it
plays programs of requests (`hil.deploy.services`) and flies (`hil.deploy.beside`), each time beside the Python board.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from pathlib import Path

import numpy as np

from firmware_py.export.app_toc import AppParameter, app_parameters
from firmware_py.wire.crtp import PORT_PARAMETERS
from firmware_py.wire.parameters import CHANNEL_WRITE, encode_ident
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.supervisor import Cause
from hil.board.board_firmware import PythonBoard
from hil.board.image_firmware import ChipImage, ImageFirmware
from hil.config import LabConfig, load_config
from hil.deploy.beside import fly_beside_python
from hil.deploy.doctor import Finding
from hil.deploy.service_programs import PROGRAMS
from hil.deploy.services import STEP_US, ServiceBench, differences, play_in_copies
from hil.emulator.stm32f405.image import Image, MemoryUse
from hil.errors import LabError
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import image_at

FREE_LEAST = 1024  # [bytes]
APP = "floaty_toc_apply"  # exists in images with the exported app
UNPROVEN = (
    "limits that the laboratory's own parameters do not have; log variables of the stock firmware alone",
    "port 10: calls for a host, hardware in the loop (`floaty deploy check --targets LINK` does on a board)",
    "restart after a crash; parameters stored in the EEPROM; decks, USB, flash wait states",
    "differences in flight below the bounds above",
)
Show = Callable[[str, int, int], None]  # (what, done, of how many)
ANSWER_US = 200_000  # time limit for the answer to a write
ACT_US = 20_000  # from a request until the stabilizer task has served it
STALE_US = 150_000  # more than from a controller's last step until the app has moved the servos to hover
CONTROLLER, OTHER_CONTROLLER = "stabilizer.controller", 1
TARGET = re.compile(r"(\w+)(?:\.(\w+))?(?:\[(\d+)\])?$")  # of an `AppParameter`
# RM0090, sections 2.3, 8.4 and 18.4
UNITS = {"TIM3": 0x4000_0400, "TIM5": 0x4000_0C00, "GPIOA": 0x4002_0000, "GPIOB": 0x4002_0400}
OFFSETS = {
    "CR1": 0x00, "CCMR1": 0x18, "CCMR2": 0x1C, "CCER": 0x20, "PSC": 0x28, "ARR": 0x2C, "MODER": 0x00, "OTYPER": 0x04,
    "AFRL": 0x20,
}  # fmt: skip
# 84 MHz / 4 / 52501 = 400 Hz; PWM mode 1 with preload, active high; alternate function 2, open drain.
SERVO_OUTPUTS: tuple[tuple[str, str, int, int], ...] = (  # peripheral, register, mask, value
    ("TIM3", "CR1", 0xFFFF, 0x81), ("TIM3", "PSC", 0xFFFF, 3), ("TIM3", "ARR", 0xFFFF, 52_500),
    ("TIM5", "CR1", 0xFFFF, 0x81), ("TIM5", "PSC", 0xFFFF, 3), ("TIM5", "ARR", 0xFFFF, 52_500),
    ("TIM3", "CCMR1", 0xFFFF, 0x6868), ("TIM3", "CCER", 0xFF, 0x11),
    ("TIM5", "CCMR2", 0xFFFF, 0x6868), ("TIM5", "CCER", 0xFF00, 0x1100),
    ("GPIOA", "MODER", 0xF0, 0xA0), ("GPIOA", "OTYPER", 0xC, 0xC), ("GPIOA", "AFRL", 0xFF00, 0x2200),
    ("GPIOB", "MODER", 0xF00, 0xA00), ("GPIOB", "OTYPER", 0x30, 0x30), ("GPIOB", "AFRL", 0xFF_0000, 0x22_0000),
)  # fmt: skip


def check_parameters(
    table: Sequence[AppParameter], board: "ImageBench", progress: Callable[[int], None] = lambda done: None
) -> Iterator[str]:
    """Yield every difference between a board's parameters and the table; the board is restored."""
    for done, parameter in enumerate(table):
        yield from _check_parameter(parameter, board)
        progress(done + 1)


def _check_parameter(parameter: AppParameter, board: "ImageBench") -> Iterator[str]:
    name, expected_type = parameter.name, parameter.scalar
    scalar = board.scalar(name)
    if scalar is None:
        yield f"{name}: the image has no such parameter"
        return
    if scalar is not expected_type:
        yield f"{name}: type {scalar.name}, expected {expected_type.name}"
        return
    default = scalar.cast(parameter.initial)
    if board.value(name) != default:
        yield f"{name}: default {board.value(name):.7g}, in the profile {default:.7g}"
    if (field := board.field(parameter)) != (expected := _behind(parameter, default)):
        yield f"{name}: default {parameter.target} = {field:.7g}, in the profile {expected:.7g}"
    before = board.value(name)
    inside, *outside = _values(parameter, scalar)
    board.write(name, inside)
    if (field := board.field(parameter)) != (expected := _behind(parameter, inside)):
        yield f"{name} = {inside:.7g} writes {parameter.target} = {field:.7g}, expected {expected:.7g}"
    for value in outside:
        board.write(name, value)
        if board.value(name) == value:
            limits = f"{parameter.low:.7g} to {parameter.high:.7g}"
            yield f"{name} = {value:.7g} is accepted, outside {limits}"
    board.write(name, before)


def _behind(parameter: AppParameter, value: float) -> float:
    """Return the number in memory for a client's value, rounded as on board."""
    product = float(np.float32(parameter.scale) * np.float32(value))
    return parameter.place.scalar.cast(product)


def _values(parameter: AppParameter, scalar: Scalar) -> list[float]:
    """Return a value inside the limits, not the default, and those just outside that fit the type."""
    low, high = (float(np.float32(limit)) for limit in (parameter.low, parameter.high))
    if scalar.is_float:
        inside = [scalar.cast(low + share * (high - low)) for share in (0.625, 0.375)]
        outside = [
            float(np.nextafter(np.float32(limit), np.float32(to)))
            for limit, to in ((low, -np.inf), (high, np.inf))
        ]
    else:
        inside, outside = [float(int(high)), float(int(high)) - 1.0], [low - 1.0, high + 1.0]
    other = next(value for value in inside if value != scalar.cast(parameter.initial))
    return [other, *(value for value in outside if scalar.cast(value) == value)]


class ImageBench(ServiceBench):
    """A bench with an image that has the app; parameters of the radio and memory by name."""

    firmware: ImageFirmware

    def __init__(self, flashed: ChipImage, config: LabConfig) -> None:
        super().__init__(flashed, config)
        self._table = self.firmware.parameters
        self._of_parameters = flashed.image.symbol("floaty_toc_apply").address

    def scalar(self, name: str) -> Scalar | None:
        return self._table[name].scalar if name in self._table else None

    def value(self, name: str) -> float:
        """Return a parameter as read by a client."""
        return self._table[name].read()

    def write(self, name: str, value: float) -> None:
        """Write a parameter over the radio. Raises `LabError` without an answer."""
        entry = self._table[name]
        ident = encode_ident(entry.number)
        self.received.clear()
        self.post(PORT_PARAMETERS, CHANNEL_WRITE, ident + entry.scalar.pack(value))
        for _ in range(ANSWER_US // STEP_US):
            self.run(STEP_US)
            for answer in self.received:
                if (answer.port, answer.channel, answer.data[:2]) == (PORT_PARAMETERS, CHANNEL_WRITE, ident):
                    return
        within = f"within {ANSWER_US // 1000} ms"
        raise LabError(f"{self.firmware.image.path}: does not answer to {name} = {value:g} {within}")

    def field(self, parameter: AppParameter) -> float:
        """Return the number in memory that a parameter sets."""
        return self.memory(parameter.target, parameter.place.scalar)

    def memory(self, target: str, scalar: Scalar) -> float:
        """Return a number in memory by its C expression, like `floaty_parameters.trim[2]`."""
        image = self.firmware.image
        matched = TARGET.match(target)
        assert matched is not None
        name, member, index = matched.groups()
        address = image.symbol(name).address + scalar.size * int(index or 0)
        if member:
            address += image.debug.variable(name, self._of_parameters)[member].offset
        return scalar.unpack(self.firmware.chip.read(address, scalar.size))

    def check_switches(self) -> Iterator[str]:
        """Yield the failures of the request parameters: stop, disarm, restart the estimator."""
        for name, value, target in (
            ("stop", 1, "floaty_supervisor.stopped"), ("stop", 0, "floaty_supervisor.stopped"),
            ("armed", 0, "floaty_supervisor.armed"), ("armed", 1, "floaty_supervisor.armed"),
        ):  # fmt: skip
            self._request(name, value)
            if (found := self.memory(target, Scalar.U8)) != value:
                yield f"floaty.{name} = {value}: {target} = {found:g}, expected {value}"
        before = self.memory("floaty_estimator.tick", Scalar.I32)
        self._request("reset", 1)
        if (ticks := self.memory("floaty_estimator.tick", Scalar.I32)) >= before:
            yield f"floaty.reset = 1: floaty_estimator.tick = {ticks:g} goes on, expected from 0 again"

    def check_watch(self) -> Iterator[str]:
        """Yield the failures of the controller's watch: it must act when another controller runs, and only then."""
        hovers = self.memory("floaty_observed.stale_hovers", Scalar.U32)
        if hovers:
            yield f"servos put to hover {hovers:g} times for a controller that stands still, expected 0: none does"
        controller = self.value(CONTROLLER)
        self.write(CONTROLLER, OTHER_CONTROLLER)
        self.run(STALE_US)
        cause = Cause(int(self.memory("floaty_supervisor.cause", Scalar.U8)))
        if cause is not Cause.NO_CONTROL:
            yield f"{CONTROLLER} = {OTHER_CONTROLLER}: cause {cause.name}, expected {Cause.NO_CONTROL.name}"
        self.write(CONTROLLER, controller)
        self.run(STALE_US)

    def _request(self, name: str, value: int) -> None:
        if self.scalar(f"floaty.{name}") is not None:
            self.write(f"floaty.{name}", value)
            self.run(ACT_US)

    def check_servo_outputs(self) -> Iterator[str]:
        """Yield the registers of timers and pins that are wrong for the servos."""
        for unit, name, mask, expected in SERVO_OUTPUTS:
            found = int.from_bytes(self.firmware.chip.read(UNITS[unit] + OFFSETS[name], 4), "little") & mask
            if found != expected:
                yield f"servo outputs: {unit}.{name} = 0x{found:x}, expected 0x{expected:x}"


def check_services(
    image: ServiceBench, python: ServiceBench, progress: Callable[[int], None]
) -> Iterator[str]:
    """Yield, for each program of requests that the boards answer differently, its first difference."""
    answers = (play_in_copies(bench, PROGRAMS.values()) for bench in (python, image))
    for done, (name, expected, found) in enumerate(zip(PROGRAMS, *answers, strict=True)):
        for difference in islice(differences(expected, found), 1):
            yield f"{name}: {difference}"
        progress(done + 1)


def check_memory(memory: tuple[MemoryUse, ...]) -> Finding:
    """Return the use of the memories; less than a kilobyte left is a warning."""
    short = [f"{one.name} has less than {FREE_LEAST} B left" for one in memory if one.free < FREE_LEAST]
    uses = (f"{one.name} {one.used} B of {one.size}, {one.free} B free" for one in memory)
    return Finding("memory", "; ".join((*uses, *short)), not short)


def check_image(elf: Path, profile: str, overrides: tuple[str, ...], show: Show) -> Iterator[Finding]:
    """Yield the findings on an image's app, on the bench and in flight. Raises `LabError`."""
    config = load_config(profile, overrides)
    flashed = image_at(str(elf), None)
    show("boot", 0, 1)
    bench = ImageBench(flashed, config)
    constants = bench.firmware.differences(config)
    yield Finding("constants", constants or "as in the profile", not constants)
    python = ServiceBench(
        PythonBoard(), config
    )  # the programs are played on copies, and leave both as they are
    services = list(check_services(bench, python, lambda done: show("services", done, len(PROGRAMS))))
    table = app_parameters(config)
    found = list(check_parameters(table, bench, lambda done: show("parameters", done, len(table))))
    good = f"{len(table)} defaults, limits and the fields that they write are the profile's"
    yield from _all(found, "params", good)
    for subject, failures, good in (
        ("switches", bench.check_switches(), "stop, arm and reset act"),
        ("watch", bench.check_watch(), "acts when another controller runs, and only then"),
        (
            "servos",
            bench.check_servo_outputs(),
            f"{len(SERVO_OUTPUTS)} fields of timers and pins are as for 400 Hz",
        ),
    ):
        yield from _all(list(failures), subject, good)

    yield from _all(
        services,
        "services",
        f"{len(PROGRAMS)} programs of requests are answered as by the Python board",
    )

    def progress(name: str, now_us: int, flight: Flight) -> None:
        show(f"flight, {name}", now_us, flight.end_us)

    compared, ends, states = fly_beside_python(elf, profile, overrides, progress)
    yield from (Finding("flight", text, False) for text in ends)
    yield from (Finding("flight", str(one), one.held) for one in compared)
    good = "the supervisor's states and causes are the Python board's, in their order"
    yield from _all(states, "states", good)


def has_app(elf: Path) -> tuple[bool, tuple[MemoryUse, ...]]:
    """Return whether an image has the exported app, and its memory use. Raises `LabError`."""
    image = Image(elf)
    return image.has(APP), image.memory


def _all(found: list[str], subject: str, good: str) -> Iterator[Finding]:
    if found:
        yield from (Finding(subject, text, False) for text in found)
    else:
        yield Finding(subject, good)
