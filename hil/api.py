"""The laboratory for users' programs: fly, read the results, define experiments.

`floaty docs python` shows an example of each. Lengths are in m, angles in rad, forces in N, times in s, except a log's own
clock, `t`, which counts microseconds; frames are W (world, z up) and B (body, x forward, y left, z up).
"""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, Unpack

import pyarrow as pa

from ground_station import trajectory
from hil.board.cores.boards import C
from hil.config import DEFAULT_PROFILE, LabConfig
from hil.errors import LabError, reading
from hil.laboratory.arguments import Known, checked
from hil.laboratory.experiment import Experiment
from hil.laboratory.experiments import (
    check_flown,
    find_again,
    find_experiment,
    find_experiments,
    find_shipped,
    finder_of,
)
from hil.laboratory.fault_kinds import Kind, Knob, declare, knob
from hil.laboratory.faults import Fault
from hil.laboratory.faults import parse as fault
from hil.laboratory.files.folder import folder_of, reserved
from hil.laboratory.files.recorder import config_of, load_events, load_log
from hil.laboratory.files.result import Outcome, Result, read_result
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import in_lockstep
from hil.laboratory.metrics import METRICS, Metric, Verdict, column, free_flight, position_error, with_angles
from hil.laboratory.request import RADIO, Options, Request
from hil.laboratory.run import MakeFlight
from hil.laboratory.run import fly as fly_into
from hil.laboratory.swarms.flying import fly_swarm as fly_together
from hil.laboratory.swarms.folder import swarm_folder, swarm_reserved
from hil.laboratory.swarms.request import swarm_of
from hil.laboratory.swarms.result import SwarmResult
from hil.pictures.exports.demonstrations import Demonstrations, demonstrations_of
from hil.world.rigid import RigidBody

__all__ = [
    "Along", "Experiment", "Fault", "Goal", "Kind", "Knob", "LabError", "Metric", "Options", "Request",
    "RigidBody", "Run", "Swarm", "column", "command_of", "declare", "fault", "fly", "fly_swarm", "knob", "load_run",
    "position_error", "request_of",
]  # fmt: skip

Progress = Callable[[float], None]  # (share of the flight, 0..1)
Found = TypeVar("Found", Result, SwarmResult)


@checked
class Goal(trajectory.Goal):
    """The goal frame G: upright, turned by `yaw`."""

    __slots__ = ()


@checked
class Along(trajectory.Along):
    """Makes a trajectory from a function of time, for experiments that move the goal."""

    __slots__ = ()


@checked
def request_of(experiment: Experiment | str, **options: Unpack[Options]) -> Request:
    """Return the request for an experiment, an object, a name or FILE.py:NAME. Raises `LabError` for bad input."""
    chosen = find_experiment(experiment) if isinstance(experiment, str) else experiment
    return Request.of(chosen, **options)


@checked
def fly(
    flown: Request | Experiment | str,
    folder: Path | str | None = None,
    progress: bool | Progress = False,
    report: bool = False,
    replace: bool = False,
    **options: Unpack[Options],
) -> Run:
    """Fly once, into a run folder, by default `runs/EXPERIMENT-SEED`.

    An earlier flight of the same request is replaced there. A flight of another request is kept: by default the folder is
    then `runs/EXPERIMENT-SEED-2` and so on; a `folder` with one is refused without `replace`.

    `coverage` adds to the coverage of the image that flies, and writes it (`floaty docs coverage`).

    `flown` is an experiment, the name of one, FILE.py:NAME, or a `Request`, which takes no options. `progress` shows the
    time in flight on standard error, or is called with the completed share of the flight. `report` writes `report.html`.

    A crash or a failed limit is a result, not an error. Raises `LabError` for bad input.
    """
    if isinstance(flown, Request):
        if options:
            raise LabError(f"fly: a Request has its options already: {', '.join(options)}")
        request = flown
    else:
        request = request_of(flown, **options)
    place = folder_of(request) if folder is None else Path(folder)
    show = _shown(request) if progress is True else progress or None

    def on_progress(now_us: int, flight: Flight) -> None:
        if show is not None:
            show(min(now_us / flight.end_us, 1.0))  # almost 0 while the release is not planned

    with reserved(request, place, replace):
        result = fly_into(request, place, progress=on_progress, flight_of=maker_of(request))
        if show is not None:
            show(1.0)
        run = Run(result)
        if report:
            run.write_report()
    _write_coverage(request.bench.coverage)
    return run


@checked
def fly_swarm(
    flown: Experiment | str,
    robots: int,
    folder: Path | str | None = None,
    report: bool = False,
    replace: bool = False,
    **options: Unpack[Options],
) -> Swarm:
    """Fly several robots together in lockstep, by default into `runs/EXPERIMENT-SEED-xROBOTS`.

    `flown` is as for `fly`, or a folder with a trajectory for each robot. Robot 1 has the seed of `options`, the next ones
    the next. `report` writes the reports of the swarm and of each robot. Raises `LabError` for bad input.
    """
    chosen = find_experiments(flown, robots) if isinstance(flown, str) else [flown] * robots
    request = swarm_of(chosen, **options)
    place = swarm_folder(request) if folder is None else Path(folder)
    with swarm_reserved(request, place, replace):
        swarm = Swarm(fly_together(request, place))
        if report:
            swarm.write_report()
    _write_coverage(options.get("coverage"))
    return swarm


def _write_coverage(out: Path | None) -> None:
    """Write the files of a flight's coverage, if it has one."""
    if out is not None:
        from hil.pictures.exports.coverage import write_coverage

        write_coverage(out)


def maker_of(request: Request) -> MakeFlight:
    """Return the function that assembles a request's flight, by its link and board."""
    if request.bench.in_loop:
        from hil.servers.in_the_loop import in_the_loop

        return in_the_loop
    if request.bench.in_lockstep:
        return in_lockstep
    from hil.servers.linked import linked_flight

    return linked_flight


@checked
def load_run(folder: Path | str, experiment: Experiment | str | None = None) -> Run:
    """Return an earlier run. Raises `LabError` when the folder has none.

    Nothing of the folder is executed, and nothing that it names. An experiment of a file or package is therefore unknown
    unless you give it: an `Experiment`, or its name or FILE.py:NAME, which is executed.
    """
    place = Path(folder)
    if experiment is None:
        return Run(read_result(place, find_shipped))
    given = find_experiment(experiment) if isinstance(experiment, str) else experiment
    run = Run(read_result(place, finder_of(given)))
    check_flown(given, run.result)
    return run


@dataclass(frozen=True, eq=False)
class Flown(Generic[Found]):
    """What one robot, or robots that flew together, left in a folder."""

    result: Found

    @property
    def folder(self) -> Path:
        """The folder of log, result and pictures; of a swarm, with a run folder for each robot."""
        return self.result.folder

    @property
    def passed(self) -> bool:
        """Whether every robot completed its flight, and every limit holds, also those of a swarm."""
        return self.result.passed

    @property
    def outcome(self) -> Outcome:
        """completed, lost, interrupted or error; of a swarm, the worst of all robots."""
        return self.result.outcome

    @property
    def metrics(self) -> Mapping[str, float]:
        """Figures after the release, in the unit of `Run.unit_of`; of a swarm, `distance_min` [m]. NaN: no value."""
        return Known("metric", self.result.metrics)

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Every limit with its value and whether it holds; of a swarm, those of the whole."""
        return self.result.verdicts

    @property
    def hash(self) -> str:
        """SHA-256 of everything recorded, of a swarm of all robots' hashes; the same for the same flight in lockstep."""
        return self.result.hash


class Run(Flown[Result]):
    """A flight and its folder."""

    @property
    def request(self) -> Request:
        """The request, equal to the flown one if its experiment is known."""
        return self.result.request

    @property
    def experiment(self) -> Experiment | None:
        """The experiment; None when it neither ships nor was given to `load_run`."""
        return self.request.experiment if self.request.experiment.is_known else None

    @cached_property
    def config(self) -> LabConfig:
        """The configuration of the flight, from its log. Raises `LabError` for one of another version."""
        return config_of(self.folder, self.log.schema.metadata)

    @property
    def cause(self) -> str | None:
        """Why the flight was lost or failed."""
        return self.result.cause

    @cached_property
    def log(self) -> pa.Table:
        """One row per 10 ms; `t` [us], all other columns with `unit` and `frame` in the metadata of their fields.

        `truth.roll`, `truth.pitch` and `truth.yaw` are computed here from the recorded quaternion.
        """
        return with_angles(load_log(self.folder))

    @property
    def free(self) -> pa.Table:
        """The rows after the release."""
        return free_flight(self.log)

    def to_pandas(self) -> Any:
        """Return the log as a `pandas.DataFrame`, by time since the release [s]. Raises `LabError` without pandas."""
        try:
            frame = self.log.to_pandas()
        except ImportError as error:
            raise LabError(f"to_pandas: {error}: pip install pandas") from None
        release_us = column(self.free, "t")[:1]
        frame.index = (frame["t"] - (release_us[0] if len(release_us) else 0)) * 1e-6
        return frame.rename_axis("s")

    def to_dataset(self) -> Demonstrations:
        """Return the control law's data for imitation learning: observations (N, 20), actions (N, 4)."""
        with reading(self.folder):
            return demonstrations_of(self.log, self.config)

    @property
    def units(self) -> Mapping[str, str]:
        """The unit of every column of the log, empty for a pure number."""
        with reading(self.folder):
            return Known("column", {one.name: one.metadata[b"unit"].decode() for one in self.log.schema})

    @checked
    def unit_of(self, metric: str) -> str:
        """Return the unit of a metric, empty for a pure number."""
        return Known("metric", {**METRICS, **self.result.own_metrics})[metric].unit

    @property
    def events(self) -> list[dict[str, Any]]:
        """The events of board, station and laboratory: `t_us`, `source`, `text`."""
        return load_events(self.folder)

    @property
    def paths(self) -> Mapping[str, Path]:
        """The files of the run by their names: log.parquet, events.jsonl, telemetry.csv, result.json, …"""
        return Known("file", {path.name: path for path in sorted(self.folder.iterdir())})

    @checked
    def plot(
        self,
        *columns: str,
        size: tuple[float, float] | None = None,
        units: Literal["SI", "customary"] | None = None,
    ) -> Any:
        """Return a matplotlib figure of columns of the log, one axis per unit; of errors and flaps if none is named.

        `size` is its width and height [in]. `units` are those of the whole figure: SI, the default of named columns, or
        customary (cm, deg, ms, %), the default of errors and flaps. The `rcParams` of matplotlib that you have set are kept.
        The flight's faults and events are marked as in the report. Raises `LabError` for a column that the log lacks.
        """
        from hil.pictures.drawing import plotted

        with reading(self.folder):
            return plotted(self.log, columns, units or ("SI" if columns else "customary"), size)

    def write_report(self) -> Path:
        """Write `report.html` with all figures, and return its path.

        What needs the code of an unknown experiment is left out and reported on standard error.
        """
        from hil.pictures.report import not_executed, write_report  # loads matplotlib

        if missing := not_executed(self.request.experiment, self.request.faults):
            print(f"{self.folder}: {missing}", file=sys.stderr)
        with reading(self.folder):
            return write_report(self.folder, self.experiment)

    def __repr__(self) -> str:
        failed = "; ".join(map(str, self.result.failed))
        how = self.cause or failed or ("all limits hold" if self.verdicts else "no limits")
        return f"<{self.request.title}: {self.outcome}, {how}; {self.folder}>"

    def _repr_html_(self) -> str:
        """Return the HTML that a notebook shows: verdict, metrics with their limits, and path."""
        how, _, _ = repr(self)[1:-1].rpartition("; ")
        verdict = "passed" if self.passed else "failed"
        head = "".join(f"<th>{name}</th>" for name in ("metric", "value", "limit", "verdict"))
        rows = "".join(
            f"<tr>{''.join(f'<td>{escape(cell)}</td>' for cell in row)}</tr>" for row in self.result.rows
        )
        place = escape(str(self.folder))
        if report := self.paths.get("report.html"):
            place = f'<a href="{escape(str(report))}">{escape(str(report))}</a>'
        return f"<p><b>{verdict}</b>: {escape(how)}</p><table><tr>{head}</tr>{rows}</table><p>{place}</p>"


class Swarm(Flown[SwarmResult]):
    """Robots that flew together, and their folder."""

    @property
    def robots(self) -> tuple[Run, ...]:
        """The flight of each robot."""
        return tuple(map(Run, self.result.robots))

    def write_report(self) -> Path:
        """Write `report.html` of the swarm and of each robot, and return the path of the first."""
        from hil.pictures.swarm import write_swarm_report  # loads matplotlib

        for one in self.robots:
            one.write_report()
        return write_swarm_report(self.result)

    def __repr__(self) -> str:
        failed = [f"robot {i}" for i, one in enumerate(self.robots, 1) if not one.passed]
        failed += [str(one) for one in self.verdicts if not one.holds]
        return f"<{self.result.request.title}: {'; '.join(failed) or 'all limits hold'}; {self.folder}>"


@checked
def command_of(request: Request) -> str | None:
    """Return the command that repeats a flight bit for bit; None for an experiment that is unknown or without a name."""
    experiment = request.experiment
    if not experiment.is_known or find_again(experiment.name, experiment.source) != experiment:
        return None
    bench = request.bench
    options = [  # with the usual values
        ("--seed", request.seed, None), ("--duration", request.duration_s, experiment.duration_s),
        ("--profile", request.profile, DEFAULT_PROFILE),
        *(("--set", one, None) for one in request.overrides[len(experiment.settings) :]),
        *(("--fault", one, None) for one in request.faults[len(experiment.faults) :]),
        ("--link", bench.link, RADIO), ("--board", bench.board, C), ("--elf", bench.elf, None),
        ("--hil", bench.in_loop, None),
    ]  # fmt: skip
    words = [word for name, value, usual in options if value != usual for word in (name, str(value))]
    return shlex.join(["floaty", "fly", experiment.reference, *words])


def _shown(request: Request) -> Progress:
    """Return the callback that shows the progress in one line of standard error, which a notebook shows as well."""

    def show(share: float) -> None:
        text = f"\r{request.experiment.name}, seed {request.seed}: {share:4.0%} of {request.duration_s:g} s"
        print(text, end="\n" if share >= 1.0 else "", file=sys.stderr, flush=True)

    return show
