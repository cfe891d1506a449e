"""An experiment: a trajectory for the ground station, planned events, and limits on metrics."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import pyarrow as pa

from ground_station.trajectory import Goal, Hold, Trajectory
from hil.errors import LabError, blame, refusing
from hil.laboratory.arguments import checked
from hil.laboratory.faults import Fault
from hil.laboratory.metrics import METRICS, Metric, check_limits, free_flight, measure
from hil.laboratory.robot import Robot

LOOK_US = 20_000  # how often a goal is sent
# [m] sideways on an axis: y-square's; a jump of 0.2 m in x or 0.3 m in y loses the robot.
JUMP_MAX = 0.2 + 1e-9
NAME = re.compile(r"\w[\w.-]*")


def stay(home: Goal, release_us: int) -> Trajectory:
    """Hold the home goal."""
    return Hold(home)


def need_nothing(robot: Robot) -> None:
    """Need nothing special on board."""


def leave_alone(flight: object) -> None:
    """Plan no events."""


def nothing(flight: pa.Table) -> Mapping[str, float]:
    """Measure no additional metrics."""
    return {}


@dataclass(frozen=True, slots=True)
class Source:
    """The source of an experiment that does not ship."""

    reference: str  # as `floaty fly` accepts it: FILE.py:NAME, or the name of an entry point
    sha256: str  # of its file
    package: str = ""  # and version, of one that is installed


@checked
@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment; `limits` maps names of `hil.laboratory.metrics.METRICS` or of its own `metrics` to bounds in that
    metric's unit.

    `script` is called once with the flight, at the release or before it, and plans events. All fields can be pickled,
    because flights run in parallel processes. Raises `LabError` for an invalid name, duration or metric.
    """

    name: str
    summary: str  # one line
    duration_s: float  # of free flight, after the release
    limits: Mapping[str, float]  # of the default profile; another profile has its own in [limits.NAME]
    trajectory: Callable[[Goal, int], Trajectory] = stay  # (home, release instant [us])
    prepare: Callable[[Robot], None] = need_nothing  # creates at the start what the script will need
    script: Callable[[Any], None] = leave_alone  # takes the `Flight`, which is described above this file
    settings: tuple[str, ...] = ()  # "section.key=value", override the profile
    faults: tuple[Fault, ...] = ()  # those of the command line are added
    # Computes the experiment's own metrics from the rows after the release.
    measure: Callable[[pa.Table], Mapping[str, float]] = nothing
    metrics: Mapping[str, Metric] = field(default_factory=dict)  # of `measure`, beyond METRICS
    pictures: tuple[str, ...] = ()  # its own pictures by name in `hil.pictures.gallery`, first in the report
    # Draws one more picture, a matplotlib Figure, from the rows after the release.
    draw: Callable[[pa.Table], Any] | None = None
    source: Source | None = None  # None: it ships, or is in no file

    def __repr__(self) -> str:
        return f"<Experiment {self.name}, {self.duration_s:g} s: {self.summary}>"

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise LabError(
                f"experiment {self.name!r}: a name has letters, digits, dots, hyphens and underscores"
            )
        if not 0.0 < self.duration_s < math.inf:
            raise LabError(
                f"experiment {self.name}: duration_s = {self.duration_s}: expected seconds, above 0"
            )
        for fault in self.faults:
            if fault.start_s >= self.duration_s:
                raise LabError(
                    f"experiment {self.name}: fault {fault}: the flight ends {self.duration_s:g} s after the release"
                )
        for name in self.metrics:
            if name in METRICS:
                raise LabError(f"experiment {self.name}: metric {name}: every flight has one of that name")
        with refusing(f"experiment {self.name}: ", LabError):
            check_limits(self.limits, self.metrics)

    @property
    def reference(self) -> str:
        """Its name for `floaty fly` and `floaty station`."""
        return self.source.reference if self.source else self.name

    @property
    def is_known(self) -> bool:
        """Whether this is not a stand-in."""
        return self.trajectory is not not_executed

    def check_known(self) -> None:
        """Raise `LabError` for a stand-in, which cannot be flown."""
        if not self.is_known:
            raise LabError(
                f"experiment {self.name}: its code was not executed; load_run(folder, experiment=…) executes what you name"
            )

    def measured(self, flight: pa.Table) -> Mapping[str, float]:
        """Return its own metrics, from the rows after the release. Raises `LabError` for invalid ones."""
        try:
            values = {name: float(value) for name, value in self.measure(flight).items()}
        except Exception as error:
            raise LabError(f"experiment {self.name}: measure: {blame(error)}") from error
        if unknown := values.keys() - METRICS.keys() - self.metrics.keys():
            raise LabError(
                f"experiment {self.name}: measure returned {min(unknown)!r}, which `metrics` does not declare"
            )
        return values

    def metrics_of(self, log: pa.Table, lost: bool, resets: int | None = None) -> dict[str, float]:
        """Return the metrics of every flight and its own; NaN where the flight was too short. Raises like `measured`."""
        metrics = measure(log, lost, resets) | dict.fromkeys(self.metrics, math.nan)
        if (free := free_flight(log)).num_rows > 1:
            metrics.update(self.measured(free))
        return metrics

    def check_goals(
        self, home: tuple[float, float, float], duration_s: float, left: Callable[[Sequence[float]], str]
    ) -> None:
        """Raise `LabError` when the trajectory lacks a goal at some time, leaves the flow, or jumps too far to follow.

        `left` returns why a robot would be lost at a place (3,) [m] in W; empty if not.
        """
        t_us, before = 0, home
        try:
            trajectory = self.trajectory(Goal(home, 0.0), 0)
            for t_us in range(0, round(duration_s * 1e6), LOOK_US):
                goal = trajectory.at(t_us)
                if not math.isfinite(math.fsum((*goal.p_WG, goal.yaw))) or len(goal.p_WG) != 3:
                    raise LabError(f"{goal}: expected three finite numbers and a yaw")
                if why := left(goal.p_WG):
                    raise LabError(f"a goal outside the flow: {why}")
                if (jump := max(abs(goal.p_WG[axis] - before[axis]) for axis in (0, 1))) > JUMP_MAX:
                    raise LabError(f"the goal jumps {jump:.2f} m sideways: up to 0.2 m can be followed")
                before = goal.p_WG
        except Exception as error:
            raise LabError(
                f"experiment {self.name}: trajectory at {t_us * 1e-6:g} s: {blame(error)}"
            ) from error


def not_executed(*_: object) -> Any:
    """Raise `LabError`: the trajectory, and the picture, of an experiment whose code is not executed."""
    raise LabError("the experiment's code was not executed")


def unknown(
    name: str, source: Source | None, pictures: tuple[str, ...] = (), draws: bool = False
) -> Experiment:
    """Return the stand-in for an experiment whose code is not executed: it has pictures, but cannot be flown."""
    draw = not_executed if draws else None
    return Experiment(name, "", 1.0, {}, trajectory=not_executed, pictures=pictures, draw=draw, source=source)
