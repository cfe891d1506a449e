"""A request: which flight to fly, on which bench. All code that flies or reads a flight uses this description.

A run folder stores the request, and `Request.read` returns an equal one, given a function that finds its experiment.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict, Unpack

from pydantic import (
    BeforeValidator,
    GetCoreSchemaHandler,
    GetPydanticSchema,
    PlainSerializer,
    TypeAdapter,
    ValidationInfo,
)
from pydantic_core.core_schema import CoreSchema, with_info_after_validator_function

from ground_station.links.crazyflie_link import FlightTimes, FromFloor
from ground_station.links.schemes import SCHEMES
from ground_station.trajectory import Goal, Trajectory
from hil.board.cores.boards import BOARDS, CORTEX_M4, C
from hil.board.real_core import is_link
from hil.config import DEFAULT_PROFILE, LabConfig, Overrides, check_logic, read_config, settings_of
from hil.errors import LabError, require
from hil.laboratory.arguments import checked
from hil.laboratory.bodies import digest_of_body
from hil.laboratory.experiment import Experiment, Source, unknown
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Fault, check, parse
from hil.laboratory.metrics import check_limits, limits_of

RADIO, MAVLINK = "radio", "mavlink"
LOCKSTEP = (RADIO, MAVLINK)  # links that are fully simulated
REAL = "real"  # the board of a flight recorded only by its ground station
DURATION_MAX_S = 86_400.0
SEED_MAX = 2**62
HELD_LEAST_US = 100_000  # of a flight from floor to floor, whose errors are judged
USUAL = {"profile": DEFAULT_PROFILE, "link": RADIO, "board": C}  # of `Request.parts`

InLoop = Literal["still", "moving"] | None
Find = Callable[
    [str, Source | None], Experiment | None
]  # returns the experiment of a name or source, None: unknown here


@checked
@dataclass(frozen=True, slots=True)
class Bench:
    """The link and the board of a flight, and how they run."""

    link: str = RADIO  # radio and mavlink: in lockstep; a URI: a station in another process, paced
    board: str = C  # a runner of the flight core, the path of a complete image, or a link
    elf: Path | None = None  # the symbols of an image without its own
    in_loop: InLoop = None  # a real board flies by its own tasks and clock, with its servos still or moving
    gdb: int | None = None  # port on which an image waits for a debugger; 0: any
    realtime: bool = False  # pace the flight to the wall clock
    trace: bool = False  # record the schedule of the whole flight, not only 50 ms
    coverage: Path | None = field(default=None, compare=False)  # where an image's executed blocks are added
    profile_cpu: Path | None = field(default=None, compare=False)  # where its cycles are written

    @property
    def is_image(self) -> bool:
        """Whether the board executes a complete image."""
        return self.board not in (*BOARDS, REAL) and not is_link(self.board)

    @property
    def in_lockstep(self) -> bool:
        """Whether station and board share one time line."""
        return self.link in LOCKSTEP

    def check(self) -> None:
        """Raise `LabError` when link, board and options do not match, or a package for them is missing."""
        if self.is_image:
            check_image(self.board)
        if self.is_image and self.link.startswith(MAVLINK):
            raise LabError(f"--link {self.link}: {self.board} speaks CRTP over its radio, not MAVLink")
        if self.elf is not None and not self.is_image:
            raise LabError(f"--elf {self.elf}: goes with an image as --board, not with {self.board}")
        if self.gdb is not None and not self.is_image:
            raise LabError(f"--gdb {self.gdb}: needs one flight with an image as --board")
        for name, out in (("coverage", self.coverage), ("profile-cpu", self.profile_cpu)):
            if out is not None and not self.is_image:
                raise LabError(f"--{name} {out}: needs an image as --board, not {self.board}")
        if self.in_loop and not (is_link(self.board) and self.link == RADIO):
            raise LabError(
                f"--hil: --board {self.board} --link {self.link}: expected the link to a real board as --board"
            )
        if self.board != C and not self.is_image and not self.in_lockstep:
            raise LabError(
                f"--board {self.board}: --link {self.link}: only {C} flies over a link, and an image"
            )
        if not self.in_lockstep and self.link.partition(":")[0] not in SCHEMES:
            raise LabError(
                f"--link {self.link}: expected radio, mavlink, radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:PORT, "
                "mavlink:pty or mavlink:PATH"
            )
        self._require_packages()

    def check_many(self, option: str, count: int) -> None:
        """Raise `LabError` for what only one flight at a time can have, where `option` asks for `count`."""
        if not self.in_lockstep:
            raise LabError(f"--link {self.link}: {option} is for flights in lockstep: {', '.join(LOCKSTEP)}")
        if is_link(self.board) or self.in_loop:
            raise LabError(f"--board {self.board}: {option} {count}: a real board is in one flight at a time")
        alone = {
            "--gdb": self.gdb is not None, "--perfetto": self.trace, "--profile-cpu": self.profile_cpu is not None,
            "--realtime": self.realtime,
        }  # fmt: skip
        if given := [name for name, is_given in alone.items() if is_given]:
            raise LabError(f"{option} {count}: {', '.join(given)}: for one flight only")

    def _require_packages(self) -> None:
        link, board = f"--link {self.link}", f"--board {self.board}"
        if self.link.startswith(MAVLINK):
            require(link, "mavlink", "pymavlink", *(() if self.in_lockstep else ("serial",)))
        elif not self.in_lockstep:
            require(link, "radio", "cflib")
        if is_link(self.board):
            require(board, "radio", "cflib")
        elif self.board == CORTEX_M4:
            require(board, "deploy", "unicorn", "elftools", "ziglang")
        elif self.is_image:
            require(board, "deploy", "unicorn", "cffi", "elftools")


class Options(TypedDict, total=False):
    """How to fly an experiment, everything optional: the parts of the request and of its bench."""

    profile: str  # one that ships, or a path that ends in .toml; default: floaty
    overrides: Overrides  # {"section.key": value}, or "section.key=value" as for `--set`
    seed: int  # of all random numbers; default: 1
    duration_s: float | None  # of free flight; default: the experiment's
    faults: Sequence[Fault | str]  # added to the experiment's own
    trajectory: Callable[[Goal, int], Trajectory]  # instead of the experiment's, like Along(path)
    link: str  # radio and mavlink: in lockstep; a URI: in real time; default: radio
    board: str  # runner of the flight core: c, python or cortex-m4; default: c
    elf: Path | None
    in_loop: InLoop
    gdb: int | None
    realtime: bool
    trace: bool
    coverage: Path | None
    profile_cpu: Path | None


@dataclass(frozen=True, slots=True)
class Named:
    """The parts of a stored request that name its experiment."""

    experiment: str
    source: Source | None
    pictures: tuple[str, ...] = ()
    draws: bool = False  # it has a picture that its own code draws


def _found(named: Named, info: ValidationInfo) -> Experiment:
    """Return the experiment of a stored request: found again, or its stand-in."""
    find: Find = info.context or unknown
    found = find(named.experiment, named.source)
    return found or unknown(named.experiment, named.source, named.pictures, named.draws)


def _by_name(_: object, handler: GetCoreSchemaHandler) -> CoreSchema:
    return with_info_after_validator_function(_found, handler.generate_schema(Named))


@dataclass(frozen=True)
class Request:
    """One flight. `overrides` and `faults` begin with those of the experiment itself.

    `Request.of` makes one from a user's options and checks it.
    """

    experiment: Annotated[Experiment, GetPydanticSchema(_by_name)]
    profile: str
    overrides: tuple[str, ...]
    seed: Annotated[int, BeforeValidator(lambda seed: 0 if seed is None else seed)]
    duration_s: float
    faults: tuple[str, ...]  # as text, because the reader may not know their kinds
    bench: Bench

    @classmethod
    @checked
    def of(cls, experiment: Experiment, **options: Unpack[Options]) -> Request:
        """Return the request for an experiment: its settings and faults first. Raises `LabError` if it cannot fly."""
        trajectory, duration_s = options.get("trajectory"), options.get("duration_s")
        if trajectory is not None:
            experiment = dataclasses.replace(experiment, trajectory=trajectory)
        bench: Any = {name: value for name, value in options.items() if name in Bench.__dataclass_fields__}
        request = cls(
            experiment,
            options.get("profile", DEFAULT_PROFILE),
            (*experiment.settings, *settings_of(options.get("overrides", ()))),
            options.get("seed", 1),
            experiment.duration_s if duration_s is None else duration_s,
            tuple(map(str, (*experiment.faults, *options.get("faults", ())))),
            Bench(**bench),
        )
        request = dataclasses.replace(request, faults=tuple(map(str, request.planned_faults)))
        request.check()
        return request

    def check(self) -> None:
        """Raise `LabError` when the flight cannot be flown, before writing anything."""
        self.bench.check()
        if not 0 <= self.seed <= SEED_MAX:
            raise LabError(f"--seed {self.seed}: expected a whole number, 0 to {SEED_MAX}")
        if not 0.0 < self.duration_s <= DURATION_MAX_S:
            raise LabError(
                f"--duration {self.duration_s:g}: expected seconds, above 0 and up to {DURATION_MAX_S:g}"
            )
        check_logic(self.config)
        own = len(self.experiment.settings)
        self.config.check_effect(f"experiment {self.experiment.name}: ", self.overrides[:own], self.profile)
        self.config.check_effect("--set ", self.overrides[own:], self.profile)
        self.config.check_decks(self.bench.is_image)
        on_top = self.planned_faults[len(self.experiment.faults) :]
        check(on_top, self.duration_s, self.bench.link, self.config)
        check_limits(self.limits, self.experiment.metrics)
        home = self.config.flight.home
        if self.times is not None:
            self._check_pilot(self.times)
        self.experiment.check_goals(home, self.duration_s, partial(why_left, self.config))

    def _check_pilot(self, times: FlightTimes) -> None:
        """Raise `LabError` when the Crazyflie's firmware cannot fly this request."""
        if not self.bench.is_image or self.bench.link != RADIO:
            raise LabError(
                f"profile {self.profile}: its robot flies with the Crazyflie's own firmware over the radio; "
                "--board FILE: the image, an ELF file, a .bin or the zip of a release"
            )
        if times.land_us - times.begin_us < HELD_LEAST_US:
            least = self.duration_s - 1e-6 * (times.land_us - times.begin_us)
            raise LabError(
                f"--duration {self.duration_s:g}: take-off and landing alone take {least:g} s (profile {self.profile}); "
                f"expected {least + 1e-6 * HELD_LEAST_US:g} s or more"
            )

    @cached_property
    def config(self) -> LabConfig:
        """The configuration of the flight. Raises `LabError` for an unknown profile or a wrong override."""
        return read_config(self.profile, self.overrides)

    @cached_property
    def planned_faults(self) -> tuple[Fault, ...]:
        """The faults of the flight; the file of the user's own robot may declare their kinds. Raises `LabError`."""
        if any(text.partition("@")[0] not in KINDS for text in self.faults):
            digest_of_body(self.config)
        return tuple(map(parse, self.faults))

    @cached_property
    def times(self) -> FlightTimes | None:
        """The take-off and landing times with the Crazyflie's firmware; None for a robot that hovers from its release on."""
        if not self.config.pilot.enabled:
            return None
        return FlightTimes.of(self.config.pilot, self.config.flight.release_us, round(self.duration_s * 1e6))

    @property
    def trajectory(self) -> Trajectory:
        """The goals of the flight."""
        flight, home, times = self.config.flight, Goal(self.config.flight.home, 0.0), self.times
        if times is None:
            return self.experiment.trajectory(home, flight.release_us)
        floor = flight.home[2] + flight.start_offset[2]
        flown = self.experiment.trajectory(home, times.begin_us)
        return FromFloor(flown, floor, home, self.config.pilot, times)

    @property
    def is_real(self) -> bool:
        """Whether it was a real flight: without a seed, known only from the ground station."""
        return self.bench.board == REAL

    @property
    def limits(self) -> Mapping[str, float]:
        """The limits of the flight."""
        return limits_of(self.experiment.limits, self.config.limits.get(self.experiment.name))

    @property
    def title(self) -> str:
        """The heading of a page or a table."""
        return f"{self.experiment.name}, {'real flight' if self.is_real else f'seed {self.seed}'}"

    @property
    def text(self) -> str:
        """The title and the options, without those that are as usual."""
        options = {name: value for name, value in self.parts().items() if name not in ("", "seed")}
        unusual = [f"{name} {value}" for name, value in options.items() if value != USUAL.get(name, "")]
        return ", ".join([self.title, *unusual])

    def __repr__(self) -> str:
        return f"<Request {self.text}>"

    def parts(self) -> dict[str, str]:
        """Return the options as text, by their names in `floaty fly`: equal for equal flights."""
        return {
            "": self.experiment.reference, "seed": str(self.seed), "duration": f"{self.duration_s!r} s",
            "profile": self.profile, "set": " ".join(self.overrides), "fault": " ".join(self.faults),
            "link": self.bench.link, "board": self.bench.board, "hil": self.bench.in_loop or "",
        }  # fmt: skip

    def stored(self) -> dict[str, Any]:
        """Return the request as a run folder stores it, ready for JSON."""
        source, bench = self.experiment.source, self.bench
        return {
            "experiment": self.experiment.name, "source": None if source is None else asdict(source),
            "pictures": self.experiment.pictures, "draws": self.experiment.draw is not None,
            "profile": self.profile, "overrides": self.overrides, "seed": None if self.is_real else self.seed,
            "duration_s": self.duration_s, "faults": self.faults,
            **{one.name: getattr(bench, one.name) for one in fields(Bench) if one.compare},
            "elf": None if bench.elf is None else str(bench.elf),
        }  # fmt: skip

    @staticmethod
    def read(values: Mapping[str, Any], find: Find = unknown) -> Request:
        """Return a stored request; `find` returns its experiment. Raises pydantic's `ValidationError`."""
        return _stored().validate_python(values, context=find)


def _nested(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return a stored request as nested parts; each picks its own fields."""
    return {**values, "experiment": values, "bench": values}


StoredRequest = Annotated[Request, BeforeValidator(_nested), PlainSerializer(Request.stored)]


@cache
def _stored() -> TypeAdapter[Request]:
    return TypeAdapter(StoredRequest)


def why_left(config: LabConfig, p_W: Sequence[float]) -> str:
    """Return why a robot at a place [m] is outside the flow or its room, by its body's limits; empty when inside."""
    if config.pilot.enabled:
        room, ceiling = config.quadrotor.room, config.quadrotor.ceiling
        inside = max(abs(p_W[0]), abs(p_W[1])) <= room and 0.0 <= p_W[2] <= ceiling
        return "" if inside else f"{tuple(p_W)} m; up to {room:g} m sideways and {ceiling:g} m high"
    limits, height = config.plant.limits, p_W[2] - config.tunnel.hover_height
    if (radius := math.sqrt(p_W[0] * p_W[0] + p_W[1] * p_W[1])) > limits.radius:
        return f"{radius:.2f} m from the axis; up to {limits.radius:g} m"
    if not -limits.below <= height <= limits.above:
        where = "below" if height < 0.0 else "above"
        return f"{abs(height):.2f} m {where} the hover point; up to {getattr(limits, where):g} m"
    return ""


def check_image(board: str) -> None:
    """Raise `LabError` when the file of `--board` is missing."""
    if not Path(board).is_file():
        raise LabError(
            f"--board {board}: no such file; expected {', '.join(BOARDS)}, an image of a Crazyflie's firmware: an ELF "
            "file, a .bin or the zip of a release, or the link to a real board"
        )
