"""A run: one flight into its folder, with log, telemetry, events, result, recording and report.

`runs/<experiment>-<seed>/` holds `log.parquet`, `events.jsonl`, `telemetry.csv`, `result.json`, `flight.rrd` and
`report.html`. Whatever ends the flight (its time, a crash, Ctrl-C, an error in a task), what was flown is kept.
"""

from __future__ import annotations

import json
import math
import platform
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import pyarrow as pa

from firmware_py.export.boards import BOARDS, PYTHON, runner_of
from firmware_py.export.cortex_m4 import CortexM4Runner, Usage
from firmware_py.export.errors import ExportError
from firmware_py.rtos import TaskReport, WatchdogError
from ground_station.latency import Stage
from ground_station.telemetry_log import TELEMETRY
from hil.clock import Clock
from hil.config import DEFAULT_PROFILE, LabConfig, load_config
from hil.errors import LabError
from hil.laboratory.ages import ages_of, told, with_goals_sent
from hil.laboratory.experiment import Experiment
from hil.laboratory.faults import Fault, check
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import LOCKSTEP, lockstep_flight
from hil.laboratory.metrics import METRICS, Verdict, free_flight, judge, measure
from hil.laboratory.recorder import Recorder, load_log

RESULT = "result.json"
LOADED_US = 250_000  # every part of the core has been called by then
BUILD = Path("runs/build")


@dataclass(frozen=True, slots=True)
class Request:
    """What the user asked for."""

    experiment: Experiment
    config: LabConfig
    profile: str
    overrides: tuple[str, ...]
    seed: int
    duration_s: float
    link: str = "radio"  # radio and mavlink: in lockstep; a URI: a station in a process of its own, paced
    faults: tuple[Fault, ...] = ()  # on top of the experiment's own; `LabError` for those that cannot act
    board: str = PYTHON  # what executes the flight core

    def __post_init__(self) -> None:
        if self.board not in BOARDS:
            raise LabError(f"--board {self.board}: expected {', '.join(BOARDS[:-1])} or {BOARDS[-1]}")
        if self.board != PYTHON and not self.in_lockstep:
            raise LabError(f"--board {self.board}: --link {self.link}: only python flies over a link")
        check(self.faults, self.duration_s, self.link, self.config.markers.enabled)

    @classmethod
    def of(
        cls,
        experiment: Experiment,
        profile: str = DEFAULT_PROFILE,
        overrides: Sequence[str] = (),
        seed: int = 1,
        duration_s: float | None = None,
        link: str = "radio",
        faults: Sequence[Fault] = (),
        board: str = PYTHON,
    ) -> Request:
        """Return the request for an experiment: its settings on the profile, `overrides` on both. Raises `LabError`."""
        overrides = (*experiment.settings, *overrides)
        config = load_config(profile, overrides)
        duration_s = experiment.duration_s if duration_s is None else duration_s
        return cls(experiment, config, profile, overrides, seed, duration_s, link, tuple(faults), board)

    @property
    def in_lockstep(self) -> bool:
        """Whether station and board share one time line."""
        return self.link in LOCKSTEP

    @property
    def all_faults(self) -> tuple[Fault, ...]:
        """The experiment's faults and those on top."""
        return (*self.experiment.faults, *self.faults)


@dataclass(frozen=True, slots=True)
class QueueReport:
    """How full a queue became."""

    name: str
    length: int
    high_water: int
    dropped: int


@dataclass(frozen=True, slots=True)
class Result:
    """How a run went; `outcome` is completed, lost, interrupted or error."""

    folder: Path
    request: Request
    outcome: str
    cause: str | None
    metrics: Mapping[str, float]
    verdicts: tuple[Verdict, ...]
    hash: str
    real_time_factor: float
    tasks: tuple[TaskReport, ...]
    queues: tuple[QueueReport, ...]
    usage: Usage | None  # of the board, where it was measured
    ages: tuple[Stage, ...]  # where the age of the poses came from
    stood_still_us: int = 0  # simulated time, while the machine was too slow for a paced flight

    @property
    def passed(self) -> bool:
        """Whether the flight came to an end of its own, which may be a crash, and every limit holds."""
        return self.outcome in ("completed", "lost") and all(verdict.holds for verdict in self.verdicts)


MakeFlight = Callable[["Request", Path, Clock | None, bool], Flight]  # (request, telemetry, clock, trace_all)


def fly(
    request: Request,
    folder: Path,
    clock: Clock | None = None,
    progress: Callable[[int, Flight], None] | None = None,
    on_batch: Callable[[pa.RecordBatch], None] | None = None,
    trace_all: bool = False,
    flight_of: MakeFlight | None = None,
) -> Result:
    """Fly once and write everything but the pictures into `folder`, which `prepare` has made.

    `flight_of` puts the flight together: without it, in lockstep.

    An error of the firmware ends in the outcome "error", Ctrl-C in "interrupted".
    """
    limits = request.config.limits.get(request.experiment.name, request.experiment.limits)
    judge(dict.fromkeys(METRICS, 0.0), limits)  # refuse unknown metrics before the flight
    flight = (flight_of or lockstep)(request, folder / TELEMETRY, clock, trace_all)
    recorder = Recorder(folder, flight.channels(), metadata_of(request), on_batch)
    flight.recorder = recorder
    outcome, cause = "error", None
    pace = _Pace()

    def on_progress(now_us: int) -> None:
        pace.begin(now_us)
        if progress is not None:
            progress(now_us, flight)

    try:
        end = flight.run(on_progress)
        outcome = "interrupted" if end.interrupted else "lost" if end.lost else "completed"
        cause = end.lost
    except WatchdogError as error:
        outcome, cause = "lost", str(error)
        recorder.note(flight.now_us, "board", cause)
    except Exception as error:
        cause = f"{type(error).__name__}: {error}"
        recorder.note(flight.now_us, "lab", cause)
    finally:
        factor = pace.end(flight.now_us)
        record = flight.line.record
        digest = recorder.close(None if record is None else partial(with_goals_sent, record))
        flight.close()
        flight.write_schedule(folder)
    log = load_log(folder)
    metrics = measure(log, outcome == "lost")
    if (free := free_flight(log)).num_rows > 1:
        metrics.update(request.experiment.measure(free))
    verdicts = tuple(judge(metrics, limits))
    firmware = flight.robot.firmware
    queues = tuple(
        QueueReport(queue.name, queue.length, queue.high_water, queue.dropped)
        for queue in firmware.kernel.queues
    )
    tasks = tuple(firmware.statistics.reports())
    usage = firmware.runner.usage if isinstance(firmware.runner, CortexM4Runner) else None
    ages = ages_of(told(folder), log, request.link)
    result = Result(
        folder, request, outcome, cause, metrics, verdicts, digest, factor, tasks, queues, usage, ages,
        flight.lab.clock.stood_still_us,
    )  # fmt: skip
    write_result(result)
    return result


class _Pace:
    """Simulated over real time, from an instant on before which the machine loads or compiles the core."""

    def __init__(self) -> None:
        self._us, self._ns = 0, time.monotonic_ns()
        self._begun = False

    def begin(self, now_us: int) -> None:
        """Count from here, if it is time to; later calls do nothing."""
        if not self._begun and now_us >= LOADED_US:
            self._begun, self._us, self._ns = True, now_us, time.monotonic_ns()

    def end(self, now_us: int) -> float:
        """Return the factor up to now."""
        return (now_us - self._us) * 1e3 / (time.monotonic_ns() - self._ns)


def lockstep(request: Request, telemetry: Path, clock: Clock | None, trace_all: bool) -> Flight:
    """Return a flight over a modelled link. Raises `LabError` when its board cannot be had here."""
    try:
        runner = runner_of(request.board, BUILD)
    except ExportError as error:
        raise LabError(f"--board {request.board}: {error}") from None
    return lockstep_flight(
        request.config, request.experiment, request.duration_s, request.seed, telemetry, clock, trace_all,
        request.link, request.faults, runner,
    )  # fmt: skip


def prepare(folder: Path) -> None:
    """Make an empty run folder; one that holds something else than a run is left alone. Raises `LabError`."""
    try:
        if folder.exists():
            if any(folder.iterdir()) and not any(
                (folder / name).exists() for name in (RESULT, "events.jsonl")
            ):
                raise LabError(
                    f"--out {folder}: the folder is not empty and holds no run; choose another one"
                )
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
    except OSError as error:
        raise LabError(f"--out {folder}: cannot be written ({error.strerror or error})") from None


def write_result(result: Result) -> None:
    """Write `result.json`."""
    request = result.request
    content = {
        "experiment": request.experiment.name,
        "profile": request.profile,
        "overrides": list(request.overrides),
        "seed": request.seed,
        "duration_s": request.duration_s,
        "link": request.link,
        "board": request.board,
        "faults": [str(fault) for fault in request.all_faults],
        "outcome": result.outcome,
        "cause": result.cause,
        "metrics": {name: value if math.isfinite(value) else None for name, value in result.metrics.items()},
        "verdicts": [
            {
                "metric": verdict.metric,
                "value": verdict.value if math.isfinite(verdict.value) else None,
                "bound": verdict.bound,
                "holds": verdict.holds,
            }
            for verdict in result.verdicts
        ],
        "passed": result.passed,
        "tasks": [asdict(task) for task in result.tasks],
        "queues": [asdict(queue) for queue in result.queues],
        "usage": asdict(result.usage) if result.usage else None,
        "ages": [asdict(stage) for stage in result.ages],
        "hash": result.hash,
        "versions": versions(),
        "commit": commit(),
        "real_time_factor": round(result.real_time_factor, 2),
        "stood_still_ms": result.stood_still_us / 1000,
    }
    (result.folder / RESULT).write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def read_result(folder: Path) -> dict[str, Any]:
    """Return the content of a run's `result.json`; a flight that was killed has none: then a minimal one."""
    path = folder / RESULT
    if path.is_file():
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return content
    log = load_log(folder)
    metadata = {key.decode(): value.decode() for key, value in (log.schema.metadata or {}).items()}
    metrics = measure(log, lost=False)
    return {
        "experiment": metadata.get("experiment", "?"),
        "profile": metadata.get("profile", "?"),
        "overrides": json.loads(metadata.get("overrides", "[]")),
        "seed": int(metadata.get("seed", 0)),
        "duration_s": float(metadata.get("duration_s", 0)),
        "link": metadata.get("link", "radio"),
        "board": metadata.get("board", PYTHON),
        "faults": json.loads(metadata.get("faults", "[]")),
        "outcome": "error",
        "cause": "the process ended before the flight did",
        "metrics": {name: value if math.isfinite(value) else None for name, value in metrics.items()},
        "verdicts": [],
        "tasks": [],
        "queues": [],
        "usage": None,
        "ages": [],
        "passed": False,
        "hash": "",
        "versions": json.loads(metadata.get("versions", "{}")),
        "commit": metadata.get("commit", ""),
        "real_time_factor": None,
        "stood_still_ms": None,
    }


def metadata_of(request: Request) -> dict[str, str]:
    """Return the metadata of the log's schema."""
    return {
        "experiment": request.experiment.name,
        "profile": request.profile,
        "overrides": json.dumps(request.overrides),
        "seed": str(request.seed),
        "duration_s": str(request.duration_s),
        "link": request.link,
        "board": request.board,
        "faults": json.dumps([str(fault) for fault in request.all_faults]),
        "config": request.config.model_dump_json(),
        "versions": json.dumps(versions()),
        "commit": commit(),
    }


def versions() -> dict[str, str]:
    """Return the versions of what computed the flight."""
    found = {"python": platform.python_version()}
    for name in ("floaty-hil", "numpy", "numba", "pyarrow"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found


def commit() -> str:
    """Return the git commit of the sources, with `+` when they were changed; empty outside a clone."""
    source = Path(__file__).parent
    try:
        described = subprocess.run(
            ["git", "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty=+"],
            cwd=source, capture_output=True, text=True, timeout=10, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ""
    return described.stdout.strip()
