"""The experiments and faults that ship are those that users know: how long, where to, how strong, within which limits.

`experiments.json` can be read: a number that changes there changes what a run's verdict means.
"""

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import pytest

from ground_station.trajectory import Goal
from hil.config import load_config
from hil.deploy.drill import DRILL, FAILURE
from hil.laboratory.experiment import Experiment
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.fault_kinds import KINDS, SHIPPED
from support.approved import approve, judge

KNOWN = Path(__file__).with_name("experiments.json")
HOME, RELEASE_US = Goal((0.1, -0.2, 1.15), 0.3), 1_000_000
LOOK_US = 990_000


def call_of(function: Any) -> str:
    """Return the name of a function with the values bound to it."""
    bound = [*getattr(function, "args", ()), *getattr(function, "keywords", {}).items()]
    return " ".join(map(str, [getattr(function, "func", function).__name__, *bound]))


def goals(experiment: Experiment) -> list[str]:
    """Return time, place and yaw of each goal that differs from the one before."""
    course, found = experiment.trajectory(HOME, RELEASE_US), [""]
    for t_us in range(0, RELEASE_US + round(experiment.duration_s * 1e6), LOOK_US):
        goal = course.at(t_us)
        text = " ".join(f"{number + 0.0:.5f}" for number in (*goal.p_WG, goal.yaw))
        if not found[-1].endswith(f": {text}"):
            found.append(f"{t_us / 1e6:g} s: {text}")
    return found[1:]


def asked(experiment: Experiment) -> dict[str, Any]:
    """Return all that an experiment asks of a flight."""
    functions = (experiment.prepare, experiment.script, experiment.measure)
    return {
        "summary": experiment.summary,
        "duration_s": round(experiment.duration_s, 6),
        "limits": dict(experiment.limits),
        "settings": [*experiment.settings],
        "faults": [*map(str, experiment.faults)],
        "metrics": {name: str(metric) for name, metric in experiment.metrics.items()},
        "functions": [*map(call_of, functions)],
        "pictures": [*experiment.pictures],
        "goals": goals(experiment),
    }


def kinds() -> dict[str, str]:
    """Return unit, bounds and links of each kind of fault, and what it makes of the values 3 and 0.5 of its knobs."""
    return {
        name: f"{kind.unit} {kind.size} {kind.low}..{kind.high} x {kind.scale:.5g}, {kind.duration_s} s, {kind.outcome}, "
        f"link {kind.link}, markers {kind.markers}, body {kind.body}, "
        f"knobs {' '.join(f'{one.blend(3.0, 0.5):g}' for one in kind.knobs)}"
        for name, kind in KINDS.items()
        if name in SHIPPED
    }


def drilled(experiment: Experiment) -> dict[str, Any]:
    """Return all that a drill asks of a flight, and what its script plans."""
    planned: list[str] = []
    mocap = Made(dropout=0.25)

    def plan(at_us: int, act: Callable[[int], None]) -> None:
        before, count = mocap.dropout, len(planned)
        act(at_us)
        if len(planned) == count:
            planned.append(f"{at_us / 1e6:g} s: dropout {before:g} to {mocap.dropout:g}")

    line = Made(command=lambda now_us, packet: planned.append(f"{now_us / 1e6:g} s: {packet!r}"))
    flight: Any = Made(
        config=load_config(), release_us=11_000_000, robot=Made(mocap=mocap), line=line, events=Made(at=plan)
    )
    experiment.script(flight)
    settings = [re.sub("=/.*/", "=", one) for one in experiment.settings]
    return asked(experiment) | {"settings": settings, "planned": planned}


FOUND: dict[str, Callable[[], Any]] = {
    **{name: partial(asked, one) for name, one in EXPERIMENTS.items()},
    **{one.name: partial(drilled, one) for one in (DRILL, FAILURE)},
    "kinds of faults": kinds,
}


@pytest.mark.parametrize("name", FOUND)
def test_an_experiment_and_a_fault_are_what_they_were(name: str) -> None:
    judge(KNOWN, name, FOUND[name]())


if __name__ == "__main__":
    approve(KNOWN, FOUND)
