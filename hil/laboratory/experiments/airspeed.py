"""Airspeeds: the paper's 8 to 11 m/s, with the hover angle adapted to each, within this plant's lift.

By the Table the lift at speed V and opening theta is m g (V/10)^2 (1 + (2.3/g) (25 deg - theta)): closing a flap further
adds little lift, opening it costs little. Attitude control needs up to 8 degrees of the opening (95 % of the hover's
time), so that the flaps can carry the robot between -3 and 44 degrees: 9.5 to 10.4 m/s. Outside it sinks or rises; 8 m/s
would need 56 % more lift than at 10 m/s, and a flat plate of Floaty's size has 18 % more. Every speed is flown with the
flaps opened through zero.
"""

from collections.abc import Mapping
from functools import partial
from math import degrees, radians, sqrt

import numpy as np
import pyarrow as pa

from hil.laboratory.experiment import Experiment
from hil.laboratory.metrics import BOX, column, position_error

DESIGN_SPEED, DESIGN_ANGLE = 10.0, radians(25.0)  # [m/s], [rad] paper
LIFT_PER_RAD = 2.3 / 9.81  # share of the weight; paper, Table: z per u4
OPENING_MIN, OPENING_MAX = -0.192, 0.9  # [rad] -11 deg; the profile's
FOR_ATTITUDE = radians(8.0)  # [rad] of the opening


def hover_angle(speed: float) -> float:
    """Return the opening [rad] at which the lift equals the weight at `speed` [m/s], even outside the flaps' range."""
    return DESIGN_ANGLE - ((DESIGN_SPEED / speed) ** 2 - 1.0) / LIFT_PER_RAD


def attainable() -> tuple[float, float]:
    """Return the smallest and the largest speed [m/s] at which the flaps carry the robot and control its attitude."""
    low, high = (
        DESIGN_SPEED / sqrt(1.0 + LIFT_PER_RAD * (DESIGN_ANGLE - opening))
        for opening in (OPENING_MIN + FOR_ATTITUDE, OPENING_MAX - FOR_ATTITUDE)
    )
    return low, high


def holding(speed: float, flight: pa.Table) -> Mapping[str, float]:
    """Return the mean error in height over the second half, and whether it agrees with the lift model."""
    low, high = attainable()
    times, height = column(flight, "t"), position_error(flight)[:, 2]
    error = float(abs(height[times >= times.mean()].mean()))
    return {"height_off": error, "as_computed": float((error <= BOX) == (low <= speed <= high))}


def airspeed(speed: float) -> Experiment:
    """Return the hover at a speed [m/s]."""
    low, high = attainable()
    carried = low <= speed <= high
    held = {"lost": 0.0, "height_off": 0.06, "in_box": 0.85}
    limits = {"as_computed": 1.0} | (held if carried else {"lost": 1.0})
    wanted = hover_angle(speed)
    angle = float(np.clip(wanted, 0.0, OPENING_MAX))
    outcome = "carried" if carried else "beyond the flaps"
    return Experiment(
        name=f"airspeed-{speed:g}",
        summary=f"hover at {speed:g} m/s: needs flaps at {degrees(wanted):.0f} deg, {outcome} (paper: 8 to 11 m/s)",
        duration_s=10.0,
        limits=limits,
        settings=(
            f"tunnel.speed={speed:g}", f"allocation.hover_angle={angle:.4f}", f"allocation.opening_min={OPENING_MIN}",
        ),
        measure=partial(holding, speed),
        pictures=("airspeed",),
    )  # fmt: skip


AIRSPEEDS = tuple(airspeed(speed) for speed in (8.0, 8.5, 9.0, 9.5, 9.75, 10.0, 10.25, 10.5, 11.0))
