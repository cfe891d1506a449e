"""One flight of many: its description, which gives the same request in any worker process, and its row.

A flight that cannot be flown, raises or takes too long becomes a row with its error. A full disk raises instead.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path
from typing import Any

from hil.config import DEFAULT_PROFILE
from hil.errors import LabError, blame
from hil.laboratory.experiment import Source
from hil.laboratory.experiments import find_again, find_experiment
from hil.laboratory.files.folder import reserved
from hil.laboratory.files.result import Result
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import in_lockstep
from hil.laboratory.request import Options, Request
from hil.laboratory.run import LOADED_US, fly
from hil.research.campaigns.config import FlightLimits, Value

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
LOG = ("log.parquet", "events.jsonl", "result.json")
LOG_AND_TELEMETRY = (*LOG, "telemetry.csv")  # the input of `floaty identify`


@dataclass(frozen=True, slots=True)
class Job:
    """Flight `index` of a plan: its experiment, the values drawn for it, and its kept files."""

    index: int
    experiment: str  # as `find_experiment` accepts it
    options: Options  # of `Request.of`
    values: Mapping[str, Value]  # by axis
    folder: Path | None = None  # for its files; None: only the row is kept
    files: tuple[str, ...] | None = None  # kept in it; None: all, and no other flight is replaced there
    limits: FlightLimits | None = None  # None: no limit
    source: Source | None = None  # of the experiment when the plan was made

    def request(self) -> Request:
        """Return the request. Raises `LabError` if it cannot be flown."""
        return Request.of(find_experiment(self.experiment), **self.options)

    @property
    def text(self) -> str:
        """The flight as text: equal for equal flights."""
        return json.dumps([self.experiment, self.options], default=str, sort_keys=True)


@dataclass(frozen=True, slots=True)
class Row:
    """A flight and its result; equal for the same flight on every worker."""

    job: Job
    outcome: str  # as of a `Result`
    error: str  # why it was lost or failed
    passed: bool
    hash: str  # empty: it did not end
    metrics: Mapping[str, float]  # empty: it was not flown
    holds: Mapping[str, bool]  # by limit that applies

    @property
    def seed(self) -> int:
        return self.job.options.get("seed", 1)

    @property
    def folder(self) -> Path:
        assert self.job.folder is not None
        return self.job.folder

    @property
    def failed(self) -> list[str]:
        """The limits that do not hold."""
        return [name for name, holds in self.holds.items() if not holds]

    def columns(self) -> dict[str, Any]:
        """Return the row of the dataset by column."""
        options = self.job.options
        return {
            "index": self.job.index, "experiment": self.job.experiment,
            "profile": options.get("profile", DEFAULT_PROFILE), "seed": self.seed,
            "settings": list(options.get("overrides", ())), "faults": [str(one) for one in options.get("faults", ())],
            "outcome": self.outcome, "error": self.error, "passed": self.passed, "hash": self.hash,
            **{f"parameter.{name}": value for name, value in self.job.values.items()},
            **{f"metric.{name}": value for name, value in self.metrics.items()},
            **{f"holds.{name}": value for name, value in self.holds.items()},
        }  # fmt: skip

    @classmethod
    def of(cls, job: Job, columns: Mapping[str, Any]) -> Row:
        """Return the row of a job from the columns of a dataset."""
        metrics, holds = (
            {name[len(kind) :]: value for name, value in columns.items() if name.startswith(kind)}
            for kind in ("metric.", "holds.")
        )
        return cls(
            job,
            **{name: columns[name] for name in ("outcome", "error", "passed", "hash")},
            metrics={name: nan if value is None else value for name, value in metrics.items()},
            holds={name: value for name, value in holds.items() if value is not None},
        )


@dataclass(frozen=True)
class Plan:
    """Flights by number, and all that they depend on. Equal plans have equal flights of equal number."""

    about: Mapping[str, Any]  # the specification, as JSON values
    flights: int
    job: Callable[[int], Job]
    experiments: tuple[str, ...]
    profiles: tuple[str, ...]
    values: Mapping[str, type]  # drawn for each flight
    half_width: float | None = None  # of the failure rate's interval at which to stop; None: fly all
    cluster: int = 1  # consecutive flights with similar results

    @classmethod
    def of(cls, jobs: Sequence[Job]) -> Plan:
        """Return the plan of some flights, numbered here. Raises `LabError` for an unknown experiment."""
        sources = {
            name: find_experiment(name).source for name in dict.fromkeys(job.experiment for job in jobs)
        }
        numbered = [
            replace(job, index=index, source=sources[job.experiment]) for index, job in enumerate(jobs)
        ]
        digest = hashlib.sha256("".join(job.text for job in jobs).encode()).hexdigest()[:16]
        about = {"flights": {"count": len(jobs), "digest": digest}}
        profiles = dict.fromkeys(job.options.get("profile", DEFAULT_PROFILE) for job in jobs)
        values = {name: type(value) for job in jobs for name, value in job.values.items()}
        return cls(about, len(jobs), numbered.__getitem__, tuple(sources), tuple(profiles), values)


class TooLongError(Exception):
    """A flight goes beyond its limits."""


def fly_job(job: Job) -> Row:
    """Fly. Raises `LabError` for a full disk or a changed experiment file."""
    # One of many samples: its failure does not stop the others.
    limited = job.limits is not None
    experiment = find_again(job.experiment, job.source)
    if experiment is None:
        raise LabError(f"experiment {job.experiment}: its file has changed since the first flight")
    try:
        return row_of(job, _flown(job, Request.of(experiment, **job.options)))
    except LabError as error:
        if not limited:
            raise
        return failed(job, str(error))
    except OSError as error:
        if error.errno in FULL:
            raise LabError(f"flight {job.index}: {tempfile.gettempdir()}: {error.strerror}") from None
        return failed(job, blame(error))
    except Exception as error:
        kind, text = type(error).__name__, blame(error)  # which names the kind of an error of the user's code
        return failed(job, text if kind in text else f"{kind}: {text}")


def _flown(job: Job, request: Request) -> Result:
    if job.folder is None:
        return fly_within(request, job.limits)
    with reserved(request, job.folder, replace=job.files is not None):
        result = fly(request, job.folder)
        for file in job.folder.iterdir():
            if job.files is not None and file.name not in job.files:
                file.unlink()
    return result


def fly_within(request: Request, limits: FlightLimits | None) -> Result:
    """Fly within limits without leaving files. Real time starts after loading and compiling."""
    begun: list[float] = []

    def watch(now_us: int, flight: Flight) -> None:
        if limits is None:
            return
        if now_us >= LOADED_US and not begun:
            begun.append(time.monotonic())
        if now_us > limits.simulated_s * 1e6:
            raise TooLongError(f"limits.simulated_s = {limits.simulated_s:g}: the flight had not ended")
        if begun and time.monotonic() - begun[0] > limits.wall_s:
            raise TooLongError(f"limits.wall_s = {limits.wall_s:g}: the flight had not ended")

    with tempfile.TemporaryDirectory(prefix="floaty-") as parent:
        return fly(request, Path(parent) / "run", progress=watch, flight_of=_unlogged)


def _unlogged(request: Request, _telemetry: Path | None, stack: ExitStack) -> Flight:
    """Return the flight without the station's unused log, which takes an eighth of its time."""
    return in_lockstep(request, None, stack)


def row_of(job: Job, result: Result) -> Row:
    """Return the row of a finished flight. Raises `LabError` for a full disk."""
    cause = result.cause or ""
    if result.outcome == "error" and any(os.strerror(number) in cause for number in FULL):
        raise LabError(f"flight {job.index}: {tempfile.gettempdir()}: {cause}")
    holds = {verdict.metric: verdict.holds for verdict in result.verdicts if verdict.applies}
    digest = result.hash if result.outcome != "error" else ""
    return Row(job, result.outcome, cause, result.passed, digest, dict(result.metrics), holds)


def failed(job: Job, error: str) -> Row:
    """Return the row of a flight that ended with an error."""
    return Row(job, "error", error, passed=False, hash="", metrics={}, holds={})
