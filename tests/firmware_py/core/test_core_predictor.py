"""Delay compensation: a pose of any age that the history reaches ends in the same estimate of now.

Truth here is the model itself, in float64 by scipy's matrix exponential; poses are samples of it, some time old.
"""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from firmware_py.core.predictor import QUIET_TICKS
from firmware_py.core.structs import HORIZON_LIMIT, POSE_INVALID, POSE_ON_TIME, POSE_TOO_OLD
from support.core_bench import LEVEL, Core, Vector, counts, quaternion, turned
from support.paper_model import model

TICK_US = 10_000


def no_couplings(core: Core) -> Core:
    """Make the model a pure integrator, so that constant velocities are its motions."""
    for name in core.parameters.memory.dtype.names:
        if name.startswith(("roll_", "y_", "pitch_", "x_", "yaw_", "z_")):
            core.parameters.memory[name] = 0.0
    return core


VELOCITY = np.array([0.4, -0.3, 0.2])
YAW_RATE = 1.5


def glide(core: Core, ticks: int, age_us: int, first: int = 0, period: int = 2) -> None:
    """Feed a motion of constant velocity and yaw rate that is at the origin at time 0; poses are `age_us` old."""
    for tick in range(first, first + ticks):
        t = (tick + 1) * 0.01 - age_us * 1e-6
        if tick % period == 0:
            core.pose(VELOCITY * t, quaternion(yaw=YAW_RATE * t), age_us)
        core.tick(counts((0, 0, YAW_RATE)))


def glide_error(core: Core, ticks: int) -> tuple[float, float]:
    """Return the error of position [m] and yaw [rad] at now, `ticks` after the start."""
    p = VELOCITY * ticks * 0.01
    yaw = turned(core.now[8] - YAW_RATE * ticks * 0.01)
    return float(np.linalg.norm(core.now[:3] - p)), abs(float(yaw))


@pytest.mark.parametrize("predict", [0, 1])
def test_the_age_that_is_reported_is_the_poses_own_whether_it_is_used_or_not(predict: int) -> None:
    core = Core(predict=predict)
    glide(core, 20, 44_000)
    assert int(core.fields.pose_age_us) == 44_000


@pytest.mark.long
@pytest.mark.parametrize("age_us", [20_000, 40_000, 120_000])
def test_without_prediction_the_estimate_lags_by_the_age(age_us: int) -> None:
    core = no_couplings(Core(predict=0))
    glide(core, 300, age_us)
    position, yaw = glide_error(core, 300)
    assert position == pytest.approx(np.linalg.norm(VELOCITY) * age_us * 1e-6, rel=0.05)
    assert yaw == pytest.approx(YAW_RATE * age_us * 1e-6, rel=0.1)
    assert core.fields.horizon == 0
    assert core.fields.filtered_tick == core.fields.tick
    assert (core.now == core.x).all()


def commands(tick: int) -> Vector:
    """Return flap deviations that excite all four inputs."""
    t = 0.01 * tick
    u = 0.03 * np.sin([2.0 * t, 3.1 * t + 1, 0.7 * t, 0.5 * t + 2]) * [1, 0.5, 2, 3]
    return np.array([[1, 1, -1, -1], [1, -1, -1, 1], [-1, -1, -1, -1], [-1, 1, -1, 1]]) @ u


def true_motion(ticks: int, steps: int = 10) -> Vector:
    """Return the model's states in G every millisecond from rest, as yaw turns the horizontal forces."""
    A, B = model()
    both = np.zeros((20, 20))
    both[:16, :16], both[:16, 16:] = A, B
    step = expm(both * 0.01 / steps)
    x, out = np.zeros(16), [np.zeros(16)]
    for k in range(ticks * steps):
        c, s = math.cos(x[8]), math.sin(x[8])
        R = np.array([[c, s], [-s, c]])
        y = x.copy()
        y[0:2], y[3:5] = R @ x[0:2], R @ x[3:5]
        y = step[:16] @ np.concatenate([y, commands(k // steps)])
        y[0:2], y[3:5] = R.T @ y[0:2], R.T @ y[3:5]
        x = y
        out.append(x)
    return np.array(out)


TRUTH = true_motion(400)


@pytest.mark.long
@pytest.mark.parametrize("age_us", [0, 17_000, 40_000, 80_000, 120_000])
def test_prediction_follows_the_model_through_the_buffered_commands(age_us: int) -> None:
    core, worst = Core(), np.zeros(16)
    for tick in range(400):
        t_ms = (tick + 1) * 10 - age_us // 1000
        if tick % 2 == 0 and t_ms >= 0:
            x = TRUTH[t_ms]
            core.pose(x[:3], quaternion(*x[6:9]), age_us)
        core.tick(counts(TRUTH[tick * 10 + 10][9:12], 10), 10, commands(tick))
        if tick > 100:
            worst = np.maximum(worst, np.abs(core.now - TRUTH[tick * 10 + 10]))
    assert np.abs(TRUTH[1000:]).max(axis=0)[[0, 1, 3, 4, 6, 7]].min() > 0.02  # there is something to predict
    assert worst[0:3].max() < 2e-3
    assert worst[3:6].max() < 0.02
    assert worst[6:9].max() < 5e-3
    assert worst[9:12].max() < 5e-3
    assert worst[12:16].max() < 2e-3


def test_pose_older_than_the_history_is_dropped_and_counted() -> None:
    core = Core()
    glide(core, 300, 40_000)
    before = core.counters
    for age_us in (125_000, 200_000, 2**31 - 1):
        assert core.pose((0, 0, 0), LEVEL, age_us) == POSE_TOO_OLD
        core.tick(counts((0, 0, YAW_RATE)))
    assert core.counters == before | {"too_old": before["too_old"] + 3}


def test_pose_without_age_counts_as_40_ms_old() -> None:
    told, untold = Core(), Core()
    for core, age_us in ((told, 40_000), (untold, -1)):
        for tick in range(50):
            core.pose((0.001 * tick, 0, 0), LEVEL, age_us)
            core.tick()
    assert told.counters["fused"] > 40
    assert told.estimator.bytes() == untold.estimator.bytes()


ages = st.lists(st.integers(0, 4), min_size=30, max_size=60)


@pytest.mark.long
@settings(deadline=None, max_examples=60)
@given(ages)
def test_estimate_of_the_past_does_not_depend_on_when_a_pose_came_in(late: list[int]) -> None:
    """Poses that arrive early, late, in bursts and out of order end in the same bits as poses that are 40 ms old."""
    regular, shuffled = Core(), Core()
    arrivals: dict[int, list[int]] = {}
    for instant, delay in enumerate(late):  # the pose of tick `instant` arrives up to the horizon later
        arrivals.setdefault(max(instant + delay, 5), []).insert(0, instant)
    for tick in range(5, len(late) + 5):
        instants = {regular: [tick - 4], shuffled: arrivals.get(tick, [])}
        for core, wanted in instants.items():
            while core.fields.tick < tick - 1:
                core.tick()
            for instant in wanted:
                if 0 < instant < len(late) and instant > core.fields.filtered_tick:
                    p = (0.01 * math.sin(instant), 0.01 * math.cos(instant), 0)
                    assert core.pose(p, LEVEL, (tick - instant) * TICK_US) == POSE_ON_TIME
            core.tick()
        if tick > 6:
            assert regular.fields.filtered_tick == shuffled.fields.filtered_tick == tick - 4
    assert regular.fields.fused > 20
    assert (regular.x == shuffled.x).all()
    assert (regular.P == shuffled.P).all()


@pytest.mark.long
@given(st.integers(0, 124_999))
@example(124_999)
@settings(deadline=None)
def test_pose_waits_at_the_tick_nearest_to_its_instant(age_us: int) -> None:
    core = Core()
    glide(core, 20, 120_000)  # the longest horizon
    core.fields.pose_waiting[:] = 0
    assert core.pose((0, 0, 0), LEVEL, age_us) == POSE_ON_TIME
    tick = round(21 - age_us / TICK_US - 1e-9)
    assert core.fields.pose_waiting[tick % 32]
    assert core.fields.pose_lag[tick % 32] == pytest.approx(age_us * 1e-6 - 0.01 * (21 - tick), abs=1e-8)
    assert core.fields.pose_waiting.sum() == 1


# The horizon


@pytest.mark.long
def test_measured_horizon_follows_an_older_pose_at_once_and_a_younger_one_slowly() -> None:
    core = Core()
    glide(core, 100, 40_000)
    assert core.fields.horizon == 4
    too_old = core.fields.too_old
    glide(core, 10, 80_000, first=100)
    assert core.fields.horizon == 8
    assert core.fields.too_old - too_old <= 4  # while the filter waits
    seen = []
    for part in range(60):
        glide(core, 10, 40_000, first=110 + 10 * part)
        seen.append(int(core.fields.horizon))
    assert seen[0] == 8
    assert seen[-1] == 4
    assert all(0 <= a - b <= 1 for a, b in pairwise(seen))
    assert all(90 <= 10 * seen.count(horizon) <= 110 for horizon in (8, 7, 6, 5))
    assert core.fields.tick - core.fields.filtered_tick == 4


def test_the_horizon_shrinks_by_a_pose_more_than_a_second_after_the_last_old_one() -> None:
    for ticks, horizon in ((QUIET_TICKS, 8), (QUIET_TICKS + 1, 7)):
        core = Core()
        glide(core, 100, 80_000)
        assert (core.fields.horizon, core.fields.quiet_ticks) == (8, 2)
        for _ in range(ticks - 2):
            core.tick()
        core.pose((0, 0, 0), LEVEL, 40_000)
        assert core.fields.horizon == horizon, ticks


@pytest.mark.parametrize(("length", "valid"), [(1.19, True), (1.21, False), (0.81, True), (0.79, False)])
def test_a_quaternion_counts_within_a_fifth_of_its_squared_length(length: float, valid: bool) -> None:
    answer = Core().pose((0, 0, 0), (math.sqrt(length), 0, 0, 0), age_us=0)
    assert (answer == POSE_ON_TIME, answer == POSE_INVALID) == (valid, not valid)


def test_fixed_horizon_ignores_the_age() -> None:
    cores = [Core(age_measured=0, horizon=6) for _ in range(4)]
    for core, age_us in zip(cores, (-1, 0, 40_000, 10**9), strict=True):
        for tick in range(60):
            core.pose((0.001 * tick, 0, 0), LEVEL, age_us)
            core.tick()
    assert cores[0].fields.horizon == 6
    assert cores[0].fields.tick - cores[0].fields.filtered_tick == 6
    assert cores[0].fields.fused > 40
    assert len({core.estimator.bytes() for core in cores}) == 1


@pytest.mark.long
@pytest.mark.parametrize("horizon", [-(2**31), -5, 0, 13, 1000, 2**31 - 1])
@pytest.mark.parametrize("measured", [0, 1])
def test_senseless_horizon_parameter_acts_as_the_nearest_one(horizon: int, measured: int) -> None:
    nearest = Core(age_measured=measured, horizon=min(max(horizon, 1), HORIZON_LIMIT))
    core = Core(age_measured=measured, horizon=horizon)
    for each in (core, nearest):
        for tick in range(60):
            each.pose((0.001 * tick, 0, 0), LEVEL, 30_000)
            each.tick()
    assert core.fields.fused > 40
    assert core.estimator.bytes() == nearest.estimator.bytes()


@pytest.mark.long
def test_a_horizon_that_grows_and_shrinks_neither_loses_nor_repeats_history() -> None:
    """The past is estimated with the same bits as by a filter that waited from the start and goes on to."""
    follows, waits = Core(), Core(horizon=12)
    estimates: dict[Core, dict[int, bytes]] = {follows: {}, waits: {}}
    kept, horizons = True, set()
    for tick in range(600):
        age_us = 110_000 if 120 < tick < 180 else 70_000 if 60 <= tick < 250 else 40_000
        t = (tick + 1) * 0.01 - age_us * 1e-6
        for core, seen in estimates.items():
            if tick % 2 == 0 and t > 0 and (core is follows or kept):  # both get what the first kept
                kept = core.pose(VELOCITY * t, quaternion(yaw=YAW_RATE * t), age_us) == POSE_ON_TIME
            core.tick(counts((0, 0, YAW_RATE)), 10, commands(tick))
            seen[int(core.fields.filtered_tick)] = core.fields.x.tobytes() + core.fields.P.tobytes()
        waits.fields.quiet_ticks = 0
        horizons.add(int(follows.fields.horizon))
    assert follows.counters["too_old"] == 4
    assert (horizons, follows.fields.horizon, waits.fields.horizon) == ({4, 7, 8, 9, 10, 11}, 7, 12)
    common = estimates[follows].keys() & estimates[waits].keys()
    assert len(common) > 570
    assert all(estimates[follows][tick] == estimates[waits][tick] for tick in common)


@pytest.mark.long
@pytest.mark.parametrize(("first", "then"), [(4, 9), (9, 4), (1, 12), (12, 1)])
def test_fixed_horizon_may_change_in_flight(first: int, then: int) -> None:
    """After it has settled, the filter is one that had the new horizon from the start."""
    changed, settled = Core(age_measured=0, horizon=first), Core(age_measured=0, horizon=then)
    for tick in range(400):
        if tick == 150:
            changed.parameters.fields.horizon = then
        for core in (changed, settled):
            t = (tick + 1 - (then if tick >= 150 else int(core.parameters.fields.horizon))) * 0.01
            if tick % 2 == 0:
                core.pose(VELOCITY * t, quaternion(yaw=YAW_RATE * t))
            core.tick(counts((0, 0, YAW_RATE)), 10, commands(tick))
    assert changed.fields.filtered_tick == settled.fields.filtered_tick == 400 - then
    assert changed.now == pytest.approx(settled.now, abs=1e-5)
    assert np.allclose(changed.P, settled.P, rtol=1e-4, atol=1e-9)
    assert changed.counters.get("refused") is None


@pytest.mark.long
def test_predictor_may_be_switched_in_flight() -> None:
    core = no_couplings(Core())
    for part, predict in enumerate((1, 0, 1)):
        core.parameters.fields.predict = predict
        glide(core, 120, 40_000, first=120 * part)
        position, _ = glide_error(core, 120 * (part + 1))
        lag = 0.0 if predict else np.linalg.norm(VELOCITY) * 0.04
        assert position == pytest.approx(lag, abs=2e-3)
    assert "refused" not in core.counters


def test_older_pose_after_a_growth_does_not_shrink_the_horizon() -> None:
    core = Core()
    glide(core, 100, 40_000)
    for tick in range(100, 120):
        age_us = 110_000 if tick % 4 == 0 else 60_000
        t = (tick + 1) * 0.01 - age_us * 1e-6
        if tick % 2 == 0:
            core.pose(VELOCITY * t, quaternion(yaw=YAW_RATE * t), age_us)
        core.tick(counts((0, 0, YAW_RATE)))
        assert core.fields.horizon == 11
    assert core.fields.tick - core.fields.filtered_tick == 11


@pytest.mark.parametrize("default_age_us", [-(2**31), -50_000, 2**31 - 1])
def test_senseless_default_age_files_no_pose_in_the_future(default_age_us: int) -> None:
    core, nearest = (
        Core(default_age_us=default_age_us),
        Core(default_age_us=0 if default_age_us < 0 else 130_000),
    )
    for each in (core, nearest):
        for tick in range(60):
            each.pose((0.001 * tick, 0, 0), LEVEL, -1)
            each.tick()
    assert core.estimator.bytes() == nearest.estimator.bytes()


@pytest.mark.long
def test_horizon_outlasts_a_silence() -> None:
    core = Core()
    glide(core, 100, 40_000)
    for _ in range(500):
        core.tick(counts((0, 0, YAW_RATE)))
    assert core.fields.horizon == 4
    assert core.pose((0, 0, 0), LEVEL, 40_000) == POSE_ON_TIME
