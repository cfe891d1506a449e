"""Tunes the gains of the law for one axis: least motion in the measured flow, within the margins, for every robot.

The design model is `hil.research.design.loop`, with estimator, predictor, lag and delays inside. The search (Nelder-Mead)
starts at the axis' linear quadratic regulator and at the old gains, and adds the worst of the drawn robots to its set until
no robot is worse. A robot that moves too much for the box or the flaps, or a loop without its margins, costs more than any
motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, radians

import numpy as np
from scipy.optimize import minimize

from hil.config import LabConfig
from hil.errors import LabError
from hil.research.design.axes import ANGLE, POSITION, RATE, STEP_S, VELOCITY, Axis, Matrix, Robot, dynamics
from hil.research.design.gains import regulator, rounded, with_integral
from hil.research.design.loop import FREQUENCIES, Complex, Loop, Timing, held
from hil.research.design.margins import Margins, margins, peak_of, pose_delay_margin, worst

PEAK = 1.9  # of the sensitivity, for every robot: a gain margin of 2.1, a phase margin of 30 deg
BOX_M = 0.10
SIGMAS = 3.0  # inside the box and clear of the flaps' limits
UNITS = {POSITION: 0.02, VELOCITY: 0.3, ANGLE: radians(5.0), RATE: 2.0}  # one unit of motion in the cost
FLAP_UNIT = 0.1  # [rad] of the regulator
OF_FLAPS = 0.25  # share of a flap's range for one input, standard deviation
ROUNDS = 3
WORST = 2  # robots added per round
WORSE = 10  # the worst robots of an axis, whose margin for late poses is computed
TOO_MUCH = 1e3
LEAST_GAIN, STEP = 0.02, 0.2  # of the search: smallest scale of a gain, and the first step


@dataclass(frozen=True, slots=True)
class Flow:
    """The disturbance of an axis in a hover, and its mean input and angle."""

    spectrum: Complex  # (L, W, W) on FREQUENCIES, per Hz: of the velocity, of the rate, if the axis has them
    input: float  # [rad] mean
    angle: float  # [rad] mean; 0 for yaw and height


@dataclass(frozen=True, slots=True)
class GainTask:
    """The requirements on the gains of an axis."""

    axis: Axis
    flow: Flow
    config: LabConfig  # model and estimator on board, limits
    timing: Timing
    delay: float  # [s] that the margin must exceed

    @property
    def flap_range(self) -> float:
        """The angle of a flap from the hover to the nearer limit [rad]."""
        allocation = self.config.allocation
        hover, least, greatest = allocation.hover_angle, allocation.opening_min, allocation.opening_max
        return float(min(greatest - hover, hover - least))

    @property
    def error_limit(self) -> float:
        """The largest error of the main state that the flaps should handle."""
        return self.config.controller.limit_xy if ANGLE in self.axis.states else 0.0

    def offset(self, gains: Matrix) -> float:
        """Return the main state's steady offset; an integral removes it."""
        if len(gains) > len(self.axis.states):
            return 0.0
        turned = gains[self.axis.states.index(ANGLE)] * self.flow.angle if self.axis.main == POSITION else 0.0
        return -(self.flow.input + turned) / gains[0] if gains[0] else inf


@dataclass(frozen=True, slots=True)
class PredictedMotion:
    main: float  # [m] or [rad] rms of the main state's error
    input: float  # [rad] rms of the input's variation


def motion(loop: Loop, task: GainTask, gains: Matrix) -> PredictedMotion:
    """Return the motion of a stable loop in the flow."""
    states, u = loop.response_to(task.flow.spectrum, gains)
    return PredictedMotion(float(np.sqrt(states[0] + task.offset(gains) ** 2)), float(np.sqrt(u)))


def cost(loop: Loop, task: GainTask, gains: Matrix) -> float:
    """Return the cost of a robot with gains: motion in units, and much more for violated conditions."""
    radius = loop.radius(gains)
    if radius >= 1.0:
        return TOO_MUCH * (1.0 + radius)
    states, u = loop.response_to(task.flow.spectrum, gains)
    states[0] += task.offset(gains) ** 2
    flap_range = task.flap_range
    allowed = OF_FLAPS * flap_range
    total: float = sum(
        float(v) / UNITS[state] ** 2 for v, state in zip(states, task.axis.states, strict=True)
    )
    total += u / allowed**2
    L = loop.open_loop(gains)
    excess = max(0.0, peak_of(L) / PEAK - 1.0) + max(0.0, 2 * task.delay / max(delay_margin(L), 1e-4) - 1.0)
    excess += max(0.0, float(np.sqrt(u)) / allowed - 1.0)
    excess += max(0.0, abs(float(gains[0])) * task.error_limit / flap_range - 1.0)
    if task.axis.main == POSITION:
        excess += max(0.0, SIGMAS * float(np.sqrt(states[0])) / BOX_M - 1.0)
    return total + 100.0 * excess


def delay_margin(L: Complex) -> float:
    """Return the delay margin [s] from the lines beside each crossing: the search needs it too often for splines."""
    size, turned = np.log(np.abs(L)), np.unwrap(np.angle(L))
    at = np.flatnonzero(np.signbit(size[:-1]) != np.signbit(size[1:]))
    share = size[at] / (size[at] - size[at + 1])
    crossing = 2 * np.pi * FREQUENCIES[at] * (FREQUENCIES[at + 1] / FREQUENCIES[at]) ** share
    angle = (1 - share) * turned[at] + share * turned[at + 1]
    return float(np.min((angle + np.pi) % (2 * np.pi) / crossing, initial=inf))


def by_regulator(axis: Axis, robot: Robot) -> Matrix:
    """Return the gains of the axis' regulator, without its flap angle feedback."""
    Phi, Gamma = held(*dynamics(axis, robot), STEP_S)
    return with_integral(axis, regulator(axis, Phi, Gamma[:, :1], UNITS, FLAP_UNIT)[: len(axis.states)])


def design(task: GainTask, loops: Sequence[Loop], start: Sequence[Matrix]) -> Matrix:
    """Return gains for the first of the loops that suit all others as well. Raises `LabError` when none are found."""
    axis, looked_at = task.axis, [loops[0]]
    count = len(axis.states)
    scale = np.maximum(np.max(np.abs(start), axis=0)[:count], LEAST_GAIN)
    best = min(start, key=lambda gains: cost(loops[0], task, gains))
    for _ in range(ROUNDS):

        def dearest(x: Matrix) -> float:
            return max(cost(loop, task, with_integral(axis, x * scale)) for loop in looked_at)  # noqa: B023

        for _ in range(2):  # the second time with a fresh simplex
            x = best[:count] / scale
            options = {
                "maxfev": 400, "xatol": 1e-3, "fatol": 1e-4, "adaptive": True,
                "initial_simplex": np.concatenate([x[None], x + STEP * np.eye(count)]),
            }  # fmt: skip
            found = minimize(dearest, x, method="Nelder-Mead", options=options)
            best = with_integral(axis, np.asarray(found.x) * scale)
        costs = np.array([cost(loop, task, best) for loop in loops])
        if costs.max() <= 1.02 * found.fun or len(looked_at) == len(loops):
            break
        known = {id(loop) for loop in looked_at}
        ranked = [loops[place] for place in np.argsort(-costs)]
        looked_at += [loop for loop in ranked if id(loop) not in known][:WORST]
    if costs.max() >= TOO_MUCH:
        raise LabError(
            f"no gains: {task.axis.label}: {int(np.sum(costs >= TOO_MUCH))} of {len(loops)} robots that the intervals allow "
            "are unstable with the best gains found"
        )
    return np.array(rounded(best))


@dataclass(frozen=True, slots=True)
class TunedAxis:
    """One axis before and after."""

    axis: Axis
    old: Matrix
    new: Matrix
    old_margins: Margins
    margins: Margins
    least: Margins  # of all robots
    late: float  # [s] by which poses may be older than stated, for the robot
    least_late: float  # of the worst robots
    old_motion: PredictedMotion | None  # None: not stable by the model
    motion: PredictedMotion

    @property
    def metric(self) -> str:
        """The metric of its motion in a flight's result, empty for yaw, which has none."""
        return self.axis.coordinate and f"rms_{self.axis.coordinate}"


def judged(
    task: GainTask, robots: Sequence[Robot], loops: Sequence[Loop], old: Matrix, new: Matrix
) -> TunedAxis:
    """Return an axis with the margins and the motion of old and new gains; the first robot is the profile's."""
    before, found = margins(loops[0], old), [margins(loop, new) for loop in loops]
    late = [
        pose_delay_margin(task.axis, robots[place], task.config, task.timing, new)
        for place in [0, *sorted(range(1, len(robots)), key=lambda place: -found[place].peak)[:WORSE]]
    ]
    return TunedAxis(
        task.axis, old, new, before, found[0], worst(found), late[0], min(late),
        motion(loops[0], task, old) if before.stable else None, motion(loops[0], task, new),
    )  # fmt: skip


def refuse_late(axes: Sequence[TunedAxis], jitter_s: float) -> None:
    """Raise `LabError` for loops that tolerate less delay than the link has."""
    for one in axes:
        least = min(one.least.delay, one.least_late)
        if least < jitter_s:
            raise LabError(
                f"refused: {one.axis.label} tolerates {1e3 * least:.1f} ms of delay, and poses arrive up to "
                f"{1e3 * jitter_s:.1f} ms later than on the mean"
            )
