"""Flight number i is a function of (spec, i): the same in any order, with the distributions that the spec names."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.request import Options
from hil.research.campaigns.config import Distribution, SampledFault, Spec
from hil.research.campaigns.sampling import (
    as_flown,
    axes,
    check_design,
    cluster_of,
    covered,
    draw,
    plan_of,
    points_of,
    value_at,
)
from hil.world.floaty.correction import PAPER_TABLE
from support.campaigns import spec_of

# 3 axes: 8 (3+2), 10 (3+1).
SAMPLINGS = {"random": 40, "sobol": 40, "latin": 40, "saltelli": 40, "morris": 40}


@pytest.mark.long
@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_a_flight_depends_on_its_number_and_on_nothing_that_was_drawn_before(sampling: str) -> None:
    spec = spec_of(sampling=sampling)
    forwards = [draw(spec, index) for index in range(spec.flights)]
    again = Spec.model_validate_json(spec.model_dump_json())
    backwards = [draw(again, index) for index in reversed(range(spec.flights))]
    assert forwards == backwards[::-1]
    assert points_of(spec).tolist() == [points_of(spec, n, 1)[0].tolist() for n in range(spec.points)]
    assert len({one.text for one in forwards}) > 3


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_another_seed_has_other_points(sampling: str) -> None:
    values = [points_of(spec_of(sampling=sampling, seed=seed)).tolist() for seed in (1, 2)]
    assert values[0] != values[1]


def test_more_flights_leave_those_that_were_drawn_as_they_are() -> None:
    for sampling in ("random", "sobol"):
        few, many = (points_of(spec_of(sampling=sampling, flights=n)) for n in (20, 50))
        assert many[:20].tolist() == few.tolist()


def test_numbers_are_those_of_scipy_s_and_salib_s_own_samplers() -> None:
    from SALib.sample import sobol

    spec = spec_of(sampling="sobol", flights=16, seed=5)
    own = stats.qmc.Sobol(3, scramble=True, rng=np.random.default_rng(5)).random(16)
    assert points_of(spec).tolist() == own.tolist()
    design = points_of(spec_of(sampling="saltelli", flights=40, seed=5))
    cube = {"num_vars": 3, "names": list("abc"), "bounds": [[0, 1]] * 3}
    assert design.tolist() == sobol.sample(cube, 8, calc_second_order=False, seed=5).tolist()


def test_a_latin_hypercube_has_one_point_in_every_slice_of_every_axis() -> None:
    points = points_of(spec_of(sampling="latin", flights=25))
    for column in points.T:
        assert sorted((column * 25).astype(int)) == list(range(25))


@pytest.mark.parametrize(
    ("distribution", "expected"),
    [
        ({"uniform": (2.0, 6.0)}, stats.uniform(2.0, 4.0)),
        ({"log_uniform": (0.1, 10.0)}, stats.loguniform(0.1, 10.0)),
        ({"normal": (3.0, 0.5)}, stats.norm(3.0, 0.5)),
        ({"normal": (1.0, 0.6, 0.0, 4.0)}, stats.truncnorm(-1.0 / 0.6, 3.0 / 0.6, 1.0, 0.6)),
    ],
)
def test_values_are_quantiles_of_their_distribution(distribution: dict[str, Any], expected: Any) -> None:
    varies = Distribution.model_validate(distribution)
    for share in (0.001, 0.2, 0.5, 0.77, 0.999):
        assert value_at(varies, share) == pytest.approx(expected.ppf(share), rel=1e-7)


def test_values_have_no_more_digits_than_every_processor_agrees_on() -> None:
    value = value_at(Distribution(log_uniform=(0.1, 10.0)), 1.0 / 3.0)
    assert value == float(f"{value:.9g}")


def test_the_ends_of_a_design_s_axes_are_values() -> None:
    assert math.isfinite(float(value_at(Distribution(normal=(0.0, 1.0)), 0.0)))
    assert value_at(Distribution(choice=(True, False)), 1.0) is False


@pytest.mark.parametrize(
    ("varies", "kind"),
    [({"choice": [True, False]}, bool), ({"choice": [True, 2.0]}, str),
     ({"choice": ["a", 2]}, str), ({"choice": ["a"]}, str),
     ({"choice": [1, 2.5]}, float), ({"uniform": [1, 2]}, float)],
)  # fmt: skip
def test_a_column_of_values_that_a_number_cannot_hold_is_of_texts(varies: dict[str, Any], kind: type) -> None:
    assert plan_of(spec_of(parameters={"actuators.tau": varies})).values == {"actuators.tau": kind}


def test_every_choice_is_as_likely_as_the_others() -> None:
    varies = Distribution(choice=("a", "b", "c"))
    drawn = [value_at(varies, share) for share in np.linspace(0.0, 0.999, 300)]
    assert [drawn.count(name) for name in "abc"] == pytest.approx([100, 100, 100], abs=1)


@pytest.mark.long
def test_a_fault_happens_in_its_share_of_the_flights_with_its_distributed_size() -> None:
    spec = spec_of(flights=512, sampling="sobol")
    faults = [draw(spec, index).options["faults"] for index in range(512)]
    sizes = [float(fault[0].partition("=")[2]) for fault in faults if fault]
    assert len(sizes) == pytest.approx(256, abs=2)
    assert stats.kstest(sizes, stats.uniform(1.0, 11.0).cdf).pvalue > 0.2
    assert {fault[0].partition("=")[0] for fault in faults if fault} == {"push.y@0.1"}


@pytest.mark.parametrize(("probability", "happens"), [(0.99, True), (1.0, False)])
def test_whether_a_fault_happens_is_an_axis_where_it_may_not(probability: float, happens: bool) -> None:
    spec = spec_of(faults=[SampledFault(kind="push.y", start_s=0.1, size=2.0, probability=probability)])
    assert ("fault 1 push.y happens" in [axis.name for axis in axes(spec)]) == happens


def test_each_point_is_flown_by_every_experiment_profile_and_seed() -> None:
    spec = spec_of(
        experiments=["hover", "yaw-step"], profiles=["floaty", "as-flown"], seeds=2, seed=10, flights=16
    )
    drawn = [draw(spec, index) for index in range(16)]
    values = [one.values["actuators.tau"] for one in drawn]
    assert (len(set(values[:8])), len(set(values[8:])), len(set(values))) == (1, 1, 2), "two points"
    first = {(one.experiment, one.options["profile"], one.options["seed"]) for one in drawn[:8]}
    assert len(first) == 8
    assert {one.options["seed"] for one in drawn} == {10, 11, 12, 13}


@pytest.mark.long
def test_the_table_s_constants_lie_within_its_uncertainty_and_fill_it() -> None:
    spec = spec_of(table={"distribution": "uniform"}, parameters={}, faults=[], flights=256, sampling="sobol")
    drawn = [draw(spec, index).values for index in range(256)]
    assert drawn[0].keys() == {f"plant.constant_factors.{name}" for name in PAPER_TABLE.keys() - {"z_vz"}}
    for name in PAPER_TABLE.keys() - {"z_vz"}:
        value, error = PAPER_TABLE[name]
        values = [abs(value) * float(one[f"plant.constant_factors.{name}"]) for one in drawn]
        assert abs(value) - error <= min(values) <= abs(value) - 0.98 * error
        assert abs(value) + 0.98 * error <= max(values) <= abs(value) + error


def test_the_table_s_uncertainty_as_a_deviation_stays_where_the_plant_can_be() -> None:
    spec = spec_of(
        table={"distribution": "normal", "constants": ["roll_roll"]}, parameters={}, faults=[], flights=512,
        sampling="sobol",
    )  # fmt: skip
    factors = [float(draw(spec, n).values["plant.constant_factors.roll_roll"]) for n in range(512)]
    expected = stats.truncnorm(-1.0 / 0.625, 3.0 / 0.625, 1.0, 0.625)  # -16 +- 10
    assert stats.kstest(factors, expected.cdf).pvalue > 0.2
    assert 0.0 <= min(factors) < 0.05


def test_the_profile_flies_the_table_s_values() -> None:
    """All but pitch per u2, where the profile takes the Methods' value."""
    model = load_config().model.model_dump()
    assert {name for name, (value, _) in PAPER_TABLE.items() if model[name] != value} == {"pitch_u2"}


@pytest.mark.parametrize(("sampling", "flights"), [("saltelli", 45), ("saltelli", 50), ("morris", 42)])
def test_an_impossible_number_of_flights_is_refused_with_a_possible_one(sampling: str, flights: int) -> None:
    with pytest.raises(LabError, match=r"needs (40 or 80|40 or 44)"):
        check_design(spec_of(sampling=sampling, flights=flights))
    check_design(spec_of(sampling=sampling, flights=40))


@pytest.mark.parametrize(("sampling", "one", "two"), [("saltelli", 5, 10), ("morris", 4, 8)])
def test_a_design_needs_two_base_rows(sampling: str, one: int, two: int) -> None:
    with pytest.raises(LabError, match=rf"needs {two}$"):
        check_design(spec_of(sampling=sampling, flights=one))
    check_design(spec_of(sampling=sampling, flights=two))


def test_where_nothing_varies_a_cluster_is_the_flights_of_a_seed() -> None:
    both = ["floaty", "as-flown"]
    assert cluster_of(spec_of(parameters={}, faults=[], flights=6, seeds=3, profiles=both)) == 2
    assert cluster_of(spec_of(flights=12, seeds=3, profiles=both)) == 6


def test_a_campaign_over_seeds_alone_has_no_axes() -> None:
    spec = spec_of(parameters={}, faults=[], flights=3)
    assert axes(spec) == ()
    assert [draw(spec, index).options["seed"] for index in range(3)] == [1, 2, 3]


def test_flights_add_their_coverage_to_one_file_wherever_they_are_flown() -> None:
    plan = plan_of(spec_of())
    for index in (0, 1):
        one, other = covered(plan, Path("cov")).job(index), plan.job(index)
        assert one.options == other.options | Options(coverage=Path.cwd() / "cov")
        assert replace(one, options=other.options) == other


def test_points_as_flown_say_which_faults_happened_and_nothing_of_those_that_did_not() -> None:
    fault = {"kind": "push.y", "probability": 0.25, "start_s": 1.0, "size": {"uniform": [0.5, 2.0]}}
    wind = {"tunnel.side_wind": {"uniform": [0.0, 0.1]}}
    faults = [fault, fault | {"probability": 1.0}]
    spec = Spec.model_validate(
        {"experiments": ["hover"], "flights": 64, "faults": faults, "parameters": wind}
    )
    drawn = points_of(spec)
    flown = as_flown(spec, drawn)
    assert np.array_equal(drawn, points_of(spec)), "the points stay"
    names = [axis.name for axis in axes(spec)]
    happens, size = names.index("fault 1 push.y happens"), names.index("fault 1 push.y size")
    always = names.index("fault 2 push.y size")
    there = [len(draw(spec, index).options["faults"]) == 2 for index in range(64)]
    assert 8 < sum(there) < 24
    assert flown[:, happens].tolist() == [float(one) for one in there]
    assert np.array_equal(flown[:, size], np.where(there, drawn[:, size], 0.5))
    assert np.array_equal(flown[:, [always, 0]], drawn[:, [always, 0]])
