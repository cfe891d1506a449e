"""Gains, profiles and optimised shapes: what is promised holds, and what is written flies."""

import math
import tomllib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.research.design import optimise as search
from hil.research.design.authority import authorities
from hil.research.design.axes import AXES, PITCH, ROLL, Axis
from hil.research.design.bounds import HIGH, LOW, SEARCHED, at_bounds, shape_of
from hil.research.design.gains import gains_of, profile_text
from hil.research.design.linear import Linear, Point
from hil.research.design.sweeps import flat_high
from hil.research.design.trim import balanced, coefficient_of, scaled
from hil.world.config import PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.geometry import weigh
from hil.world.floaty.plant import Plant

CONFIG = load_config()
PAPER = Point(CONFIG.geometry, coefficient_of(CONFIG), math.radians(28.0), 0.0, 0.9)
DESIGNS = ("design-flat", "design-paper", "design-best")


def point_of(profile: str) -> Point:
    config = load_config(profile)
    return Point(config.geometry, coefficient_of(config), config.plant.hover_angle, 0.0, 0.9)


# Of the linear model's states behind each axis' gains; the first of x, y and z is the integral of the next.
BEHIND = {"roll": (None, 1, 3, 6), "pitch": (None, 0, 4, 7), "yaw": (5, 8), "height": (None, 2)}


def closed_loop(model: Linear, gains: dict[str, float], axis: Axis) -> NDArray[np.complex128]:
    """Poles of one axis in continuous time, behind the flaps' lag of 50 ms; ours are found in discrete time."""
    states = BEHIND[axis.name]
    n = len(states)
    A = np.zeros((n + 1, n + 1))
    for row, state in enumerate(states):
        if state is None:
            A[row, row + 1] = 1.0
            continue
        A[row, :n] = [0.0 if other is None else model.A[state, other] for other in states]
        A[row, n] = model.B[state, axis.input]
    A[n, :n] = [-20.0 * gains[name] for name in axis.gains[:n]]
    A[n, n] = -20.0
    return np.linalg.eigvals(A)


@pytest.mark.long
@pytest.mark.parametrize("robot", [PAPER, flat_high(PAPER)], ids=["paper", "flat"])
def test_gains_hold_every_axis_of_a_stable_and_of_an_unstable_robot(robot: Point) -> None:
    model = robot.linear
    gains = gains_of(model)
    for axis in AXES:
        assert closed_loop(model, gains, axis).real.max() < -0.1, axis.name


def test_an_axis_that_no_input_reaches_is_refused_in_one_line() -> None:
    model = PAPER.linear
    dead = model.B.copy()
    dead[:, 1] = 0.0
    with pytest.raises(LabError, match=r"no gains: pitch, x cannot be held") as caught:
        gains_of(Linear(model.A, dead))
    assert "\n" not in str(caught.value)


@pytest.mark.long
@pytest.mark.parametrize("name", DESIGNS)
def test_a_written_profile_is_the_robot_that_was_written(name: str, tmp_path: Path) -> None:
    point = point_of(name)
    (tmp_path / "again.toml").write_text(profile_text(point, gains_of(point.linear), "again\nand again"))
    again, shipped = load_config(str(tmp_path / "again.toml")), load_config(name)
    assert again.geometry == shipped.geometry
    assert again.plant.airspeed == pytest.approx(shipped.plant.airspeed)
    assert coefficient_of(again) == pytest.approx(coefficient_of(CONFIG), rel=1e-9), "the same plates"
    assert again.model.model_dump() == pytest.approx(shipped.model.model_dump(), rel=1e-3)
    assert again.controller.model_dump() == pytest.approx(shipped.controller.model_dump(), rel=0.02, abs=1e-3)


@pytest.mark.parametrize(("length", "radius"), [(0.5, None), (1.0, None), (2.0, 0.9)])
def test_the_tunnel_grows_with_a_robot_and_never_shrinks(length: float, radius: float | None) -> None:
    written = tomllib.loads(profile_text(PAPER, {}, "about", length))
    assert written["tunnel"] == {"speed": PAPER.speed} | ({"profile_radius": radius} if radius else {})
    assert (written["allocation"]["opening_min"], written["allocation"]["opening_max"]) == (0.0, 0.9)


def test_the_flat_robot_falls_over_in_the_time_of_its_pole() -> None:
    point = point_of("design-flat")
    tunnel = TunnelConfig(turbulence="none", profile_radius=5.0, height_slope=0.0, speed=point.speed)
    plant = Plant(
        point.geometry, PlantConfig(variant="plate", airspeed=point.speed, hover_angle=point.opening), tunnel,
        PlantServoConfig(), np.random.default_rng(1),
    )  # fmt: skip
    values, vectors = np.linalg.eig(point.linear.A[np.ix_((1, 3, 6), (1, 3, 6))])
    mode = (vectors[:, values.real.argmax()] / vectors[1, values.real.argmax()]).real * 0.002  # [rad] of roll
    q = (math.cos(mode[1] / 2), math.sin(mode[1] / 2), 0.0, 0.0)
    plant.place((0.0, 0.0, tunnel.hover_height), q, (0.0, mode[0], 0.0), (mode[2], 0.0, 0.0))
    growth = point.linear.growth(ROLL)
    seconds = round(math.log(20.0) / growth, 3)
    plant.advance(round(1e6 * seconds))
    assert growth == pytest.approx(8.97, abs=0.01)
    assert 2 * math.atan2(plant.q_WB[1], plant.q_WB[0]) == pytest.approx(
        0.002 * math.exp(growth * seconds), rel=0.03
    )


# Tests that share a search: pytest-xdist runs them in one process.
SHARED_SEARCH = pytest.mark.xdist_group("small-search")


@cache
def small_search(figure: str, seed: int) -> search.Optimum:
    return search.optimise(PAPER, figure, seed, generations=1)


@SHARED_SEARCH
@pytest.mark.long
def test_searches_from_other_seeds_end_at_the_same_robot() -> None:
    one, other = (small_search("least-authority", seed).best for seed in (1, 11))
    assert other.authority == pytest.approx(one.authority, rel=0.002)
    kinks = [math.degrees(found.point.geometry.kink_angle) for found in (one, other)]
    assert kinks[0] == pytest.approx(kinks[1], abs=0.5)


@pytest.mark.parametrize("name", DESIGNS)
def test_conditions_are_positive_where_the_robot_is_stable_and_steers(name: str) -> None:
    for one in search.around(point_of(name)):
        model = one.linear
        stable = max(model.growth(ROLL), model.growth(PITCH)) < 0.0
        steers = min(model.steady(ROLL), model.steady(PITCH)) > 0.0
        assert (search.conditions(one)[8:16] > 0.0).all() == (stable and steers)


def test_a_shape_is_the_worse_the_more_it_violates_conditions() -> None:
    paper = Point(CONFIG.geometry, coefficient_of(CONFIG), math.radians(25.0), 0.0, 0.9)
    shapes = search.Shapes(paper, "least-authority")
    slightly, more = (shapes.loss(shapes.first + np.array([0.0, down, 0.0, 0.0])) for down in (0.0, 0.1))
    assert 0.0 < slightly < more < search.NO_HOVER
    assert shapes.loss(np.where([True, False, True, True], HIGH, LOW)) == search.NO_HOVER
    assert not shapes.tried


@SHARED_SEARCH
@pytest.mark.long
def test_the_optimum_keeps_span_mass_speed_and_is_stable_and_steers_around_its_hover() -> None:
    found = small_search("least-authority", 1)
    best = found.best.point
    assert best.geometry.footprint == PAPER.geometry.footprint
    assert weigh(best.geometry).mass == pytest.approx(weigh(PAPER.geometry).mass)
    assert best.speed == pytest.approx(PAPER.speed, rel=1e-9)
    for opening in (best.opening - search.RESERVE, best.opening, best.opening + search.RESERVE):
        model = Point(best.geometry, best.coefficient, opening, best.low, best.high).linear
        assert max(model.growth(ROLL), model.growth(PITCH)) < 0.0
        assert min(model.steady(ROLL), model.steady(PITCH)) > 0.0
    share = authorities(PAPER)
    assert found.best.authority == pytest.approx(min(v / share[k] for k, v in authorities(best).items()))
    assert found.best.authority == max(one.authority for one in found.tried)


@SHARED_SEARCH
@pytest.mark.long
def test_the_front_is_what_nothing_beats_in_both() -> None:
    found = small_search("least-authority", 1)
    places, front = (
        search.placed(found.tried, "least-authority"),
        search.front(found.tried, "least-authority"),
    )
    for stable, figure in places:
        assert ((front[:, 0] >= stable) & (front[:, 1] >= figure)).any()
    for stable, figure in front:
        assert not ((places[:, 0] > stable) & (places[:, 1] > figure)).any()


@pytest.mark.parametrize("base", [0.15, 0.30, 0.45])
def test_a_smaller_base_plate_turns_more_easily_as_its_flaps_reach_further_inwards(base: float) -> None:
    """The flaps are a square with a square hole, of inertia M (S^2 + b^2) / 6; Floaty's own shape has its own inertia."""
    geometry = PAPER.geometry
    flaps, span, (box, *_) = 4 * geometry.flap_mass, geometry.footprint, geometry.masses

    def budget(base_side: float) -> float:
        return (
            flaps * (span**2 + base_side**2) / 6.0 + box.mass * (box.size[0] ** 2 + box.size[1] ** 2) / 12.0
        )

    shapes = search.Shapes(PAPER, "least-authority")
    own = shapes.build(shapes.first)
    found = shapes.build(np.array([*shapes.first[:2], base, shapes.first[3]]))
    assert own is not None
    assert weigh(own.geometry).inertia == pytest.approx(weigh(geometry).inertia, rel=1e-9)
    assert found is not None
    expected = weigh(geometry).inertia[2] * budget(base * span) / budget(geometry.base_side)
    assert weigh(found.geometry).inertia[2] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("number", range(len(SEARCHED)), ids=[one.name for one in SEARCHED])
def test_every_number_of_a_shape_at_a_bound_of_the_search_is_named(number: int) -> None:
    """With the reason; a shape inside of all bounds has no line."""
    geometry = PAPER.geometry
    assert at_bounds(geometry) == []
    span = geometry.footprint
    for x, end in ((LOW[number], "lower"), (HIGH[number], "upper")):
        kink, height, base, strip = np.where(np.arange(4) == number, x, shape_of(geometry)).tolist()
        shape = balanced(
            geometry, height * span, kink_angle=kink, base_side=base * span, strip_width=strip * span
        )
        (line,) = at_bounds(shape)
        assert line.startswith(f"{SEARCHED[number].name} = ")
        assert f"at the {end} bound of the search (" in line


def test_lighter_or_wider_robots_hold_slower_air_in_the_same_proportion() -> None:
    low, high = search.held(PAPER)
    lines = search.exercise(
        search.Optimum(*2 * (search.Candidate(PAPER, -16.0, 1.0, high / low),), True, ()),
        low / 1.25,
        high / 1.25,
    )
    mass, span = 0.34 / 1.25**2, 23.0 * 1.25
    assert f"with {1e3 * mass:.0f} g instead of 340 g" in lines[1]
    assert f"{span:.1f} cm instead of 23.0 cm" in lines[1]
    for other in (scaled(PAPER.geometry, 1.0, 1.25**-2), scaled(PAPER.geometry, 1.25, 1.0)):
        slower = search.held(Point(other, PAPER.coefficient, PAPER.opening, 0.0, 0.9))
        assert slower == pytest.approx((low / 1.25, high / 1.25), rel=1e-6)


def test_the_steady_side_step_is_that_of_the_simulated_linear_model() -> None:
    model = PAPER.linear
    chosen = [0, 4, 7]
    A, b = model.A[np.ix_(chosen, chosen)].copy(), model.B[chosen, 1]
    A[1:, 0] = 0.0  # the drift in x is held, the attitude follows
    A[:, 0] = 0.0
    flow = np.block([[A, b[:, None]], [np.zeros((1, 4))]])
    early, late = (expm(flow * t)[0, 3] for t in (10.0, 11.0))
    assert late - early == pytest.approx(model.steady(PITCH), rel=1e-3)


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.long
def test_the_three_designs_hover(name: str, tmp_path: Path) -> None:
    result = fly(Request.of(EXPERIMENTS["hover"], profile=name, seed=2, duration_s=8.0), tmp_path / "flight")
    assert result.outcome == "completed"
    assert result.metrics["in_box"] > 0.97
