"""Edges of a campaign: its end, the flights with a fault, the worst and lost flights, how a figure is ranked."""

import errno
import json
import os
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from SALib.analyze import pawn as pawn_of_salib
from scipy.stats import bootstrap

from hil.errors import LabError
from hil.laboratory.metrics import METRICS
from hil.research.campaigns import report
from hil.research.campaigns.config import Distribution
from hil.research.campaigns.dataset import Dataset, schema_of, table_of
from hil.research.campaigns.findings import (
    FailureMap,
    Influence,
    Limited,
    Rate,
    _beyond,
    find,
    influence_of,
    pawn,
    slices,
)
from hil.research.campaigns.jobs import Row, failed, row_of
from hil.research.campaigns.report import write_report
from hil.research.campaigns.run import STOP_FROM, Progress, Tally, interval
from hil.research.campaigns.sampling import (
    CubeAxis,
    as_flown,
    axes,
    draw,
    draw_at,
    plan_of,
    points_of,
    problem,
)
from support.campaigns import BAD_PUSH, planted, spec_of
from support.html_page import Page


def half(failed: int, flown: int) -> float:
    low, high = interval(failed / flown, flown)
    return (high - low) / 2.0


def ended(passed: list[bool], order: list[int], flights: int, half_width: float | None) -> object:
    """What a campaign has found when its rows arrive in an order."""
    progress = Progress(SimpleNamespace(flights=flights, half_width=half_width, cluster=1))  # type: ignore[arg-type]
    for index in order:
        progress.add(index, passed[index])
    return progress.end, progress.interim


@pytest.mark.long
@settings(max_examples=20)
@given(st.data())
def test_a_campaign_ends_at_the_same_flight_whatever_order_its_rows_arrive_in(data: st.DataObject) -> None:
    passed = data.draw(st.lists(st.booleans(), min_size=40, max_size=40))
    order = data.draw(st.permutations(range(40)))
    half_width = data.draw(st.sampled_from([None, 0.05, 0.1, 0.15, 0.2]))
    assert ended(passed, order, 40, half_width) == ended(passed, list(range(40)), 40, half_width)


def test_a_campaign_may_end_from_its_thirtieth_flight_on_and_at_the_width_itself() -> None:
    all_hold = [True] * 60
    end, interim = ended(all_hold, list(range(60)), 60, half(0, STOP_FROM))
    assert end == STOP_FROM
    assert (interim.flown, interim.failed, interim.complete) == (STOP_FROM, 0, True)  # type: ignore[attr-defined]
    assert ended(all_hold, list(range(60)), 60, half(0, STOP_FROM + 1))[0] == STOP_FROM + 1  # type: ignore[index]
    last_fails = [*all_hold[:-1], False]  # and comes first
    _, interim = ended(last_fails, [59, *range(59)], 60, half(0, STOP_FROM))
    assert (interim.flown, interim.failed) == (STOP_FROM, 0)  # type: ignore[attr-defined]
    assert ended(all_hold, list(range(60)), 60, 0.5)[0] == STOP_FROM  # type: ignore[index]


def test_a_campaign_of_n_flights_ends_with_the_last_of_them_and_not_before() -> None:
    progress = Progress(SimpleNamespace(flights=3, half_width=None, cluster=1))  # type: ignore[arg-type]
    for index, end in ((2, None), (1, None), (0, 3)):
        progress.add(index, index != 1)
        assert progress.end == end
    assert (progress.interim.failed, progress.interim.flown) == (1, 3)


@pytest.mark.parametrize("probability", [0.2, 0.8])
def test_a_fault_happens_with_its_probability_and_is_marked_where_it_does(probability: float) -> None:
    (push,) = spec_of().faults
    spec = spec_of(flights=200, faults=[push.model_dump() | {"probability": probability}])
    happened = np.array([bool(draw(spec, index).options["faults"]) for index in range(200)])
    assert happened.mean() == pytest.approx(probability, abs=0.08)
    column = [axis.name for axis in axes(spec)].index("fault 1 push.y happens")
    flown = as_flown(spec, points_of(spec))
    assert flown[:, column].tolist() == happened.astype(float).tolist()
    edge = np.full((1, len(axes(spec))), 1.0 - probability)  # as a design may have it
    assert as_flown(spec, edge)[0, column] == len(draw_at(spec, edge[0], 0, 0, 0).options["faults"])
    size = [axis.name for axis in axes(spec)].index("fault 1 push.y size")
    assert (flown[~happened, size] == 0.5).all()
    assert (flown[happened, size] != 0.5).all()


def test_every_profile_flies_an_experiment_before_the_next_experiment() -> None:
    pairs = list(product(("hover", "y-square"), ("floaty", "as-flown", "lqr")))
    spec = spec_of(flights=6, experiments=("hover", "y-square"), profiles=("floaty", "as-flown", "lqr"))
    jobs = [draw(spec, index) for index in range(6)]
    assert [(job.experiment, job.options["profile"]) for job in jobs] == pairs


@pytest.mark.parametrize(("bound", "good", "bad"), [("max", "1", "4"), ("min", "4", "1")])
def test_quantiles_count_from_good_to_bad(bound: str, good: str, bad: str) -> None:
    metric = replace(METRICS["poses_refused"], bound=bound)
    limited = Limited("hover", "floaty", "x", metric, 2.0, Rate(0, 4), np.array([3.0, 1.0, 4.0, 2.0]))
    assert (limited.quantile(0.0), limited.quantile(1.0)) == (good, bad)


def rows_of(*changes: dict[str, object]) -> list[Row]:
    rows = []
    for index, change in enumerate(changes):
        row = planted(draw(spec_of(flights=len(changes)), index))
        metrics = {**row.metrics, **change.pop("metrics", {})}  # type: ignore[dict-item]
        rows.append(replace(row, passed=False, metrics=metrics, **change))
    return rows


def test_the_worst_flights_are_those_lost_first_then_those_far_beyond_a_limit() -> None:
    limits = {"in_box": False}
    rows = rows_of(
        {"metrics": {"in_box": 0.5}, "holds": limits},
        {"outcome": "lost", "error": "late", "metrics": {"flown": 9.0}},
        {"metrics": {"in_box": 0.1}, "holds": limits},
        {"outcome": "lost", "error": "early", "metrics": {"flown": 2.0}},
        {"metrics": {"rms_x": 0.5}, "holds": {"in_box": True}},
        {
            "metrics": {"in_box": 0.89, "unseen": 9.0},
            "holds": {"in_box": False, "unseen": False},
        },  # by the farthest
    )
    spec = spec_of(flights=6, settings=["limits.hover.in_box=0.9"])
    table = table_of([row.columns() for row in rows], schema_of(plan_of(spec)))
    found = find(spec, table)
    assert [one.index for one in found.worst] == [3, 1, 5, 2, 0, 4]
    assert (found.rate.failed, found.rate.flown, found.worst[2].why) == (6, 6, "in_box, unseen")


@pytest.mark.parametrize("allowed", [False, True])
def test_a_lost_flight_is_counted_apart_and_no_limit_is_counted_over_it(
    allowed: bool, tmp_path: Path
) -> None:
    """Of six flights two are lost and one ends with an error; an allowed loss is judged on the part before it."""
    lost = {"outcome": "lost", "error": "tumbled", "holds": {"in_box": False, "resets": False}}
    rows = rows_of(
        {**lost}, {**lost}, {"outcome": "error", "error": "planted", "holds": {}},
        {"holds": {"in_box": False, "resets": True}}, *({"holds": {"in_box": True, "resets": True}} for _ in range(2)),
    )  # fmt: skip
    spec = spec_of(flights=6, settings=["limits.hover.lost=1", "limits.hover.in_box=0.9"] if allowed else [])
    dataset = Dataset(tmp_path, plan_of(spec), False)
    for row in rows:
        dataset.add(row)
    dataset.close()
    page, found = write_report("spec.toml", spec, dataset, complete=True)
    (cell,) = found.cells
    assert (cell.lost.failed, cell.lost.flown, cell.loss_allowed) == (2, 5, allowed)
    rates = {one.name: (one.rate.failed, one.rate.flown) for one in found.limits}
    assert (rates["in_box"], rates["resets"]) == (((3, 5), (2, 5)) if allowed else ((1, 3), (0, 3)))
    assert "lost" not in rates
    tables = Page(page.read_text()).tables
    assert tables["cells"][1][3].startswith("2 of 5: ")
    texts = {row[1].split()[0]: row[2] for row in tables["limits"][1:]}
    assert texts["resets"].startswith("2 of 5: " if allowed else "0 of 3 that were not lost: ")
    told = json.loads((tmp_path / "result.json").read_text())
    assert told["cells"][0]["lost"]["failed"] == 2
    resets = next(one for one in told["limits"] if one["metric"] == "resets")
    assert (resets["failed"], resets["flown"]) == rates["resets"]


def test_rows_beyond_the_end_are_dropped_and_a_row_that_came_twice_counts_once(tmp_path: Path) -> None:
    spec = spec_of()
    rows = Dataset(tmp_path, plan_of(spec), False)
    for index in (3, 0, 1, 1, 2, 0, 4):
        rows.add(planted(draw(spec, index)))
    rows.close(4)
    assert rows.table(["index"])["index"].to_pylist() == [0, 1, 2, 3]


@pytest.mark.long
def test_every_point_has_the_row_of_its_flight() -> None:
    """Two profiles fly each point: flights 2 n and 2 n + 1."""
    spec = spec_of(flights=120, profiles=["floaty", "as-flown"])
    table = table_of([planted(draw(spec, index)).columns() for index in range(120)], schema_of(plan_of(spec)))
    mapped = find(spec, table).failure_map
    assert mapped is not None
    size = [axis.name for axis in mapped.axes].index("fault 1 push.y size")
    happens = [axis.name for axis in mapped.axes].index("fault 1 push.y happens")
    bad = (BAD_PUSH - 1.0) / 11.0
    assert (
        mapped.failed.tolist()
        == ((mapped.points[:, happens] == 1.0) & (mapped.points[:, size] >= bad)).tolist()
    )


def test_a_cell_names_its_failed_flights_first_and_whether_its_fault_happens() -> None:
    spec = spec_of(flights=8)
    names = [axis.name for axis in axes(spec)]
    happens, size = names.index("fault 1 push.y happens"), names.index("fault 1 push.y size")
    points = np.full((8, len(names)), 0.01)
    points[4:, happens] = 1.0
    points[7, [size, names.index("actuators.tau")]] = 1.0  # in the last cell, not beyond it
    failed = np.array([False, True, False, True, False, True, True, False])
    weights = np.zeros(len(names))
    weights[[happens, size, names.index("actuators.tau")]] = 2.0, 1.0, -0.6
    found = FailureMap(axes(spec), np.arange(10, 18), points, failed, weights, 0.0)
    drawn = report._map(found)
    cells = {one.text: one for one in report._cells(spec, found, drawn)}
    assert [names[column] for column in drawn.shown] == ["fault 1 push.y size", "actuators.tau"]
    axes_shown = drawn.figure.axes[0]
    assert (axes_shown.get_xlabel(), axes_shown.get_ylabel()) == ("fault 1 push.y size", "actuators.tau")
    told = [one.get_text() for one in (*axes_shown.get_xticklabels(), *axes_shown.get_yticklabels())]
    assert told == [text for column in drawn.shown for text in report._ticks(axes(spec)[column])[1]]
    shades = axes_shown.collections[0]
    for place in ((0.1, 0.2), (0.9, 0.2), (0.2, 0.9)):  # with the fault, and other numbers in their middle
        point = np.full((1, len(names)), 0.5)
        point[0, [happens, *drawn.shown]] = 1.0, *place
        shade = next(n for n, path in enumerate(shades.get_paths()) if path.contains_point(place))
        assert shades.levels[shade] <= 100.0 * found.chance(point)[0] <= shades.levels[shade + 1]
    assert [(one.failed, one.flown) for one in cells.values()] == [(2, 3), (0, 1)], "of those with the fault"
    flights, (last,) = (one.flights for one in cells.values())
    assert [flight[:2] for flight in flights] == [(15, True), (16, True), (14, False)]
    assert last[:2] == (17, False)
    fault, number = axes(spec)[happens], axes(spec)[size]
    assert (report._range(fault, 0.0, 0.5)[:8], report._range(fault, 0.5, 1.0)[:5]) == ("without ", "with ")
    assert report._ticks(fault) == ([0.0, 1.0], ["without", "with"])
    assert report._range(number, 0.0, 0.5) == "fault 1 push.y size 1 to 6.5"
    kind = CubeAxis("kind", Distribution(choice=("a", "b")))
    assert report._range(kind, 0.0, 0.5) == "kind a"
    assert report._ticks(number) == ([0.1, 0.3, 0.5, 0.7, 0.9], ["2.1", "4.3", "6.5", "8.7", "10.9"])


@pytest.mark.parametrize("bound", ["max", "min"])
@pytest.mark.parametrize(("count", "scale"), [(100, "linear"), (101, "log")])
def test_a_histogram_tells_what_fails_from_the_limit_itself_and_counts_few_flights_linearly(
    bound: str, count: int, scale: str
) -> None:
    values = np.array([2.0, *np.linspace(1.0, 4.0, count - 1)])
    metric = replace(METRICS["poses_refused"], bound=bound)
    limited = Limited("hover", "floaty", "x", metric, 2.0, Rate(0, count), values)
    shown, *_ = report._histograms([limited]).axes
    failing = int(((values > 2.0) if bound == "max" else (values < 2.0)).sum())
    heights = [sum(bar.get_height() for bar in bars) for bars in shown.containers]
    assert (heights, shown.get_yscale()) == ([count - failing, failing], scale)


@pytest.mark.parametrize(
    "several", [{"profiles": ["floaty", "as-flown"]}, {"experiments": ["hover", "yaw-sine-0.02"]}]
)
def test_each_profile_s_and_experiment_s_rate_is_of_its_own_clusters(several: dict[str, list[str]]) -> None:
    """Saltelli: the points of a base row share their wind, each flown by both."""
    spec = spec_of(sampling="saltelli", flights=8 * 5 * 2, **several)
    table = table_of([planted(draw(spec, index)).columns() for index in range(80)], schema_of(plan_of(spec)))
    found = find(spec, table)
    passed = np.array([planted(draw(spec, index)).passed for index in range(80)]).reshape(8, 5, 2)
    for number, cell in enumerate(found.cells):
        assert (cell.profile, cell.experiment) == (spec.profiles[number % len(spec.profiles)],
            spec.experiments[number % len(spec.experiments)])  # fmt: skip
        assert cell.rate == tallied(~passed[:, :, number])
    assert found.rate == tallied(~passed.reshape(8, 10))


def pairs(count: int, rate: float, alike: float, seed: int = 4) -> np.ndarray:
    """Return flights of two profiles at `count` points, (count, 2), which agree at least in a share of the points."""
    rng = np.random.default_rng(seed)
    failed = rng.random((count, 2)) < rate
    same = rng.random(count) < alike
    failed[same, 1] = failed[same, 0]
    return failed


def tallied(failed: np.ndarray) -> Rate:
    tally = Tally(failed.shape[1])
    for cluster, flights in enumerate(failed.tolist()):
        for one in flights:
            tally.add(cluster, not one)
    return tally.rate


def rate_of(failed: np.ndarray, size: int) -> tuple[int, int, float]:
    """Failed, flown, and the variance over that of independent flights: from the clusters' scatter, with two whole ones."""
    flown, fails = len(failed), int(failed.sum())
    rare, clusters = min(fails, flown - fails), flown / size
    if not rare or clusters <= 1:
        return fails, flown, max(1, min(size, flown))
    sums = np.array([failed[begin : begin + size].sum() for begin in range(0, flown, size)])
    scatter = ((sums**2).sum() - fails**2 / clusters) / (1 - 1 / clusters)
    design = scatter / (fails * (1 - fails / flown))
    return fails, flown, min(size, max(1.0, (rare * design + 2 * size) / (rare + 2)))


@pytest.mark.long
@pytest.mark.parametrize("size", [1, 2, 4])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.7, 1.0])
def test_a_campaign_s_rate_is_that_of_the_clusters_of_the_flights_that_are_known(
    size: int, share: float
) -> None:
    """After each row, whatever their order; at the end of the flights up to it only."""
    rng = np.random.default_rng(size)
    failed, order = rng.random(48) < share, rng.permutation(48)
    plan = SimpleNamespace(flights=48, half_width=0.2, cluster=size)
    progress, seen = Progress(plan), Tally(size)  # type: ignore[arg-type]
    arrived: list[int] = []
    for index in (None, *order.tolist()):
        if index is not None:
            progress.add(index, not failed[index])
            seen.add(index // size, not failed[index])
            arrived.append(index)
        interim = progress.interim
        if progress.end is None:
            assert interim.interval == seen.rate.interval
            expected: Any = rate_of(failed[arrived], 1)[:2]
        else:
            expected = rate_of(failed[: progress.end], size)
        assert (interim.failed, interim.flown, interim.design)[: len(expected)] == pytest.approx(expected)
    assert progress.end is not None
    assert progress.end % size == 0


@pytest.mark.parametrize("size", [1, 2, 4])
@pytest.mark.parametrize("share", [0.0, 0.1, 0.7, 1.0])
def test_a_rate_has_the_variance_of_its_clusters_from_none_on(size: int, share: float) -> None:
    failed, tally = np.random.default_rng(size).random(30) < share, Tally(size)
    for count in range(31):
        rate = tally.rate
        assert (rate.failed, rate.flown, rate.design) == pytest.approx(rate_of(failed[:count], size))
        if count < 30:
            tally.add(count // size, not failed[count])


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_the_interval_of_clusters_is_that_of_a_bootstrap_over_the_clusters(alike: float) -> None:
    failed = pairs(1000, 0.2, alike)
    again = bootstrap((failed.mean(axis=1),), np.mean, n_resamples=2000, rng=np.random.default_rng(1))
    low, high = tallied(failed).interval
    assert (low, high) == pytest.approx(tuple(again.confidence_interval), abs=0.003)
    naive = interval(failed.mean(), failed.size)
    assert (high - low) / (naive[1] - naive[0]) == pytest.approx((1.0 + alike) ** 0.5, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize("rate", [0.05, 0.2])
def test_nineteen_of_twenty_intervals_contain_the_rate_of_pairs_that_agree_in_94_percent(rate: float) -> None:
    alike = 1.0 - 0.06 / (2 * rate * (1 - rate))
    inside = []
    for seed in range(300):
        low, high = tallied(pairs(250, rate, alike, seed)).interval
        inside.append(low <= rate <= high)
    assert 0.92 <= np.mean(inside) <= 0.99


def test_clusters_without_failure_count_once() -> None:
    assert tallied(np.zeros((50, 2), bool)).interval == interval(0.0, 50)


def test_one_failure_hardly_shows_that_a_cluster_s_flights_are_independent() -> None:
    failed = np.zeros((50, 2), bool)
    failed[7, 0] = True  # the variance over that of independent flights is 100 / 99
    assert tallied(failed).design == pytest.approx((100 / 99 + 2 * 2) / 3)


def test_a_campaign_of_pairs_ends_between_pairs_by_the_interval_of_the_pairs() -> None:
    failed = pairs(400, 0.2, 1.0).ravel().tolist()
    progress = Progress(SimpleNamespace(flights=800, half_width=0.06, cluster=2))  # type: ignore[arg-type]
    for index, one in enumerate(failed):
        progress.add(index, not one)
    assert progress.end is not None
    assert progress.end % 2 == 0
    assert half(sum(failed[: progress.end : 2]), progress.end // 2) == pytest.approx(0.06, abs=0.002)


@pytest.mark.parametrize(("sampling", "rows"), [("saltelli", 5), ("morris", 4)])
def test_points_of_a_base_row_fly_in_the_same_wind(sampling: str, rows: int) -> None:
    spec = spec_of(sampling=sampling, flights=8 * rows * 2, profiles=["floaty", "as-flown"], seed=10)
    seeds = [draw(spec, index).options["seed"] for index in range(spec.flights)]
    assert seeds == [10 + index // (2 * rows) for index in range(spec.flights)]
    assert plan_of(spec).cluster == 2 * rows


def test_pawn_is_that_of_salib() -> None:
    rng = np.random.default_rng(2)
    points = rng.random((500, 3))
    values = points[:, 0] + 0.3 * rng.normal(size=500)
    expected = pawn_of_salib.analyze(problem(3), points, values, S=10)["median"]
    assert pawn(slices(points), values) == pytest.approx(expected, abs=0.005)


def test_a_point_at_an_edge_is_in_the_slice_above_it() -> None:
    """Of the edges between slices four lie at the lower value, one between both and four at the upper value."""
    found = slices(np.repeat([[0.0, 1.0], [1.0, 0.0]], 50, axis=0))
    assert found.argmax(axis=2).tolist() == 50 * [[4, 9]] + 50 * [[9, 4]]
    assert (found.sum(axis=2) == 1).all()


def test_both_values_of_an_axis_of_two_count_for_pawn() -> None:
    points = np.repeat([[0.0], [1.0]], 50, axis=0)
    assert pawn(slices(points), points[:, 0]) == pytest.approx([0.5])


def test_values_that_are_all_equal_depend_on_no_axis() -> None:
    points = np.random.default_rng(1).random((100, 2))
    assert pawn(slices(points), np.ones(100)).tolist() == [0.0, 0.0]


def test_a_metric_that_is_no_number_is_beyond_every_limit() -> None:
    limit = SimpleNamespace(metric=METRICS["max_y"], bound=0.1)
    assert [_beyond(limit, value) for value in (0.2, np.nan, np.inf)] == [pytest.approx(1.0), np.inf, np.inf]
    below_zero = SimpleNamespace(metric=METRICS["in_box"], bound=-2.0)
    assert _beyond(below_zero, -3.0) == 0.5  # type: ignore[arg-type]


def test_the_threshold_of_chance_is_that_of_the_strongest_axis_of_random_orders(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spec, rng = spec_of(flights=40), np.random.default_rng(3)
    points, orders = rng.random((40, len(axes(spec)))), rng.random((20, 40))
    monkeypatch.setattr("hil.research.campaigns.sampling.shuffled", lambda *given: orders)
    strongest = sorted(max(pawn(slices(points), order)) for order in orders)
    found = influence_of(spec, "max_y", points, orders[0])
    assert found.chance == pytest.approx(0.95 * strongest[18] + 0.05 * strongest[19])
    assert [*found.by_axis.values()] == pawn(slices(points), orders[0]).tolist()


def test_the_intervals_of_total_indices_are_theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    told = {"S1": [7.0] * 3, "S1_conf": [8.0] * 3, "ST": [0.1, 0.2, 0.3], "ST_conf": [0.01, 0.02, 0.03]}
    monkeypatch.setattr("hil.research.campaigns.findings.sobol.analyze", lambda *what, **how: told)
    spec = spec_of(sampling="saltelli", flights=40)
    found = influence_of(spec, "max_y", np.zeros((40, 3)), np.zeros(40))
    assert [*found.by_axis.values()] == told["ST"]
    assert [*found.halves.values()] == told["ST_conf"]


@pytest.mark.long
def test_inert_axes_exceed_the_threshold_of_chance_in_one_of_twenty_campaigns() -> None:
    varied = ("actuators.tau", "plant.mass_factor", "plant.drag_factor")
    spec = spec_of(flights=60, parameters={name: {"uniform": [0.9, 1.1]} for name in varied})
    rng = np.random.default_rng(3)
    beyond = 0
    for _ in range(20):
        points, values = rng.random((60, len(axes(spec)))), rng.normal(size=60)
        beyond += bool(influence_of(spec, "max_y", points, values).ranked)
    assert 1 <= beyond <= 2


@pytest.mark.parametrize(("failures", "mapped"), [(4, False), (5, True), (7, True), (8, False)])
def test_a_failure_map_needs_five_failures_and_five_flights_that_hold(failures: int, mapped: bool) -> None:
    spec = spec_of(flights=12)
    rows = [replace(planted(draw(spec, index)), passed=index >= failures) for index in range(12)]
    found = find(spec, table_of([row.columns() for row in rows], schema_of(plan_of(spec))))
    assert (found.failure_map is not None) == mapped


@pytest.mark.long
def test_the_logistic_map_is_pulled_to_no_influence_as_by_one_flight_more() -> None:
    """At the optimum the residuals balance the prior, whose precision is an axis' variance; the offset has none."""
    spec = spec_of(flights=40)
    rows = [planted(draw(spec, index)).columns() for index in range(40)]
    found = find(spec, table_of(rows, schema_of(plan_of(spec)))).failure_map
    assert found is not None
    left = found.failed - found.chance(found.points)
    assert left.sum() == pytest.approx(0.0, abs=1e-3)
    assert left @ (found.points - 0.5) == pytest.approx(found.weights / 12.0, abs=1e-3)


@pytest.mark.parametrize(("flights", "known"), [(19, False), (20, True)])
def test_an_influence_needs_two_flights_in_every_slice_of_an_axis(flights: int, known: bool) -> None:
    spec = spec_of(flights=flights)
    rows = [planted(draw(spec, index)).columns() for index in range(flights)]
    found = find(spec, table_of(rows, schema_of(plan_of(spec)))).influences
    assert any(one.method == "PAWN" for one in found) == known


def test_a_flight_that_was_not_flown_has_no_metric_and_no_verdict() -> None:
    spec = spec_of(flights=1)
    (row,) = table_of([failed(draw(spec, 0), "no board").columns()], schema_of(plan_of(spec))).to_pylist()
    assert all(np.isnan(row[name]) for name in row if name.startswith("metric."))
    assert {row[name] for name in row if name.startswith("holds.")} == {None}


def test_an_index_whose_interval_is_too_wide_is_not_ranked() -> None:
    found = Influence(
        "x", "total Sobol index", {"a": 13.5, "b": 0.4, "c": -0.9}, None, {"a": 1.1, "b": 0.1}, 1.0
    )
    assert (found.ranked, found.unknown) == ([("c", -0.9), ("b", 0.4)], ["a"])
    assert found.text("b") == "b 0.4 ± 0.1"
    assert Influence("x", "", {"a": 1.0}, None, {"a": np.nan}, 1.0).unknown == ["a"]
    assert Influence("x", "", {"a": 1.0}, None, {"a": 1.0}, 1.0).unknown == []


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_any_kind_of_full_disk_ends_a_campaign_and_another_error_is_a_row(number: int) -> None:
    job, cause = draw(spec_of(), 3), f"OSError: {os.strerror(number)}: x"

    def ended(outcome: str, cause: str | None) -> Any:
        verdicts = (
            SimpleNamespace(metric="a", holds=True, applies=True),
            SimpleNamespace(metric="b", holds=False, applies=False),
        )
        return SimpleNamespace(
            outcome=outcome, cause=cause, verdicts=verdicts, hash="h", passed=False, metrics={"x": 1.0}
        )

    with pytest.raises(LabError, match=rf"^flight 3: .*: OSError: {os.strerror(number)}: x$"):
        row_of(job, ended("error", cause))
    assert row_of(job, ended("error", "broken")) == Row(
        job, "error", "broken", False, "", {"x": 1.0}, {"a": True}
    )
    assert row_of(job, ended("lost", cause)) == Row(job, "lost", cause, False, "h", {"x": 1.0}, {"a": True})
    assert row_of(job, ended("completed", None)).error == ""
