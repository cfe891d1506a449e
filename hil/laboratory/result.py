"""The result of a run: its origin and outcome; `result.json`, written once and read back as the same type.

A number that a flight does not have is NaN here and null in the file. Of a run whose process was killed, which left no
`result.json`, origin and metrics come from the log.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError, computed_field

from firmware_py.export.usage import Usage
from firmware_py.rtos import TaskReport
from ground_station.latency import Stage
from hil.devices.board_firmware import ImageReport
from hil.errors import LabError
from hil.laboratory.experiment import Source
from hil.laboratory.metrics import Figure, Metric, Verdict, measure
from hil.laboratory.recorder import load_log

RESULT = "result.json"
USUAL = {"profile": "floaty", "link": "radio", "board": "python"}  # of `Origin.requested`
REAL = "real"  # the board of a flight that only its ground station saw

# reset: flown to its end, but the board was reset on the way.
Outcome = Literal["completed", "lost", "reset", "interrupted", "error"]
# In a log's schema values are JSON text.
AsText = BeforeValidator(lambda value: json.loads(value) if isinstance(value, str) else value)
OrNone = BeforeValidator(lambda value: None if value == "null" else value)  # likewise


@dataclass(frozen=True, slots=True)
class QueueReport:
    """The greatest length of a queue, and its drops."""

    name: str
    length: int
    high_water: int
    dropped: int


@dataclass(frozen=True, slots=True)
class Origin:
    """What was flown, by which program; also stored in the log's schema."""

    experiment: str
    profile: str
    overrides: Annotated[tuple[str, ...], AsText]
    seed: Annotated[int | None, OrNone]  # None: a real flight has none
    duration_s: float
    link: str
    board: str
    faults: Annotated[tuple[str, ...], AsText]  # the experiment's own and those on top
    versions: Annotated[Mapping[str, str], AsText]  # of the packages that computed the flight
    commit: str
    source: Annotated[Source | None, AsText]  # of an experiment that does not ship
    logic: str  # hash of the user's modules in the core, empty without

    def fields(self) -> dict[str, Any]:
        """Return them by name, also of a `Result`."""
        return {field.name: getattr(self, field.name) for field in fields(Origin)}

    def requested(self) -> dict[str, str]:
        """Return the request as text, by what `floaty fly` calls it: equal for flights that were asked for alike."""
        return {
            "": self.source.reference if self.source else self.experiment,
            "seed": str(self.seed), "duration": f"{self.duration_s!r} s", "profile": self.profile,
            "set": " ".join(self.overrides), "fault": " ".join(self.faults), "link": self.link, "board": self.board,
        }  # fmt: skip

    @property
    def title(self) -> str:
        """The heading of a page or a table."""
        return (
            f"{self.experiment}, real flight" if self.seed is None else f"{self.experiment}, seed {self.seed}"
        )

    def metadata(self) -> dict[str, str]:
        """Return it as text for a log's schema."""
        values = _ORIGIN.dump_python(self, mode="json")
        return {
            name: value if isinstance(value, str) else json.dumps(value) for name, value in values.items()
        }


@dataclass(frozen=True, slots=True)
class Result(Origin):
    """The outcome of a run."""

    outcome: Outcome
    cause: str | None
    metrics: Mapping[str, Figure]
    own_metrics: Mapping[str, Metric]  # the definitions of the experiment's own metrics
    verdicts: tuple[Verdict, ...]
    tasks: tuple[TaskReport, ...]
    queues: tuple[QueueReport, ...]
    usage: Usage | None  # of the board, where it was measured
    ages: tuple[Stage, ...]  # the latency budget of the poses
    hash: str  # empty: the process was killed
    real_time_factor: Figure
    stood_still_ms: Figure  # simulated time, while the machine was too slow for a paced flight
    folder: Annotated[Path, Field(exclude=True)] = Path()  # its run folder
    image: ImageReport | None = None  # of a board that executes an image
    not_shown: int | None = None  # rows of the log that the live viewer did not take; null without one

    @computed_field  # type: ignore[prop-decorator]
    @property
    def passed(self) -> bool:
        """Whether the flight ended by itself, which may be a crash if a limit admits it, and every limit holds."""
        return self.outcome in ("completed", "reset", "lost") and all(
            verdict.holds for verdict in self.verdicts
        )

    @property
    def failed(self) -> tuple[Verdict, ...]:
        """The limits that its figures fail; of a lost flight that on the loss alone, which fails the others."""
        return tuple(verdict for verdict in self.verdicts if verdict.applies and not verdict.holds)


def with_resets(outcome: Outcome, cause: str | None, resets: float) -> tuple[Outcome, str | None]:
    """Return outcome and cause of a flight whose board was reset so often."""
    if not resets > 0:
        return outcome, cause
    how = f"the board was reset {resets:.0f} time{'s' if resets > 1 else ''}"
    return "reset" if outcome == "completed" else outcome, "; ".join(filter(None, (cause, how)))


_ORIGIN, _RESULT = TypeAdapter(Origin), TypeAdapter(Result)


def write_result(result: Result) -> None:
    """Write `result.json`."""
    (result.folder / RESULT).write_bytes(_RESULT.dump_json(result, indent=2) + b"\n")


def read_result(folder: Path) -> Result:
    """Return the result of a run folder. Raises `LabError` when the folder holds no run of this version."""
    path = folder / RESULT
    try:
        if not path.is_file():
            return _of_killed(folder)
        return replace(_RESULT.validate_json(path.read_bytes()), folder=folder)
    except OSError as error:
        raise LabError(f"{folder}: {error.strerror or error}") from None
    except ValidationError as error:
        raise LabError(f"{path}: {_first_of(error)}") from None


def _of_killed(folder: Path) -> Result:
    log = load_log(folder)
    metadata = {key.decode(): value.decode() for key, value in (log.schema.metadata or {}).items()}
    try:
        origin = _ORIGIN.validate_python(metadata)
    except ValidationError as error:
        raise LabError(f"{folder}: the log's schema: {_first_of(error)}") from None
    return Result(
        **origin.fields(), outcome="error", cause="the process ended before the flight did",
        metrics=measure(log, lost=False), own_metrics={}, verdicts=(), tasks=(), queues=(), usage=None, ages=(), hash="",
        real_time_factor=math.nan, stood_still_ms=math.nan, folder=folder,
    )  # fmt: skip


def _first_of(error: ValidationError) -> str:
    """Return the first error: the value, and what is expected."""
    detail = error.errors()[0]
    name, message = ".".join(map(str, detail["loc"])), detail["msg"]
    if detail["type"] == "missing":
        return f"{name} is missing: it was written by another version; fly again"
    value = f"{name} = {detail['input']!r}: " if name else ""
    return f"{value}{message[0].lower()}{message[1:]}"
