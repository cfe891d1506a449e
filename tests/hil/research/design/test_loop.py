"""The design model: margins against a plant whose margins are known, its predictions against scipy's Lyapunov equation."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import brentq

from hil.config import load_config
from hil.errors import LabError
from hil.research.design.axes import AXES, DELAY, HEIGHT, PITCH, ROLL, STEP_S, Axis, gains_in, robot_of
from hil.research.design.loop import FREQUENCIES, Timing, build
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
