"""What an experiment is: a trajectory for the ground station, what happens on the way, and limits on metrics."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from ground_station.trajectory import Goal, Hold, Trajectory
from hil.errors import LabError, blame
from hil.laboratory.metrics import METRICS, Metric

if TYPE_CHECKING:
    import pyarrow as pa

    from hil.laboratory.faults import Fault
    from hil.laboratory.flight import Flight
    from hil.laboratory.robot import Robot


LOOK_US = 20_000  # how often a goal goes up
NAME = re.compile(r"\w[\w.-]*")


def stay(home: Goal, release_us: int) -> Trajectory:
    """Hold the home goal."""
    return Hold(home)


def need_nothing(robot: Robot) -> None:
    """Need nothing special on board."""


def leave_alone(flight: Flight) -> None:
    """Let nothing happen."""


def nothing(flight: pa.Table) -> Mapping[str, float]:
    """Measure no more than every flight."""
    return {}


@dataclass(frozen=True, slots=True)
class Source:
    """Where an experiment stands that does not ship."""

    reference: str  # what `floaty fly` takes: FILE.py:NAME, or the name of an entry point
    sha256: str  # of its file
    package: str = ""  # and version, of one that is installed


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment; `limits` maps names of `hil.laboratory.metrics.METRICS` or of its own `metrics` to bounds in that
    metric's unit.

    `script` is called once with the flight, at the release or before it, and plans what shall happen as events. Everything
    in here can be pickled: flights are flown in parallel processes. Raises `LabError` for a name, a duration or a metric
    that cannot be.
    """

    name: str
    summary: str  # one line
    duration_s: float  # of free flight, after the release
    limits: Mapping[str, float]  # of the default profile; another one has its own in [limits.NAME]
    trajectory: Callable[[Goal, int], Trajectory] = stay  # (home, release instant [us])
    prepare: Callable[[Robot], None] = need_nothing  # lets be there from the start what the script will need
    script: Callable[[Flight], None] = leave_alone
    settings: tuple[str, ...] = ()  # "section.key=value", on top of the profile
    faults: tuple[Fault, ...] = ()  # those of the command line come on top
    measure: Callable[[pa.Table], Mapping[str, float]] = (
        nothing  # its own metrics, from the rows after the release
    )
    metrics: Mapping[str, Metric] = field(default_factory=dict)  # what `measure` brings beyond METRICS
    pictures: tuple[str, ...] = ()  # names of its own, first in the report; `hil.pictures.gallery` has them
    draw: Callable[[pa.Table], Any] | None = (
        None  # one more picture: a matplotlib Figure of the rows after the release
    )
    source: Source | None = None  # None: it ships, or stands in no file

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise LabError(
                f"experiment {self.name!r}: a name has letters, digits, dots, hyphens and underscores"
            )
        if not 0.0 < self.duration_s < math.inf:
            raise LabError(
                f"experiment {self.name}: duration_s = {self.duration_s}: expected seconds, above 0"
            )
        for name in self.metrics:
            if name in METRICS:
                raise LabError(f"experiment {self.name}: metric {name}: every flight has one of that name")

    @property
    def reference(self) -> str:
        """What `floaty fly` and `floaty station --trajectory` call it."""
        return self.source.reference if self.source else self.name

    def measured(self, flight: pa.Table) -> Mapping[str, float]:
        """Return its own metrics, from the rows after the release. Raises `LabError` for what is none."""
        try:
            values = {name: float(value) for name, value in self.measure(flight).items()}
        except Exception as error:
            raise LabError(f"experiment {self.name}: measure: {blame(error)}") from error
        if unknown := values.keys() - METRICS.keys() - self.metrics.keys():
            raise LabError(
                f"experiment {self.name}: measure returned {min(unknown)!r}, which `metrics` does not declare"
            )
        return values

    def check_goals(self, home: tuple[float, float, float], duration_s: float) -> None:
        """Raise `LabError` when the trajectory has no goal at an instant of the flight."""
        t_us = 0
        try:
            trajectory = self.trajectory(Goal(home, 0.0), 0)
            for t_us in range(0, round(duration_s * 1e6), LOOK_US):
                trajectory.at(t_us)
        except Exception as error:
            raise LabError(
                f"experiment {self.name}: trajectory at {t_us * 1e-6:g} s: {blame(error)}"
            ) from error
