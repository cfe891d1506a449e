"""Environments for gymnasium: one robot in the whole laboratory, or many in the fast model.

Observations and actions are those of `firmware_py.core.observation`, float32; a step is the controller's, 10 ms. An episode
ends when the robot is lost (terminated) or after `duration_s` (truncated).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from firmware_py.core.observation import ACTIONS, OBSERVATIONS
from firmware_py.core_runner import CoreBlocks, CoreRunner, default_runner
from firmware_py.elementary import atan2
from firmware_py.geometry import rotation_matrix, to_euler_zyx, wrap_angle
from ground_station.trajectory import Goal, Offsets, Sine, Trajectory
from hil.board.board_firmware import PythonBoard
from hil.config import DEFAULT_PROFILE, Overrides, load_config, settings_of
from hil.errors import LabError, shown
from hil.laboratory.arguments import checked
from hil.laboratory.experiment import Experiment
from hil.laboratory.faults import Fault
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Request
from hil.pictures.exports.demonstrations import observer
from hil.research.campaigns.config import find_spec, read_spec
from hil.research.campaigns.sampling import draw
from hil.research.learn import batch, law
from hil.research.learn.agent import DELAY_MAX
from hil.research.learn.tasks import (
    AXES,
    PUSH_KINDS,
    PUSH_S,
    Episode,
    EpisodeTask,
    draw_episode,
    find_task,
    reward_of,
)
from hil.world.floaty.plant import Plant
from hil.world.structs import FloatyBlocks

Fidelity = Literal["fast", "firmware"]
JUST_BEFORE_US = 1  # a step ends this long before the controller runs, after the estimator
# Position error and velocity [m, m/s], angles [rad], rates [rad/s], flaps [rad], actions: bounds of a board's estimate.
REACH = np.repeat(np.array([10.0, 20.0, np.pi, 40.0, np.pi, 1.0], np.float32), (3, 3, 3, 3, 4, 4))
OBSERVATION_SPACE = Box(-REACH, REACH, dtype=np.float32)
ACTION_SPACE = Box(-1.0, 1.0, (ACTIONS,), np.float32)
Info = dict[str, Any]


@checked
@dataclass(frozen=True, kw_only=True)
class Setup:
    """The settings of an environment. Raises `LabError` for impossible values."""

    profile: str = DEFAULT_PROFILE  # of the board, and of the robot without `robots`
    overrides: Overrides = ()  # "section.key=value"
    robots: str = ""  # a campaign, by name or path: its parameters are drawn for each episode
    robot_count: int = 100  # total number drawn
    duration_s: float = 10.0
    faults: Sequence[Fault | str] = ()  # of every episode; fidelity firmware only
    pose_delay_us: int = 0  # not compensated by the board; fidelity fast only
    errors: batch.EstimateErrors = field(
        default_factory=batch.EstimateErrors
    )  # of the estimate; fidelity fast only

    def __post_init__(self) -> None:
        if not 0.0 < self.duration_s <= 3600.0:
            raise LabError(f"duration_s = {self.duration_s!r}: expected seconds, above 0 and up to 3600")
        if not 0 <= self.pose_delay_us <= DELAY_MAX * batch.CONTROL_US:
            raise LabError(
                f"pose_delay_us = {self.pose_delay_us!r}: expected 0..{DELAY_MAX * batch.CONTROL_US}"
            )
        if self.robot_count < 1:
            raise LabError(f"robot_count = {self.robot_count!r}: expected 1 or more")

    @property
    def steps(self) -> int:
        """Control steps of an episode."""
        return round(self.duration_s * 1e6 / batch.CONTROL_US)

    def settings(self) -> list[tuple[str, ...]]:
        """Return the settings of every robot that an episode may draw."""
        own = settings_of(self.overrides)
        if not self.robots:
            return [own]
        spec = read_spec(find_spec(self.robots))
        spec = spec.model_copy(update={"flights": self.robot_count * spec.cells})
        drawn = (draw(spec, index * spec.cells).options for index in range(self.robot_count))
        return [(*settings_of(options.get("overrides", ())), *own) for options in drawn]


def _checked(actions: batch.Actions, count: int) -> batch.Actions:
    """Return a copy of actions as (count, 4). Raises `LabError` for numbers of another count, or that are not finite."""
    copied = np.array(actions, np.float32)
    if copied.size != count * ACTIONS or not np.isfinite(copied).all():
        raise LabError(f"action = {shown(actions)}: expected {count} x {ACTIONS} finite numbers")
    return copied.reshape(count, ACTIONS)


def make_env(
    task: str, fidelity: Fidelity = "fast", **setup: Any
) -> gymnasium.Env[batch.Actions, batch.Actions]:
    """Return the environment of a task with one robot; the keywords are those of `Setup`. Raises `LabError`."""
    if fidelity not in ("fast", "firmware"):
        raise LabError(f"fidelity = {fidelity!r}: expected fast or firmware")
    setup.pop("render_mode", None)
    return (FirmwareEnv if fidelity == "firmware" else FastEnv)(find_task(task), Setup(**setup))


def make_vec(task: str, num_envs: int = 1, fidelity: Fidelity = "fast", **setup: Any) -> FastVectorEnv:
    """Return the environment of a task with many robots in one process. Raises `LabError`."""
    if fidelity != "fast":
        raise LabError(
            f'fidelity = {fidelity!r}: many in one process are fast; else vectorization_mode="sync" or "async"'
        )
    if num_envs < 1:
        raise LabError(f"num_envs = {num_envs!r}: expected 1 or more")
    setup.pop("render_mode", None)
    return FastVectorEnv(find_task(task), num_envs, Setup(**setup))


class FastVectorEnv(VectorEnv[batch.Actions, batch.Actions, NDArray[Any]]):
    """Many robots at once; an ended episode is replaced in the same step (`info["final_obs"]` has its last observation)."""

    def __init__(self, task: EpisodeTask, num_envs: int, setup: Setup) -> None:
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = OBSERVATION_SPACE, ACTION_SPACE
        self.observation_space = batch_space(OBSERVATION_SPACE, num_envs)
        self.action_space = batch_space(ACTION_SPACE, num_envs)
        self._task, self._setup = task, setup
        self._fleet = fleet_of(setup, num_envs)
        self._steps = np.zeros(num_envs, np.int64)
        self._streams: list[np.random.Generator] = []

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: Info | None = None
    ) -> tuple[batch.Actions, Info]:
        """Begin all episodes; robot n has the seed + n."""
        seeds = [seed + n for n in range(self.num_envs)] if isinstance(seed, int) else seed
        if seeds is not None or not self._streams:
            self._streams = [seeding.np_random(one)[0] for one in seeds or [None] * self.num_envs]
            self.np_random = self._streams[0].spawn(1)[0]  # for common draws
        for n in range(self.num_envs):
            self._begin(n)
        return self._fleet.agents["observation"].copy(), {}

    def step(
        self, actions: batch.Actions
    ) -> tuple[batch.Actions, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Info]:
        """Advance all robots by 10 ms."""
        limited = _checked(actions, self.num_envs)
        self._fleet.advance(limited, self.np_random)
        observations = np.clip(self._fleet.agents["observation"], -REACH, REACH)
        self._steps += 1
        lost = self._fleet.lost
        late = (self._steps >= self._setup.steps) & ~lost
        info: Info = {}
        if (over := lost | late).any():
            info = {"final_obs": observations.copy(), "_final_obs": over}
            for n in np.flatnonzero(over):
                self._begin(int(n))
            observations[over] = self._fleet.agents["observation"][over]
        return observations, self._fleet.agents["reward"].copy(), lost, late, info

    def _begin(self, n: int) -> None:
        rng = self._streams[n]
        episode = draw_episode(self._task, rng, self._setup.duration_s)
        self._fleet.begin(n, episode, rng)
        self._steps[n] = 0


class FastEnv(gymnasium.Env[batch.Actions, batch.Actions]):
    """One robot in the fast model."""

    def __init__(self, task: EpisodeTask, setup: Setup) -> None:
        self.observation_space, self.action_space = OBSERVATION_SPACE, ACTION_SPACE
        self._task, self._setup = task, setup
        self._fleet = fleet_of(setup, 1)
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[batch.Actions, Info]:
        super().reset(seed=seed)
        episode = draw_episode(self._task, self.np_random, self._setup.duration_s)
        self._fleet.begin(0, episode, self.np_random)
        self._steps = 0
        return self._fleet.agents["observation"][0].copy(), {}

    def step(self, action: batch.Actions) -> tuple[batch.Actions, float, bool, bool, Info]:
        limited = _checked(action, 1)
        self._fleet.advance(limited, self.np_random)
        self._steps += 1
        lost, late = bool(self._fleet.lost[0]), self._steps >= self._setup.steps
        agent = self._fleet.agents[0]
        return np.clip(agent["observation"], -REACH, REACH), float(agent["reward"]), lost, late, {}

    @property
    def truth(self) -> FloatyBlocks:
        """A copy of the plant's memory."""
        return self._fleet.truth(0)


class FirmwareEnv(gymnasium.Env[batch.Actions, batch.Actions]):
    """One robot in the laboratory: emulated board, estimator, radio, cameras, faults. Flies its action as user logic.

    `flight` is the current episode's.
    """

    def __init__(self, task: EpisodeTask, setup: Setup) -> None:
        if setup.pose_delay_us or setup.errors != batch.EstimateErrors():
            raise LabError(
                'pose_delay_us, errors: need fidelity="fast"; the laboratory has its own, and faults'
            )
        self.observation_space, self.action_space = OBSERVATION_SPACE, ACTION_SPACE
        self._task, self._setup = task, setup
        self._robots = setup.settings()
        self._previous, self._observation = np.zeros(ACTIONS, np.float32), np.zeros(OBSERVATIONS, np.float32)
        self._see: Callable[[], object]
        self._blocks: CoreBlocks | None = None
        self.flight: Flight | None = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[batch.Actions, Info]:
        """Boot the board and fly up to the release."""
        super().reset(seed=seed)
        self.close()
        episode = draw_episode(self._task, self.np_random, self._setup.duration_s)
        request = self._request(episode, int(self.np_random.integers(1 << 31)))
        self.flight = lockstep_flight(request, executor=PythonBoard(self._runner))
        self._previous[:] = 0.0
        self._run_until(self.flight.release_us - JUST_BEFORE_US)
        return self._observe(), {}

    def step(self, action: batch.Actions) -> tuple[batch.Actions, float, bool, bool, Info]:
        """Hand the action to the control law, and fly up to its next step."""
        flight = self.flight
        if flight is None or self._blocks is None or flight.robot.body.lost is not None:
            raise gymnasium.error.ResetNeeded("step: call reset first; a flight ends with the robot's loss")
        limited = np.clip(_checked(action, 1)[0], -1.0, 1.0)
        own: Any = self._blocks.named["controller_own"].fields
        own.u1, own.u2, own.u3, own.u4 = limited
        change = float(((limited - self._previous) ** 2).sum())
        self._previous[:] = limited
        self._run_until(flight.now_us + batch.CONTROL_US)
        body, goal = flight.robot.body, flight.line.trajectory.at(flight.now_us)
        distance = math.dist(body.p_WB.tolist(), goal.p_WG)
        x, y, z = rotation_matrix(tuple(body.q_WB.tolist()))[2].tolist()
        yaw = to_euler_zyx(tuple(body.q_WB.tolist()))[2]
        tilt = atan2(math.sqrt(x * x + y * y), z)
        reward = reward_of(distance, tilt, wrap_angle(yaw - goal.yaw), change)
        over = flight.now_us - flight.release_us >= (self._setup.steps - 0.5) * batch.CONTROL_US
        return self._observe(), reward, body.lost is not None, over, {}

    def close(self) -> None:
        if self.flight is not None:
            self.flight.close()
            self.flight = None

    def _run_until(self, us: int) -> None:
        assert self.flight is not None
        self.flight.lab.end_at(us)
        self.flight.lab.run()

    def _observe(self) -> batch.Actions:
        self._see()
        return np.clip(self._observation, -REACH, REACH)

    def _runner(self, blocks: CoreBlocks) -> CoreRunner:
        self._blocks = blocks
        self._see = observer(blocks.parameters, blocks.estimator, self._previous, self._observation)
        return default_runner(blocks)

    def _request(self, episode: Episode, seed: int) -> Request:
        setup, settings = self._setup, self._robots[int(episode.robot * len(self._robots))]
        experiment = Experiment(
            f"learn-{self._task.name}", self._task.summary, setup.duration_s + 0.1, {},
            trajectory=PathOf(episode), faults=pushes_of(episode),
        )  # fmt: skip
        start = ", ".join(map(repr, episode.start.tolist()))
        own = (f"flight.start_offset=[{start}]", f'logic.controller="{Path(law.__file__)}"')
        return Request.of(
            experiment, profile=setup.profile, overrides=(*settings, *own), seed=seed, faults=setup.faults
        )


@dataclass(frozen=True)
class PathOf:
    """Makes the trajectory of an episode."""

    episode: Episode

    def __call__(self, home: Goal, start_us: int) -> Trajectory:
        """Return the goal's path from the release on."""
        signals = zip(AXES, self.episode.amplitude.tolist(), self.episode.frequency_hz.tolist(), strict=True)
        return Offsets(home, start_us, **{axis: Sine(size, hz) for axis, size, hz in signals})


def pushes_of(episode: Episode) -> tuple[Fault, ...]:
    """Return the pushes of an episode as faults."""
    drawn = zip(episode.push_at.tolist(), episode.push_kind.tolist(), episode.push_size.tolist(), strict=True)
    return tuple(Fault(PUSH_KINDS[kind], at, PUSH_S, size) for at, kind, size in drawn if at < np.inf)


def fleet_of(setup: Setup, count: int) -> batch.Fleet:
    """Return the fast robots of a setup. Raises `LabError` for features of the whole laboratory only."""
    if setup.faults:
        raise LabError(f'faults = {setup.faults!r}: need fidelity="firmware"')
    board = load_config(setup.profile, settings_of(setup.overrides))
    if not board.robot.has_plates:
        raise LabError(
            f'profile = {setup.profile!r}: its body is {board.robot.body}; only floaty has fidelity="fast"'
        )
    unused, _ = seeding.np_random(0)  # these plants never advance
    worlds = [
        Plant(world.geometry, world.plant, world.tunnel, world.actuators, unused, world.flight.home)
        for world in (load_config(setup.profile, settings) for settings in setup.settings())
    ]
    return batch.Fleet(board, worlds, count, setup.pose_delay_us, setup.errors)
