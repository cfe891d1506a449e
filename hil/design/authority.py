"""The authority of the flaps: every input inside the flaps' range, singly and together.

The robot is level in its updraft, so that each plate's force depends only on its vertical normal; one array holds all
openings.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from hil.design.linear import Linear
from hil.floaty.geometry import axis_of, weigh
from hil.floaty.shape import MIRRORS, MIX, SIGNS, flap_plates
from hil.world.config import GeometryConfig
from hil.world.motion import GRAVITY

GRID = 11  # openings of each flap between its limits
LEVEL_SHARE = 0.02  # of the weight: a lift within it holds the height
QUANTITIES = ("roll", "pitch", "yaw", "lift")  # [rad/s2] three times, then in weights
Wrenches = NDArray[np.float64]  # (N, 6) force [N] and torque [N m] in B


@dataclass(frozen=True, slots=True)
class Attainable:
    """The wrenches of all combinations of openings."""

    all: NDArray[np.float64]  # (N, 4) in the order of QUANTITIES
    level: NDArray[np.float64]  # (M, 4) those with the weight as lift


def wrenches(geometry: GeometryConfig, openings: NDArray[np.float64], pressure: float) -> Wrenches:
    """Return force and torque for openings (N, 4) [rad] in an updraft of dynamic pressure times C_D `pressure` [N/m2]."""
    height, axis = weigh(geometry).axis_height, axis_of(geometry)
    total = np.zeros((len(openings), 6))
    total[:, 2] = pressure * geometry.base_side**2
    for part in flap_plates(geometry):
        for flap, mirror in enumerate(MIRRORS):
            # Cosine and sine in the sense of rotation of flap 2.
            c, s = np.cos(openings[:, flap])[:, None], -np.sin(openings[:, flap])[:, None]
            n, r = (
                mirror * ((axis @ v) * axis + c * (v - (axis @ v) * axis) + s * np.cross(axis, v))
                for v in (part.normal, part.centre)
            )
            force = pressure * part.area * (n[:, 2] * np.abs(n[:, 2]))[:, None] * n
            total[:, :3] += force
            total[:, 3:] += np.cross(r + np.array([0.0, 0.0, height]), force)
    return total


def pressure_at(geometry: GeometryConfig, opening: float) -> float:
    """Return the dynamic pressure times C_D [N/m2] that carries the robot at an opening of all flaps."""
    lift = wrenches(geometry, np.full((1, 4), opening), 1.0)[0, 2]
    return float(weigh(geometry).mass * GRAVITY / lift)


def _accelerations(
    geometry: GeometryConfig, opening: float, openings: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (N, 4) in the order of QUANTITIES, at the hover with `opening`."""
    weight = weigh(geometry)
    found = wrenches(geometry, openings, pressure_at(geometry, opening))
    return np.column_stack((found[:, 3:] / weight.inertia, found[:, 2] / (weight.mass * GRAVITY)))


def attainable(geometry: GeometryConfig, opening: float, low: float, high: float) -> Attainable:
    """Return the accelerations that the flaps attain between two openings [rad], at the hover with `opening`."""
    grid = np.linspace(low, high, GRID)
    every = _accelerations(geometry, opening, np.array(list(product(grid, repeat=4))))
    level = every[np.abs(every[:, 3] - 1.0) < LEVEL_SHARE]
    return Attainable(every, level)


def reach(opening: float, low: float, high: float) -> float:
    """Return the angle [rad] that every flap can turn in both directions from the hover."""
    return max(min(opening - low, high - opening), 0.0)


def single(
    geometry: GeometryConfig, opening: float, low: float, high: float
) -> dict[str, tuple[float, float]]:
    """Return each input's smallest and largest own quantity, reached alone inside the flaps' range."""
    found = {}
    for index, name in enumerate(QUANTITIES):
        towards = SIGNS * MIX[:, index]  # of u on the openings: theta = SIGNS * opening
        ends = [(limit - opening) / t for t in towards for limit in (low, high)]
        least, most = max(e for e in ends if e <= 0), min(e for e in ends if e >= 0)
        u = np.linspace(least, most, 81)
        values = _accelerations(geometry, opening, opening + u[:, None] * towards)[:, index]
        found[name] = (float(values.min()), float(values.max()))
    return found


def authority(linear: Linear, opening: float, low: float, high: float) -> dict[str, float]:
    """Return each input's authority about the hover: |input constant| times the reach; [1/s2] of angles, [m/s2] of lift."""
    f, far = linear.constants, reach(opening, low, high)
    return {
        "roll": abs(f.roll_u1) * far, "pitch": abs(f.pitch_u2) * far, "yaw": abs(f.yaw_u3) * far, "lift": abs(f.z_u4) * far,
    }  # fmt: skip


def least(authorities: dict[str, float], of: dict[str, float]) -> float:
    """Return the smallest authority over the axes, each as a share of another robot's."""
    return min(authorities[name] / of[name] for name in QUANTITIES)
