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
from firmware_py.core.subset import i32
from firmware_py.elementary import cos, sin
from firmware_py.geometry import from_euler_zyx, multiply
from hil.world.config import PlantConfig
from hil.world.fixed_order import Matrix, fit_polynomial
from hil.world.floaty.geometry import Weight
from hil.world.floaty.shape import MIX
from hil.world.motion import GRAVITY, evaluate
from hil.world.plates import LIFT_U4_MAX
from hil.world.structs import FloatyBlocks

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
# [1/s2] paper, Methods: contradicts the Table's +1100; tests/hil/research/studies/test_paper.py supports it
PITCH_INPUT_METHODS = -1066.0

LIFT_SAMPLES = np.linspace(-LIFT_U4_MAX, LIFT_U4_MAX, 45)  # [rad] u4 at which l is fitted, every 0.025
LIFT_ORDER = 6
AFFECTED = ("x", "y", "z", "roll", "pitch", "yaw")  # by the rows of `accelerations`
DIFFERENCE = 1e-3  # [rad, rad/s, m/s] step of the five-point difference


def calm(plant: FloatyBlocks, speed: float) -> FloatyBlocks:
    """Return a copy of the plant, level and at rest at the hover point, in a uniform flow of `speed` [m/s]."""
    copy = plant.copy()
    body, air, flaps = copy.body.fields, copy.air.fields, copy.flaps.fields
    body.p_WB[:], body.q_WB[:] = (0.0, 0.0, air.hover_height), (1.0, 0.0, 0.0, 0.0)
    body.v_WB[:] = body.omega_B[:] = body.push[:] = air.side_wind_W[:] = 0.0
    body.tether_length, body.net_height, body.held = math.inf, -math.inf, i32(0)
    flaps.angle[:] = flaps.hover
    air.speed, air.profile_radius, air.fan = speed, math.inf, 1.0
    air.height_slope = air.gust_scale = air.occlusion_depth = 0.0
    return copy


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


class Probe:
    """A calm plant of which one cause is changed."""

    def __init__(self, calm_plant: FloatyBlocks) -> None:
        self._calm, self._plant = calm_plant, calm_plant.copy()
        self._evaluate = bound(evaluate, *self._plant)

    def accelerations(self, cause: str, amount: float) -> Matrix:
        """Return linear (W) and angular accelerations (B), (6,), with a cause changed by `amount`."""
        for changed, block in zip(self._plant, self._calm, strict=True):
            changed.memory[:] = block.memory
        body, flaps = self._plant.body.fields, self._plant.flaps.fields
        if cause[0] == "u":
            flaps.angle[:] += amount * MIX[:, int(cause[1]) - 1]
        elif cause[0] == "v":
            body.v_WB["xyz".index(cause[1])] = amount
        elif cause[0] == "q":
            w, x, y, z = body.q_WB.tolist()
            about = [sin(amount / 2) * (axis == cause[1]) for axis in "xyz"]
            body.q_WB[:] = multiply((w, x, y, z), (cos(amount / 2), about[0], about[1], about[2]))
        else:
            body.omega_B["xyz".index(cause[1])] = amount
        self._evaluate()
        return np.concatenate([body.acceleration_W, body.alpha_B])

    def slope(self, cause: str) -> Matrix:
        """Return the change of the accelerations per unit of a cause."""
        h, of = DIFFERENCE, partial(self.accelerations, cause)
        return (8 * (of(h) - of(-h)) - (of(2 * h) - of(-2 * h))) / (12 * h)


def linearise(plant: FloatyBlocks, speed: float, point: OperatingPoint = LEVEL) -> Constants:
    """Return the constants of the plant about a point of a uniform flow of `speed` [m/s]: the level hover."""
    c = calm(plant, speed)
    c.flaps.fields.angle[:] += sum(column * u for column, u in zip(MIX.T, point.inputs, strict=True))
    c.air.fields.side_wind_W[:] = point.side_wind
    c.body.fields.q_WB[:] = from_euler_zyx(*point.attitude)
    slope_of = cache(Probe(c).slope)
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


def trim_and_correct(plant: FloatyBlocks, config: PlantConfig, weight: Weight) -> None:
    """Write the trimmed drag, then the correction of the configured variant; needs the plates and the true mass."""
    design, flaps = calm(plant, config.airspeed), plant.flaps.fields
    body, trimmed = design.body.fields, design.flaps.fields
    body.mass, body.inertia[:] = weight.mass, weight.inertia
    trimmed.drag_factor, trimmed.corrected, trimmed.pressure = 1.0, i32(0), 1.0
    bound(evaluate, *design)()
    flaps.pressure = trimmed.pressure = weight.mass * GRAVITY / body.wrench_B[2]
    flaps.airspeed = config.airspeed
    flaps.corrected = i32(config.variant != "plate")
    if config.variant == "plate":
        return

    probe = Probe(design)
    lift = [probe.accelerations("u4", u4)[2] / GRAVITY + 1.0 for u4 in LIFT_SAMPLES.tolist()]
    flaps.lift_fit[:] = fit_polynomial(LIFT_SAMPLES, np.array(lift), LIFT_ORDER)
    L = linearise(design, config.airspeed)
    T = target_constants(config, L)
    m, (ix, iy, _) = weight.mass, weight.inertia
    flaps.by_input[:3] = T.x_u2 / L.x_u2, T.y_u1 / L.y_u1, T.z_u4 / GRAVITY
    flaps.by_input[3:] = T.roll_u1 / L.roll_u1, iy * T.pitch_u2, T.yaw_u3 / L.yaw_u3
    flaps.by_tilt[:2] = m * (T.x_pitch - L.x_pitch), m * (T.y_roll - L.y_roll)
    flaps.by_tilt[3:5] = ix * (T.roll_roll - L.roll_roll), iy * (T.pitch_pitch - L.pitch_pitch)
    rates = (T.roll_rate - L.roll_rate, T.pitch_rate - L.pitch_rate, T.yaw_rate - L.yaw_rate)
    flaps.by_rate[3:] = np.multiply(weight.inertia, rates)
