"""A trajectory that the robot cannot fly is refused before the flight, from any source."""

import math
from collections.abc import Callable
from pathlib import Path

import pytest

from hil import Along, Experiment, Goal, LabError, Request
from hil.api import request_of
from hil.laboratory.experiments import EXPERIMENTS, find_experiment

Place = tuple[float, float, float]


def jumping(x: float = 0.0, y: float = 0.0, z: float = 0.0, until_s: float = 9.0) -> Callable[[float], Place]:
    return lambda t: (x, y, z) if 1.0 < t < until_s else (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("path", "text"),
    [
        (jumping(y=5.0), r"at 1.02 s: .*a goal outside the flow: 5.00 m from the axis; up to 0.45 m"),
        (jumping(y=5.0, until_s=1.05), "at 1.02 s: .*5.00 m from the axis"),
        (jumping(x=0.4, y=0.4), "0.57 m from the axis"),
        (jumping(z=0.9), "0.90 m above the hover point; up to 0.85 m"),
        (jumping(z=-0.9), "0.90 m below the hover point; up to 0.8 m"),
        (jumping(x=0.25), "the goal jumps 0.25 m sideways: up to 0.2 m can be followed"),
        (jumping(y=-0.25), "the goal jumps 0.25 m sideways: up to 0.2 m"),
        (lambda t: (0.1 * t, 0.0, 0.0), r"at 4.5\d s: .*a goal outside the flow: 0.45 m"),
    ],
)
def test_a_goal_that_cannot_be_followed_is_refused(path: Callable[[float], Place], text: str) -> None:
    with pytest.raises(LabError, match=text):
        request_of("hover", duration_s=6.0, trajectory=Along(path))


@pytest.mark.parametrize(
    "path", [jumping(y=0.2), jumping(x=-0.2), jumping(z=0.8), lambda t: (0.07 * t, 0.0, 0.0)]
)
def test_a_goal_that_can_be_followed_is_not(path: Callable[[float], Place]) -> None:
    request_of("hover", duration_s=6.0, trajectory=Along(path))


@pytest.mark.parametrize("goal", [Goal((0.0, math.nan, 1.15), 0.0), Goal((0.0, 0.0, 1.15), math.inf)])
def test_an_invalid_goal_is_refused(goal: Goal) -> None:
    class Own:
        def at(self, t_us: int) -> Goal:
            return goal

    with pytest.raises(LabError, match=r"expected three finite numbers and a yaw"):
        request_of("hover", trajectory=lambda home, start_us: Own())


def test_a_file_with_such_a_trajectory_is_refused_with_its_name(tmp_path: Path) -> None:
    text = "from hil import Along, Experiment\nfar = Experiment('far', '', 3.0, {}, Along(lambda t: (0.0, t, 0.0)))\n"
    (tmp_path / "far.py").write_text(text)
    with pytest.raises(LabError, match=r"experiment far: trajectory at 0.46 s: a goal outside the flow"):
        Request.of(find_experiment(f"{tmp_path}/far.py:far"))


def test_every_experiment_that_ships_can_be_followed() -> None:
    for experiment in EXPERIMENTS.values():
        Request.of(experiment, duration_s=min(experiment.duration_s, 40.0))


def test_the_start_of_a_trajectory_may_not_jump_either() -> None:
    with pytest.raises(LabError, match=r"trajectory at 0 s: the goal jumps 0.30 m"):
        Request.of(Experiment("mine", "", 1.0, {}, Along(lambda t: (0.3, 0.0, 0.0))))
