"""The result of a run: its origin and outcome; `result.json`, written once and read back as the same type.

A missing number is NaN here and null in the file. A killed process leaves no `result.json`; origin and metrics then come
from the log.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import pyarrow as pa
from pydantic import Field, TypeAdapter, ValidationError, computed_field
from pydantic_core import from_json

from firmware_py.export.usage import Usage
from firmware_py.logic.loading import digest_of
from firmware_py.rtos import TaskReport
from ground_station.latency import Stage
from hil.board.board_firmware import ImageReport
from hil.config import LabConfig
from hil.errors import LabError, reading, refusing
from hil.laboratory.bodies import digest_of_body
from hil.laboratory.experiment import unknown
from hil.laboratory.files.ages import ages_of, reported_ages
from hil.laboratory.files.installation import commit, versions
from hil.laboratory.files.recorder import load_log, stored_in
from hil.laboratory.files.whole_files import write_whole
from hil.laboratory.metrics import METRICS, PHASES, Figure, Metric, Verdict, judge, measure, short_of
from hil.laboratory.request import Find, Request, StoredRequest
from hil.world.scene import VisualModel

RESULT = "result.json"
PARTS = ("request", "program", "experiment", "bench")  # their fields are on the top level of the file

# reset: flown to its end, but the board was reset in flight.
Outcome = Literal["completed", "lost", "reset", "interrupted", "error"]


@dataclass(frozen=True, slots=True)
class QueueReport:
    """The greatest length of a queue, and its drops."""

    name: str
    length: int
    high_water: int
    dropped: int


@dataclass(frozen=True, slots=True)
class Program:
    """The program that computed a flight."""

    versions: Mapping[str, str]  # of the packages
    commit: str
    logic: str  # hash of the user's modules in the core, empty if none
    robot: str = ""  # hash of the file of the user's own body, empty if none

    @classmethod
    def of(cls, config: LabConfig) -> "Program":
        """Return this program with the modules of a configuration."""
        return cls(*_loaded(), digest_of(config.logic), digest_of_body(config))


@cache
def _loaded() -> tuple[Mapping[str, str], str]:
    """Return versions and commit of what this process has loaded: git takes as long as a short flight."""
    return versions(), commit()


def metadata_of(request: Request, program: Program, look: VisualModel) -> dict[str, str]:
    """Return a flight's origin and its robot's look as text for the log's schema."""
    times = None if request.is_real else request.times
    return {
        "request": json.dumps(request.stored()),
        "program": json.dumps(asdict(program)),
        "config": request.config.model_dump_json(),
        "look": json.dumps(look.stored()),
        **({} if times is None else {PHASES: json.dumps(asdict(times))}),
    }


@dataclass(frozen=True, slots=True)
class Result:
    """The outcome of a run. Its file has the fields of request and program on the top level."""

    request: StoredRequest
    program: Program
    outcome: Outcome
    cause: str | None
    metrics: Mapping[str, Figure]
    own_metrics: Mapping[str, Metric]  # the definitions of the experiment's own metrics
    verdicts: tuple[Verdict, ...]
    ages: tuple[Stage, ...]  # the latency budget of the poses
    hash: str  # empty: the process was killed
    tasks: tuple[TaskReport, ...] = ()
    queues: tuple[QueueReport, ...] = ()
    usage: Usage | None = None  # of the board, where it was measured
    real_time_factor: Figure = math.nan
    stood_still_ms: Figure = math.nan  # of simulated time, while the machine was too slow for a paced flight
    folder: Annotated[Path, Field(exclude=True)] = Path()  # its run folder
    image: ImageReport | None = None  # of a board that executes an image
    failures: tuple[str, ...] = ()  # what stopped an image or one of its tasks, in order
    not_shown: int | None = None  # rows of the log that the live viewer did not take; null without one

    @computed_field  # type: ignore[prop-decorator]
    @property
    def passed(self) -> bool:
        """Whether the flight ended by itself, or in a crash that a limit admits, and every limit holds."""
        return self.outcome in ("completed", "reset", "lost") and all(
            verdict.holds for verdict in self.verdicts
        )

    @property
    def rows(self) -> tuple[tuple[str, str, str, str], ...]:
        """Every metric that the flight has, and every one with a limit: name, value, limit and verdict as text."""
        verdicts, found = {verdict.metric: verdict for verdict in self.verdicts}, []
        for name, value in self.metrics.items():
            verdict, metric = verdicts.get(name), self.own_metrics.get(name) or METRICS.get(name)
            if metric is None or (verdict is None and math.isnan(value)):  # None: of another version
                continue
            over = short_of(metric, value, self.metrics, self.request.duration_s)
            bound = (
                ""
                if verdict is None
                else f"{'<=' if metric.bound == 'max' else '>='} {metric.show(verdict.bound)}"
            )
            found.append((name, metric.show(value) + over, bound, "" if verdict is None else verdict.mark))
        return tuple(found)

    @property
    def failed(self) -> tuple[Verdict, ...]:
        """The limits that failed; for a lost flight only the limit on the loss, which fails the others."""
        return tuple(verdict for verdict in self.verdicts if verdict.applies and not verdict.holds)


def with_failures(outcome: Outcome, cause: str | None, failures: Sequence[str]) -> tuple[Outcome, str | None]:
    """Return outcome and cause of a flight in which firmware failed: the first failure, which may explain the others."""
    if not failures:
        return outcome, cause
    more = f"{len(failures) - 1} more in events.jsonl" if len(failures) > 1 else None
    outcome = "error" if outcome == "completed" else outcome
    return outcome, "; ".join(filter(None, (failures[0], more, cause)))


def with_resets(outcome: Outcome, cause: str | None, resets: float) -> tuple[Outcome, str | None]:
    """Return outcome and cause of a flight with this number of resets."""
    if not resets > 0:
        return outcome, cause
    how = f"the board was reset {resets:.0f} time{'s' if resets > 1 else ''}"
    return "reset" if outcome == "completed" else outcome, "; ".join(filter(None, (cause, how)))


def judged(
    request: Request,
    program: Program,
    ended: tuple[Outcome, str | None],
    metrics: Mapping[str, float],
    log: pa.Table,
    digest: str,
    folder: Path,
) -> Result:
    """Return the result of a flight by the limits of its request."""
    own = request.experiment.metrics
    outcome, cause = ended
    return Result(
        request=request,
        program=program,
        outcome=outcome,
        cause=cause,
        metrics=metrics,
        own_metrics=own,
        verdicts=tuple(judge(metrics, request.limits, own)),
        ages=ages_of(reported_ages(folder), log, request.bench.link),
        hash=digest,
        folder=folder,
    )


@cache  # building it takes time that a flight has after its end
def _as_json() -> TypeAdapter[Result]:
    return TypeAdapter(Result)


def write_result(result: Result) -> None:
    values = _as_json().dump_python(result, mode="json")
    flat = {**values.pop("request"), **values.pop("program"), **values}
    write_whole(result.folder / RESULT, json.dumps(flat, indent=2) + "\n")


def read_result(folder: Path, find: Find = unknown) -> Result:
    """Return the result of a run folder; `find` finds its experiment, by default a stand-in.

    Raises `LabError` when the folder holds no run of this version.
    """
    path = folder / RESULT
    with reading(folder), refusing(f"{folder}: ", OSError):
        if not path.exists():
            return _of_killed(folder, find)
        try:
            return _read(from_json(path.read_bytes()), folder, find)
        except ValidationError as error:
            raise LabError(f"{path}: {_first_of(error)}") from None
        except ValueError as error:
            raise LabError(f"{path}: invalid JSON: {error}") from None


def _read(values: Any, folder: Path, find: Find) -> Result:
    parts = {**values, "request": values, "program": values} if isinstance(values, dict) else values
    return replace(_as_json().validate_python(parts, context=find), folder=folder)


def _of_killed(folder: Path, find: Find) -> Result:
    log = load_log(folder)
    metadata = log.schema.metadata
    outcome = {
        "outcome": "error", "cause": "the process ended before the flight did", "metrics": measure(log, lost=False),
        "own_metrics": {}, "verdicts": (), "ages": (), "hash": "",
    }  # fmt: skip
    try:
        return _read(
            {**stored_in(metadata, "request"), **stored_in(metadata, "program"), **outcome}, folder, find
        )
    except ValidationError as error:
        raise LabError(f"{folder}: the log's schema: {_first_of(error)}") from None


def _first_of(error: ValidationError) -> str:
    """Return the first error: the value and what is expected."""
    detail = error.errors()[0]
    place = detail["loc"][sum(part in PARTS for part in detail["loc"][:-1]) :]
    name, message = ".".join(map(str, place)), detail["msg"]
    if detail["type"] == "missing":
        return f"{name} is missing: it was written by another version; fly again"
    value = f"{name} = {detail['input']!r}: " if name else ""
    return f"{value}{message[0].lower()}{message[1:]}"
