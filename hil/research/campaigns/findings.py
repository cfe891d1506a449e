"""The findings of a campaign: failure rates with intervals, distributions, influences, and the worst flights.

The samplings that each measure of influence needs:

    PAWN            any: the median distance of the distributions in slices of an axis from that of all flights, 0..1;
                    shown are axes beyond what the strongest of all axes reaches by chance in 95 % of random orders
    total Sobol     saltelli: the share of the variance that remains when all axes but this one are fixed
    mu* of Morris   morris: the mean change of the figure over one axis
    logistic map    any, with some failures and some flights that hold: log-odds of failing over the whole axis, or from
                    without a fault to with it
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from SALib.analyze import morris, sobol
from scipy.optimize import minimize
from scipy.special import expit

from hil.api import command_of
from hil.errors import LabError
from hil.laboratory.metrics import METRICS, Metric
from hil.laboratory.request import Options
from hil.research.campaigns import sampling
from hil.research.campaigns.config import Spec
from hil.research.campaigns.run import Rate, Tally

Array = NDArray[np.float64]
WORST = 10
SLICES = 10
MAPPED_FROM = 5  # failures, and flights that hold
ORDERS, CHANCE = 200, 0.95  # random orders of the flights, and their share below the threshold
SHARE_KNOWN = 1.0  # largest half interval of a shown share of the variance
PULL = 1.0  # weight of the prior that pulls the logistic map towards no influence


@dataclass(frozen=True, slots=True)
class Limited:
    """A limit of an experiment on a profile, over the judged flights.

    Judged are all that ended, without lost ones unless a limit on `lost` admits them.
    """

    experiment: str
    profile: str
    name: str
    metric: Metric
    bound: float
    rate: Rate
    values: Array  # of the judged flights with the metric

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
    chance: float | None = None  # bound of the strongest axis without any influence, in 95 % of cases
    halves: Mapping[str, float] = field(default_factory=dict)  # of the 95 % intervals by SALib
    most: float = math.inf  # largest half interval of a shown measure

    @property
    def ranked(self) -> list[tuple[str, float]]:
        """Axes above chance with small enough intervals, the strongest first."""
        above = [
            (name, value)
            for name, value in self.by_axis.items()
            if abs(value) > (self.chance or 0.0) and name not in self.unknown
        ]
        return sorted(above, key=lambda item: -abs(item[1]))

    @property
    def unknown(self) -> list[str]:
        """Axes whose intervals are too wide."""
        return [name for name, half in self.halves.items() if not half <= self.most]

    def text(self, name: str) -> str:
        """Return the measure of an axis, with its interval if it has one."""
        half = f" ± {self.halves[name]:.2g}" if name in self.halves else ""
        return f"{name} {self.by_axis[name]:.3g}{half}"


@dataclass(frozen=True, slots=True)
class FailureMap:
    """A logistic map from the cube to the chance of failing."""

    axes: tuple[sampling.CubeAxis, ...]
    flights: NDArray[np.int64]  # (N,) their numbers
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
    """A flight, and the command that repeats it."""

    index: int
    outcome: str
    why: str
    command: str


@dataclass(frozen=True, slots=True)
class ProfileCell:
    """An experiment on a profile: how often it fails, and how often the robot is lost."""

    experiment: str
    profile: str
    rate: Rate
    lost: Rate
    loss_allowed: bool  # by a limit on `lost`
    limits: tuple[Limited, ...]

    @property
    def loss_text(self) -> str:
        """How often the robot is lost, and whether that is a failure."""
        return f"{self.lost}{', allowed by a limit' if self.loss_allowed else ''}"

    def rate_text(self, limit: Limited) -> str:
        """How often a limit fails, and of which flights."""
        return limit.rate.text(" that were not lost" if self.lost.failed and not self.loss_allowed else "")


@dataclass(frozen=True, slots=True)
class Findings:
    """All that is in the report."""

    rate: Rate
    cells: tuple[ProfileCell, ...]
    errors: tuple[str, ...]  # of flights that did not end, each text once with its count
    influences: tuple[Influence, ...]
    failure_map: FailureMap | None
    worst: tuple[Worst, ...]

    @property
    def limits(self) -> tuple[Limited, ...]:
        """The limits of all cells."""
        return tuple(one for cell in self.cells for one in cell.limits)


def find(spec: Spec, flights: pa.Table) -> Findings:
    """Return the findings from a campaign's flights."""
    passed = flights["passed"].to_numpy(zero_copy_only=False).astype(bool)
    cells = tuple(
        _cell(spec, flights, number) for number in range(len(spec.experiments) * len(spec.profiles))
    )
    limits = tuple(one for cell in cells for one in cell.limits)
    points = sampling.points_of(spec)
    which = flights["index"].to_numpy() // spec.cells
    mapped = _failure_map(spec, flights["index"].to_numpy(), sampling.as_flown(spec, points)[which], ~passed)
    influences = [*_influences(spec, points, which, flights, limits, ~passed)]
    if mapped is not None:
        influences.insert(0, mapped.influence)
    size = sampling.cluster_of(spec)
    return Findings(
        _rate(flights, "passed", size, size), cells, _errors(flights), tuple(influences), mapped,
        _worst(spec, flights, limits),
    )  # fmt: skip


def _rate(flights: pa.Table, column: str, size: int, cluster: int) -> Rate:
    """Return how often a column is false, for clusters of `cluster` numbers, of which the table has `size`."""
    tally = Tally(size)
    for index, holds in zip(flights["index"].to_pylist(), flights[column].to_pylist(), strict=True):
        if holds is not None:
            tally.add(index // cluster, holds)
    return tally.rate


def _cell(spec: Spec, flights: pa.Table, number: int) -> ProfileCell:
    cluster = sampling.cluster_of(spec)
    size = cluster // (len(spec.experiments) * len(spec.profiles))
    drawn = sampling.draw(spec, number)
    profile = drawn.options["profile"]
    plain = Options(**{**drawn.options, "overrides": spec.settings, "faults": ()})
    request = replace(drawn, options=plain).request()
    rows = _of_cell(flights, drawn.experiment, profile)
    ended = rows.filter(pc.not_equal(rows["outcome"], "error"))
    stays = pc.not_equal(ended["outcome"], "lost")
    allowed = request.limits.get("lost", 0.0) >= 1.0
    judged, found = ended if allowed else ended.filter(stays), []
    for name, bound in request.limits.items():
        if name == "lost":
            continue
        values = judged[f"metric.{name}"].to_numpy()
        metric = request.experiment.metrics.get(name) or METRICS[name]
        rate = _rate(judged, f"holds.{name}", size, cluster)
        found.append(
            Limited(drawn.experiment, profile, name, metric, bound, rate, values[np.isfinite(values)])
        )
    lost = _rate(ended.append_column("stays", stays), "stays", size, cluster)
    return ProfileCell(
        drawn.experiment, profile, _rate(rows, "passed", size, cluster), lost, allowed, tuple(found)
    )


def _of_cell(flights: pa.Table, experiment: str, profile: str) -> pa.Table:
    """Return the flights of an experiment on a profile."""
    return flights.filter(
        pc.and_(pc.equal(flights["experiment"], experiment), pc.equal(flights["profile"], profile))
    )


def _errors(flights: pa.Table) -> tuple[str, ...]:
    failed = flights.filter(pc.equal(flights["outcome"], "error"))
    texts = failed["error"].to_pylist()
    first = dict(reversed(list(zip(texts, failed["index"].to_pylist(), strict=True))))
    return tuple(f"{texts.count(text)}×, first flight {first[text]}: {text}" for text in dict.fromkeys(texts))


def _failure_map(
    spec: Spec, flights: NDArray[np.int64], points: Array, failed: NDArray[np.bool_]
) -> FailureMap | None:
    known = sampling.axes(spec)
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
    return FailureMap(known, flights, points, failed, fitted[1:], float(fitted[0]))


def _influences(
    spec: Spec, points: Array, which: NDArray[np.int64], flights: pa.Table, limits: tuple[Limited, ...],
    failed: NDArray[np.bool_],
) -> list[Influence]:  # fmt: skip
    """Return the influence of the axes on failing, on losses, and on the metric of every limit."""
    names = [axis.name for axis in sampling.axes(spec)]
    figures = {"failing": failed.astype(float)} | {
        name: flights[f"metric.{name}"].to_numpy()
        for name in dict.fromkeys(("lost", *(one.name for one in limits)))
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
        found.append(influence_of(spec, figure, points[there], means))
    return found


def influence_of(spec: Spec, figure: str, points: Array, means: Array) -> Influence:
    """Return the influence of the axes on a figure, of which each point (N, D) has its mean."""
    names = [axis.name for axis in sampling.axes(spec)]
    cube = sampling.problem(points.shape[1])

    def by_name(values: Array) -> dict[str, float]:
        return dict(zip(names, map(float, values), strict=True))

    if spec.sampling == "saltelli":
        found = sobol.analyze(cube, means, calc_second_order=False, seed=spec.seed)
        halves = by_name(found["ST_conf"])
        return Influence(figure, "total Sobol index", by_name(found["ST"]), None, halves, SHARE_KNOWN)
    if spec.sampling == "morris":
        found = morris.analyze(cube, points, means, num_levels=sampling.LEVELS, seed=spec.seed)
        halves = by_name(found["mu_star_conf"])
        return Influence(figure, "Morris' mu*", by_name(found["mu_star"]), None, halves, float(np.ptp(means)))
    inside = slices(points)
    orders = sampling.shuffled(spec, means, ORDERS)
    chance = np.quantile([pawn(inside, order).max() for order in orders], CHANCE)
    return Influence(figure, "PAWN", by_name(pawn(inside, means)), float(chance))


def slices(points: Array) -> NDArray[np.bool_]:
    """Return which points (N, D) are in which slice of each axis, (N, D, SLICES), of equal numbers of points."""
    edges = np.quantile(points, np.linspace(0.0, 1.0, SLICES + 1), axis=0)
    number = [np.searchsorted(edges[1:-1, d], points[:, d], side="right") for d in range(points.shape[1])]
    return np.equal(np.array(number).T[:, :, None], np.arange(SLICES))


def pawn(inside: NDArray[np.bool_], values: Array) -> Array:
    """Return each axis' median distance (Kolmogorov-Smirnov) of the values in its slices from all values, (D,)."""
    order = np.argsort(values, kind="stable")
    last = np.append(np.diff(values[order]) > 0.0, True)  # equal values have the last one's place
    counts = inside[order].cumsum(axis=0)
    sizes = np.maximum(counts[-1], 1)
    share = np.arange(1, len(values) + 1) / len(values)
    distances = np.abs(counts / sizes - share[:, None, None])[last].max(axis=0)
    return np.asarray(np.nanmedian(np.where(counts[-1] > 0, distances, np.nan), axis=1))


def _worst(spec: Spec, flights: pa.Table, limits: tuple[Limited, ...]) -> tuple[Worst, ...]:
    """Return the failed flights, the worst first: lost early, then far beyond a limit; errors are listed separately."""
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
    return tuple(
        Worst(index, outcome, why, again(spec, index)) for _, index, outcome, why in sorted(ranked)[:WORST]
    )


def again(spec: Spec, index: int) -> str:
    """Return the command that repeats a flight, or in parentheses why there is none."""
    try:
        return command_of(sampling.draw(spec, index).request()) or "(an experiment that no command names)"
    except LabError as error:
        return f"({error})"


def _beyond(limit: Limited, value: float) -> float:
    """Return a value's excess as a share of the limit."""
    if not np.isfinite(value):
        return float("inf")
    sign = 1.0 if limit.metric.bound == "max" else -1.0
    return float(sign * (value - limit.bound) / max(abs(limit.bound), 1e-9))
