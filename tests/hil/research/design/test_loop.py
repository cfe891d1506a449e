"""The design model: margins against a plant whose margins are known, its predictions against scipy's Lyapunov equation."""

from math import inf, radians
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov
from scipy.optimize import brentq

from hil.config import load_config
from hil.errors import LabError
from hil.research.design import tune
from hil.research.design.axes import (
    AXES,
    DELAY,
    HEIGHT,
    PITCH,
    ROLL,
    STEP_S,
    YAW,
    Axis,
    dynamics,
    gains_in,
    robot_of,
)
from hil.research.design.loop import FREQUENCIES, Timing, _robot_tick, build, filter_gain, held
from hil.research.design.margins import margins, margins_of, pose_delay_margin
from hil.research.design.tune import Flow, GainTask, by_regulator, cost, delay_margin, design, motion

Array = NDArray[np.float64]
CONFIG = load_config()
NOW = Timing.of(CONFIG, 0.040)
NAMES = [axis.name for axis in AXES]


def flat(axis: Axis, per_hz: float = 1e-3) -> Array:
    """The spectrum of white accelerations."""
    width = len(axis.states) // 2
    return np.broadcast_to(per_hz * np.eye(width), (len(FREQUENCIES), width, width)).astype(complex)


def task(axis: Axis, delay: float = 0.001) -> GainTask:
    return GainTask(axis, Flow(flat(axis), 0.0, 0.0), CONFIG, NOW, delay)


@pytest.mark.long
def test_margins_are_those_of_a_third_order_plant_with_delay() -> None:
    late = 0.05

    def response(w: Array) -> NDArray[np.complex128]:
        s = 1j * w
        return np.asarray(2.0 * np.exp(-s * late) / (s * (s + 1) * (s + 2)))

    found = margins_of(np.geomspace(1e-2, 50, 2000), response(np.geomspace(1e-2, 50, 2000)))
    crossing = brentq(lambda w: 4.0 / (w**2 * (w**2 + 1) * (w**2 + 4)) - 1.0, 0.1, 10)
    phase = np.pi / 2 - np.arctan(crossing) - np.arctan(crossing / 2) - late * crossing
    turning = brentq(lambda w: np.pi / 2 - np.arctan(w) - np.arctan(w / 2) - late * w, 0.1, 10)
    grid = np.linspace(0.01, 10, 100_000)
    assert found.phase == pytest.approx(phase, rel=1e-4)
    assert found.delay == pytest.approx(phase / crossing, rel=1e-4)
    assert found.gain == pytest.approx(1 / abs(response(np.array([turning]))[0]), rel=1e-4)
    assert found.least_gain == 0.0
    assert found.peak == pytest.approx(np.max(1 / np.abs(1 + response(grid))), rel=1e-4)


@pytest.mark.parametrize("profile", ["floaty", "design-flat", "design-double"])
@pytest.mark.parametrize("axis", AXES, ids=NAMES)
def test_the_search_s_delay_margin_is_that_of_python_control(profile: str, axis: Axis) -> None:
    config = load_config(profile)
    loop, gains = build(axis, robot_of(config), config, NOW), gains_in(config, axis)
    assert delay_margin(loop.open_loop(gains)) == pytest.approx(margins(loop, gains).delay, rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("profile", ["floaty", "design-flat"])
@pytest.mark.parametrize("axis", AXES, ids=NAMES)
def test_at_the_gain_margin_the_loop_begins_to_grow(profile: str, axis: Axis) -> None:
    config = load_config(profile)
    loop = build(axis, robot_of(config), config, NOW)
    gains = gains_in(config, axis)
    found = margins(loop, gains)
    assert found.stable

    def radius(factor: float) -> float:
        """Of a servo that answers so many times as strongly."""
        return float(
            np.abs(np.linalg.eigvals(loop.A - (factor * loop.Bv + loop.Bu) @ (gains[None] @ loop.N))).max()
        )

    assert radius(0.995 * found.gain) < 1.0 < radius(1.005 * found.gain)
    if found.least_gain:
        assert radius(0.995 * found.least_gain) > 1.0 > radius(1.005 * found.least_gain)


@pytest.mark.long
@pytest.mark.parametrize("axis", AXES, ids=NAMES)
def test_at_the_delay_margin_the_loop_begins_to_grow(axis: Axis) -> None:
    loop = build(axis, robot_of(CONFIG), CONFIG, NOW)
    gains = gains_in(CONFIG, axis)
    size, ticks = len(loop.A), margins(loop, gains).delay / STEP_S

    def radius(late: int) -> float:
        """Of a loop whose commands reach the servos whole ticks later."""
        waiting = np.eye(late, k=-1)
        feedback = -gains[None] @ loop.N
        closed = np.block(
            [
                [loop.A + loop.Bu @ feedback, np.concatenate([np.zeros((size, late - 1)), loop.Bv], axis=1)],
                [np.concatenate([feedback, np.zeros((late - 1, size))]), waiting],
            ]
        )
        return float(np.abs(np.linalg.eigvals(closed)).max())

    assert radius(int(ticks)) < 1.0 < radius(int(ticks) + 1)


def test_a_filter_and_predictor_that_know_the_robot_know_its_state_after_any_command() -> None:
    axis = HEIGHT  # the gyro's mean comes half a tick late; height has no gyro
    now, states = build(axis, robot_of(CONFIG) | {DELAY: 0.0}, CONFIG, NOW).answers
    assert now[:, :2, :2].sum(axis=2) == pytest.approx(states[:, :, :2].sum(axis=2), rel=1e-6)


def test_the_y_loop_of_the_authors_gains_has_the_pole_that_the_specification_prints() -> None:
    config = load_config("as-flown")
    axis = ROLL
    poles = np.linalg.eigvals(build(axis, robot_of(config), config, NOW).closed(gains_in(config, axis)))
    slowest = np.log(poles[np.argmax(np.abs(poles))]) / STEP_S
    assert slowest.real == pytest.approx(0.26, abs=0.03)  # a prototype apart from this code has +0.26 +- 4.9i
    assert abs(slowest.imag) == pytest.approx(4.9, abs=0.05)


@pytest.mark.long
@pytest.mark.parametrize("axis", AXES, ids=NAMES)
def test_poses_may_be_late_up_to_the_margin_and_no_later(axis: Axis) -> None:
    robot, gains = robot_of(CONFIG), gains_in(CONFIG, axis)
    most = pose_delay_margin(axis, robot, CONFIG, NOW, gains)
    assert build(axis, robot, CONFIG, NOW.later(0.98 * most)).radius(gains) < 1.0
    assert build(axis, robot, CONFIG, NOW.later(1.02 * most + 1e-3)).radius(gains) > 1.0


def test_without_the_predictor_the_authors_x_loop_bears_less() -> None:
    blind = load_config("as-flown", ["predictor.enabled=false"])
    assert Timing.of(blind, 0.04) == Timing(0.04, 0)
    assert Timing.of(load_config("as-flown", ["predictor.age=fixed"]), 0.06) == Timing(0.06, 4)
    timings = [Timing.of(CONFIG, age_s) for age_s in (0.004, 0.014, 0.016)]
    assert [(one.age_s, one.horizon) for one in timings] == [(0.01, 1), (0.01, 1), (0.02, 2)]
    axis, gains = PITCH, gains_in(blind, PITCH)
    helped = margins(build(axis, robot_of(blind), load_config("as-flown"), NOW), gains)
    left_alone = margins(build(axis, robot_of(blind), blind, Timing.of(blind, 0.04)), gains)
    assert left_alone.delay < helped.delay - 0.03


@pytest.mark.parametrize("axis", AXES, ids=NAMES)
def test_predicted_motion_is_that_of_the_lyapunov_equation(axis: Axis) -> None:
    loop, gains = build(axis, robot_of(CONFIG), CONFIG, NOW), gains_in(CONFIG, axis)
    per_hz = 1e-3
    each = per_hz / (2 * STEP_S)  # variance of white noise, one value a tick
    P = solve_discrete_lyapunov(loop.closed(gains), each * loop.Bw @ loop.Bw.T)
    states, u = loop.response_to(flat(axis, per_hz), gains)
    assert states == pytest.approx(np.diag(loop.C @ P @ loop.C.T), rel=0.05)
    assert u == pytest.approx(float(gains @ loop.N @ P @ loop.N.T @ gains), rel=0.05)
    assert FREQUENCIES[-1] < 0.5 / STEP_S


@pytest.mark.parametrize("axis", AXES, ids=NAMES)
def test_the_filter_s_gain_is_that_of_its_recursion_with_the_profile_s_noises(axis: Axis) -> None:
    """An input is the mean of four flaps, a pose comes in every second tick."""
    noise, Phi = CONFIG.estimator, held(*dynamics(axis, robot_of(CONFIG)), STEP_S)[0]
    process = {"position": noise.process_position, "velocity": noise.process_velocity, "angle": noise.process_attitude,
        "rate": noise.process_rate}  # fmt: skip
    Q = np.diag([*(process[state] for state in axis.states), noise.process_flap / 4])
    measured = {
        "rate": noise.measured_rate,
        "position": 2 * noise.measured_position,
        "angle": 2 * noise.measured_attitude,
    }
    seen = [state for state in measured if state in axis.states]
    C = np.array([[float(state == one) for state in (*axis.states, "flap")] for one in seen])
    P = np.eye(len(Q))
    for _ in range(3000):
        P = Phi @ P @ Phi.T + Q
        K = P @ C.T @ np.linalg.inv(C @ P @ C.T + np.diag([measured[state] for state in seen]))
        P = P - K @ C @ P
    found, rows = filter_gain(axis, CONFIG, Phi)
    assert found == pytest.approx(K, rel=1e-4, abs=1e-7)
    assert rows.tolist() == C.tolist()


def test_a_robot_that_answers_later_has_less_delay_left() -> None:
    axis, robot = ROLL, robot_of(CONFIG)
    slow = build(axis, robot | {DELAY: robot[DELAY] + 0.005}, CONFIG, NOW)
    usual = build(axis, robot, CONFIG, NOW)
    gains = gains_in(CONFIG, axis)
    assert margins(usual, gains).delay - margins(slow, gains).delay == pytest.approx(0.005, abs=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("axis", AXES, ids=NAMES)
def test_designed_gains_move_less_inside_their_margins_than_the_regulator_s(axis: Axis) -> None:
    loop = build(axis, robot_of(CONFIG), CONFIG, NOW)
    start = by_regulator(axis, robot_of(CONFIG))
    gains = design(task(axis), [loop], [start])
    assert cost(loop, task(axis), gains) <= cost(loop, task(axis), start)
    found = margins(loop, gains)
    assert found.stable
    assert found.peak < 2.0
    assert found.delay > 0.002
    assert motion(loop, task(axis), gains).input < 0.25 * task(axis).flap_range


@pytest.mark.long
def test_robots_that_no_gains_hold_are_refused() -> None:
    axis, robot = ROLL, robot_of(CONFIG)
    robots = [robot, robot | {"roll_u1": -robot["roll_u1"], "y_u1": -robot["y_u1"]}]
    loops = [build(axis, one, CONFIG, NOW) for one in robots]
    with pytest.raises(LabError, match="of 2 robots that the intervals allow are unstable"):
        design(task(axis), loops, [gains_in(CONFIG, axis)])


def test_the_integral_removes_the_offset_at_rest() -> None:
    at_rest = GainTask(ROLL, Flow(flat(ROLL), 0.02, 0.01), CONFIG, NOW, 0.001)
    gains = np.array([-2.0, -1.0, 1.0, 0.05])
    assert at_rest.offset(gains) == pytest.approx(0.03 / 2.0)  # u = 2 y - roll = 0.02, roll = 0.01
    assert (
        GainTask(HEIGHT, Flow(flat(HEIGHT), 0.02, 0.0), CONFIG, NOW, 0.001).offset(np.array([3.0, 1.0, 1.0]))
        == 0.0
    )


class Planted:
    """A loop with given variances of its states and input, radius and open-loop response."""

    def __init__(
        self, axis: Axis, radius: float = 0.9, u: float = 0.0, peak: float = 1.0, main: float = 0.0
    ) -> None:
        self._states, self._u, self._radius = np.full(len(axis.states), 1e-4), u, radius
        self._states[0] += main
        self._L = np.full(len(FREQUENCIES), -1.0 - 1.0 / peak + 0j)  # never of size 1

    def radius(self, gains: Array) -> float:
        return self._radius

    def response_to(self, spectrum: Any, gains: Array) -> tuple[Array, float]:
        return self._states.copy(), self._u

    def open_loop(self, gains: Array) -> Any:
        return self._L


@pytest.mark.parametrize("axis", AXES, ids=NAMES)
def test_the_cost_is_motion_in_units_and_much_more_for_each_violated_condition(
    axis: Axis, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each condition costs nothing at its limit and 100 times the excess above; an unstable loop more than all."""
    allocation, controller = CONFIG.allocation, CONFIG.controller
    share = min(
        allocation.opening_max - allocation.hover_angle, allocation.hover_angle - allocation.opening_min
    )
    units = {"position": 0.02, "velocity": 0.3, "angle": radians(5.0), "rate": 2.0}
    moved = sum(1e-4 / units[state] ** 2 for state in axis.states)
    gains = np.zeros(len(axis.gains))
    gains[0] = 1e-6
    assert task(axis).flap_range == pytest.approx(share)

    def extra(gains: Array = gains, task: GainTask = task(axis), **planted: float) -> float:  # noqa: B008
        return cost(Planted(axis, **planted), task, gains) - moved  # type: ignore[arg-type]

    assert extra() == pytest.approx(0.0, abs=1e-9)
    for u in (0.25, 0.35):
        costs = u**2 / 0.25**2 + 100.0 * (u / 0.25 - 1.0)
        assert extra(u=(u * share) ** 2) == pytest.approx(costs)
    assert extra(peak=1.9) == pytest.approx(0.0, abs=1e-9)
    assert extra(peak=2.0) == pytest.approx(100.0 * (2.0 / 1.9 - 1.0))
    turns = "angle" in axis.states
    for factor in (1.0, 1.5):
        steep = np.zeros(len(axis.gains))
        steep[0] = -factor * share / controller.limit_xy
        assert extra(gains=steep) == pytest.approx(100.0 * (factor - 1.0) if turns else 0.0, abs=1e-6)
    far = (0.1 / 3.0) ** 2 - 1e-4  # three times the rms of 3.3 cm reach the end of the box
    assert extra(main=far) == pytest.approx(far / units[axis.states[0]] ** 2)
    wide = (0.15 / 3.0) ** 2 - 1e-4
    outside = 50.0 if axis.main == "position" else 0.0
    assert extra(main=wide) - wide / units[axis.states[0]] ** 2 == pytest.approx(outside)
    monkeypatch.setattr(GainTask, "offset", lambda task, gains: far**0.5)
    assert extra() == pytest.approx(far / units[axis.states[0]] ** 2), "the offset counts as motion"
    monkeypatch.setattr(tune, "delay_margin", lambda L: 0.02)
    assert extra(task=task(axis, 0.01)) == pytest.approx(extra(task=task(axis, 0.0)))
    assert extra(task=task(axis, 0.015)) - extra(task=task(axis, 0.01)) == pytest.approx(50.0), (
        "twice the delay"
    )
    assert extra(radius=1.0) + moved == 2000.0
    assert extra(radius=1.25) > extra(radius=1.0)
    assert extra(radius=0.999) < 10.0


def test_the_offset_is_held_by_the_first_gain_and_of_a_position_after_the_turn_that_it_needs() -> None:
    flow = Flow(flat(ROLL), 0.02, 0.01)
    for axis, expected in ((ROLL, 0.015), (YAW, 0.01)):
        still = GainTask(axis, flow, CONFIG, NOW, 0.0)
        gains = np.array([-2.0, *np.ones(len(axis.gains) - 1)])
        assert still.offset(gains) == pytest.approx(expected)
        gains[0] = 0.0
        assert still.offset(gains) == inf


@pytest.mark.parametrize("worst", [(3.0, 1.0, 2.0), (1.0, 3.0, 2.5)])
def test_gains_are_the_best_for_the_worst_robots_and_their_integral_is_a_third(
    monkeypatch: pytest.MonkeyPatch, worst: tuple[float, ...]
) -> None:
    """Loops of height whose costs are distances from a wish: between the two extremes, whatever the order."""
    wishes = [np.array([1.0, 1.0]), *(np.array([place, 0.5 * place]) for place in worst)]
    asked: list[int] = []

    def distance(loop: Any, task: GainTask, gains: Array) -> float:
        asked.append(loop.number)
        assert gains[2] == pytest.approx(gains[0] / 3.0)
        return float(np.sum((gains[:2] - loop.wish) ** 2)) + (1e3 if loop.lost else 0.0)

    monkeypatch.setattr(tune, "cost", distance)
    loops: list[Any] = [SimpleNamespace(wish=wish, number=n, lost=False) for n, wish in enumerate(wishes)]
    start = [np.array([one, 0.0, one / 3.0]) for one in (7.0, 1.5)]
    found = design(task(HEIGHT), loops, start)
    assert found == pytest.approx([2.0, 1.0, 2.0 / 3.0], abs=0.02)
    assert [float(f"{gain:.4g}") for gain in found] == found.tolist(), "as a profile has them"
    assert asked[:2] == [0, 0], "both starts"
    alone = design(task(HEIGHT), loops[:1], start)
    assert alone == pytest.approx([1.0, 1.0, 1.0 / 3.0], abs=0.005)
    asked.clear()
    alike: list[Any] = [SimpleNamespace(wish=wishes[0], number=n, lost=False) for n in range(4)]
    assert design(task(HEIGHT), alike, start).tolist() == alone.tolist()
    assert [asked.count(number) for number in (1, 2, 3)] == [1, 1, 1], "no robot is worse than the first"
    loops[2].lost = True
    with pytest.raises(
        LabError, match=r"^no gains: height: 1 of 4 robots that the intervals allow are unstable with"
    ):
        design(task(HEIGHT), loops, start)


@pytest.mark.parametrize("axis", AXES, ids=NAMES)
def test_the_regulator_s_gains_hold_the_robot_with_its_flap_angle_fed_back_too(axis: Axis) -> None:
    """Of the design's weights: 2 cm, 0.3 m/s, 5 degrees, 2 rad/s and 0.1 rad of flaps cost one each."""
    robot = robot_of(CONFIG)
    Phi, Gamma = held(*dynamics(axis, robot), STEP_S)
    units = {"position": 0.02, "velocity": 0.3, "angle": radians(5.0), "rate": 2.0}
    Q = np.diag([*(units[state] ** -2 for state in axis.states), 0.0])
    P = solve_discrete_are(Phi, Gamma[:, :1], Q, [[100.0]])
    K = np.linalg.solve(100.0 + Gamma[:, :1].T @ P @ Gamma[:, :1], Gamma[:, :1].T @ P @ Phi)[0]
    n = len(axis.states)
    gains = by_regulator(axis, robot)
    assert gains[:n] == pytest.approx(K[:n], rel=1e-6)
    assert gains[n:].tolist() == pytest.approx([K[0] / 3.0] * (len(axis.gains) - n))


def test_loops_that_bear_less_delay_than_poses_have_are_refused_in_one_line() -> None:
    one: Any = SimpleNamespace(axis=ROLL, least=SimpleNamespace(delay=0.020), least_late=0.015)
    other: Any = SimpleNamespace(axis=YAW, least=SimpleNamespace(delay=0.0141), least_late=0.030)
    tune.refuse_late([one, other], 0.0141)
    with pytest.raises(LabError) as refused:
        tune.refuse_late([one, other], 0.0142)
    assert str(refused.value) == (
        "refused: yaw tolerates 14.1 ms of delay, and poses arrive up to 14.2 ms later than on the mean"
    )
    with pytest.raises(LabError, match=r"^refused: roll, y tolerates 15\.0 ms"):
        tune.refuse_late([one, other], 0.0151)


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_an_input_acts_at_once_at_the_earliest_and_a_tick_later_at_the_latest(axis: Axis) -> None:
    found = [_robot_tick(axis, robot_of(CONFIG) | {DELAY: delay}) for delay in (-0.004, 0.0, 0.01, 0.014)]
    for early, late in (found[:2], found[2:]):
        assert all(np.array_equal(one, other) for one, other in zip(early, late, strict=True))
    (_, before, after, whole), (_, later, rest, _) = found[1:3]
    assert before == pytest.approx(0.0)
    assert after == pytest.approx(whole[:, :1])
    assert rest == pytest.approx(0.0)
    assert later == pytest.approx(whole[:, :1])
