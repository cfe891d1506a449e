"""One axis of the whole loop, sampled every 10 ms.

Plant (the linear model after servo lag and delay), gyro (mean over a tick), poses (a horizon late), the board's
stationary filter and predictor with its own model, the history of commands, the gains. Poses of every second tick count
as poses of every tick with twice the variance. The robot may differ from the model on board: both are arguments.

The loop is opened between command and servo, so the estimator still has the command: `now = Gv v + Gu u + Gw w`, v the
servos' input, u the board's command, w accelerations of the flow. In flight v = u = -k now.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are

from hil.config import LabConfig
from hil.research.design import axes

Complex = NDArray[np.complexfloating[Any, Any]]
FREQUENCIES = np.geomspace(0.02, 49.0, 240)  # [Hz]


def held(flow: axes.Matrix, columns: axes.Matrix, seconds: float) -> tuple[axes.Matrix, axes.Matrix]:
    """Return the transition over a time, and the effect of inputs held over it."""
    n, m = columns.shape
    both = expm(np.block([[flow, columns], [np.zeros((m, n + m))]]) * seconds)
    return both[:n, :n], both[:n, n:]


@dataclass(frozen=True, slots=True)
class Timing:
    """The age of poses, and the board's horizon for it."""

    age_s: float
    horizon: int  # ticks by which the filter is late, bridged by the predictor

    @classmethod
    def of(cls, config: LabConfig, age_s: float) -> Timing:
        """Return the timing of a profile's board for poses of an age."""
        predictor = config.predictor
        if not predictor.enabled:
            return cls(age_s, 0)
        if predictor.age == "fixed":
            return cls(age_s, predictor.horizon)
        ticks = max(1, round(age_s / axes.STEP_S))
        return cls(ticks * axes.STEP_S, ticks)  # the fraction of a tick is bridged by the velocities

    def later(self, seconds: float) -> Timing:
        """Return the timing with poses older than their stated age."""
        return Timing(self.age_s + seconds, self.horizon)


def filter_gain(axis: axes.Axis, config: LabConfig, Phi: axes.Matrix) -> tuple[axes.Matrix, axes.Matrix]:
    """Return the stationary gain of the board's filter, and its measured rows: gyro, then pose."""
    n, noise = len(axis.states), config.estimator
    process = {
        axes.POSITION: noise.process_position,
        axes.VELOCITY: noise.process_velocity,
        axes.ANGLE: noise.process_attitude,
        axes.RATE: noise.process_rate,
    }
    # An input is a mean of four flaps, so its variance is a quarter.
    Q = np.diag([*(process[state] for state in axis.states), noise.process_flap / 4])
    measured = {
        axes.RATE: noise.measured_rate,
        axes.POSITION: 2 * noise.measured_position,
        axes.ANGLE: 2 * noise.measured_attitude,
    }
    seen = [state for state in measured if state in axis.states]
    C = np.zeros((len(seen), n + 1))
    C[range(len(seen)), [axis.states.index(state) for state in seen]] = 1.0
    R = np.diag([measured[state] for state in seen])
    P = solve_discrete_are(Phi.T, C.T, Q, R)
    gain: axes.Matrix = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    return gain, C


@dataclass(frozen=True, eq=False)
class Loop:
    """s+ = A s + Bv v + Bu u + Bw w; now = N s; errors = C s."""

    axis: axes.Axis
    A: axes.Matrix
    Bv: axes.Matrix  # (S, 1)
    Bu: axes.Matrix  # (S, 1)
    Bw: axes.Matrix  # (S, W) accelerations of the flow: of the velocity, of the rate, if the axis has them
    N: axes.Matrix  # (G, S) the quantity that each gain multiplies
    C: axes.Matrix  # (n, S) true states

    def closed(self, gains: axes.Matrix) -> axes.Matrix:
        """Return the matrix of the loop in flight."""
        closed: axes.Matrix = self.A - (self.Bv + self.Bu) @ (gains[None] @ self.N)
        return closed

    def radius(self, gains: axes.Matrix) -> float:
        """Return the largest absolute eigenvalue in flight: below 1 the loop is stable."""
        return float(np.abs(np.linalg.eigvals(self.closed(gains))).max())

    @cached_property
    def answers(self) -> tuple[Complex, Complex]:
        """Return `now` (L, G, 2 + W) and true states (L, n, 2 + W) per v, u, w on the lines, for any gains."""
        z = np.exp(2j * np.pi * FREQUENCIES * axes.STEP_S)
        inputs = np.concatenate([self.Bv, self.Bu, self.Bw], axis=1)
        solved: Complex = np.linalg.solve(z[:, None, None] * np.eye(len(self.A)) - self.A, inputs)
        return self.N @ solved, self.C @ solved

    def open_loop(self, gains: axes.Matrix) -> Complex:
        """Return L on the lines: in flight 1 + L."""
        now, _ = self.answers
        fed = np.einsum("g,lgc->lc", gains, now)
        L: Complex = fed[:, 0] / (1 + fed[:, 1])
        return L

    def response_to(self, spectrum: Complex, gains: axes.Matrix) -> tuple[axes.Matrix, float]:
        """Return the variances of the true states (n,) and of the command in a flow with a spectrum (L, W, W), per Hz."""
        now, answers = self.answers
        fed = np.einsum("g,lgc->lc", gains, now)
        u = -fed[:, 2:] / (1 + fed[:, 0] + fed[:, 1])[:, None]
        states = answers[:, :, 2:] + (answers[:, :, 0] + answers[:, :, 1])[:, :, None] * u[:, None]
        power = np.einsum("lnw,lwx,lnx->ln", states, spectrum, states.conj()).real
        of_u = np.einsum("lw,lwx,lx->l", u, spectrum, u.conj()).real
        return np.trapezoid(power, FREQUENCIES, axis=0), float(np.trapezoid(of_u, FREQUENCIES))


def build(axis: axes.Axis, robot: axes.Robot, config: LabConfig, timing: Timing) -> Loop:
    """Return the loop of an axis of a robot with a profile's model, estimator and predictor on board."""
    Phi, before, rest, whole = _robot_tick(axis, robot)
    Phi_b, columns = held(*axes.dynamics(axis, axes.robot_of(config)), axes.STEP_S)
    Gamma_b = columns[:, :1]
    K, seen = filter_gain(axis, config, Phi_b)
    n, horizon, lag = len(axis.states), timing.horizon, timing.age_s / axes.STEP_S
    rows = [axis.states.index(state) for state in axis.pose]
    depth = max(horizon, int(np.ceil(lag))) + 1  # ticks of stored poses, besides the current one

    # Each part of the loop is a row over all parts and inputs: the code then follows the order of a tick.
    sizes = (n + 1, 1, depth * len(rows), horizon + 1, n + 1, len(axis.gains) - n)
    every = np.eye(sum(sizes) + 1 + whole.shape[1])
    x, v_before, past, commands, xi, integral, v, u, w = np.split(every, np.cumsum([*sizes, 1, 1]))

    rate = axis.states.index(axes.RATE) if axes.RATE in axis.states else None
    N = xi
    for step in range(horizon):  # the predictor: uses the commands, and rates from the gyro
        N = Phi_b @ N + Gamma_b @ commands[horizon - step - 1][None]
        if rate is not None:
            N[rate] = _gyro(x[rows], past, horizon - step - 1)
    summed = integral - axes.STEP_S * N[: len(integral)]

    x_next = Phi @ x + before @ v_before + rest @ v + whole[:, 1:] @ w
    past_next = np.concatenate([x[rows], past])[: len(past)]
    commands_next = np.concatenate([u, commands[:-1]])
    predicted = Phi_b @ xi + Gamma_b @ commands_next[-1:]
    measured = _ago(x_next[rows], past_next, lag)
    if rate is not None:
        measured = np.concatenate([_gyro(x_next[rows], past_next, horizon)[None], measured])
    corrected = predicted + K @ (measured - seen @ predicted)
    following = np.concatenate([x_next, v, past_next, commands_next, corrected, summed])

    size = sum(sizes)
    A, Bv, Bu, Bw = np.split(following, [size, size + 1, size + 2], axis=1)
    return Loop(axis, A, Bv, Bu, Bw, np.concatenate([N[:n], -summed])[:, :size], x[:n, :size])


def _robot_tick(
    axis: axes.Axis, robot: axes.Robot
) -> tuple[axes.Matrix, axes.Matrix, axes.Matrix, axes.Matrix]:
    """Return the robot's transition over a tick, the effects of the input before and after its delay, and of all inputs."""
    flow, columns = axes.dynamics(axis, robot)
    delay = min(max(robot[axes.DELAY], 0.0), axes.STEP_S)
    Phi, whole = held(flow, columns, axes.STEP_S)
    late, rest = held(flow, columns, axes.STEP_S - delay)
    return Phi, late @ held(flow, columns, delay)[1][:, :1], rest[:, :1], whole


def _gyro(present: axes.Matrix, past: axes.Matrix, ticks: int) -> axes.Matrix:
    """Return the row of the mean rate over the tick that ended `ticks` ago."""
    mean: axes.Matrix = (_ago(present, past, ticks)[-1] - _ago(present, past, ticks + 1)[-1]) / axes.STEP_S
    return mean


def _ago(present: axes.Matrix, past: axes.Matrix, ticks: float) -> axes.Matrix:
    """Return the rows of position and angle `ticks` ago."""
    first, share = int(ticks), ticks - int(ticks)
    history = np.concatenate([present, past]).reshape(-1, *present.shape)
    mixed: axes.Matrix = (1 - share) * history[first]
    return mixed + share * history[first + 1] if share else mixed
