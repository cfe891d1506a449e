"""Gains, profiles and optimised shapes: what is promised holds, and what is written flies."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_lyapunov

from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.research.design import optimise as search
from hil.research.design.authority import authorities
from hil.research.design.axes import AXES, HEIGHT, PITCH, ROLL, YAW, Axis, dynamics
from hil.research.design.bounds import HIGH, LOW, SEARCHED, at_bounds, shape_of
from hil.research.design.gains import _least_cost, gains_of, profile_text
from hil.research.design.linear import Linear, Point
from hil.research.design.linear import point_of as shipped
from hil.research.design.loop import held
from hil.research.design.sweeps import flat_high
from hil.research.design.trim import balanced, coefficient_of, scaled
from hil.world.config import PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.geometry import weigh
from hil.world.floaty.plant import Plant
from support.paths import ROOT

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


@pytest.mark.parametrize("axis", [YAW, HEIGHT], ids=["yaw", "height"])
def test_gains_cost_least_in_the_gusts_by_bryson_s_rule(axis: Axis) -> None:
    """Variances over the squares of what is allowed, of a flap command that is one period late; 2 % aside they are more."""
    robot = PAPER.linear.robot | {"flap_rate": 20.0}
    Phi, Gamma = held(*dynamics(axis, robot), 0.01)
    turn = math.radians(10.0 if axis is YAW else 8.0)
    allowed = {"position": 0.06, "velocity": 0.3, "angle": turn, "rate": 1.0}
    gust = {"velocity": 0.01, "rate": 0.15}
    n = len(axis.states)

    def cost(gains: NDArray[np.float64]) -> float:
        row = np.array([*gains, 0.0, 0.0])  # nothing of the flap, nothing of the command under way
        closed = np.vstack([np.hstack([Phi, Gamma[:, :1]]), -row])
        noise = np.diag([*(gust.get(state, 0.0) ** 2 for state in axis.states), 0.0, 0.0])
        P = solve_discrete_lyapunov(closed, noise)
        moved = sum(P[i, i] / allowed[state] ** 2 for i, state in enumerate(axis.states))
        return float(moved + row @ P @ row / math.radians(8.0) ** 2)

    gains = _least_cost(axis, robot)
    for step in 0.02 * np.concatenate([np.eye(n), -np.eye(n)]):
        assert cost(gains * (1.0 + step)) > cost(gains)


@pytest.mark.long
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


@pytest.mark.parametrize("name", DESIGNS)
def test_conditions_are_positive_where_the_robot_is_stable_and_steers(name: str) -> None:
    """By Hurwitz: products of the poles' polynomial, in the order of roll and pitch, below, at and above the hover."""
    point = point_of(name)
    around = search.around(point)
    assert [one.opening - point.opening for one in around] == pytest.approx(np.radians([-8.0, 0.0, 8.0]))
    expected = []
    for one in around:
        model, f = one.linear, one.linear.constants
        stable = max(model.growth(ROLL), model.growth(PITCH)) < 0.0
        steers = min(model.steady(ROLL), model.steady(PITCH)) > 0.0
        assert (
            (search.conditions(replace(one))[8:16] > 0.0).all() == search._flies(one) == (stable and steers)
        )
        for axis, chosen, steady in (
            (ROLL, (1, 3, 6), f.y_u1 * f.roll_roll - f.y_roll * f.roll_u1),
            (PITCH, (0, 4, 7), f.x_pitch * f.pitch_u2 - f.x_u2 * f.pitch_pitch),
        ):
            _, a2, a1, a0 = np.poly(model.A[np.ix_(chosen, chosen)])
            expected += [a2 / 5.0, a0 / 100.0, (a2 * a1 - a0) / 1000.0, steady / 1000.0]
            assert (min(expected[-4:-1]) > 0.0) == (model.growth(axis) < 0.0)
    assert search.conditions(point) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("good", "held"),
    [
        ((5, 6, 7, 8), (5, 8)),
        ((0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12), (0, 12)),
        ((0, 1, 4, 6, 7, 9), (6, 7)),
        ((4, 6, 7, 8, 9, 10, 11, 12), (6, 12)),
        ((0, 1, 2, 3, 4, 5, 7, 8, 9), (math.nan, math.nan)),
    ],
)
def test_a_robot_holds_the_updrafts_of_the_openings_around_its_hover_at_which_it_flies(
    monkeypatch: pytest.MonkeyPatch, good: tuple[int, ...], held: tuple[float, float]
) -> None:
    """Openings 3 degrees apart leave 8 to each limit; the smallest updraft belongs to none of the ends."""
    low, slowest = math.radians(2.0), math.radians(31.0)
    point = replace(PAPER, low=low, high=low + math.radians(8.0 + 36.0 + 8.0), opening=math.radians(28.5))
    steps = {round(math.degrees(low) + 8.0 + 3.0 * n, 6): n for n in range(13)}

    def number(opening: float) -> int:
        return steps[round(math.degrees(opening), 6)]

    monkeypatch.setattr(search, "_flies", lambda one: number(one.opening) in good)
    monkeypatch.setattr(search, "speed_at", lambda shape, drag, opening: 9.0 + (opening - slowest) ** 2)
    if math.isnan(held[0]):
        assert np.isnan(search.held(point)).all()
        assert search.speed_range(point, {}) == search.BAD
        return
    speeds = [9.0 + math.radians(10.0 + 3.0 * n - 31.0) ** 2 for n in range(held[0], held[1] + 1)]
    assert search.held(point) == pytest.approx((min(speeds), max(speeds)))
    assert search.speed_range(point, {}) == pytest.approx(max(speeds) / min(speeds))


SHARE = dict(zip(("roll", "pitch", "yaw", "lift"), (2.0, 4.0, 8.0, 16.0), strict=True))


@pytest.fixture
def planted(monkeypatch: pytest.MonkeyPatch) -> list[NDArray[np.float64]]:
    """Robots that are their numbers between the bounds: roll and pitch rise with the first, yaw falls, until the second
    violates conditions above 0.4; returns the shapes that were looked at."""
    looked: list[NDArray[np.float64]] = []

    def build(shapes: search.Shapes, x: NDArray[np.float64]) -> Any:
        z = (np.clip(x, LOW, HIGH) - LOW) / (HIGH - LOW)
        return None if z[3] > 0.9 else SimpleNamespace(z=z)

    def shares(point: Any) -> dict[str, float]:
        z = getattr(point, "z", np.array([0.0, 0.0, 0.0, 0.0]))
        rise = {"roll": 1.0 + z[0] + z[1], "pitch": 3.0 + z[0], "yaw": 2.0 - z[0] + z[1], "lift": 9.0}
        return {name: SHARE[name] * value for name, value in rise.items()}

    def look(point: Any, reference: Any, ratio: float) -> search.Candidate:
        if hasattr(point, "z"):
            looked.append(point.z)
        own = min(shares(point)[name] / SHARE[name] for name in SHARE)
        return search.Candidate(point, 0.0, own, ratio)

    monkeypatch.setattr(search.Shapes, "build", build)
    monkeypatch.setattr(search, "authorities", lambda point: shares(point) if hasattr(point, "z") else SHARE)
    monkeypatch.setattr(search, "conditions", lambda point: np.array([*[1.0] * 23, 0.4 - point.z[1]]))
    monkeypatch.setattr(search, "_look", look)
    ranged = lambda point, reference: 1.0 + point.z[0] if hasattr(point, "z") else 1.5  # noqa: E731
    monkeypatch.setattr(search, "speed_range", ranged)
    monkeypatch.setitem(search.FIGURES, "speed-range", ranged)  # type: ignore[arg-type]
    monkeypatch.setitem(
        search.FIGURES,  # type: ignore[arg-type]
        "least-authority", lambda point, share: min(shares(point)[name] / share[name] for name in share),
    )  # fmt: skip
    return looked


def test_a_climb_ends_where_the_least_authority_is_largest_and_conditions_hold(
    planted: list[NDArray[np.float64]],
) -> None:
    shapes = search.Shapes(PAPER, "least-authority")
    for begin in (0.2, 0.9):
        found = shapes.climb(LOW + begin * np.array([1.0, 0.3, 0.5, 0.5]) * (HIGH - LOW))
        assert ((found - LOW) / (HIGH - LOW))[:2] == pytest.approx([0.5, 0.4], abs=2e-4)
        assert shapes.loss(found) == pytest.approx(-1.9, abs=3e-4)


@pytest.mark.parametrize("figure", ["least-authority", "speed-range"])
def test_a_search_climbs_from_the_best_and_from_the_robot_and_its_best_is_of_all_that_it_tried(
    planted: list[NDArray[np.float64]], monkeypatch: pytest.MonkeyPatch, figure: str
) -> None:
    asked: list[Any] = []
    best, top, first = (
        LOW + np.array(z) * (HIGH - LOW) for z in ((0.1, 0.1, 0, 0), (0.2, 0.2, 0, 0), (0, 0, 0, 0))
    )

    def evolve(loss: Any, bounds: Any, **options: Any) -> Any:
        asked.append((bounds, options))
        assert [loss(LOW + np.array([0.1, 0.1, 0, height]) * (HIGH - LOW)) for height in (0.0, 0.95)] == [
            pytest.approx(-1.2 if figure == "least-authority" else -1.1), search.NO_HOVER]  # fmt: skip
        assert loss(LOW + np.array([0.9, 0.5, 0, 0]) * (HIGH - LOW)) == pytest.approx(math.tanh(0.1))
        return SimpleNamespace(x=best)

    climbed: list[Any] = []
    monkeypatch.setattr(search, "differential_evolution", evolve)
    monkeypatch.setattr(search, "_flies", lambda point: point.opening >= PAPER.opening)
    monkeypatch.setattr(
        search.Shapes, "climb", lambda shapes, x: climbed.append(x) or (top if x is best else first)
    )
    found = search.optimise(PAPER, figure, 7, 3)
    ((bounds, options),) = asked
    assert bounds == [(one.low, one.high) for one in SEARCHED]
    assert (options["maxiter"], options["seed"], options["polish"]) == (3, 7, False)
    begun = options["init"]
    assert begun.shape == (search.POPULATION, 4)
    assert begun[0] == pytest.approx(shape_of(PAPER.geometry))
    assert np.std(begun[1:20] - begun[0], axis=0) == pytest.approx(0.1 * (HIGH - LOW), rel=0.4)
    assert ((begun >= LOW) & (begun <= HIGH)).all()
    assert np.ptp(begun[20:], axis=0) == pytest.approx(HIGH - LOW, rel=0.12)
    assert (found.reference.point, found.reference_flies, found.reference.ratio) == (PAPER, False, 1.5)
    if figure == "speed-range":
        assert (climbed, found.best.ratio, len(found.tried)) == ([], pytest.approx(1.1), 1)
        return
    assert climbed[0] is best
    assert climbed[1] == pytest.approx(begun[0])
    assert [one.ratio for one in found.tried] == [0.0] * 3
    assert found.best.reached(figure) == found.best.authority == pytest.approx(1.4)


def test_a_search_without_a_robot_that_flies_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "differential_evolution", lambda *_, **more: SimpleNamespace(x=LOW))
    with pytest.raises(LabError) as refused:
        search.optimise(replace(PAPER, low=math.radians(3.0)), "speed-range", 1)
    assert str(refused.value) == (
        "no robot of 0.23 m and 0.34 kg is stable and steers at "
        f"{PAPER.speed:.3g} m/s with openings of 3 to 52 deg"
    )


def test_a_shape_is_the_worse_the_more_it_violates_conditions() -> None:
    paper = Point(CONFIG.geometry, coefficient_of(CONFIG), math.radians(25.0), 0.0, 0.9)
    shapes = search.Shapes(paper, "least-authority")
    slightly, more = (shapes.loss(shapes.first + np.array([0.0, down, 0.0, 0.0])) for down in (0.0, 0.1))
    assert 0.0 < slightly < more < search.NO_HOVER
    assert shapes.loss(np.where([True, False, True, True], HIGH, LOW)) == search.NO_HOVER
    assert not shapes.tried


@pytest.mark.long
def test_the_optimum_keeps_span_mass_speed_is_stable_and_steers_around_its_hover_and_is_that_of_other_seeds() -> (
    None
):
    floaty = shipped(CONFIG)
    found = search.optimise(floaty, "least-authority", 1, generations=1)
    best = found.best.point
    assert best.geometry.footprint == floaty.geometry.footprint
    assert weigh(best.geometry).mass == pytest.approx(weigh(floaty.geometry).mass)
    assert best.speed == pytest.approx(floaty.speed, rel=1e-9)
    for opening in (best.opening - search.RESERVE, best.opening, best.opening + search.RESERVE):
        model = Point(best.geometry, best.coefficient, opening, best.low, best.high).linear
        assert max(model.growth(ROLL), model.growth(PITCH)) < 0.0
        assert min(model.steady(ROLL), model.steady(PITCH)) > 0.0
    share = authorities(floaty)
    assert found.best.authority == pytest.approx(min(v / share[k] for k, v in authorities(best).items()))
    assert found.best.authority == max(one.authority for one in found.tried)
    other = (ROOT / "tests" / "approved" / "optimise.txt").read_text(encoding="utf-8")  # of seed 11
    kink = tomllib.loads(other.partition("\n[geometry]\n")[2].partition("\n[")[0])["kink_angle"]
    assert best.geometry.kink_angle == pytest.approx(kink, abs=math.radians(0.5))
    assert found.best.authority == pytest.approx(
        float(other.partition("\nleast-authority: ")[2].partition(";")[0]), rel=0.002
    )


@pytest.mark.parametrize("figure", ["least-authority", "speed-range"])
def test_the_front_is_what_nothing_beats_in_both(figure: str) -> None:
    rng = np.random.default_rng(3)
    tried = tuple(search.Candidate(PAPER, *values) for values in rng.integers(-9, 9, (60, 3)).tolist())
    places, front = search.placed(tried, figure), search.front(tried, figure)
    assert places.tolist() == [
        [-one.stiffness, one.ratio if figure == "speed-range" else one.authority] for one in tried
    ]
    for stable, value in places:
        assert ((front[:, 0] >= stable) & (front[:, 1] >= value)).any()
    for stable, value in front:
        assert [stable, value] in places.tolist()
        better = (places >= (stable, value)).all(axis=1) & (places > (stable, value)).any(axis=1)
        assert not better.any()


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
    one, span = SEARCHED[number], geometry.footprint
    for x, end in ((LOW[number], "lower"), (HIGH[number], "upper")):
        kink, height, base, strip = np.where(np.arange(4) == number, x, shape_of(geometry)).tolist()
        shape = balanced(
            geometry, height * span, kink_angle=kink, base_side=base * span, strip_width=strip * span
        )
        (line,) = at_bounds(shape)
        value = f"{math.degrees(x):.0f} deg" if number == 0 else f"{x:.3g} of the footprint"
        why = one.why_low if end == "lower" else one.why_high
        assert line == f"{one.name} = {value}: at the {end} bound of the search ({why})"
    for share, end in ((0.0009, "lower"), (0.0011, ""), (0.9989, ""), (0.9991, "upper")):
        found = one.reached(one.low + share * (one.high - one.low))
        assert (f"at the {end} bound" in found) if end else not found


@pytest.mark.long
def test_lighter_or_wider_robots_hold_slower_air_in_the_same_proportion(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    low, high = search.held(PAPER)
    for other in (scaled(PAPER.geometry, 1.0, 1.25**-2), scaled(PAPER.geometry, 1.25, 1.0)):
        slower = search.held(Point(other, PAPER.coefficient, PAPER.opening, 0.0, 0.9))
        assert slower == pytest.approx((low / 1.25, high / 1.25), rel=1e-6)
    best, own = (search.Candidate(replace(PAPER, opening=one), 0.0, 0.0, 0.0) for one in (0.1, 0.2))
    ranges = {0.1: (10.0, 12.5), 0.2: (10.0, 12.4)}
    monkeypatch.setattr(search, "held", lambda point: ranges[point.opening])
    least = ["the robot as it is holds 10.00 to 12.40 m/s, a ratio of 1.240; 1.250 are needed",
        "the best shape holds 10.00 to 12.50 m/s, a ratio of 1.250; 1.250 are needed",
        "with 218 g instead of 340 g at the same span, or 28.8 cm instead of 23.0 cm at the same mass, it holds 8 to "
        "10.00 m/s; the wider one turns by -20 % per input"]  # fmt: skip
    assert search.exercise(search.Optimum(best, own, True, ()), 8.0, 10.0) == least
    ranges[0.2] = math.nan, math.nan
    least[0] = "the robot as it is does not fly at its hover: no range"
    assert search.exercise(search.Optimum(best, own, True, ()), 8.0, 10.0) == least


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
