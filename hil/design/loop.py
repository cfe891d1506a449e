"""One axis of the whole loop, sampled every 10 ms, with the margins of the law's gains.

Plant (the linear model behind servo lag and delay), gyro (mean over a tick), poses (a horizon late), the board's stationary
filter and predictor on the board's own model, the history of its commands, the gains. Poses of every second tick count as
poses of every tick that are half as certain. The robot may differ from the model on board: both are handed in.

The loop is broken between command and servo, where the estimator still knows the command: `now = Gv v + Gu u + Gw w`, v what
the servos get, u what the board commands, w accelerations of the flow. In flight v = u = -k now.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hil.config import LabConfig
from hil.errors import LabError

try:
    from scipy.linalg import expm, solve_discrete_are
except ImportError:
    from firmware_py.extras import install_command

    raise LabError(f"gains need scipy: {install_command('design')}") from None

Matrix = NDArray[np.float64]
Complex = NDArray[np.complexfloating[Any, Any]]
Robot = Mapping[str, float]  # constants of a [model], and `delay`

STEP_S = 0.01
DELAY = "delay"  # [s] from the end of a gyro sample's tick to the servo: control 1 ms later, half a PWM period, computing
OWN_DELAY_S = 0.003
TICK_DELAYS_S = 0.010  # in `floaty identify`'s delay, input to gyro, besides: half a tick of holding, half the gyro's mean
POSITION, VELOCITY, ANGLE, RATE = "position", "velocity", "angle", "rate"
LOWEST_HZ, HIGHEST_HZ, LINES = 0.02, 49.0, 240


@dataclass(frozen=True, slots=True)
class Axis:
    """An input of the law, the states behind it, and its gains in a profile."""

    name: str
    input: int
    states: tuple[str, ...]
    gains: tuple[str, ...]  # by state, then of the integral of the first one where there is one
    constants: tuple[str, ...]  # of the fastest equation, then of the velocity's

    @property
    def main(self) -> str:
        """The state that the axis controls."""
        return self.states[0]


TURN = (POSITION, VELOCITY, ANGLE, RATE)
AXES = (
    Axis("roll, y", 0, TURN, ("gain_y", "gain_vy", "gain_roll", "gain_p"),
         ("roll_u1", "roll_rate", "roll_roll", "roll_vy", "y_u1", "y_roll", "y_vy")),
    Axis("pitch, x", 1, TURN, ("gain_x", "gain_vx", "gain_pitch", "gain_q"),
         ("pitch_u2", "pitch_rate", "pitch_pitch", "pitch_vx", "x_u2", "x_pitch", "x_vx")),
    Axis("yaw", 2, (ANGLE, RATE), ("gain_yaw", "gain_r"), ("yaw_u3", "yaw_rate")),
    Axis("height", 3, (POSITION, VELOCITY), ("gain_z", "gain_vz", "gain_iz"), ("z_u4", "z_vz")),
)  # fmt: skip


def robot_of(config: LabConfig, delay_s: float = OWN_DELAY_S) -> dict[str, float]:
    """Return a profile's model as a robot."""
    return {**config.model.model_dump(), DELAY: delay_s}


def gains_in(config: LabConfig, axis: Axis) -> Matrix:
    """Return the gains of an axis in a profile."""
    return np.array([getattr(config.controller, name) for name in axis.gains])


def dynamics(axis: Axis, robot: Robot) -> tuple[Matrix, Matrix]:
    """Return the matrix of states and flap in continuous time, and the columns (flap command, accelerations of the flow)."""
    n = len(axis.states)
    k = [robot[name] for name in axis.constants]
    flow = np.zeros((n + 1, n + 1))
    if axis.states == TURN:
        a, b, c, d, e, h, g = k
        flow[:4] = np.array([[0, 1, 0, 0, 0], [0, g, h, 0, e], [0, 0, 0, 1, 0], [0, d, c, b, a]])
    else:
        flow[:2] = np.array([[0, 1, 0], [0, k[1], k[0]]])
    flow[n, n] = -robot["flap_rate"]
    pushed = [row for row, state in enumerate(axis.states) if state in (VELOCITY, RATE)]
    columns = np.zeros((n + 1, 1 + len(pushed)))
    columns[n, 0] = robot["flap_rate"]
    columns[pushed, range(1, 1 + len(pushed))] = 1.0
    return flow, columns


def held(flow: Matrix, columns: Matrix, seconds: float) -> tuple[Matrix, Matrix]:
    """Return the transition over a time, and the effect of inputs held over it."""
    n, m = columns.shape
    both = expm(np.block([[flow, columns], [np.zeros((m, n + m))]]) * seconds)
    return both[:n, :n], both[:n, n:]


@dataclass(frozen=True, slots=True)
class Timing:
    """The age of poses, and what the board knows of it."""

    age_s: float
    horizon: int  # ticks that the filter runs behind and the predictor bridges

    @classmethod
    def of(cls, config: LabConfig, age_s: float) -> Timing:
        """Return the timing of a profile's board with poses of an age."""
        predictor = config.predictor
        if not predictor.enabled:
            return cls(age_s, 0)
        if predictor.age == "fixed":
            return cls(age_s, predictor.horizon)
        ticks = max(1, round(age_s / STEP_S))
        return cls(ticks * STEP_S, ticks)  # the fraction of a tick is bridged by the velocities

    def later(self, seconds: float) -> Timing:
        """Return the timing with poses that are older than they state."""
        return Timing(self.age_s + seconds, self.horizon)


def filter_gain(axis: Axis, config: LabConfig, Phi: Matrix) -> tuple[Matrix, Matrix]:
    """Return the stationary gain of the board's filter, and the rows that it measures: gyro, then pose."""
    n, noise = len(axis.states), config.estimator
    process = {
        POSITION: noise.process_position,
        VELOCITY: noise.process_velocity,
        ANGLE: noise.process_attitude,
        RATE: noise.process_rate,
    }
    # An input is a mean of four flaps, so its variance is a quarter.
    Q = np.diag([*(process[state] for state in axis.states), noise.process_flap / 4])
    measured = {
        RATE: noise.measured_rate,
        POSITION: 2 * noise.measured_position,
        ANGLE: 2 * noise.measured_attitude,
    }
    seen = [state for state in measured if state in axis.states]
    C = np.zeros((len(seen), n + 1))
    C[range(len(seen)), [axis.states.index(state) for state in seen]] = 1.0
    R = np.diag([measured[state] for state in seen])
    P = solve_discrete_are(Phi.T, C.T, Q, R)
    gain: Matrix = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    return gain, C


@dataclass(frozen=True, eq=False)
class Loop:
    """s+ = A s + Bv v + Bu u + Bw w; now = N s; errors = C s."""

    axis: Axis
    A: Matrix
    Bv: Matrix  # (S, 1)
    Bu: Matrix  # (S, 1)
    Bw: Matrix  # (S, W) accelerations of the flow: of the velocity, of the rate, as the axis has them
    N: Matrix  # (G, S) the quantity that each gain multiplies
    C: Matrix  # (n, S) true states

    def closed(self, gains: Matrix) -> Matrix:
        """Return the matrix of the loop in flight."""
        closed: Matrix = self.A - (self.Bv + self.Bu) @ (gains[None] @ self.N)
        return closed

    def radius(self, gains: Matrix) -> float:
        """Return the largest absolute eigenvalue in flight: below 1 the loop is stable."""
        return float(np.abs(np.linalg.eigvals(self.closed(gains))).max())

    @cached_property
    def answers(self) -> tuple[Complex, Complex]:
        """Return `now` (L, G, 2 + W) and true states (L, n, 2 + W) per v, u, w on the lines, whatever the gains."""
        z = np.exp(2j * np.pi * FREQUENCIES * STEP_S)
        inputs = np.concatenate([self.Bv, self.Bu, self.Bw], axis=1)
        solved: Complex = np.linalg.solve(z[:, None, None] * np.eye(len(self.A)) - self.A, inputs)
        return self.N @ solved, self.C @ solved

    def open_loop(self, gains: Matrix) -> Complex:
        """Return L on the lines: in flight 1 + L."""
        now, _ = self.answers
        fed = np.einsum("g,lgc->lc", gains, now)
        L: Complex = fed[:, 0] / (1 + fed[:, 1])
        return L

    def disturbed(self, gains: Matrix) -> tuple[Complex, Complex]:
        """Return true states (L, n, W) and command (L, W) per acceleration of the flow, in flight."""
        now, states = self.answers
        fed = np.einsum("g,lgc->lc", gains, now)
        u = -fed[:, 2:] / (1 + fed[:, 0] + fed[:, 1])[:, None]
        return states[:, :, 2:] + (states[:, :, 0] + states[:, :, 1])[:, :, None] * u[:, None], u


FREQUENCIES = np.geomspace(LOWEST_HZ, HIGHEST_HZ, LINES)  # [Hz]


class _Rows:
    """Index ranges of named parts of one state vector."""

    def __init__(self, sizes: Mapping[str, int]) -> None:
        self.places: dict[str, slice] = {}
        self.size = 0
        for name, size in sizes.items():
            self.places[name] = slice(self.size, self.size + size)
            self.size += size

    def pick(self, name: str) -> Matrix:
        """Return the rows that select a part of the state."""
        return np.eye(self.size)[self.places[name]]


def build(axis: Axis, robot: Robot, config: LabConfig, timing: Timing) -> Loop:
    """Return the loop of an axis of a robot with a profile's model, estimator and predictor on board."""
    Phi, before, rest, whole = _robot_tick(axis, robot)
    Phi_b, column_b = held(*dynamics(axis, robot_of(config)), STEP_S)
    Gamma_b = column_b[:, :1]
    K, seen = filter_gain(axis, config, Phi_b)

    n, h, integral = len(axis.states), timing.horizon, len(axis.gains) - len(axis.states)
    lag = timing.age_s / STEP_S
    poses = [row for row, state in enumerate(axis.states) if state in (POSITION, ANGLE)]
    depth = max(h + 1, int(np.ceil(lag)) + 1)  # ticks of poses that are kept, besides the present one
    rows = _Rows(
        {"x": n + 1, "v": 1, "past": depth * len(poses), "u": h + 1, "filter": n + 1, "integral": integral}
    )
    x, v, past, commands, xi = (rows.pick(name) for name in ("x", "v", "past", "u", "filter"))
    rate = axis.states.index(RATE) if axis.states[poses[-1]] == ANGLE else None
    N = _predicted(xi, commands, x[poses], past, rate, Phi_b, Gamma_b)[:n]
    if integral:
        summed = rows.pick("integral") - STEP_S * N[:1]
        N = np.concatenate([N, -summed])

    # The next state, first over (s, v, u, w), part by part
    size, width = rows.size, whole.shape[1] - 1
    wide = np.zeros((size, size + 2 + width))

    def over(matrix: Matrix) -> Matrix:
        return np.pad(matrix, ((0, 0), (0, 2 + width)))

    x_next = over(Phi @ x + before @ v)
    x_next[:, size] += rest[:, 0]
    x_next[:, size + 2 :] += whole[:, 1:]
    past_next = over(np.concatenate([x[poses], past])[: depth * len(poses)])
    commands_next = np.zeros((h + 1, wide.shape[1]))
    commands_next[0, size + 1] = 1.0
    commands_next[1:] = over(commands[:-1])
    predicted = over(Phi_b @ xi) + Gamma_b @ commands_next[h][None]
    measured = _ago(x_next[poses], past_next, lag)
    if rate is not None:
        measured = np.concatenate([_gyro(x_next[poses], past_next, h)[None], measured])
    wide[rows.places["x"]] = x_next
    wide[rows.places["v"], size] = 1.0
    wide[rows.places["past"]] = past_next
    wide[rows.places["u"]] = commands_next
    wide[rows.places["filter"]] = predicted + K @ (measured - seen @ predicted)
    if integral:
        wide[rows.places["integral"]] = over(summed)
    s, command, flow = wide[:, :size], wide[:, size + 1 : size + 2], wide[:, size + 2 :]
    return Loop(axis, s, wide[:, size : size + 1], command, flow, N, x[:n])


def _robot_tick(axis: Axis, robot: Robot) -> tuple[Matrix, Matrix, Matrix, Matrix]:
    """Return the robot's transition over a tick, and the effects of the input before and after its delay, and over all."""
    flow, columns = dynamics(axis, robot)
    delay = min(max(robot[DELAY], 0.0), STEP_S)
    Phi, whole = held(flow, columns, STEP_S)
    late, rest = held(flow, columns, STEP_S - delay)
    return Phi, late @ held(flow, columns, delay)[1][:, :1], rest, whole


def _predicted(
    xi: Matrix, commands: Matrix, present: Matrix, past: Matrix, rate: int | None, Phi: Matrix, Gamma: Matrix
) -> Matrix:
    """Return the board's state brought to now: from the filter's state through the commands, rates from the gyro."""
    z = xi
    horizon = len(commands) - 1
    for step in range(horizon):
        z = Phi @ z + Gamma @ commands[horizon - step - 1][None]
        if rate is not None:
            z[rate] = _gyro(present, past, horizon - step - 1)
    return z


def _gyro(present: Matrix, past: Matrix, ticks: int) -> Matrix:
    """Return the row of the mean rate over the tick that ended that many ticks ago."""
    mean: Matrix = (_ago(present, past, ticks)[-1] - _ago(present, past, ticks + 1)[-1]) / STEP_S
    return mean


def _ago(present: Matrix, past: Matrix, ticks: float) -> Matrix:
    """Return the rows of position and angle that many ticks ago."""
    first, share = int(ticks), ticks - int(ticks)
    history = np.concatenate([present, past]).reshape(-1, *present.shape)
    mixed: Matrix = (1 - share) * history[first]
    return mixed + share * history[first + 1] if share else mixed


@dataclass(frozen=True, slots=True)
class Margins:
    """The stability margins of a loop that is opened before the servo."""

    stable: bool
    gain: float  # factor on the gain up to which it is stable, infinite without
    least_gain: float  # factor below 1 down to which it is stable, 0 without
    phase: float  # [rad]
    delay: float  # [s] between command and servo, on top of the present delay
    peak: float  # of the sensitivity 1 / (1 + L)


UNSTABLE = Margins(False, 1.0, 1.0, 0.0, 0.0, np.inf)


def margins(loop: Loop, gains: Matrix) -> Margins:
    """Return the margins of a loop with gains; none of an unstable one."""
    if loop.radius(gains) >= 1.0:
        return UNSTABLE
    return margins_of(2 * np.pi * FREQUENCIES, loop.open_loop(gains))


def margins_of(w: Matrix, L: Complex) -> Margins:
    """Return the margins of a stable loop from its open-loop response on a fine grid."""
    size, turned = np.log(np.abs(L)), np.unwrap(np.angle(L))
    phases, delays = [], []
    for w_c, share, place in _crossings(w, size):
        angle = (1 - share) * turned[place] + share * turned[place + 1]
        above = float((angle + np.pi) % (2 * np.pi))
        phases.append(min(above, 2 * np.pi - above))
        delays.append(above / w_c)
    up, down = [np.inf], [0.0]
    around = np.arange(np.floor(turned.min() / (2 * np.pi)) - 1, np.ceil(turned.max() / (2 * np.pi)) + 1)
    for turns in around:
        for _, share, place in _crossings(w, turned - np.pi * (2 * turns + 1)):
            factor = float(np.exp(-(1 - share) * size[place] - share * size[place + 1]))
            (up if factor > 1 else down).append(factor)
    peak = float(np.max(1 / np.abs(1 + L)))
    return Margins(True, min(up), max(down), min(phases, default=np.inf), min(delays, default=np.inf), peak)


def _crossings(w: Matrix, values: Matrix) -> list[tuple[float, float, int]]:
    """Return where values cross zero: frequency, share of the distance to the next line, line."""
    places = np.flatnonzero(np.signbit(values[:-1]) != np.signbit(values[1:]))
    shares = values[places] / (values[places] - values[places + 1])
    return [
        (float(w[place] * (w[place + 1] / w[place]) ** share), float(share), int(place))
        for place, share in zip(places, shares, strict=True)
    ]


def pose_delay_margin(
    axis: Axis, robot: Robot, config: LabConfig, timing: Timing, gains: Matrix, most_s: float = 0.5
) -> float:
    """Return by how much poses may be older than they state [s] before the loop is unstable; at most `most_s`."""

    def stable(seconds: float) -> bool:
        return build(axis, robot, config, timing.later(seconds)).radius(gains) < 1.0

    low, high = 0.0, STEP_S
    while stable(high):
        low, high = high, 2 * high
        if low >= most_s:
            return most_s
    while high - low > 1e-3:
        middle = (low + high) / 2
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low


def response_to(spectrum: Complex, loop: Loop, gains: Matrix) -> tuple[Matrix, float]:
    """Return the variances of the true states (n,) and of the command in a flow of that spectrum (L, W, W), per Hz."""
    states, u = loop.disturbed(gains)
    power = np.einsum("lnw,lwx,lnx->ln", states, spectrum, states.conj()).real
    of_u = np.einsum("lw,lwx,lx->l", u, spectrum, u.conj()).real
    return np.trapezoid(power, FREQUENCIES, axis=0), float(np.trapezoid(of_u, FREQUENCIES))


def worst(found: Sequence[Margins]) -> Margins:
    """Return the least of each margin over several loops."""
    return Margins(
        all(one.stable for one in found),
        min(one.gain for one in found),
        max(one.least_gain for one in found),
        min(one.phase for one in found),
        min(one.delay for one in found),
        max(one.peak for one in found),
    )
