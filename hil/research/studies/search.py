"""`floaty tune --vary`: finds numbers of a profile, also of own logic, that make a metric best, by flights."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution
from scipy.stats import qmc

from firmware_py.logic.loading import load_logic
from hil.config import LabConfig, load_config
from hil.errors import LabError, hint
from hil.laboratory.experiments import find_experiment
from hil.laboratory.metrics import METRICS, Metric
from hil.laboratory.request import Options
from hil.research.campaigns.jobs import Job, Row
from hil.research.campaigns.run import Runner
from hil.research.studies.study import distance

DISTANCE = "distance"
FAR = Metric("m", "max", "rms distance from the goal")
LOST = 1e9  # cost of a flight that does not end, above any metric
SHAPE = re.compile(r"([a-z_0-9]+\.[\w.]+)=(\S+?)\.\.(\S+)")
UNSEEN = 1000  # from the seeds of the search to those of the judgement
DIGITS = 5  # of the numbers that fly, so that a profile states exactly these

Numbers = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Interval:
    """A number of a profile that may be chosen from `low` to `high`; a whole one if it is whole in the profile."""

    key: str
    low: float
    high: float
    given: float | int

    def value(self, number: float) -> float | int:
        """Return a number as it flies."""
        return round(number) if isinstance(self.given, int) else float(f"{number:.{DIGITS}g}")


@dataclass(frozen=True, slots=True)
class Aim:
    """What is searched: the experiment of a profile whose metric is to be best, over `seeds`, in `flights` flights."""

    experiment: str
    options: Options
    metric: str
    seeds: tuple[int, ...]
    flights: int

    @property
    def meaning(self) -> Metric:
        """The metric. Raises `LabError` for an unknown one."""
        if self.metric == DISTANCE:
            return FAR
        known = {**METRICS, **find_experiment(self.experiment).metrics}
        if self.metric not in known:
            raise LabError(f"--metric {self.metric}: {hint(self.metric, (DISTANCE, *known))}")
        return known[self.metric]

    def cost(self, rows: Sequence[Row]) -> float:
        """Return the mean cost of flights with the same numbers; the smallest one is the best."""
        sign = 1.0 if self.meaning.bound == "max" else -1.0
        return float(np.mean([sign * self._of(row) if row.outcome == "completed" else LOST for row in rows]))

    def cost_text(self, cost: float) -> str:
        """Return a cost as its metric."""
        if cost >= LOST / max(len(self.seeds), 1):
            return "lost"
        return self.meaning.show(cost if self.meaning.bound == "max" else -cost)

    def _of(self, row: Row) -> float:
        value = distance(row.metrics) if self.metric == DISTANCE else row.metrics.get(self.metric, math.nan)
        if math.isnan(value):
            raise LabError(f"--metric {self.metric}: {self.experiment} does not measure it in this time")
        return min(value, LOST)


@dataclass(frozen=True, slots=True)
class Found:
    """The numbers that were best, and the costs on seeds that the search has not seen: before, and with them."""

    values: tuple[float | int, ...]
    before: float
    after: float

    @property
    def better(self) -> bool:
        return self.after < self.before


def intervals(texts: Iterable[str], profile: str) -> tuple[Interval, ...]:
    """Return what the texts KEY=LOW..HIGH let vary. Raises `LabError`."""
    config = load_config(profile)
    found: dict[str, Interval] = {}
    for text in texts:
        match = SHAPE.fullmatch(text)
        try:
            low, high = map(float, match.groups()[1:]) if match else (math.nan, math.nan)
        except ValueError:
            low = high = math.nan
        if match is None or not -math.inf < low < high < math.inf:
            raise LabError(f"--vary {text}: expected KEY=LOW..HIGH, like logic.gain_y=-3..-0.5")
        given = _number(config, match[1])
        if given is None:
            raise LabError(f"--vary {text}: {match[1]} is no number of profile {profile}")
        found[match[1]] = Interval(match[1], low, high, given)
        for bound in (low, high):
            load_config(profile, (f"{match[1]}={found[match[1]].value(bound)}",))
    return tuple(found.values())


def _number(config: LabConfig, key: str) -> float | int | None:
    """Return a number of a profile; None for anything else."""
    section, _, name = key.partition(".")
    logic = load_logic(config.logic)
    if section == "logic" and logic is not None and name in logic.values:
        whole = {one.place.field for one in logic.loaded.parameters if not one.scalar.is_float}
        return int(logic.values[name]) if name in whole else float(logic.values[name])
    value: Any = config
    for part in key.split("."):
        value = getattr(value, part, None)
    return value if isinstance(value, int | float) and not isinstance(value, bool) else None


def search(
    varied: Sequence[Interval],
    aim: Aim,
    runner: Runner,
    folder: Path,
    report: Callable[[int, int, float], None],
) -> Found:
    """Search by differential evolution, and judge the best on other seeds.

    `report` gets each round, their number, and the best cost so far. Raises `LabError` for numbers that cannot be flown.
    """
    _ = aim.meaning
    size = max(5, 4 * len(varied))
    rounds = max(1, aim.flights // (size * len(aim.seeds)))
    flown = _Flown(varied, aim, runner, folder)
    low, high = (np.array([getattr(one, bound) for one in varied], float) for bound in ("low", "high"))
    given = np.clip([one.given for one in varied], low, high)
    drawn = qmc.scale(qmc.LatinHypercube(len(varied), rng=aim.seeds[0]).random(size - 1), low, high)
    number, best = 0, math.inf

    def fly(_: object, points: Iterable[Numbers]) -> Iterator[float]:
        nonlocal number, best
        number += 1
        costs = flown.costs(f"round-{number}", list(points))
        best = min(best, *costs)
        report(number, rounds, best)
        return iter(costs)

    result = differential_evolution(
        lambda _: 0.0, list(zip(low, high, strict=True)), init=np.vstack([given, drawn]), maxiter=rounds - 1, tol=0.0,
        integrality=[isinstance(one.given, int) for one in varied], polish=False, updating="deferred", workers=fly,
        rng=aim.seeds[0],
    )  # fmt: skip
    values = tuple(one.value(number) for one, number in zip(varied, result.x, strict=True))
    before, after = _Flown(varied, aim, runner, folder, UNSEEN).costs(
        "judgement", [np.array([one.given for one in varied], float), np.array(values, float)]
    )
    return Found(values, before, after)


class _Flown:
    """Flies numbers, each on every seed."""

    def __init__(
        self, varied: Sequence[Interval], aim: Aim, runner: Runner, folder: Path, more_seed: int = 0
    ) -> None:
        self._varied, self._aim, self._runner, self._folder = varied, aim, runner, folder
        self._seeds = [seed + more_seed for seed in aim.seeds]

    def costs(self, name: str, points: Sequence[Numbers]) -> list[float]:
        jobs = [self._job(point, seed) for point in points for seed in self._seeds]
        if name == "round-1":
            jobs[0].request()
        rows = self._runner.fly(name, jobs, self._folder)
        if self._runner.interrupted or len(rows) < len(jobs):
            raise KeyboardInterrupt
        for row in rows:
            if row.outcome == "error" and not row.metrics:
                raise LabError(f"{row.error}")
        count = len(self._seeds)
        return [self._aim.cost(rows[start : start + count]) for start in range(0, len(rows), count)]

    def _job(self, point: Numbers, seed: int) -> Job:
        values: Mapping[str, float | int] = {
            one.key: one.value(float(number)) for one, number in zip(self._varied, point, strict=True)
        }
        own = tuple(f"{key}={value!r}" for key, value in values.items())
        options = self._aim.options
        options = options | Options(overrides=own, seed=seed)
        return Job(0, self._aim.experiment, options, values)
