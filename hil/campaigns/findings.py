"""What a campaign has found: failure rates with their intervals, distributions, what they depend on, the worst flights.

Which sampling a measure of influence needs:

    PAWN            any: the median distance of the distributions inside and outside slices of an axis, 0..1
    total Sobol     saltelli: the share of the variance that vanishes when the axis alone is fixed
    mu* of Morris   morris: the mean change of the figure over one axis
    logistic map    any, with some failures and some flights that hold: log-odds of failing over the whole axis, or from
                    without a fault to with it
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from SALib.analyze import morris, pawn, sobol
from scipy.optimize import minimize
from scipy.special import expit

from hil.api import command_of
from hil.campaigns.config import Spec
from hil.campaigns.run import Rate
from hil.campaigns.sampling import LEVELS, CubeAxis, as_flown, axes, draw, points_of, problem
from hil.errors import LabError
from hil.laboratory.metrics import METRICS, Metric
from hil.laboratory.request import Options

Array = NDArray[np.float64]
WORST = 10
SLICES = 10
MAPPED_FROM = 5  # failures, and flights that hold
KOLMOGOROV_MEDIAN = 0.828  # median distance of a sample from its own distribution, times the root of its size
PULL = 1.0  # weight of the prior that pulls the logistic map towards no influence


@dataclass(frozen=True, slots=True)
class Limited:
    """A limit of an experiment on a profile, over the flights."""

    experiment: str
    profile: str
    name: str
    metric: Metric
    bound: float
    rate: Rate
    values: Array  # of the flights that have the metric

    def quantile(self, share: float) -> str:
        """Return a quantile as text, counted from good to bad."""
        if not len(self.values):
            return "–"
        share = share if self.metric.bound == "max" else 1.0 - share
        return self.metric.show(float(np.quantile(self.values, share)))


@dataclass(frozen=True, slots=True)
class Influence:
    """How much a metric depends on each axis."""

    figure: str
    method: str
    by_axis: Mapping[str, float]
    chance: float | None = None  # the measure of an axis without any influence

    @property
    def ranked(self) -> list[tuple[str, float]]:
        """Axes above chance, the strongest first."""
        above = [item for item in self.by_axis.items() if abs(item[1]) > (self.chance or 0.0)]
        return sorted(above, key=lambda item: -abs(item[1]))


@dataclass(frozen=True, slots=True)
class FailureMap:
    """A logistic map from the cube to the chance of failing."""

    axes: tuple[CubeAxis, ...]
    points: Array  # (N, D) 0..1, as flown
    failed: NDArray[np.bool_]  # (N,)
    weights: Array  # (D,) log-odds from one end of the axis to the other
    offset: float  # log-odds at the cube's centre

    def chance(self, points: Array) -> Array:
        """Return the chance of failing at points of the cube, (N,)."""
        return np.asarray(expit(self.offset + ((points - 0.5) * self.weights).sum(axis=1)))

    @property
    def influence(self) -> Influence:
        """The weights by axis."""
        by_axis = {axis.name: float(weight) for axis, weight in zip(self.axes, self.weights, strict=True)}
        return Influence("failing", "logistic map", by_axis)


@dataclass(frozen=True, slots=True)
class Worst:
    """A flight, and the command that flies it again."""

    index: int
    outcome: str
    why: str
    command: str


@dataclass(frozen=True, slots=True)
class Findings:
    """All that is in the report."""

    rate: Rate
    errors: tuple[str, ...]  # of flights that did not end, each text once with its count
    limits: tuple[Limited, ...]
    influences: tuple[Influence, ...]
    failure_map: FailureMap | None
    worst: tuple[Worst, ...]


def find(spec: Spec, flights: pa.Table) -> Findings:
    """Return what the flights of a campaign show."""
    passed = flights["passed"].to_numpy(zero_copy_only=False).astype(bool)
    limits = _limits(spec, flights)
    points = points_of(spec)
    which = flights["index"].to_numpy() // spec.cells
    mapped = _failure_map(spec, as_flown(spec, points)[which], ~passed)
    influences = [*_influences(spec, points, which, flights, limits, ~passed)]
    if mapped is not None:
        influences.insert(0, mapped.influence)
    return Findings(
        Rate(int((~passed).sum()), len(passed)), _errors(flights), limits, tuple(influences), mapped,
        _worst(spec, flights, limits),
    )  # fmt: skip


def _errors(flights: pa.Table) -> tuple[str, ...]:
    failed = flights.filter(pc.equal(flights["outcome"], "error"))
    texts = failed["error"].to_pylist()
    first = dict(reversed(list(zip(texts, failed["index"].to_pylist(), strict=True))))
    return tuple(f"{texts.count(text)}×, first flight {first[text]}: {text}" for text in dict.fromkeys(texts))


def _limits(spec: Spec, flights: pa.Table) -> tuple[Limited, ...]:
    found = []
    for cell in range(len(spec.experiments) * len(spec.profiles)):
        drawn = draw(spec, cell)
        profile = drawn.options["profile"]
        plain = Options(profile=profile, overrides=spec.settings, duration_s=spec.duration_s, link=spec.link)
        request = replace(drawn, options=plain).request()
        mine = pc.and_(
            pc.equal(flights["experiment"], drawn.experiment), pc.equal(flights["profile"], profile)
        )
        rows = flights.filter(mine)
        for name, bound in request.limits.items():
            holds = rows[f"holds.{name}"].drop_null()
            values = rows[f"metric.{name}"].to_numpy()
            metric = request.experiment.metrics.get(name) or METRICS[name]
            rate = Rate(len(holds) - (pc.sum(holds).as_py() or 0), len(holds))
            found.append(
                Limited(drawn.experiment, profile, name, metric, bound, rate, values[np.isfinite(values)])
            )
    return tuple(found)


def _failure_map(spec: Spec, points: Array, failed: NDArray[np.bool_]) -> FailureMap | None:
    known = axes(spec)
    if not known or min(failed.sum(), (~failed).sum()) < MAPPED_FROM:
        return None
    sign = np.where(failed, 1.0, -1.0)
    centred = points - 0.5

    def cost(weights: Array) -> tuple[float, Array]:
        doubt = expit(-sign * (weights[0] + (centred * weights[1:]).sum(axis=1)))
        slope = -(sign * doubt)[:, None] * np.column_stack((np.ones(len(sign)), centred))
        pull = PULL * np.concatenate(([0.0], weights[1:])) / 12.0  # the variance of an axis
        loss = -np.log1p(-np.minimum(doubt, 1.0 - 1e-15)).sum()
        return float(loss + 0.5 * (pull * weights).sum()), slope.sum(axis=0) + pull

    fitted = minimize(cost, np.zeros(1 + len(known)), jac=True, method="L-BFGS-B").x
    return FailureMap(known, points, failed, fitted[1:], float(fitted[0]))


def _influences(
    spec: Spec, points: Array, which: NDArray[np.int64], flights: pa.Table, limits: tuple[Limited, ...],
    failed: NDArray[np.bool_],
) -> list[Influence]:  # fmt: skip
    """Return the influence of the axes on failing, and on the metric of every limit."""
    names = [axis.name for axis in axes(spec)]
    figures = {"failing": failed.astype(float)} | {
        name: flights[f"metric.{name}"].to_numpy() for name in dict.fromkeys(one.name for one in limits)
    }
    found = []
    for figure, values in figures.items():
        usable = np.isfinite(values)
        sums = np.bincount(which[usable], values[usable], len(points))
        counts = np.bincount(which[usable], minlength=len(points))
        there = counts > 0
        means = sums[there] / counts[there]
        if len(names) < 2 or len(means) < 2 * SLICES or np.ptp(means) <= 1e-12 * np.abs(means).max():
            continue
        if spec.sampling in ("saltelli", "morris") and not there.all():
            continue  # an incomplete design gives no indices
        method, indices, chance = _indices(spec, points[there], means)
        found.append(Influence(figure, method, dict(zip(names, map(float, indices), strict=True)), chance))
    return found


def _indices(spec: Spec, points: Array, means: Array) -> tuple[str, Array, float | None]:
    cube = problem(points.shape[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # empty slices of a coarse grid
        if spec.sampling == "saltelli":
            found = sobol.analyze(cube, means, calc_second_order=False, seed=spec.seed)
            return "total Sobol index", found["ST"], None
        if spec.sampling == "morris":
            found = morris.analyze(cube, points, means, num_levels=LEVELS, seed=spec.seed)
            return "Morris' mu*", found["mu_star"], None
        found = pawn.analyze(cube, points, means, S=SLICES, seed=spec.seed)
    return "PAWN", found["median"], KOLMOGOROV_MEDIAN / (len(means) / SLICES) ** 0.5


def _worst(spec: Spec, flights: pa.Table, limits: tuple[Limited, ...]) -> tuple[Worst, ...]:
    """Return the flights that failed, the worst first: lost early, then far beyond a limit; errors are listed separately."""
    bounds = {(one.experiment, one.profile, one.name): one for one in limits}
    failed = flights.filter(pc.and_(pc.invert(flights["passed"]), pc.not_equal(flights["outcome"], "error")))
    ranked = []
    for row in failed.to_pylist():
        beyond = {
            name: _beyond(one, row[f"metric.{name}"])
            for (experiment, profile, name), one in bounds.items()
            if (experiment, profile) == (row["experiment"], row["profile"]) and row[f"holds.{name}"] is False
        }
        lost = row["outcome"] == "lost"
        order = (0.0, row["metric.flown"]) if lost else (1.0, -max(beyond.values(), default=0.0))
        ranked.append((order, row["index"], row["outcome"], row["error"] or ", ".join(beyond)))
    found = []
    for _, index, outcome, why in sorted(ranked)[:WORST]:
        try:
            command = command_of(draw(spec, index).request()) or "(an experiment that no command names)"
        except LabError as error:
            command = f"({error})"
        found.append(Worst(index, outcome, why, command))
    return tuple(found)


def _beyond(limit: Limited, value: float) -> float:
    """Return by which share of the limit a value misses it."""
    if not np.isfinite(value):
        return float("inf")
    sign = 1.0 if limit.metric.bound == "max" else -1.0
    return float(sign * (value - limit.bound) / max(abs(limit.bound), 1e-9))
