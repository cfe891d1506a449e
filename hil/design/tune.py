"""Gains of the law's own structure for one axis: least motion in the measured flow, within the margins, for every robot.

The design model is `hil.design.loop`, with estimator, predictor, lag and delays inside. The search (Nelder-Mead) begins at
the linear quadratic regulator of the axis and at the old gains, and adds the worst of the drawn robots to those that it
considers until no robot is worse. A robot that moves too much for the box or the flaps, or a loop without its margins, costs
more than any motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf, radians

import numpy as np

from hil.design.loop import (
    ANGLE,
    FREQUENCIES,
    POSITION,
    RATE,
    STEP_S,
    VELOCITY,
    Axis,
    Complex,
    Loop,
    Matrix,
    Robot,
    dynamics,
    held,
    margins_of,
    response_to,
)
from hil.errors import LabError

try:
    from scipy.linalg import solve_discrete_are
    from scipy.optimize import minimize
except ImportError:
    from firmware_py.extras import install_command

    raise LabError(f"gains need scipy: {install_command('design')}") from None

PEAK = 1.9  # of the sensitivity, for every robot: a gain margin of 2.1, a phase margin of 30 deg
BOX_M = 0.10
SIGMAS = 3.0  # that stay inside the box and clear of the flaps' limits
UNITS = {POSITION: 0.02, VELOCITY: 0.3, ANGLE: radians(5.0), RATE: 2.0}  # one unit of motion in the cost
OF_FLAPS = 0.25  # share of a flap's range that one input may take, standard deviation
ROUNDS = 3
WORST = 2  # robots added per round
TOO_MUCH = 1e3
INTEGRAL = 1.0 / 3.0  # [1/s] gain of the integral per gain, as in profiles/floaty.toml
LEAST_GAIN, STEP = 0.02, 0.2  # of the search: least scale of a gain, and the first step


@dataclass(frozen=True, slots=True)
class Task:
    """The requirements on the gains of an axis."""

    axis: Axis
    spectrum: Complex  # (L, W, W) of the flow's accelerations
    input: float  # [rad] that the robot needs at rest
    angle: float  # [rad] at which it rests
    flap_range: float  # [rad] from hover to the nearer limit
    error_limit: float  # limit on the error of the main state that the law feeds back
    delay: float  # [s] that the margin must exceed

    def offset(self, gains: Matrix) -> float:
        """Return where the main state comes to rest; an integral brings it to its goal."""
        if len(gains) > len(self.axis.states):
            return 0.0
        turned = gains[self.axis.states.index(ANGLE)] * self.angle if self.axis.main == POSITION else 0.0
        return -(self.input + turned) / gains[0] if gains[0] else inf


@dataclass(frozen=True, slots=True)
class Motion:
    """The predicted motion of a robot."""

    main: float  # [m] or [rad] rms of the main state's error
    input: float  # [rad] rms of the input's variation


def motion(loop: Loop, task: Task, gains: Matrix) -> Motion:
    """Return the motion of a stable loop in the flow."""
    states, u = response_to(task.spectrum, loop, gains)
    return Motion(float(np.sqrt(states[0] + task.offset(gains) ** 2)), float(np.sqrt(u)))


def cost(loop: Loop, task: Task, gains: Matrix) -> float:
    """Return the cost of a robot with gains: motion in units, and far more for violated conditions."""
    radius = loop.radius(gains)
    if radius >= 1.0:
        return TOO_MUCH * (1.0 + radius)
    states, u = response_to(task.spectrum, loop, gains)
    states[0] += task.offset(gains) ** 2
    allowed = OF_FLAPS * task.flap_range
    total: float = sum(
        float(v) / UNITS[state] ** 2 for v, state in zip(states, task.axis.states, strict=True)
    )
    total += u / allowed**2
    found = margins_of(2 * np.pi * FREQUENCIES, loop.open_loop(gains))
    excess = max(0.0, found.peak / PEAK - 1.0) + max(0.0, 2 * task.delay / max(found.delay, 1e-4) - 1.0)
    excess += max(0.0, float(np.sqrt(u)) / allowed - 1.0)
    excess += max(0.0, abs(float(gains[0])) * task.error_limit / task.flap_range - 1.0)
    if task.axis.main == POSITION:
        excess += max(0.0, SIGMAS * float(np.sqrt(states[0])) / BOX_M - 1.0)
    return total + 100.0 * excess


def regulator(axis: Axis, robot: Robot) -> Matrix:
    """Return the gains of the linear quadratic regulator of the axis, without its feedback of the flap angles."""
    Phi, Gamma = held(*dynamics(axis, robot), STEP_S)
    Q = np.diag([*(UNITS[state] ** -2 for state in axis.states), 0.0])
    R = np.array([[0.1**-2]])
    try:
        P = solve_discrete_are(Phi, Gamma[:, :1], Q, R)
    except (np.linalg.LinAlgError, ValueError):
        raise LabError(f"no gains: {axis.name} cannot be held by the flaps") from None
    B = Gamma[:, :1]
    return _whole(axis, np.linalg.solve(R + B.T @ P @ B, B.T @ P @ Phi)[0, : len(axis.states)])


def _whole(axis: Axis, gains: Matrix) -> Matrix:
    """Return the gains on the states, and that of the integral where there is one."""
    return gains if len(axis.gains) == len(axis.states) else np.append(gains, INTEGRAL * gains[0])


def design(task: Task, loops: Sequence[Loop], start: Sequence[Matrix]) -> Matrix:
    """Return gains for the first of the loops that suit all others as well. Raises `LabError` when none are found."""
    axis, looked_at = task.axis, [loops[0]]
    count = len(axis.states)
    scale = np.maximum(np.max(np.abs(start), axis=0)[:count], LEAST_GAIN)
    best = min(start, key=lambda gains: cost(loops[0], task, gains))
    for _ in range(ROUNDS):

        def dearest(x: Matrix) -> float:
            return max(cost(loop, task, _whole(axis, x * scale)) for loop in looked_at)  # noqa: B023

        for _ in range(2):  # the second time with a fresh simplex
            x = best[:count] / scale
            options = {
                "maxfev": 400, "xatol": 1e-3, "fatol": 1e-4, "adaptive": True,
                "initial_simplex": np.concatenate([x[None], x + STEP * np.eye(count)]),
            }  # fmt: skip
            found = minimize(dearest, x, method="Nelder-Mead", options=options)
            best = _whole(axis, np.asarray(found.x) * scale)
        costs = np.array([cost(loop, task, best) for loop in loops])
        if costs.max() <= 1.02 * found.fun or len(looked_at) == len(loops):
            break
        known = {id(loop) for loop in looked_at}
        ranked = [loops[place] for place in np.argsort(-costs)]
        looked_at += [loop for loop in ranked if id(loop) not in known][:WORST]
    if costs.max() >= TOO_MUCH:
        raise LabError(
            f"no gains: {task.axis.name}: {int(np.sum(costs >= TOO_MUCH))} of {len(loops)} robots that the intervals allow "
            "are unstable with the best gains found"
        )
    return np.array([float(f"{gain:.4g}") for gain in best])
