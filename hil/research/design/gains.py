"""A design as a flyable profile: its geometry, its design point, its own model on board, and default gains for it.

Per axis the plate model follows the flaps' lag and one period of delay; the law feeds back position, velocity, angle and
rate, not the flap angles. The gains minimise the stationary quadratic cost under gusts (static output feedback), with
weights by Bryson's rule.
"""

from collections.abc import Mapping
from dataclasses import asdict
from math import degrees, radians
from typing import Any

import control
import numpy as np
from pydantic import BaseModel
from scipy.linalg import solve_discrete_lyapunov
from scipy.optimize import minimize

from hil.errors import LabError
from hil.research.design.axes import (
    ANGLE,
    AXES,
    POSITION,
    RATE,
    STEP_S,
    VELOCITY,
    YAW,
    Axis,
    Matrix,
    Robot,
    dynamics,
)
from hil.research.design.linear import Linear, Point
from hil.research.design.loop import held
from hil.world.config import GeometryConfig

FLAP_RATE = 20.0  # [1/s] of the servos' lag; original firmware
# The largest deviation in Bryson's rule, in SI units.
ALLOWED = {POSITION: 0.06, VELOCITY: 0.3, ANGLE: radians(8.0), RATE: 1.0}
TURN_ALLOWED = ALLOWED | {ANGLE: radians(10.0)}  # of yaw
FLAPS_ALLOWED = radians(8.0)
GUSTS = {VELOCITY: 0.01, RATE: 0.15}  # [m/s], [rad/s] per period: T0 on the paper's robot
INTEGRAL = 1.0 / 3.0  # [1/s] gain of the integral per gain, as in profiles/floaty.toml
LOST = 1e9


def gains_of(model: Linear) -> dict[str, float]:
    """Return the controller's gains by their names in a profile. Raises `LabError` when an axis cannot be held."""
    robot = model.robot | {"flap_rate": FLAP_RATE}
    found: dict[str, float] = {}
    for axis in AXES:
        found |= dict(zip(axis.gains, rounded(with_integral(axis, _least_cost(axis, robot))), strict=True))
    return found


def rounded(gains: Matrix) -> list[float]:
    """Return gains rounded to the four digits of a profile."""
    return [float(f"{gain:.4g}") for gain in gains]


def with_integral(axis: Axis, gains: Matrix) -> Matrix:
    """Return the gains on the states, and the integral's if it has one."""
    return gains if len(axis.gains) == len(axis.states) else np.append(gains, INTEGRAL * gains[0])


def regulator(axis: Axis, A: Matrix, B: Matrix, allowed: Mapping[str, float], input_allowed: float) -> Matrix:
    """Return the gains of the linear quadratic regulator on all rows of `A`, whose first are the axis' states.

    Raises `LabError` when the flaps cannot hold the axis.
    """
    Q = np.zeros_like(A)
    n = len(axis.states)
    Q[range(n), range(n)] = [allowed[state] ** -2 for state in axis.states]
    try:
        K, _, _ = control.dlqr(A, B, Q, [[input_allowed**-2]])
    except (np.linalg.LinAlgError, ValueError):
        raise LabError(f"no gains: {axis.label} cannot be held by the flaps") from None
    return np.asarray(K[0])


def _least_cost(axis: Axis, robot: Robot) -> Matrix:
    Phi, Gamma = held(*dynamics(axis, robot), STEP_S)
    n, size = len(axis.states), len(Phi) + 1  # the last state is the delayed command
    A, B = np.zeros((size, size)), np.eye(size)[:, -1:]
    A[:-1] = np.hstack([Phi, Gamma[:, :1]])
    allowed = TURN_ALLOWED if axis is YAW else ALLOWED
    Q, W = np.zeros((size, size)), np.zeros((size, size))
    Q[range(n), range(n)] = [allowed[state] ** -2 for state in axis.states]
    W[range(n), range(n)] = [GUSTS.get(state, 0.0) ** 2 for state in axis.states]

    def closed(gains: Matrix) -> tuple[Matrix, float]:
        row = np.append(gains, (0.0, 0.0))[None]
        return row, float(np.abs(np.linalg.eigvals(A - B @ row)).max())

    def cost(gains: Matrix) -> float:
        row, radius = closed(gains)
        if radius >= 0.9999:
            return LOST * radius
        weight = Q + row.T @ row * FLAPS_ALLOWED**-2
        return float(np.trace(solve_discrete_lyapunov((A - B @ row).T, weight) @ W))

    search = {"maxiter": 4000, "maxfev": 4000, "xatol": 1e-5, "fatol": 1e-9, "adaptive": True}
    best = regulator(axis, A, B, allowed, FLAPS_ALLOWED)[:n]
    for _ in range(2):  # the second starts at the first one's end, with a fresh simplex
        best = np.asarray(minimize(cost, best, method="Nelder-Mead", options=search).x)
    if cost(best) >= LOST * 0.9:
        raise LabError(
            f"no gains: {axis.label} cannot be held by these gains; its loop grows by {closed(best)[1]:.3f} per step"
        )
    return best


def profile_text(point: Point, gains: Mapping[str, float], about: str, length: float = 1.0) -> str:
    """Return a TOML profile based on `floaty`; the tunnel grows with a robot `length` times as long, never shrinks."""
    found = point.linear
    model = asdict(found.constants)
    sections: dict[str, Mapping[str, Any]] = {
        "geometry": changes(point.geometry, GeometryConfig()),
        "plant": {"variant": "plate", "airspeed": point.speed, "hover_angle": point.opening},
        "tunnel": {"speed": point.speed} | ({"profile_radius": 0.45 * length} if length > 1.0 else {}),
        "model": {name: float(f"{value:.5g}") for name, value in model.items()},
        "controller": gains,
        "allocation": {"hover_angle": float(f"{point.opening:.6g}"), "opening_min": point.low, "opening_max": point.high},
    }  # fmt: skip
    written = (
        f"{about}\nWritten by floaty design; hover at {degrees(point.opening):.2f} deg and {point.speed:.2f} m/s, C_D = "
        f"{point.coefficient:.4f}. Plate model on board; gains by hil/research/design/gains.py."
    )
    return toml_text(written, "floaty", sections)


def toml_text(about: str, base: str, sections: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a profile based on another one, with comments first; omit sections without keys."""
    lines = [*(f"# {line}" for line in about.splitlines()), f'base = "{base}"']
    for name, values in sections.items():
        if values:
            lines += ["", f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in values.items())]
    return "\n".join(lines) + "\n"


def changes(section: BaseModel, base: BaseModel) -> dict[str, Any]:
    """Return the values of a section that differ from another profile's."""
    own, usual = section.model_dump(), base.model_dump()
    return {key: value for key, value in own.items() if value != usual[key]}


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else repr(value)
