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
from hil.arguments import checked
from hil.config import LabConfig
from hil.errors import LabError
from hil.floaty.plant import Plant
from hil.learn.tasks import PUSH_S, PUSHES, Episode
from hil.world import layout as at
from hil.world.fixed_order import SOURCES, atan2, exp, normal, sine_ahead
from hil.world.motion import evaluate, step
from hil.world.servos import MIDDLE_COUNTS, PERIOD_COUNTS, RAD_PER_COUNT, TIMER_MHZ

CONTROL_US = 10_000
DELAY_MAX = 12  # control steps
SEEN = 9  # position, velocity in W, and Euler angles, from the cameras
ERRORS = SEEN + 3  # plus the rates, from the gyro
GUSTS = 14
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
def command(s: Array, counts: Array, zero_offset: Array) -> None:
    """Latch the timer counts at the next PWM period, at least 1 ms from now for the board's computation."""
    ready_us = s[at.TIME_US] + at.STEP_US
    period = math.floor(ready_us * TIMER_MHZ / PERIOD_COUNTS) + 1.0
    s[at.NEXT_US] = math.ceil(period * PERIOD_COUNTS / TIMER_MHZ)
    for i in range(4):
        s[at.NEXT + i] = (counts[i] - MIDDLE_COUNTS) * RAD_PER_COUNT - zero_offset[i]


@compiled
def push(s: Array, t: float, pushes: Array) -> None:
    """Apply the pushes of this step: rows are times, kinds and sizes."""
    for i in range(6):
        s[at.PUSH + i] = 0.0
    for i in range(PUSHES):
        if pushes[0, i] <= t < pushes[0, i] + PUSH_S:
            s[at.PUSH + int(pushes[1, i])] = pushes[2, i]


@compiled
def look(s: Array, row: Array) -> None:
    """Write the cameras' measurement: position, velocity in W, and roll, pitch, yaw."""
    for i in range(6):
        row[i] = s[at.P + i]
    row[6] = atan2(s[at.R + 7], s[at.R + 8])
    row[7] = atan2(-s[at.R + 6], math.sqrt(s[at.R] * s[at.R] + s[at.R + 3] * s[at.R + 3]))
    row[8] = atan2(s[at.R + 3], s[at.R])


@compiled
def estimate(
    s: Array, seen: Array, rates: Array, errors: Array, goal: Array, now: NDArray[np.float32]
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
        now[FLAP + i] = s[at.FLAPS + i] - s[at.HOVER_FLAPS + i]


@compiled
def find_goal(s: Array, home: Array, path: Array, goal: Array) -> None:
    """Write the current goal: position in W, yaw."""
    t = s[at.TIME_US] * 1e-6
    for axis in range(4):
        goal[axis] = home[axis] + path[0, axis] * sine_ahead(2.0 * math.pi * path[1, axis] * t, 0)


@compiled
def tilt_of(x: float, y: float, z: float) -> float:
    """Return the angle between the body's z axis and the vertical [rad], for the vertical (x, y, z) in B."""
    return float(atan2(math.sqrt(x * x + y * y), z))


@compiled
def advance_all(
    plants: Array,  # (N, layout.SIZE)
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
    for n in range(plants.shape[0]):
        s = plants[n]
        change = 0.0
        act(parameters, actions[n], control)
        allocate(parameters, control)
        drive_servos(parameters, control)
        for i in range(ACTIONS):
            change += (actions[n, i] - previous[n, i]) * (actions[n, i] - previous[n, i])
            previous[n, i] = actions[n, i]
        command(s, control.count, zero_offsets[n])
        push(s, s[at.TIME_US] * 1e-6, pushes[n])
        for i in range(3):
            rates[i] = 0.5 * s[at.OMEGA + i]
        step(s, draws[n, :GUSTS], CONTROL_US)
        for i in range(3):  # the gyro's mean over the step
            rates[i] += 0.5 * s[at.OMEGA + i]
        look(s, rings[n, newest])
        for i in range(SEEN):
            errors[n, i] = constants[0] * errors[n, i] + constants[1] * constants[2 + i] * draws[n, GUSTS + i]
        for i in range(SEEN, ERRORS):
            errors[n, i] = constants[2 + i] * draws[n, GUSTS + i]
        find_goal(s, home, paths[n], goal)
        estimate(s, rings[n, seen_at], rates, errors[n], goal, estimator.now)
        observe(parameters, estimator, previous[n], observations[n])
        dx, dy, dz = s[at.P] - goal[0], s[at.P + 1] - goal[1], s[at.P + 2] - goal[2]
        turned = wrapped(rings[n, newest, 8] - goal[3])
        distance, tilt = (
            math.sqrt(dx * dx + dy * dy + dz * dz),
            tilt_of(s[at.R + 6], s[at.R + 7], s[at.R + 8]),
        )
        rewards[n] = reward_of(distance, tilt, turned, change)


@compiled
def observe_start(
    s: Array, home: Array, path: Array, ring: Array, errors: Array, parameters: Any, estimator: Any, out: Actions,
) -> None:  # fmt: skip
    """Fill the cameras' memory of a robot at its start, and write its first observation."""
    evaluate(s)
    goal, previous = np.zeros(4), np.zeros(4, np.float32)
    for row in range(DELAY_MAX + 1):
        look(s, ring[row])
    find_goal(s, home, path, goal)
    estimate(s, ring[0], s[at.OMEGA : at.OMEGA + 3], errors, goal, estimator.now)
    observe(parameters, estimator, previous, out)


@compiled
def observe_board(parameters: Any, estimator: Any, previous: Actions, out: Actions) -> None:
    """Write the observation from the memory of a board's core."""
    observe(parameters, estimator, previous, out)


class Fleet:
    """Robots that fly at the same time, each its own episode, in the arrays of `advance_all`.

    `config` is the boards'; `worlds` are the robots that an episode may draw, free and at home. `delay_us` is the pose's
    age that the estimate does not compensate. `plants`, (count, layout.SIZE), may be read.
    """

    def __init__(
        self, config: LabConfig, worlds: Sequence[Plant], count: int, delay_us: int, errors: EstimateErrors
    ) -> None:
        self._templates = np.array([world.truth for world in worlds])
        self._gust_rms = _slow_gusts(self._templates)
        self._offsets = np.array([world.zero_offset for world in worlds])
        self._home = np.array((*config.flight.home, 0.0))
        self.plants, self._zero_offsets = np.zeros((count, at.SIZE)), np.zeros((count, 4))
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
        robot, s = int(episode.robot * len(self._templates)), self.plants[n]
        s[:] = self._templates[robot]
        s[at.P : at.P + 3] += episode.start
        s[at.GUSTS : at.GUSTS + GUSTS] = self._gust_rms[robot] * normal(rng, GUSTS)
        self._zero_offsets[n] = self._offsets[robot]
        self._paths[n] = episode.amplitude, episode.frequency_hz
        self._pushes[n] = episode.push_at, episode.push_kind, episode.push_size
        self._previous[n] = 0.0
        self._errors[n] = self._sizes * normal(rng, ERRORS)
        observe_start(
            s, self._home, self._paths[n], self._rings[n], self._errors[n], self._parameters, self._estimator, out
        )  # fmt: skip

    def advance(
        self, actions: Actions, rng: np.random.Generator, observations: Actions, rewards: Array
    ) -> None:
        """Advance all by 10 ms with their actions (count, 4); write observations (count, 20) and rewards (count,)."""
        self._tick += 1
        advance_all(
            self.plants, self._paths, self._pushes, self._rings, self._errors, actions, self._previous,
            normal(rng, (len(actions), GUSTS + ERRORS)), self._constants, self._zero_offsets, self._home, self._tick,
            self._delay, self._parameters, self._estimator, self._control, observations, rewards,
        )  # fmt: skip

    @property
    def lost(self) -> NDArray[np.bool_]:
        """Which robots have left the flow, fallen or tumbled, (count,)."""
        return np.asarray(self.plants[:, at.LOST] != 0.0)


def _slow_gusts(templates: Array) -> Array:
    """Make plants' gusts advance by a control step instead of a millisecond; return their rms, (N, 14) [m/s]."""
    decay, kick = (templates[:, one : one + GUSTS] for one in (at.GUST_DECAY, at.GUST_KICK))
    rms = kick / np.sqrt(1.0 - decay**2)
    decay **= CONTROL_US // at.STEP_US
    kick[:] = rms * np.sqrt(1.0 - decay**2)
    return np.asarray(rms)
