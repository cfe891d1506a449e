"""What an experiment is: a trajectory for the ground station, a duration, and limits on metrics."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from ground_station.trajectory import Goal, Trajectory


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment; `limits` maps names of `hil.metrics.METRICS` to bounds in that metric's unit."""

    name: str
    summary: str  # one line
    duration_s: float  # of free flight, after the release
    trajectory: Callable[[Goal, int], Trajectory]  # (home, release instant [us])
    limits: Mapping[str, float]
