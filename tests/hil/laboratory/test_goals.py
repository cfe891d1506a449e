"""A trajectory that the robot cannot fly is refused before the flight, from any source."""

import math
from collections.abc import Callable
from typing import Any

import pytest

from hil import Along, Experiment, Goal, LabError, Request
from hil.api import request_of
from hil.config import load_config
from hil.laboratory.request import why_left

Place = tuple[float, float, float]


def jumping(x: float = 0.0, y: float = 0.0, z: float = 0.0, until_s: float = 9.0) -> Callable[[float], Place]:
    return lambda t: (x, y, z) if 1.0 < t < until_s else (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("path", "text"),
    [
        (jumping(y=5.0), "at 1.02 s: a goal outside the flow: 5.00 m from the axis; up to 0.45 m"),
        (jumping(y=5.0, until_s=1.05), "at 1.02 s: a goal outside the flow: 5.00 m from the axis"),
        (jumping(x=0.4, y=0.4), "0.57 m from the axis"),
        (jumping(z=0.9), "0.90 m above the hover point; up to 0.85 m"),
        (jumping(z=-0.9), "0.90 m below the hover point; up to 0.8 m"),
        (jumping(x=0.25), "the goal jumps 0.25 m sideways: up to 0.2 m can be followed"),
        (jumping(y=-0.25), "the goal jumps 0.25 m sideways: up to 0.2 m"),
        (lambda t: (0.1 * t, 0.0, 0.0), "a goal outside the flow: 0.45 m"),
        (lambda t: (0.3, 0.0, 0.0), "trajectory at 0 s: the goal jumps 0.30 m"),
        (lambda t: (0.0, 0.0), "(0.0, 0.0): expected x, y, z [m] or x, y, z [m], yaw [rad]"),
        (lambda t: (0.0,) * 5, "expected x, y, z [m]"),
        (lambda t: 0.1, "0.1: expected x, y, z [m]"),
        (lambda t: None, "None: expected x, y, z [m]"),
        (lambda t: ("a", 0.0, 0.0), "expected x, y, z [m]"),
        (lambda t: (0.0, math.nan, 0.0), "(0.0, nan, 0.0): expected finite numbers"),
        (lambda t: (0.0, 0.0, 0.0, math.inf if t > 0.1 else 0.0), "at 0.12 s: (0.0, 0.0, 0.0, inf): expected fin"),
        (lambda t: (0.0, 1e-4 / (round(t, 6) - 0.2), 0.0), "at 0.2 s: test_goals.py:"),
    ],
)  # fmt: skip
def test_a_goal_that_cannot_be_followed_is_refused_in_one_line(
    path: Callable[[float], Any], text: str
) -> None:
    with pytest.raises(LabError) as error:
        Request.of(Experiment("mine", "", 6.0, {}, Along(path)))
    assert text in str(error.value)
    assert str(error.value).startswith("experiment mine: trajectory at ")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "path", [jumping(y=0.2), jumping(x=-0.2), jumping(z=0.8), lambda t: (0.07 * t, 0.0, 0.0)]
)
def test_a_goal_that_can_be_followed_is_not(path: Callable[[float], Place]) -> None:
    request_of("hover", duration_s=6.0, trajectory=Along(path))


LIMITS = {
    "floaty": (
        "tunnel.hover_height=1",
        "plant.limits.radius=0.5",
        "plant.limits.below=0.5",
        "plant.limits.above=0.75",
    ),
    "crazyflie": ("quadrotor.room=0.5", "quadrotor.ceiling=1.75"),
}


@pytest.mark.parametrize(("profile", "lowest"), [("floaty", 0.5), ("crazyflie", 0.0)])
@pytest.mark.parametrize("axis", range(3))
def test_a_place_on_the_limit_is_inside_and_the_next_one_outside(
    axis: int, profile: str, lowest: float
) -> None:
    config = load_config(profile, LIMITS[profile])
    low, high = (lowest, 1.75) if axis == 2 else (-0.5, 0.5)
    for at, inside in ((low, True), (high, True), (low - 1e-9, False), (high + 1e-9, False)):
        place = [0.0, 0.0, 1.0]
        place[axis] = at
        assert (why_left(config, place) == "") == inside


@pytest.mark.parametrize("goal", [Goal((0.0, math.nan, 1.15), 0.0), Goal((0.0, 0.0, 1.15), math.inf)])
def test_an_invalid_goal_is_refused(goal: Goal) -> None:
    class Own:
        def at(self, t_us: int) -> Goal:
            return goal

    with pytest.raises(LabError, match=r"expected three finite numbers and a yaw"):
        request_of("hover", trajectory=lambda home, start_us: Own())
