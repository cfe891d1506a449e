"""The authority of the flaps: every input inside the flaps' range, singly and together.

The robot is level in its updraft, so that each plate's force depends only on its vertical normal; one array holds all
openings.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from hil.research.design.linear import Point
from hil.world.config import GeometryConfig
from hil.world.floaty.geometry import weigh
from hil.world.floaty.shape import MIRRORS, MIX, SIGNS, turning_plates
from hil.world.motion import GRAVITY

GRID = 11  # openings of each flap between its limits
LEVEL_SHARE = 0.02  # of the weight: a lift within it holds the height
QUANTITIES = ("roll", "pitch", "yaw", "lift")  # [rad/s2] three times, then in weights
INPUT_CONSTANTS = dict(zip(QUANTITIES, ("roll_u1", "pitch_u2", "yaw_u3", "z_u4"), strict=True))
Wrenches = NDArray[np.float64]  # (N, 6) force [N] and torque [N m] in B


@dataclass(frozen=True, slots=True)
class Attainable:
    """The wrenches of all combinations of openings."""

    all: NDArray[np.float64]  # (N, 4) in the order of QUANTITIES
    level: NDArray[np.float64]  # (M, 4) those with the weight as lift


def wrenches(geometry: GeometryConfig, openings: NDArray[np.float64], pressure: float) -> Wrenches:
    """Return force and torque for openings (N, 4) [rad] in an updraft of dynamic pressure times C_D `pressure` [N/m2]."""
    height = weigh(geometry).axis_height
    total = np.zeros((len(openings), 6))
    total[:, 2] = pressure * geometry.base_side**2
    for area, *turning in turning_plates(geometry):
        for flap, mirror in enumerate(MIRRORS):
            # Cosine and sine in the sense of rotation of flap 2.
            c, s = np.cos(openings[:, flap])[:, None], -np.sin(openings[:, flap])[:, None]
            n, r = (mirror * (along + c * across + s * beside) for along, across, beside in turning)
            force = pressure * area * (n[:, 2] * np.abs(n[:, 2]))[:, None] * n
            total[:, :3] += force
            total[:, 3:] += np.cross(r + np.array([0.0, 0.0, height]), force)
    return total


def pressure_at(geometry: GeometryConfig, opening: float) -> float:
    """Return the dynamic pressure times C_D [N/m2] that carries the robot at an opening of all flaps."""
    lift = wrenches(geometry, np.full((1, 4), opening), 1.0)[0, 2]
    return float(weigh(geometry).mass * GRAVITY / lift)


def _accelerations(point: Point, openings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 4) in the order of QUANTITIES, at the hover."""
    weight = weigh(point.geometry)
    found = wrenches(point.geometry, openings, pressure_at(point.geometry, point.opening))
    return np.column_stack((found[:, 3:] / weight.inertia, found[:, 2] / (weight.mass * GRAVITY)))


def attainable(point: Point) -> Attainable:
    """Return the accelerations that the flaps attain between their limits, at the hover."""
    grid = np.linspace(point.low, point.high, GRID)
    every = _accelerations(point, np.array(list(product(grid, repeat=4))))
    level = every[np.abs(every[:, 3] - 1.0) < LEVEL_SHARE]
    return Attainable(every, level)


def single(point: Point) -> dict[str, tuple[float, float]]:
    """Return each input's smallest and largest own quantity, reached alone inside the flaps' range."""
    found = {}
    for index, name in enumerate(QUANTITIES):
        towards = SIGNS * MIX[:, index]  # of u on the openings: theta = SIGNS * opening
        ends = [(limit - point.opening) / t for t in towards for limit in (point.low, point.high)]
        least, most = max(e for e in ends if e <= 0), min(e for e in ends if e >= 0)
        u = np.linspace(least, most, 81)
        values = _accelerations(point, point.opening + u[:, None] * towards)[:, index]
        found[name] = (float(values.min()), float(values.max()))
    return found


def authorities(point: Point) -> dict[str, float]:
    """Return each input's authority about the hover: |input constant| times the reach; [1/s2] of angles, [m/s2] of lift."""
    f = point.linear.constants
    return {name: abs(getattr(f, constant)) * point.reach for name, constant in INPUT_CONSTANTS.items()}


def least(authorities: dict[str, float], of: dict[str, float]) -> float:
    """Return the smallest authority over the axes, each as a share of another robot's."""
    return min(authorities[name] / of[name] for name in QUANTITIES)
