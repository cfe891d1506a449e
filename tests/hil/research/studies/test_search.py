"""`floaty tune --vary`: what it refuses, and that it finds what is known to be best, and judges it on other seeds."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from hil.errors import LabError
from hil.laboratory.request import Options
from hil.research.campaigns.jobs import Job, Row
from hil.research.studies.search import LOST, UNSEEN, Aim, Interval, intervals, search
from support.own_logic import LAW

VARIED = (Interval("controller.gain_y", -4.0, -1.0, -1.5), Interval("controller.gain_z", 1.0, 5.0, 4.0))


class Runner:
    """Flies a bowl: the metric is the distance from known numbers, worse on odd seeds."""

    interrupted = False

    def __init__(self, best: tuple[float, float] = (-2.5, 3.0), lost_below: float = -9.0) -> None:
        self._best, self._lost_below = best, lost_below
        self.flown: list[tuple[str, list[int]]] = []

    def fly(self, name: str, jobs: Sequence[Job], out: Path) -> list[Row]:
        self.flown.append((name, [job.options["seed"] for job in jobs]))
        return [self._row(job) for job in jobs]

    def _row(self, job: Job) -> Row:
        settings = dict(one.split("=") for one in job.options["overrides"])
        assert {key: float(value) for key, value in settings.items()} == job.values
        y, z = job.values.values()
        value = (y - self._best[0]) ** 2 + (z - self._best[1]) ** 2 + 0.01 * (job.options["seed"] % 2)
        outcome = "lost" if y < self._lost_below else "completed"
        return Row(job, outcome, "", True, "", {"rms_z": value, "in_box": 1.0 - value}, {})


def aim(metric: str, seeds: tuple[int, ...] = (1,), flights: int = 400) -> Aim:
    return Aim("hover", Options(profile="floaty"), metric, seeds, flights)


def found(runner: Any, asked: Aim, tmp_path: Path, rounds: list[Any] | None = None) -> Any:
    return search(VARIED, asked, runner, tmp_path, lambda *round_: (rounds or []).append(round_))


@pytest.mark.parametrize("outcome", ["lost", "reset", "error", "interrupted"])
def test_a_flight_that_was_not_completed_costs_more_than_any(outcome: str) -> None:
    asked = aim("rms_z", seeds=(1, 2))
    jobs = [
        Row(Job(0, "hover", Options(), {}), one, "", True, "", {"rms_z": 0.5}, {})
        for one in (outcome, "completed")
    ]
    assert asked.cost(jobs[1:]) == 0.5
    assert asked.cost(jobs) == (LOST + 0.5) / 2
    assert (asked.cost_text(asked.cost(jobs)), asked.cost_text(0.5)) == ("lost", "50 cm")
    far = Row(Job(0, "hover", Options(), {}), "completed", "", True, "", {"rms_z": 1e300}, {})
    assert asked.cost([far]) == LOST, "nor does a completed flight cost more than a lost one"


@pytest.mark.parametrize("metrics", [{}, {"rms_z": 0.5}])
def test_a_flight_whose_error_is_not_of_its_numbers_ends_the_search(
    tmp_path: Path, metrics: dict[str, float]
) -> None:
    """One with metrics has flown: it counts as lost."""

    class Failing(Runner):
        def _row(self, job: Job) -> Row:
            return Row(job, "error", "too little memory", False, "", metrics, {})

    if metrics:
        assert found(Failing(), aim("rms_z", flights=8), tmp_path).before == LOST
    else:
        with pytest.raises(LabError, match=r"^too little memory$"):
            found(Failing(), aim("rms_z", flights=8), tmp_path)


@pytest.mark.parametrize("metric", ["rms_z", "in_box"])  # smallest is best, largest is best
def test_it_finds_the_best_numbers_and_judges_them_on_other_seeds(tmp_path: Path, metric: str) -> None:
    runner = Runner()
    best = found(runner, aim(metric, seeds=(3, 4)), tmp_path)
    assert best.values == pytest.approx((-2.5, 3.0), abs=0.1)
    assert best.better
    assert best.before - best.after == pytest.approx(1.0 + 1.0, abs=0.03)
    *rounds, (name, seeds) = runner.flown
    assert {seed for _, seeds in rounds for seed in seeds} == {3, 4}
    assert (name, seeds) == ("judgement", [3 + UNSEEN, 4 + UNSEEN] * 2)
    assert sum(len(seeds) for _, seeds in rounds) <= 400


def test_the_given_numbers_are_the_first_that_fly_and_the_search_repeats(tmp_path: Path) -> None:
    runs = [Runner(), Runner()]
    results = [found(runner, aim("rms_z", flights=100), tmp_path) for runner in runs]
    assert results[0] == results[1]
    assert runs[0].flown == runs[1].flown


def test_a_lost_flight_is_worse_than_any_other(tmp_path: Path) -> None:
    best = found(Runner(best=(-3.9, 3.0), lost_below=-3.0), aim("rms_z"), tmp_path)
    assert -3.0 <= best.values[0] < -2.9
    assert aim("rms_z").cost_text(LOST) == "lost"
    assert aim("rms_z").cost_text(0.012) == "1.2 cm"
    assert aim("in_box").cost_text(-0.5) == "50 %"


def test_numbers_no_better_than_before_are_not_called_better(tmp_path: Path) -> None:
    best = found(Runner(best=(-1.5, 4.0)), aim("rms_z"), tmp_path)
    assert not best.better


def test_whole_numbers_stay_whole(tmp_path: Path) -> None:
    (tmp_path / "p.toml").write_text('base = "floaty"\n[logic]\ncontroller = "law.py"\n', encoding="utf-8")
    (tmp_path / "law.py").write_text(LAW, encoding="utf-8")
    after, gain = intervals(("logic.after=5..9", "logic.gain_iy=-1..1.5"), str(tmp_path / "p.toml"))
    assert (after.value(7.6), after.given) == (8, 1_000_000)
    assert (gain.value(0.123456789), gain.given) == (0.12346, pytest.approx(-0.4))
    assert isinstance(after.value(7.6), int)


@pytest.mark.long
@pytest.mark.parametrize(("text", "reason"), [
    *((f"controller.gain_y={bounds}", "expected KEY=LOW..HIGH") for bounds in ("1..1", "2..1", "-inf..1", "0..inf", "nan..1",
      "a..1", "1", "1..")), ("gain_y=1..2", "expected KEY=LOW..HIGH"),
    ("robot.body=1..2", "robot.body is no number of profile floaty"), ("tracker.enabled=0..1", "is no number of profile"),
    ("predictor.horizon=0..5", "predictor.horizon = 0"), ("predictor.horizon=3..13", "predictor.horizon = 13"),
])  # fmt: skip
def test_bounds_that_cannot_be_flown_are_refused_before_a_flight(text: str, reason: str) -> None:
    with pytest.raises(LabError, match=reason):
        intervals(("controller.gain_z=1..2", text), "floaty")


def test_a_metric_that_the_experiment_lacks_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(LabError, match=r"^--metric settle: hover does not measure it in this time$"):
        found(Runner(), aim("settle"), tmp_path)
