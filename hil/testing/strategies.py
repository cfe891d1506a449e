"""Faults and trajectories for Hypothesis, on grids where "smaller" means simpler for an engineer.

A failing flight shrinks to the first failing kind of fault, the size nearest to no fault, and the earliest begin; a
trajectory to the fewest goals nearest to home.
"""

import math
from dataclasses import dataclass

from hypothesis import strategies as st
from hypothesis.strategies import SearchStrategy

from ground_station.trajectory import Along
from hil.errors import LabError
from hil.laboratory.arguments import checked
from hil.laboratory.fault_kinds import KINDS, Kind, times
from hil.laboratory.faults import Fault, parse

GRID = 400  # sizes between the bounds of a kind, at least 200
GRID_S = 0.1  # of begins and durations
GRID_M, GRID_RAD = 0.01, math.radians(5.0)


@checked
def faults(
    *kinds: str,
    start_s: tuple[float, float] = (1.0, 1.0),
    duration_s: tuple[float, float] | None = None,
    size: tuple[float, float] | None = None,
) -> SearchStrategy[Fault]:
    """Return faults of some kinds, by default all that act on every flight.

    They begin `start_s` after the release, from..to, and last `duration_s`, from..to, by default the kind's duration.
    Sizes are the kind's, or those inside `size`, in steps of about 1/300 of the kind's range. Raises `LabError` for an
    unknown kind.
    """
    names = kinds or tuple(name for name, kind in KINDS.items() if not kind.needs)
    return st.one_of([_of_kind(name, start_s, duration_s, size) for name in names])


def _of_kind(
    name: str,
    start_s: tuple[float, float],
    duration_s: tuple[float, float] | None,
    size: tuple[float, float] | None,
) -> SearchStrategy[Fault]:
    kind = KINDS[parse(f"{name}@0").kind]  # raises for an unknown one
    lasting = _grid(*duration_s) if duration_s else st.just(kind.duration_s)
    return st.builds(Fault, st.just(name), _grid(*start_s), lasting, _sizes(kind, size))


@checked
@dataclass(frozen=True, slots=True)
class Waypoints:
    """A function of time for `Along`: goals relative to home, W, each held for `every_s`, the last to the end."""

    every_s: float
    goals: tuple[tuple[float, float, float, float], ...]  # x, y, z [m], yaw [rad]

    def __call__(self, t_s: float) -> tuple[float, float, float, float]:
        index = int(t_s / self.every_s) - 1  # home is first
        if index < 0 or not self.goals:
            return (0.0, 0.0, 0.0, 0.0)
        return self.goals[min(index, len(self.goals) - 1)]


@checked
def trajectories(
    reach_m: float = 0.06, turn_rad: float = 0.0, every_s: float = 1.0, most: int = 4
) -> SearchStrategy[Along]:
    """Return trajectories that jump from goal to goal, each within `reach_m` and `turn_rad` of home on every axis."""
    length, turn = _steps(reach_m, GRID_M), _steps(turn_rad, GRID_RAD)
    goal = st.tuples(length, length, length, turn)
    return st.lists(goal, max_size=most).map(lambda goals: Along(Waypoints(every_s, tuple(goals))))


def _steps(most: float, step: float) -> SearchStrategy[float]:
    count = int(most / step + 1e-9)
    return st.integers(-count, count).map(lambda index: round(index * step, 9))


def _grid(low: float, high: float) -> SearchStrategy[float]:
    if not 0.0 <= low <= high:
        raise LabError(f"{low:g}..{high:g} s: expected from..to, 0 or more")
    return st.integers(round(low / GRID_S), round(high / GRID_S)).map(lambda index: round(index * GRID_S, 9))


def _sizes(kind: Kind, within: tuple[float, float] | None) -> SearchStrategy[float]:
    """Return the sizes of a kind, counted from the harmless one."""
    if not kind.sized:
        return st.just(kind.size)
    none, step = _no_fault(kind), _round_step((kind.high - kind.low) / GRID)
    low, high = within or (kind.low, kind.high)
    first = math.ceil((max(low, kind.low) - none) / step - 1e-9)
    last = math.floor((min(high, kind.high) - none) / step + 1e-9)
    if first > last:
        raise LabError(f"size {low:g}..{high:g}: expected some of {kind.low:g}..{kind.high:g}")
    return st.integers(first, last).map(lambda index: round(none + index * step, 9))


def _no_fault(kind: Kind) -> float:
    """Return the size without effect, or the bound nearest to it."""
    blend = kind.knobs[0].blend
    neutral = 1.0 if blend is times else kind.high if blend is min else 0.0
    return min(max(neutral, kind.low), kind.high)


def _round_step(step: float) -> float:
    """Return the next larger of 1, 2, 5 times a power of ten."""
    power = float(f"1e{f'{step:e}'.partition('e')[2]}")
    return next(power * factor for factor in (1, 2, 5, 10) if power * factor >= step * (1 - 1e-9))
