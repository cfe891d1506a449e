"""Trim, linearisation and the identified correction of the plate model (docs/explanation/plant.md).

The values that depend on the plate model (trim, its own constants L, its lift ratio l) are computed here once by the
compiled model itself; only the target constants T are typed, with their source.
"""

import math
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from typing import Any

import numpy as np

from firmware_py.compiling import bound
from firmware_py.elementary import cos, sin
from firmware_py.geometry import from_euler_zyx, multiply
from hil.floaty.geometry import Weight
from hil.floaty.shape import MIX
from hil.world import layout as at
from hil.world.config import PlantConfig
from hil.world.fixed_order import fit_polynomial
from hil.world.motion import GRAVITY, evaluate
from hil.world.plates import LIFT_U4_MAX, State

# The paper's Table "Empirical estimation of dynamics constants": value and uncertainty, by the names of `Constants`.
PAPER_TABLE: dict[str, tuple[float, float]] = {
    "roll_u1": (230.0, 66.0),
    "roll_roll": (-16.0, 10.0),
    "roll_rate": (-40.0, 12.0),
    "y_u1": (-4.8, 0.1),
    "y_roll": (-6.5, 0.1),
    "pitch_u2": (1100.0, 170.0),
    "pitch_pitch": (-1560.0, 25.0),
    "pitch_rate": (-29.0, 5.0),
    "x_u2": (-0.8, 0.1),
    "x_pitch": (2.5, 0.1),
    "yaw_u3": (110.0, 1.8),
    "yaw_rate": (-7.7, 0.1),
    "z_u4": (2.3, 0.3),
    "z_vz": (-2.0, 0.1),
}


@dataclass(frozen=True, slots=True)
class Constants:
    """The linearised dynamics at hover: f_{affected, cause}; SI, W axes for x y z, the paper's u1..u4 [rad]."""

    roll_u1: float
    roll_roll: float
    roll_rate: float
    y_u1: float
    y_roll: float
    pitch_u2: float
    pitch_pitch: float
    pitch_rate: float
    x_u2: float
    x_pitch: float
    yaw_u3: float
    yaw_rate: float
    z_u4: float
    # Couplings that the Table omits or that no variant changes; the others determine them (any flat plates)
    z_vz: float = math.nan
    y_vy: float = math.nan
    x_vx: float = math.nan
    roll_vy: float = math.nan
    pitch_vx: float = math.nan


TABLE = Constants(**{name: value for name, (value, _) in PAPER_TABLE.items()})
# [1/s2] paper, Methods: contradicts the Table's +1100; tests/hil/test_paper.py supports it
PITCH_INPUT_METHODS = -1066.0

LIFT_SAMPLES = np.linspace(-LIFT_U4_MAX, LIFT_U4_MAX, 45)  # [rad] u4 at which l is fitted, every 0.025
LIFT_ORDER = 6
AFFECTED = ("x", "y", "z", "roll", "pitch", "yaw")  # by the rows of `accelerations`
DIFFERENCE = 1e-3  # [rad, rad/s, m/s] step of the five-point difference


def calm(s: State, speed: float) -> State:
    """Return a copy of the plant, level and at rest at the hover point, in a uniform flow of `speed` [m/s]."""
    c = s.copy()
    c[at.P : at.P + 3] = 0.0, 0.0, s[at.HOVER_HEIGHT]
    c[at.Q : at.Q + 4] = 1.0, 0.0, 0.0, 0.0
    c[at.V : at.V + 3] = c[at.OMEGA : at.OMEGA + 3] = c[at.SIDE_WIND : at.SIDE_WIND + 3] = 0.0
    c[at.PUSH : at.PUSH + 3] = c[at.PUSH_TORQUE : at.PUSH_TORQUE + 3] = 0.0
    c[at.FLAPS : at.FLAPS + 4] = s[at.HOVER_FLAPS : at.HOVER_FLAPS + 4]
    c[at.SPEED], c[at.PROFILE_RADIUS], c[at.FAN] = speed, math.inf, 1.0
    c[at.HEIGHT_SLOPE] = c[at.GUST_SCALE] = c[at.OCCLUSION + 3] = c[at.HELD] = 0.0
    c[at.TETHER_LENGTH] = math.inf
    c[at.NET_HEIGHT] = -math.inf
    return c


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """A robot's mean state in flight: inputs u1..u4 [rad], attitude roll, pitch, yaw [rad], side wind [m/s, W].

    `speed` is the mean flow [m/s]; None: the design's.
    """

    inputs: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    attitude: tuple[float, float, float] = (0.0, 0.0, 0.0)
    side_wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    speed: float | None = None


LEVEL = OperatingPoint()


def accelerations(c: State, cause: str, amount: float) -> State:
    """Return ACC (W) and ALPHA (B), (6,), of a calm plant with one cause changed by `amount`."""
    s = c.copy()
    if cause[0] == "u":
        s[at.FLAPS : at.FLAPS + 4] += amount * MIX[:, int(cause[1]) - 1]
    elif cause[0] == "v":
        s[at.V + "xyz".index(cause[1])] = amount
    elif cause[0] == "q":
        w, x, y, z = c[at.Q : at.Q + 4].tolist()
        about = [sin(amount / 2) * (axis == cause[1]) for axis in "xyz"]
        s[at.Q : at.Q + 4] = multiply((w, x, y, z), (cos(amount / 2), about[0], about[1], about[2]))
    else:
        s[at.OMEGA + "xyz".index(cause[1])] = amount
    bound(evaluate, s)()
    return np.concatenate([s[at.ACC : at.ACC + 3], s[at.ALPHA : at.ALPHA + 3]])


def slope(c: State, cause: str) -> State:
    """Return the change of ACC (W) and ALPHA (B), (6,), of a calm plant per unit of a cause."""
    h = DIFFERENCE
    near = accelerations(c, cause, h) - accelerations(c, cause, -h)
    far = accelerations(c, cause, 2 * h) - accelerations(c, cause, -2 * h)
    return (8 * near - far) / (12 * h)


def linearise(s: State, speed: float, point: OperatingPoint = LEVEL) -> Constants:
    """Return the constants of the plant in `s` about a point of a uniform flow of `speed` [m/s]: the level hover."""
    c = calm(s, speed)
    c[at.FLAPS : at.FLAPS + 4] += sum(column * u for column, u in zip(MIX.T, point.inputs, strict=True))
    c[at.SIDE_WIND : at.SIDE_WIND + 3] = point.side_wind
    c[at.Q : at.Q + 4] = from_euler_zyx(*point.attitude)
    slope_of = cache(partial(slope, c))
    found = {}
    for name in (field.name for field in fields(Constants)):
        affected, cause = name.split("_")
        row = AFFECTED.index(affected)
        turn = {"roll": "qx", "pitch": "qy", "rate": f"o{'xyz'[row - 3]}"}.get(cause, cause)
        found[name] = float(slope_of(turn)[row])
    return Constants(**found)


def target_constants(config: PlantConfig, plate: Constants) -> Constants:
    """Return the target constants of the configured variant; `plate` are the plate model's own constants."""
    changes: dict[str, Any] = {}
    if config.variant.startswith("methods"):
        changes["pitch_u2"] = PITCH_INPUT_METHODS
    if config.variant.endswith("_open"):
        changes |= {rate: getattr(plate, rate) for rate in ("roll_rate", "pitch_rate", "yaw_rate")}
    target = replace(TABLE, **changes)
    factors = config.constant_factors
    return replace(target, **{name: factors[name] * getattr(target, name) for name in factors})


def trim_and_correct(s: State, config: PlantConfig, weight: Weight) -> None:
    """Write the trimmed drag, then the correction of the configured variant; needs the plates and the true mass in `s`."""
    design = calm(s, config.airspeed)
    design[at.MASS], design[at.DRAG_FACTOR], design[at.CORRECTED] = weight.mass, 1.0, 0.0
    design[at.INERTIA : at.INERTIA + 3] = weight.inertia
    design[at.PRESSURE] = 1.0
    bound(evaluate, design)()
    s[at.PRESSURE] = design[at.PRESSURE] = weight.mass * GRAVITY / design[at.DRAG + 2]
    s[at.AIRSPEED] = config.airspeed
    s[at.CORRECTED] = float(config.variant != "plate")
    if config.variant == "plate":
        return

    lift = [accelerations(design, "u4", u4)[2] / GRAVITY + 1.0 for u4 in LIFT_SAMPLES.tolist()]
    s[at.LIFT_FIT : at.LIFT_FIT + LIFT_ORDER + 1] = fit_polynomial(LIFT_SAMPLES, np.array(lift), LIFT_ORDER)
    L = linearise(design, config.airspeed)
    T = target_constants(config, L)
    m, (ix, iy, iz) = weight.mass, weight.inertia
    s[at.X_INPUT], s[at.X_TILT] = T.x_u2 / L.x_u2, m * (T.x_pitch - L.x_pitch)
    s[at.Y_INPUT], s[at.Y_TILT] = T.y_u1 / L.y_u1, m * (T.y_roll - L.y_roll)
    s[at.Z_INPUT] = T.z_u4 / GRAVITY
    s[at.ROLL_INPUT], s[at.ROLL_TILT] = T.roll_u1 / L.roll_u1, ix * (T.roll_roll - L.roll_roll)
    s[at.ROLL_RATE] = ix * (T.roll_rate - L.roll_rate)
    s[at.PITCH_INPUT], s[at.PITCH_TILT] = iy * T.pitch_u2, iy * (T.pitch_pitch - L.pitch_pitch)
    s[at.PITCH_RATE] = iy * (T.pitch_rate - L.pitch_rate)
    s[at.YAW_INPUT], s[at.YAW_RATE] = T.yaw_u3 / L.yaw_u3, iz * (T.yaw_rate - L.yaw_rate)
