"""Many robots in compiled code, one control step of 10 ms at a time: the fast fidelity.

Plant, servo lag, tunnel and gusts are the laboratory's (`hil.world`), in one midpoint step per 10 ms instead of ten. The
board is reduced to its observation, allocation and servo mapping, the core's own functions. Estimator, predictor, cameras
and radio are reduced to a delay of the pose and errors of the estimate, as large as in the laboratory's hover.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.compiling import compiler
from firmware_py.config import parameters_of
from firmware_py.core.guard import allocate
from firmware_py.core.observation import ACTIONS, act, observe
from firmware_py.core.servo import drive_servos
from firmware_py.core.structs import ATTITUDE, FLAP, RATE, Control, Estimator
from firmware_py.core.subset import i32
from hil.arguments import checked
from hil.config import LabConfig
from hil.errors import LabError
from hil.floaty.plant import Plant
from hil.learn.tasks import PUSH_S, PUSHES, Episode
from hil.world.fixed_order import SOURCES, atan2, exp, normal, sine_ahead
from hil.world.motion import evaluate, step
from hil.world.servos import MIDDLE_COUNTS, PERIOD_COUNTS, RAD_PER_COUNT, TIMER_MHZ
from hil.world.structs import GUSTS, STEP_US, Air, Flaps, FloatyBlocks, Rigid

CONTROL_US = 10_000
DELAY_MAX = 12  # control steps
SEEN = 9  # position, velocity in W, and Euler angles, from the cameras
ERRORS = SEEN + 3  # plus the rates, from the gyro
Array = NDArray[np.float64]
compiled = compiler(Path(__file__).parent, *SOURCES)
Actions = NDArray[np.float32]


@checked
@dataclass(frozen=True, slots=True)
class EstimateErrors:
    """Errors of the estimate, rms. Errors of pose and velocity last `tau_s`; those of the rates change in every step.

    Raises `LabError` for values that no estimate can have.
    """

    position: float = 0.0015  # [m]
    velocity: float = 0.025  # [m/s]
    attitude: float = 0.005  # [rad]
    rate: float = 0.025  # [rad/s]
    tau_s: float = 0.05

    def __post_init__(self) -> None:
        sizes = (self.position, self.velocity, self.attitude, self.rate)
        if not (all(0.0 <= size < math.inf for size in sizes) and 0.0 < self.tau_s < math.inf):
            raise LabError(f"{self}: expected sizes of 0 or more, and tau_s above 0")


@compiled
def reward_of(distance: float, tilt: float, yaw_error: float, change: float) -> float:
    """Return the reward of a step, -0.08..1.

    `distance` from the goal [m], `tilt` [rad], `yaw_error` [rad], and the sum of the squared changes of the action.
    """
    near = 1.0 / (1.0 + (distance / 0.03) * (distance / 0.03))
    level = 1.0 / (1.0 + (tilt / 0.15) * (tilt / 0.15))
    turned = 1.0 / (1.0 + (yaw_error / 0.2) * (yaw_error / 0.2))
    return 0.6 * near + 0.2 * level + 0.2 * turned - 0.005 * change


@compiled
def wrapped(angle: float) -> float:
    """Return the same direction in -pi..pi."""
    return angle - 2.0 * math.pi * float(np.rint(angle / (2.0 * math.pi)))


@compiled
def command(body: Rigid, flaps: Flaps, counts: Array, zero_offset: Array) -> None:
    """Latch the timer counts at the next PWM period, at least 1 ms from now for the board's computation."""
    ready_us = body.time_us + STEP_US
    period = math.floor(ready_us * TIMER_MHZ / PERIOD_COUNTS) + 1.0
    flaps.next_us = math.ceil(period * PERIOD_COUNTS / TIMER_MHZ)
    for i in range(4):
        flaps.next[i] = (counts[i] - MIDDLE_COUNTS) * RAD_PER_COUNT - zero_offset[i]


@compiled
def push(body: Rigid, t: float, pushes: Array) -> None:
    """Apply the pushes of this step: rows are times, kinds and sizes."""
    for i in range(6):
        body.push[i] = 0.0
    for i in range(PUSHES):
        if pushes[0, i] <= t < pushes[0, i] + PUSH_S:
            body.push[int(pushes[1, i])] = pushes[2, i]


@compiled
def look(body: Rigid, row: Array) -> None:
    """Write the cameras' measurement: position, velocity in W, and roll, pitch, yaw."""
    R = body.R_WB
    for i in range(3):
        row[i] = body.p_WB[i]
        row[3 + i] = body.v_WB[i]
    row[6] = atan2(R[2, 1], R[2, 2])
    row[7] = atan2(-R[2, 0], math.sqrt(R[0, 0] * R[0, 0] + R[1, 0] * R[1, 0]))
    row[8] = atan2(R[1, 0], R[0, 0])


@compiled
def estimate(
    flaps: Flaps, seen: Array, rates: Array, errors: Array, goal: Array, now: NDArray[np.float32]
) -> None:
    """Write the board's estimated state: in the goal frame, with errors."""
    c, z = sine_ahead(goal[3], 1), sine_ahead(goal[3], 0)
    for part in (0, 3):
        x, y = seen[part] + errors[part], seen[part + 1] + errors[part + 1]
        if part == 0:
            x, y = x - goal[0], y - goal[1]
        now[part] = c * x + z * y
        now[part + 1] = c * y - z * x
        now[part + 2] = seen[part + 2] + errors[part + 2] - (goal[2] if part == 0 else 0.0)
    for i in range(3):
        now[ATTITUDE + i] = seen[6 + i] + errors[6 + i]
        now[RATE + i] = rates[i] + errors[SEEN + i]
    now[ATTITUDE + 2] = wrapped(now[ATTITUDE + 2] - goal[3])
    for i in range(4):
        now[FLAP + i] = flaps.angle[i] - flaps.hover[i]


@compiled
def find_goal(body: Rigid, home: Array, path: Array, goal: Array) -> None:
    """Write the current goal: position in W, yaw."""
    t = body.time_us * 1e-6
    for axis in range(4):
        goal[axis] = home[axis] + path[0, axis] * sine_ahead(2.0 * math.pi * path[1, axis] * t, 0)


@compiled
def tilt_of(x: float, y: float, z: float) -> float:
    """Return the angle between the body's z axis and the vertical [rad], for the vertical (x, y, z) in B."""
    return float(atan2(math.sqrt(x * x + y * y), z))


@compiled
def advance_all(
    bodies: Sequence[Rigid],  # (N,)
    airs: Sequence[Air],
    all_flaps: Sequence[Flaps],
    paths: Array,  # (N, 2, 4): amplitudes and frequencies of the goal
    pushes: Array,  # (N, 3, PUSHES): instants, kinds, sizes
    rings: Array,  # (N, DELAY_MAX + 1, SEEN): the cameras' measurements, the newest at `tick`
    errors: Array,  # (N, ERRORS): of the estimate
    actions: Actions,  # (N, 4)
    previous: Actions,  # (N, 4): overwritten by the actions as limited
    draws: Array,  # (N, GUSTS + ERRORS) unit normal
    constants: Array,  # decay and size of the lasting errors, then the sizes of all ERRORS
    zero_offsets: Array,  # (N, 4) [rad]
    home: Array,  # (4,) of the goal's path: [m] in W, yaw
    tick: int,
    delay: int,
    parameters: Any,
    estimator: Any,
    control: Any,
    observations: Actions,  # (N, 20), written
    rewards: Array,  # (N,), written
) -> None:
    """Advance all robots by one control step, from their actions to their next observations."""
    newest, seen_at = tick % (DELAY_MAX + 1), (tick - delay) % (DELAY_MAX + 1)
    goal, rates = np.zeros(4), np.zeros(3)
    for n in range(actions.shape[0]):
        body, air, flaps = bodies[n], airs[n], all_flaps[n]
        change = 0.0
        act(parameters, actions[n], control)
        allocate(parameters, control)
        drive_servos(parameters, control)
        for i in range(ACTIONS):
            change += (actions[n, i] - previous[n, i]) * (actions[n, i] - previous[n, i])
            previous[n, i] = actions[n, i]
        command(body, flaps, control.count, zero_offsets[n])
        push(body, body.time_us * 1e-6, pushes[n])
        for i in range(3):
            rates[i] = 0.5 * body.omega_B[i]
        air.noise_row = i32(n)
        step(body, air, flaps, draws)
        for i in range(3):  # the gyro's mean over the step
            rates[i] += 0.5 * body.omega_B[i]
        look(body, rings[n, newest])
        for i in range(SEEN):
            errors[n, i] = constants[0] * errors[n, i] + constants[1] * constants[2 + i] * draws[n, GUSTS + i]
        for i in range(SEEN, ERRORS):
            errors[n, i] = constants[2 + i] * draws[n, GUSTS + i]
        find_goal(body, home, paths[n], goal)
        estimate(flaps, rings[n, seen_at], rates, errors[n], goal, estimator.now)
        observe(parameters, estimator, previous[n], observations[n])
        dx, dy, dz = body.p_WB[0] - goal[0], body.p_WB[1] - goal[1], body.p_WB[2] - goal[2]
        turned = wrapped(rings[n, newest, 8] - goal[3])
        distance = math.sqrt(dx * dx + dy * dy + dz * dz)
        tilt = tilt_of(body.R_WB[2, 0], body.R_WB[2, 1], body.R_WB[2, 2])
        rewards[n] = reward_of(distance, tilt, turned, change)


@compiled
def observe_start(
    bodies: Sequence[Rigid], airs: Sequence[Air], all_flaps: Sequence[Flaps], n: int, home: Array, path: Array,
    ring: Array, errors: Array, parameters: Any, estimator: Any, out: Actions,
) -> None:  # fmt: skip
    """Fill the cameras' memory of a robot at its start, and write its first observation."""
    body, flaps = bodies[n], all_flaps[n]
    evaluate(body, airs[n], flaps)
    goal, previous = np.zeros(4), np.zeros(4, np.float32)
    for row in range(DELAY_MAX + 1):
        look(body, ring[row])
    find_goal(body, home, path, goal)
    estimate(flaps, ring[0], body.omega_B, errors, goal, estimator.now)
    observe(parameters, estimator, previous, out)


@compiled
def observe_board(parameters: Any, estimator: Any, previous: Actions, out: Actions) -> None:
    """Write the observation from the memory of a board's core."""
    observe(parameters, estimator, previous, out)


class Fleet:
    """Robots that fly at the same time, each its own episode, in the arrays of `advance_all`.

    `config` is the boards'; `worlds` are the robots that an episode may draw, free and at home. `delay_us` is the pose's
    age that the estimate does not compensate.
    """

    def __init__(
        self, config: LabConfig, worlds: Sequence[Plant], count: int, delay_us: int, errors: EstimateErrors
    ) -> None:
        self._plant = worlds[0].blocks
        kinds = zip(*(world.blocks for world in worlds), strict=True)
        self._templates = [np.concatenate([block.memory for block in kind]) for kind in kinds]
        self._templates[0]["step_us"] = CONTROL_US
        self._gust_rms = _slow_gusts(self._templates[1])
        self._offsets = np.array([world.zero_offset for world in worlds])
        self._home = np.array((*config.flight.home, 0.0))
        self._robots = [np.zeros(count, block.kind.dtype) for block in self._plant]
        body, air, flaps = (one.kind.rows(rows) for one, rows in zip(self._plant, self._robots, strict=True))
        self._args = body, air, flaps
        self._zero_offsets = np.zeros((count, 4))
        self._paths, self._pushes = np.zeros((count, 2, 4)), np.zeros((count, 3, PUSHES))
        self._rings, self._errors = np.zeros((count, DELAY_MAX + 1, SEEN)), np.zeros((count, ERRORS))
        self._previous = np.zeros((count, ACTIONS), np.float32)
        decay = exp(-CONTROL_US * 1e-6 / errors.tau_s)
        self._sizes = np.repeat((errors.position, errors.velocity, errors.attitude, errors.rate), 3)
        self._constants = np.array([decay, math.sqrt(1.0 - decay * decay), *self._sizes])
        self._tick, self._delay = 0, round(delay_us / CONTROL_US)
        self._parameters, self._estimator = parameters_of(config).arg, Estimator.allocate().arg
        self._control = Control.allocate().arg

    def begin(self, n: int, episode: Episode, rng: np.random.Generator, out: Actions) -> None:
        """Put robot `n` at the start of an episode, at rest in moving air; write its observation (20,)."""
        robot = int(episode.robot * len(self._offsets))
        for memory, templates in zip(self._robots, self._templates, strict=True):
            memory[n] = templates[robot]
        bodies, airs, _ = self._robots
        bodies["p_WB"][n] += episode.start
        airs["gusts"][n] = self._gust_rms[robot] * normal(rng, GUSTS)
        self._zero_offsets[n] = self._offsets[robot]
        self._paths[n] = episode.amplitude, episode.frequency_hz
        self._pushes[n] = episode.push_at, episode.push_kind, episode.push_size
        self._previous[n] = 0.0
        self._errors[n] = self._sizes * normal(rng, ERRORS)
        observe_start(
            *self._args, n, self._home, self._paths[n], self._rings[n], self._errors[n], self._parameters,
            self._estimator, out,
        )  # fmt: skip

    def advance(
        self, actions: Actions, rng: np.random.Generator, observations: Actions, rewards: Array
    ) -> None:
        """Advance all by 10 ms with their actions (count, 4); write observations (count, 20) and rewards (count,)."""
        self._tick += 1
        advance_all(
            *self._args, self._paths, self._pushes, self._rings, self._errors, actions, self._previous,
            normal(rng, (len(actions), GUSTS + ERRORS)), self._constants, self._zero_offsets, self._home, self._tick,
            self._delay, self._parameters, self._estimator, self._control, observations, rewards,
        )  # fmt: skip

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which robots have left the flow, fallen or tumbled, (count,)."""
        return np.asarray(self._robots[0]["lost"] != 0)

    def truth(self, n: int) -> FloatyBlocks:
        """Return a copy of a robot's memory."""
        copy = self._plant.copy()
        for block, memory in zip(copy, self._robots, strict=True):
            block.memory[:] = memory[n]
        return copy


def _slow_gusts(airs: NDArray[Any]) -> Array:
    """Make gusts advance by a control step instead of a millisecond; return their rms, (N, 14) [m/s]."""
    decay, kick = airs["gust_decay"], airs["gust_kick"]
    rms = kick / np.sqrt(1.0 - decay**2)
    decay **= CONTROL_US // STEP_US
    kick[:] = rms * np.sqrt(1.0 - decay**2)
    return np.asarray(rms)
