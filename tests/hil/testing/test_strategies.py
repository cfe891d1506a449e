"""Faults and trajectories for Hypothesis: what they draw is allowed, and the smallest is what an engineer calls small."""

import math
import pickle
from collections.abc import Callable
from types import SimpleNamespace as Made
from typing import Any

import pytest
from hypothesis import find, given, settings
from hypothesis import strategies as st

from ground_station.trajectory import Along, Goal
from hil.errors import LabError
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Fault, parse
from hil.testing import Waypoints, faults, strategies, trajectories

QUICK = settings(database=None, derandomize=True)
HOME = Goal((0.0, 0.0, 1.15), 0.0)


@pytest.mark.long
@given(fault=faults(start_s=(0.0, 2.0), duration_s=(0.1, 1.0)))
@settings(max_examples=200)
def test_every_fault_is_possible_and_reads_back_from_its_text(fault: Fault) -> None:
    assert not KINDS[fault.kind].needs
    assert 0.0 <= fault.start_s <= 2.0
    assert 0.1 <= fault.duration_s <= 1.0
    assert parse(str(fault)) == fault


@pytest.mark.long
def test_every_size_of_a_kind_s_grid_can_be_asked_for_alone() -> None:
    for kind in (one for one in KINDS.values() if one.sized):
        none, step = (
            strategies._no_fault(kind),
            strategies._round_step((kind.high - kind.low) / strategies.GRID),
        )
        indices = range(
            math.ceil((kind.low - none) / step - 1e-6), math.floor((kind.high - none) / step + 1e-6) + 1
        )
        for size in (round(none + index * step, 9) for index in indices):
            strategies._sizes(kind, (size, size))  # it raises for one that is not on the grid


class Every(tuple[float, ...]):
    """In place of a strategy: all that it may draw."""

    def map(self, value_of: Callable[[Any], float]) -> "Every":
        return Every(map(value_of, self))


@pytest.fixture
def _every(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(st, "integers", lambda low, high: Every(range(low, high + 1)))


@pytest.mark.usefixtures("_every")
def test_sizes_reach_from_bound_to_bound_of_every_kind_and_each_can_be_asked_for_alone() -> None:
    for kind in (one for one in KINDS.values() if one.sized):
        step = strategies._round_step((kind.high - kind.low) / strategies.GRID)
        sizes: Any = strategies._sizes(kind, None)
        assert -1e-9 <= sizes[0] - kind.low < step, kind.meaning
        assert -1e-9 <= kind.high - sizes[-1] < step, kind.meaning
        for one in sizes[:: len(sizes) // 20]:
            assert strategies._sizes(kind, (one, one)) == (one,), kind.meaning


@pytest.mark.usefixtures("_every")
def test_goals_reach_equally_far_on_each_axis_and_turn_by_what_is_allowed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(st, "tuples", lambda *parts: parts)
    monkeypatch.setattr(st, "lists", lambda goal, max_size: Made(map=lambda make: (goal, max_size, make)))
    found: Any = trajectories(reach_m=0.29, turn_rad=math.radians(15), every_s=0.5, most=3)
    goal, most, make = found
    lengths, turns = [0.01 * n for n in range(-29, 30)], [math.radians(5 * n) for n in range(-3, 4)]
    assert ([*map(pytest.approx, (lengths, lengths, lengths, turns))], most) == ([*map(list, goal)], 3)
    goals = [(0.01, 0.02, 0.03, 0.04), (0.0, 0.0, 0.0, 0.0)]
    assert make(goals) == Along(Waypoints(0.5, tuple(goals)))
    begins: Any = strategies._grid(0.3, 0.7)
    assert begins == (0.3, 0.4, 0.5, 0.6, 0.7)


@given(fault=faults("push.y", size=(-1.0, 0.5)))
def test_sizes_stay_within_what_is_asked(fault: Fault) -> None:
    assert -1.0 <= fault.size <= 0.5
    assert (fault.start_s, fault.duration_s) == (1.0, 0.1)


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "size"),
    [("push.y", 0.0), ("wind.fan", 1.0), ("imu.saturation", 2000.0), ("mocap.swap", 0.001)],
)
def test_the_smallest_fault_is_none_at_all(kind: str, size: float) -> None:
    smallest = find(faults(kind), lambda fault: True, settings=QUICK)
    assert smallest.size == pytest.approx(size, rel=0.02)


@pytest.mark.long
@pytest.mark.parametrize(("bound", "smallest"), [(2.31, 2.4), (-2.31, -2.4)])
def test_a_failure_shrinks_to_the_first_size_beyond_the_bound(bound: float, smallest: float) -> None:
    def fails(fault: Fault) -> bool:
        return fault.size * bound > bound * bound

    found = find(faults("push.y", start_s=(0.5, 3.0)), fails, settings=QUICK)
    assert (found.size, found.start_s) == (smallest, 0.5)


@pytest.mark.long
@given(way=trajectories(reach_m=0.05, turn_rad=0.2, every_s=0.5, most=3), t_s=st.floats(0.0, 10.0))
def test_every_goal_is_within_reach_of_home_where_the_way_begins(way: Along, t_s: float) -> None:
    path = way(HOME, 0)
    goal = path.at(round(t_s * 1e6))
    assert all(abs(now - then) <= 0.05 + 1e-9 for now, then in zip(goal.p_WG, HOME.p_WG, strict=True))
    assert abs(goal.yaw) <= 0.2
    assert path.at(499_999) == HOME
    assert goal == pickle.loads(pickle.dumps(way))(HOME, 0).at(round(t_s * 1e6))


def test_a_path_holds_every_goal_for_its_time_and_the_last_to_the_end() -> None:
    way = Waypoints(0.5, ((0.01, 0.0, 0.0, 0.0), (0.02, 0.0, 0.0, 0.0)))
    assert [way(t)[0] for t in (0.0, 0.49, 0.5, 0.99, 1.0, 9.5)] == [0.0, 0.0, 0.01, 0.01, 0.02, 0.02]


@pytest.mark.long
def test_a_failing_way_shrinks_to_one_goal_on_one_axis() -> None:
    def fails(way: Along) -> bool:
        return any(abs(goal[1]) > 0.025 for goal in way.path.goals)  # type: ignore[attr-defined]

    found = find(trajectories(), fails, settings=QUICK)
    assert found == Along(Waypoints(1.0, ((0.0, 0.03, 0.0, 0.0),)))


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: faults("push.w"), "unknown kind 'push.w'"),
        (lambda: faults("push.y", start_s=(2.0, 1.0)), "2..1 s: expected from..to"),
        (lambda: faults("push.y", size=(30.0, 40.0)), "size 30..40: expected some of -20..20"),
    ],
)
def test_impossible_arguments_are_one_line(make: object, told: str) -> None:
    with pytest.raises(LabError, match=told.replace(".", r"\.")):
        make()  # type: ignore[operator]
