"""What an experiment is: a trajectory for the ground station, what happens on the way, and limits on metrics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ground_station.trajectory import Goal, Hold, Trajectory

if TYPE_CHECKING:
    from hil.harness import Flight


def stay(home: Goal, release_us: int) -> Trajectory:
    """Hold the home goal."""
    return Hold(home)


def leave_alone(flight: Flight) -> None:
    """Let nothing happen."""


@dataclass(frozen=True, slots=True)
class Experiment:
    """One experiment; `limits` maps names of `hil.metrics.METRICS` to bounds in that metric's unit.

    `script` is called once with the flight before it begins and plans what shall happen as events.
    """

    name: str
    summary: str  # one line
    duration_s: float  # of free flight, after the release
    limits: Mapping[str, float]
    trajectory: Callable[[Goal, int], Trajectory] = stay  # (home, release instant [us])
    script: Callable[[Flight], None] = leave_alone
