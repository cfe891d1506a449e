"""A default design of the controller's gains for any robot: the least quadratic cost that the law's structure allows.

Per axis the plate model stands behind the flaps' lag and one period of delay; the law feeds back position, velocity, angle
and rate, not the flap angles. Its gains minimise the stationary cost under gusts (static output feedback), with
weights by Bryson's rule. `floaty design --write` puts them into a profile.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import radians

import numpy as np
from numpy.typing import NDArray

from hil.design.linear import Linear
from hil.errors import LabError

try:
    from scipy.linalg import expm, solve_discrete_are, solve_discrete_lyapunov
    from scipy.optimize import minimize
except ImportError:
    from firmware_py.extras import install_command

    raise LabError(f"gains need scipy: {install_command('design')}") from None

PERIOD = 0.01  # [s] of the controller
FLAP_RATE = 20.0  # [1/s] of the servos' lag; original firmware
# The greatest deviation that Bryson's rule allows, in SI units.
ALLOWED = {"position": 0.06, "velocity": 0.3, "angle": radians(8.0), "rate": 1.0, "turn": radians(10.0)}
FLAPS_ALLOWED = radians(8.0)
GUSTS = {"velocity": 0.01, "rate": 0.15}  # [m/s], [rad/s] per period: T0 on the paper's robot
INTEGRAL = 1.0 / 3.0  # [1/s] gain_iz per gain_z, as in profiles/floaty.toml
LOST = 1e9
Matrix = NDArray[np.float64]

# Gains by input: names in the profile, states of `Linear` behind them (None: the integral of the next), their kinds of units
LOOPS: tuple[tuple[tuple[str, ...], tuple[int | None, ...], tuple[str, ...]], ...] = (
    (("gain_y", "gain_vy", "gain_roll", "gain_p"), (None, 1, 3, 6), ("position", "velocity", "angle", "rate")),
    (("gain_x", "gain_vx", "gain_pitch", "gain_q"), (None, 0, 4, 7), ("position", "velocity", "angle", "rate")),
    (("gain_yaw", "gain_r"), (5, 8), ("turn", "rate")),
    (("gain_z", "gain_vz"), (None, 2), ("position", "velocity")),
)  # fmt: skip


def gains_of(model: Linear) -> dict[str, float]:
    """Return the controller's gains by their names in a profile. Raises `LabError` when an axis cannot be held."""
    found: dict[str, float] = {}
    for index, (names, states, kinds) in enumerate(LOOPS):
        values = _least_cost(*_sampled(model, index, states), kinds, names[0])
        found |= {name: float(f"{value:.4g}") for name, value in zip(names, values, strict=True)}
    return found | {"gain_iz": float(f"{INTEGRAL * found['gain_z']:.4g}")}


def _sampled(model: Linear, index: int, states: Sequence[int | None]) -> tuple[Matrix, Matrix]:
    """Return one axis sampled: its states, the flap angle, and the command that is still delayed."""
    n = len(states)
    flow = np.zeros((n + 2, n + 2))  # the last one is the command, held
    for row, state in enumerate(states):
        if state is None:
            flow[row, row + 1] = 1.0
            continue
        for column, other in enumerate(states):
            if other is not None:
                flow[row, column] = model.A[state, other]
        flow[row, n] = model.B[state, index]
    flow[n, n], flow[n, n + 1] = -FLAP_RATE, FLAP_RATE
    stepped = expm(flow * PERIOD)
    A = np.zeros((n + 2, n + 2))
    A[: n + 1] = stepped[: n + 1]
    B = np.zeros((n + 2, 1))
    B[n + 1] = 1.0
    return A, B


def _least_cost(A: Matrix, B: Matrix, kinds: Sequence[str], name: str) -> Matrix:
    n = len(kinds)
    Q = np.zeros_like(A)
    Q[range(n), range(n)] = [ALLOWED[kind] ** -2 for kind in kinds]
    R = np.array([[FLAPS_ALLOWED**-2]])
    W = np.zeros_like(A)
    W[range(n), range(n)] = [GUSTS.get(kind, 0.0) ** 2 for kind in kinds]
    try:
        P = solve_discrete_are(A, B, Q, R)
    except (np.linalg.LinAlgError, ValueError):
        raise LabError(f"no gains: {name[5:]} cannot be held by the flaps") from None
    start = np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)[0, :n]

    def radius(K: Matrix) -> float:
        return float(np.abs(np.linalg.eigvals(A - B @ np.append(K, (0.0, 0.0))[None])).max())

    def cost(K: Matrix) -> float:
        if radius(K) >= 0.9999:
            return LOST * radius(K)
        row = np.append(K, (0.0, 0.0))[None]
        closed = A - B @ row
        return float(np.trace(solve_discrete_lyapunov(closed.T, Q + row.T @ R @ row) @ W))

    search = {"maxiter": 4000, "maxfev": 4000, "xatol": 1e-5, "fatol": 1e-9, "adaptive": True}
    best: Matrix = np.asarray(start)
    for _ in range(2):  # the second from the end of the first, with a fresh simplex
        best = np.asarray(minimize(cost, best, method="Nelder-Mead", options=search).x)
    if cost(best) >= LOST * 0.9:
        raise LabError(
            f"no gains: {name[5:]} cannot be held by these four gains; its loop grows by {radius(best):.3f} per step"
        )
    return best
