"""The environments: spaces, seeds, agreement of the two fidelities, and what the law on board sees."""

import copy
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from scipy.spatial.transform import Rotation

import hil.research.learn
from ground_station.trajectory import Goal
from hil.config import load_config
from hil.errors import LabError
from hil.research.learn.batch import EstimateErrors, Fleet
from hil.research.learn.envs import REACH, FastEnv, Fidelity, FirmwareEnv, Setup, make_env, make_vec
from hil.research.learn.tasks import PUSHES, TASKS, EpisodeTask, draw_episode
from hil.world.floaty.plant import Plant
from hil.world.servos import next_period_us
from hil.world.tunnel import GUST_RMS

STILL = ["tunnel.turbulence=none"]


def actions(count: int, size: float) -> np.ndarray:
    """Actions (count, 4) that change every 50 ms, the same in every test."""
    rng = np.random.default_rng(7)
    return np.repeat(rng.uniform(-size, size, (-(-count // 5), 4)), 5, axis=0)[:count].astype(np.float32)


@pytest.mark.long
@pytest.mark.parametrize("fidelity", ["fast", "firmware"])
@pytest.mark.parametrize("task", TASKS)
def test_gymnasium_s_checker_passes(task: str, fidelity: str) -> None:
    env = gymnasium.make(f"floaty/{task}-v0", fidelity=fidelity, duration_s=0.5)
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.parametrize("fidelity", ["fast", "firmware"])
def test_both_fidelities_take_four_actions_and_show_twenty_numbers(fidelity: Fidelity) -> None:
    env = make_env("Hover", fidelity, render_mode=None)
    assert env.observation_space == Box(-REACH, REACH, (20,), np.float32)
    assert env.action_space == Box(-1.0, 1.0, (4,), np.float32)
    env.close()
    assert make_vec("Hover", 2, render_mode=None).single_action_space == env.action_space


def test_stable_baselines_checker_passes() -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker")
    for fidelity in ("fast", "firmware"):
        checker.check_env(make_env("Hover", fidelity, duration_s=0.5))


@pytest.mark.long
@pytest.mark.parametrize("task", TASKS)
def test_both_fidelities_fly_alike_in_open_loop_from_the_same_seed(task: str) -> None:
    """In calm air, for a second: 2 mm, 0.02 m/s and 10 mrad; rewards within 0.02."""
    settings: Any = {"duration_s": 1.0, "overrides": STILL}
    fast, whole = make_env(task, "fast", **settings), make_env(task, "firmware", **settings)
    assert isinstance(fast, FastEnv)
    assert isinstance(whole, FirmwareEnv)
    fast.reset(seed=11)
    whole.reset(seed=11)
    for action in actions(100, 0.25):
        mine, theirs = fast.step(action), whole.step(action)
        assert whole.flight is not None
        plant = whole.flight.robot.body
        flown = fast.truth.body.fields
        np.testing.assert_allclose(flown.p_WB, plant.p_WB, atol=0.002)
        np.testing.assert_allclose(flown.v_WB, plant.v_WB, atol=0.02)
        np.testing.assert_allclose(flown.q_WB, plant.q_WB, atol=0.005)
        assert mine[1] == pytest.approx(theirs[1], abs=0.02)
        assert mine[2:4] == theirs[2:4]
    assert mine[3], "the episode is over after 100 steps"
    whole.close()


@pytest.mark.long
def test_the_law_on_board_sees_what_the_environment_returns() -> None:
    env = make_env("Track", "firmware", duration_s=0.5)
    assert isinstance(env, FirmwareEnv)
    observation, _ = env.reset(seed=5)
    for action in actions(20, 0.2):
        following = env.step(action)[0]
        assert env._blocks is not None
        memory: Any = env._blocks.named["controller_memory"].fields
        np.testing.assert_array_equal(memory.seen, observation)
        np.testing.assert_array_equal(memory.action, action)
        np.testing.assert_array_equal(following[16:], action)
        observation = following
    env.close()


@pytest.mark.long
@pytest.mark.parametrize("fidelity", ["fast", "firmware"])
def test_the_same_seed_gives_the_same_bytes(fidelity: str) -> None:
    def flown(seed: int) -> bytes:
        env = make_env("Push", fidelity, duration_s=0.3)  # type: ignore[arg-type]
        rows = [env.reset(seed=seed)[0]]
        for action in actions(30, 0.3):
            observation, reward, *_ = env.step(action)
            rows += [observation, np.array([reward])]
        env.close()
        return b"".join(row.tobytes() for row in rows)

    assert flown(3) == flown(3)
    assert flown(3) != flown(4)


def test_a_copy_flies_on_from_the_same_state_apart_from_its_original() -> None:
    env = gymnasium.make_vec("floaty/Push-v0", num_envs=2)
    env.reset(seed=1)
    twin = copy.deepcopy(env)
    flown = [[one.step(np.tile(action, (2, 1)))[0] for action in actions(20, 0.2)] for one in (env, twin)]
    np.testing.assert_array_equal(*flown)
    own, other = (
        [*one._memory, one._draws, one._sensing.memory]
        for one in (env.unwrapped._fleet, twin.unwrapped._fleet)
    )  # type: ignore[attr-defined]
    assert not any(map(np.shares_memory, own, other))


def test_a_row_of_many_robots_flies_as_the_seed_of_its_own() -> None:
    """Starts, paths and pushes; the gusts of many are one stream."""
    many = gymnasium.make_vec("floaty/Track-v0", num_envs=3, overrides=STILL)
    many.reset(seed=0)
    alone = make_env("Track", overrides=STILL)
    assert isinstance(alone, FastEnv)
    alone.reset(seed=2)
    for action in actions(30, 0.2):
        many.step(np.tile(action, (3, 1)))
        alone.step(action)
    one, other = many.unwrapped._fleet.truth(2).body.fields, alone.truth.body.fields  # type: ignore[attr-defined]
    for found, expected in ((one.p_WB, other.p_WB), (one.q_WB, other.q_WB), (one.v_WB, other.v_WB)):
        np.testing.assert_array_equal(found, expected)


def test_a_lost_robot_ends_its_episode_and_begins_another_in_the_same_step() -> None:
    many = gymnasium.make_vec("floaty/Hover-v0", num_envs=4, duration_s=5.0)
    many.reset(seed=1)
    full = np.ones((4, 4), np.float32)
    for _ in range(500):
        observations, _, lost, late, info = many.step(full)
        if lost.any():
            break
    assert lost.any()
    assert not (lost & late).any()
    for n in np.flatnonzero(lost):
        assert abs(info["final_obs"][n]).max() > abs(observations[n]).max()
        assert not observations[n, 16:].any(), "a new episode has no previous action"
    for n in np.flatnonzero(~lost):
        np.testing.assert_array_equal(info["final_obs"][n], observations[n])


@pytest.mark.parametrize("fidelity", ["fast", "firmware"])
@pytest.mark.parametrize("action", [[0.0, 0.0, math.nan, 0.0], [0.0, math.inf, 0.0, 0.0], [0.0, 0.0, 0.0]])
def test_an_action_that_is_not_four_finite_numbers_is_refused(fidelity: str, action: list[float]) -> None:
    env = make_env("Hover", fidelity, duration_s=0.07)  # type: ignore[arg-type]
    env.reset(seed=1)
    with pytest.raises(LabError, match="expected 1 x 4 finite numbers"):
        env.step(np.array(action, np.float32))


@pytest.mark.parametrize("fidelity", ["fast", "firmware"])
def test_an_episode_is_truncated_after_its_duration(fidelity: str) -> None:
    env = make_env("Hover", fidelity, duration_s=0.07)  # type: ignore[arg-type]
    env.reset(seed=1)
    ends = [env.step(np.zeros(4, np.float32))[2:4] for _ in range(7)]
    assert ends == [(False, False)] * 6 + [(False, True)]
    env.close()


def test_episodes_of_many_robots_that_follow_one_another_are_of_equal_length() -> None:
    many = gymnasium.make_vec("floaty/Hover-v0", num_envs=2, duration_s=0.07)
    many.reset(seed=1)
    ends = [step for step in range(1, 22) if many.step(np.zeros((2, 4), np.float32))[3].all()]
    assert ends == [7, 14, 21]


def test_a_loss_in_the_last_step_is_no_truncation() -> None:
    def until_lost(duration_s: float) -> tuple[int, bool, bool]:
        many = gymnasium.make_vec("floaty/Hover-v0", num_envs=1, duration_s=duration_s)
        many.reset(seed=1)
        for step in range(1, 500):
            _, _, lost, late, _ = many.step(np.ones((1, 4), np.float32))
            if lost.any() or late.any():
                return step, bool(lost[0]), bool(late[0])
        raise AssertionError("not lost")

    steps, *_ = until_lost(5.0)
    assert until_lost(0.01 * steps) == (steps, True, False)


@pytest.mark.parametrize("many", [False, True])
def test_observations_stay_within_their_space_however_wrong_the_estimate(many: bool) -> None:
    errors = EstimateErrors(position=1e3, velocity=1e3, attitude=1e3, rate=1e3)
    made = (
        gymnasium.make_vec("floaty/Hover-v0", num_envs=2, errors=errors)
        if many
        else make_env("Hover", errors=errors)
    )
    made.reset(seed=1)
    found = [made.step(np.zeros((2, 4) if many else 4, np.float32))[0] for _ in range(20)]
    assert all(made.observation_space.contains(one) for one in found)
    assert np.abs(found).max() == REACH.max(), "a bound was reached"


@pytest.mark.parametrize("fidelity", ["fast", "firmware"])
def test_a_step_is_rewarded_for_the_truth_at_its_end(fidelity: str) -> None:
    """Distance, tilt and yaw of the goal at that instant, and the change of the limited action, by scipy's rotations."""
    env = make_env("Hover", fidelity, duration_s=0.5)  # type: ignore[arg-type]
    env.reset(seed=3)
    before, goal = np.zeros(4), Goal(tuple(load_config().flight.home), 0.0)
    for action in actions(12, 0.5):
        seen, reward, *_ = env.step(action)
        if isinstance(env, FastEnv):
            body: Any = env.truth.body.fields
        else:
            assert env.flight is not None
            body, now_us = env.flight.robot.body, env.flight.now_us
            env.flight.robot.advance_truth(now_us)  # changes nothing: it is there
            goal = env.flight.line.trajectory.at(now_us)
        np.testing.assert_array_equal(seen[16:], action)
        R = Rotation.from_quat(np.roll(body.q_WB, -1))
        far, tilt = math.dist(body.p_WB, goal.p_WG), math.acos(R.as_matrix()[2, 2])
        yaw = float(R.as_euler("ZYX")[0]) - goal.yaw
        parts = [
            weight / (1.0 + (x / scale) ** 2)
            for weight, x, scale in ((0.6, far, 0.03), (0.2, tilt, 0.15), (0.2, yaw, 0.2))
        ]
        assert reward == pytest.approx(sum(parts) - 0.005 * ((action - before) ** 2).sum(), rel=1e-9)
        before = np.array(action, float)
    env.close()


@pytest.mark.long
@pytest.mark.parametrize("fidelity", ["fast", "firmware"])
def test_actions_are_limited_and_forgotten_at_a_reset(fidelity: str) -> None:
    limited, wild = (make_env("Hover", fidelity, duration_s=0.5) for _ in range(2))  # type: ignore[arg-type]
    for env in (limited, wild):
        env.reset(seed=1)
    for _ in range(3):
        expected, reward, *_ = limited.step(np.array((1.0, -1.0, 1.0, 0.5), np.float32))
        found, same, *_ = wild.step(np.array((5.0, -3.0, 1.01, 0.5), np.float32))
        assert (found.tobytes(), same) == (expected.tobytes(), reward)
    assert not wild.reset(seed=1)[0][16:].any()
    for env in (limited, wild):
        env.close()


@pytest.mark.long
def test_a_push_of_the_fast_model_acts_from_its_instant_on_for_a_tenth_of_a_second() -> None:
    env = make_env("Push", overrides=STILL)
    assert isinstance(env, FastEnv)
    for seed in (1, 2, 3):
        env.reset(seed=seed)
        drawn = env._fleet._memory[-1]["pushes"][0].T
        for action in np.zeros((700, 4), np.float32):
            begin_us = round(env.truth.body.fields.time_us)
            env.step(action)
            expected = np.zeros(6)
            for at_s, kind, size in drawn:
                if 0 <= begin_us - round(1e6 * at_s) < 100_000:
                    expected[int(kind)] = size
            np.testing.assert_array_equal(env.truth.body.fields.push, expected)


def test_flaps_follow_a_command_from_the_first_period_that_begins_a_millisecond_after_the_step() -> None:
    env = make_env("Hover", overrides=STILL)
    assert isinstance(env, FastEnv)
    env.reset(seed=1)
    for action in actions(12, 0.2):
        now_us, before = round(env.truth.body.fields.time_us), env.truth.flaps.fields
        env.step(action)
        after, angle = env.truth.flaps.fields, before.angle.copy()
        waits_s = 1e-6 * (next_period_us(now_us + 1000) - now_us)
        for command, lasts_s in ((before.command, waits_s), (after.command, 0.01 - waits_s)):
            error = command + after.trim - angle
            left = np.maximum(np.abs(error) * np.exp(-lasts_s / after.lag), after.dead_band)
            angle = np.where(
                np.abs(error) > after.dead_band, command + after.trim - np.copysign(left, error), angle
            )
        assert after.angle == pytest.approx(angle, abs=1e-9)


def test_every_draw_of_an_episode_is_a_number_of_its_own() -> None:
    task = EpisodeTask("t", "", (1.0, 2.0, 3.0), (4.0, 5.0, 6.0, 7.0), (0.1, 0.3), (1.0,) * 6)
    share: list[np.ndarray] = []

    def numbers(count: int) -> np.ndarray:
        share.append(np.linspace(0.02, 0.98, count))
        return share[0]

    one = draw_episode(task, SimpleNamespace(random=numbers), 9.0)  # type: ignore[arg-type]
    unit = [
        (one.start / task.start + 1.0) / 2.0, (one.amplitude / task.path + 1.0) / 2.0, (one.frequency_hz - 0.1) / 0.2,
    ]  # fmt: skip
    assert np.concatenate(unit) == pytest.approx(share[0][:11])
    assert (one.push_size + 1.0) / 2.0 == pytest.approx(share[0][-1 - PUSHES : -1])
    assert (one.push_at / 3.0 - np.arange(3) - 0.2) / 0.5 == pytest.approx(share[0][11:14], abs=0.01), (
        "of three thirds"
    )
    assert one.push_kind.tolist() == (6 * share[0][14:17]).astype(int).tolist()
    assert one.robot == share[0][-1]


def test_an_age_of_the_pose_delays_the_observation_of_the_cameras_alone() -> None:
    quiet: Any = {"overrides": STILL, "errors": hil.research.learn.EstimateErrors(0.0, 0.0, 0.0, 0.0)}
    now, late = make_env("Hover", **quiet), make_env("Hover", pose_delay_us=46_000, **quiet)  # five steps
    assert isinstance(now, FastEnv)
    home = load_config().flight.home
    seen = {env: [env.reset(seed=2)[0]] for env in (now, late)}
    for action in actions(40, 0.3):
        rates = now.truth.body.fields.omega_B.copy()
        steps = {env: env.step(action) for env in seen}
        for env, rows in seen.items():
            rows.append(steps[env][0])
        assert steps[now][1] == steps[late][1], "the reward is of the truth"
        body, flaps = (block.fields for block in (now.truth.body, now.truth.flaps))
        yaw, pitch, roll = Rotation.from_quat(body.q_WB, scalar_first=True).as_euler("ZYX")
        assert seen[now][-1][2] == pytest.approx(home[2] - body.p_WB[2], abs=1e-6)
        expected = (roll, pitch, -yaw, *(rates + body.omega_B) / 2, *(flaps.angle - flaps.hover))
        assert seen[now][-1][6:16] == pytest.approx(np.array(expected), abs=2e-6)
    fresh, old = np.array(seen[now]), np.array(seen[late])
    np.testing.assert_array_equal(old[5:, :9], fresh[:-5, :9])
    np.testing.assert_array_equal(old[:5, :9], fresh[[0] * 5, :9])
    np.testing.assert_array_equal(old[:, 9:], fresh[:, 9:])


def test_the_fast_model_shows_distance_and_velocity_along_its_heading_each_with_its_own_error() -> None:
    quiet: Any = {"overrides": STILL, "errors": EstimateErrors(0.0, 0.0, 0.0, 0.0)}
    env = make_env("Track", **quiet)
    assert isinstance(env, FastEnv)
    env.reset(seed=11)
    amplitude, hertz = env._fleet._memory[-1]["path"][0]
    home = np.array([*load_config().flight.home, 0.0])
    errors, lasting = 0.01 * np.array([3, -5, 7, 2, 11, -4, 1, 6, -8]), env._fleet._sensing.fields.lasting
    for action in actions(60, 0.3):
        env._fleet.agents["errors"][0, :9] = errors / lasting
        seen, body = env.step(action)[0], env.truth.body.fields
        goal = home + amplitude * np.sin(2e-6 * np.pi * hertz * body.time_us)
        yaw, pitch, roll = Rotation.from_quat(body.q_WB, scalar_first=True).as_euler("ZYX") + errors[:5:-1]
        seen_W = [goal[:3] - body.p_WB - errors[:3], body.v_WB + errors[3:6]]
        expected = Rotation.from_euler("Z", yaw).apply(seen_W, inverse=True)
        assert seen[6:9] == pytest.approx([roll, pitch, goal[3] - yaw], abs=2e-6)
        assert seen[:6].reshape(2, 3) == pytest.approx(expected, abs=2e-6)
    assert abs(goal[3]) > 0.1


def test_errors_of_the_estimate_have_their_sizes_from_the_start_on_and_last_their_time() -> None:
    """As the difference from a flight without errors: of 300 robots after each of 40 steps."""
    errors = hil.research.learn.EstimateErrors(0.002, 0.03, 0.005, 0.07, tau_s=0.08)
    rows = []
    for one in (errors, hil.research.learn.EstimateErrors(0.0, 0.0, 0.0, 0.0)):
        many = gymnasium.make_vec("floaty/Hover-v0", num_envs=300, overrides=STILL, errors=one)
        seen = [many.reset(seed=3)[0]]
        seen += [many.step(np.zeros((300, 4), np.float32))[0] for _ in range(40)]
        rows.append(np.array(seen)[:, :, :12].reshape(41, 300, 4, 3))
    error = rows[0] - rows[1]
    sizes = np.sqrt((error**2).mean(axis=(1, 3)))
    for at in (sizes[0], sizes[1:].mean(axis=0)):
        assert at == pytest.approx((0.002, 0.03, 0.005, 0.07), rel=0.08)
    kept = (error[8:] * error[:-8]).mean(axis=(0, 1, 3)) / (error**2).mean(axis=(0, 1, 3))
    assert kept == pytest.approx((*3 * (math.exp(-1.0),), 0.0), abs=0.05)


def test_each_robot_flies_in_the_gusts_of_its_own_tunnel_which_stay_as_strong_as_they_begin() -> None:
    board, unused = load_config(), np.random.default_rng(1)
    tunnels = [load_config("floaty", [f"tunnel.turbulence={level}"]) for level in ("none", "T1")]
    worlds = [
        Plant(one.geometry, one.plant, one.tunnel, one.actuators, unused, one.flight.home) for one in tunnels
    ]
    fleet, rng = Fleet(board, worlds, 400, 0, EstimateErrors()), np.random.default_rng(2)
    episode = draw_episode(TASKS["Hover"], rng, 1.0)
    for n in range(400):
        fleet.begin(n, replace(episode, robot=0.25 + 0.5 * (n % 2)), rng)
    for _ in range(2):
        gusts = np.array([fleet.truth(n).air.fields.gusts for n in range(400)])
        assert not gusts[::2].any()
        assert np.sqrt((gusts[1::2] ** 2).mean(axis=0)) == pytest.approx(GUST_RMS["T1"], rel=0.2)
        for _ in range(50):
            fleet.advance(np.zeros((400, 4), np.float32), rng)


@pytest.mark.long
def test_robots_are_drawn_from_the_campaign_s_distributions_in_both_fidelities() -> None:
    options: Any = {"robots": "table", "robot_count": 5, "overrides": STILL, "duration_s": 0.2}
    fast, whole = make_env("Hover", "fast", **options), make_env("Hover", "firmware", **options)
    assert isinstance(fast, FastEnv)
    assert isinstance(whole, FirmwareEnv)
    lags = set()
    for seed in range(8):
        fast.reset(seed=seed)
        whole.reset(seed=seed)
        assert whole.flight is not None
        lags.add(lag := float(fast.truth.flaps.fields.lag))
        assert lag == whole.flight.config.actuators.tau
        assert 0.040 <= lag <= 0.060
    assert 2 < len(lags) <= 5
    whole.close()


def test_every_robot_is_another_point_of_its_campaign_and_the_user_s_settings_come_last(
    tmp_path: Path,
) -> None:
    """Each point of this campaign is flown by two seeds."""
    (tmp_path / "robots.toml").write_text(
        'experiments = ["hover"]\nflights = 2\nseeds = 2\n[parameters]\n"actuators.tau" = { uniform = [0.04, 0.06] }\n'
    )
    setup = Setup(robots=str(tmp_path / "robots.toml"), robot_count=5, overrides=["actuators.tau=0.07"])
    found = setup.settings()
    assert len(set(found)) == len(found) == 5
    assert {load_config("floaty", one).actuators.tau for one in found} == {0.07}


@pytest.mark.long
def test_faults_act_in_the_laboratory() -> None:
    env = make_env("Hover", "firmware", duration_s=1.0, faults=["servo.stuck.2@0.1"])
    assert isinstance(env, FirmwareEnv)
    env.reset(seed=1)
    for action in actions(60, 0.5):
        env.step(action)
    assert env.flight is not None
    assert env.flight.robot.body.servo_speed.tolist() == [1.0, 0.0, 1.0, 1.0]
    env.close()


@pytest.mark.long
def test_the_errors_of_the_fast_model_are_those_of_the_laboratory_s_hover(tmp_path: Path) -> None:
    """Within a factor of two, for position, velocity, attitude and rates."""
    run = hil.fly("hover", duration_s=5.0, seed=3, folder=tmp_path / "run")
    frame = run.to_pandas()[lambda rows: rows["flight.free"] > 0]
    goal = frame[["goal.x", "goal.y", "goal.z"]].to_numpy()
    groups = {"position": "x y z", "velocity": "vx vy vz", "rate": "p q r"}
    errors = hil.research.learn.EstimateErrors()
    for name, columns in groups.items():
        truth = frame[[f"truth.{one}" for one in columns.split()]].to_numpy()
        found = frame[[f"estimate.{one}" for one in columns.split()]].to_numpy() + (
            goal if name == "position" else 0.0
        )
        if name == "rate":  # the gyro's mean of a step
            truth = (truth + np.roll(truth, 1, axis=0)) / 2
        rms = float(np.sqrt(np.mean((found - truth)[1:] ** 2)))
        assert (
            0.5 < rms / getattr(errors, name) < 4.0
            if name == "rate"
            else 0.5 < rms / getattr(errors, name) < 2.0
        )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "Hoover"}, "task 'Hoover': unknown; did you mean Hover?"),
        ({"task": "Hover", "fidelity": "slow"}, "fidelity = 'slow': expected fast or firmware"),
        (
            {"task": "Hover", "profile": "crazyflie"},
            "profile = 'crazyflie': its body is crazyflie; only floaty has",
        ),
        ({"task": "Hover", "duration_s": 0.0}, "duration_s = 0.0: expected seconds, above 0 and up to 3600"),
        ({"task": "Hover", "pose_delay_us": 130_000}, "pose_delay_us = 130000: expected 0..120000"),
        ({"task": "Hover", "robots": "tabel"}, "campaign 'tabel': neither the name of a campaign"),
        ({"task": "Hover", "robot_count": 0}, "robot_count = 0: expected 1 or more"),
        ({"task": "Hover", "profile": "nosuch"}, "profile 'nosuch'"),
        ({"task": "Hover", "faults": ["mocap.dropout@1"]}, 'need fidelity="firmware"'),
        ({"task": "Hover", "durations": 3}, "unknown argument 'durations'; did you mean duration_s?"),
        ({"task": "Hover", "duration_s": "5"}, "duration_s = '5': expected a number"),
        ({"task": "Hover", "robots": 3}, "robots = 3: expected text"),
        ({"task": "Hover", "errors": None}, "errors = None: expected a EstimateErrors"),
        ({"task": "Hover", "fidelity": "firmware", "pose_delay_us": 90_000}, 'need fidelity="fast"'),
        (
            {"task": "Hover", "fidelity": "firmware", "errors": hil.research.learn.EstimateErrors(tau_s=1.0)},
            'need fidelity="fast"',
        ),
        ({"task": "Hover", "num_envs": 0}, "num_envs = 0: expected 1 or more"),
    ],
)
def test_bad_input_is_one_line(arguments: dict[str, Any], message: str) -> None:
    make = hil.research.learn.envs.make_vec if "num_envs" in arguments else make_env
    with pytest.raises(LabError) as refused:
        make(**arguments)
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("wrong", [{"position": -0.1}, {"rate": float("nan")}, {"tau_s": 0.0}])
def test_errors_that_no_estimate_can_have_are_one_line(wrong: dict[str, float]) -> None:
    with pytest.raises(LabError, match="expected sizes of 0 or more, and tau_s above 0"):
        hil.research.learn.EstimateErrors(**wrong)


def test_a_step_before_the_reset_is_refused() -> None:
    with pytest.raises(gymnasium.error.ResetNeeded, match="call reset first"):
        make_env("Hover", "firmware").step(np.zeros(4, np.float32))


@pytest.mark.long
def test_a_step_after_the_loss_is_refused() -> None:
    env = make_env("Hover", "firmware")
    env.reset(seed=1)
    lost = False
    for _ in range(999):
        _, _, lost, _, _ = env.step(np.zeros(4, np.float32))
        if lost:
            break
    assert lost, "nothing controls it"
    with pytest.raises(gymnasium.error.ResetNeeded, match="ends with the robot's loss"):
        env.step(np.zeros(4, np.float32))
