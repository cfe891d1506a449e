"""What an experiment is: a trajectory for the ground station, what happens on the way, and limits on metrics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ground_station.trajectory import Goal, Hold, Trajectory

if TYPE_CHECKING:
    import pyarrow as pa

    from hil.laboratory.faults import Fault
    from hil.laboratory.flight import Flight
    from hil.laboratory.robot import Robot


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
class Experiment:
    """One experiment; `limits` maps names of `hil.laboratory.metrics.METRICS` to bounds in that metric's unit.

    `script` is called once with the flight, at the release or before it, and plans what shall happen as events. Everything
    in here can be pickled: flights are flown in parallel processes.
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
    pictures: tuple[str, ...] = ()  # names of its own, first in the report; `hil.pictures.gallery` has them
