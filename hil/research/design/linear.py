"""The linear dynamics of a geometry about its level hover: the full plate model by central differences, poles per axis.

States: velocity x, y, z (W), small turns about x, y, z, rates about x, y, z (B). Inputs: the paper's u1..u4 [rad].
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hil.config import LabConfig
from hil.research.design.axes import ANGLE, AXES, FLAP, NUISANCES, PITCH, RATE, ROLL, VELOCITY, Axis, Matrix
from hil.research.design.trim import coefficient_of, speed_at
from hil.world.config import GeometryConfig, PlantConfig, TunnelConfig
from hil.world.floaty.correction import DIFFERENCE, Constants, Probe, calm
from hil.world.floaty.plant import assemble
from hil.world.structs import FloatyBlocks

CAUSES = ("vx", "vy", "vz", "qx", "qy", "qz", "ox", "oy", "oz", "u1", "u2", "u3", "u4")
STATES = 9


@dataclass(frozen=True, slots=True)
class Linear:
    """x' = A x + B u about a hover."""

    A: Matrix  # (9, 9)
    B: Matrix  # (9, 4)

    @property
    def constants(self) -> Constants:
        return Constants(**{name: value for name, value in self.robot.items() if name not in NUISANCES})

    @property
    def robot(self) -> dict[str, float]:
        """All constants of the four axes."""
        both = np.hstack([self.A, self.B])
        return {
            name: float(both[_place(axis, affected), _place(axis, cause)])
            for axis in AXES
            for name, (affected, cause) in axis.terms.items()
        }

    def poles(self, axis: Axis) -> list[complex]:
        """Return the open-loop poles [1/s] of an axis and its velocity, the slowest oscillation first."""
        chosen = places(axis)
        found = np.linalg.eigvals(self.A[np.ix_(chosen, chosen)])
        return sorted(map(complex, found), key=lambda pole: (-abs(pole.imag), -pole.real, -pole.imag))

    def steady(self, axis: Axis) -> float:
        """Return the sideways acceleration per input [m/s2] after the attitude has settled, in its usual direction.

        Negative: the robot steers in the opposite direction to the paper's; NaN for yaw and height.
        """
        f = self.constants
        if axis is PITCH:
            return f.x_u2 - f.x_pitch * f.pitch_u2 / f.pitch_pitch
        return -(f.y_u1 - f.y_roll * f.roll_u1 / f.roll_roll) if axis is ROLL else math.nan

    def growth(self, axis: Axis) -> float:
        """Return the largest real part of an axis' poles [1/s]: positive when it is unstable."""
        return max(pole.real for pole in self.poles(axis))


def places(axis: Axis) -> list[int]:
    """Return the places of an axis' states in CAUSES, except the controlled one, which has no effect."""
    return [_place(axis, state) for state in axis.states[1:]]


def _place(axis: Axis, state: str) -> int:
    if state == VELOCITY:
        return "xyz".index(axis.coordinate)
    return {ANGLE: 3, RATE: 6, FLAP: STATES}[state] + axis.input


def calm_plates(geometry: GeometryConfig, speed: float, opening: float) -> FloatyBlocks:
    """Return the plate model, level and at rest at a hover, at a speed [m/s] and opening [rad]."""
    plant = PlantConfig(variant="plate", airspeed=speed, hover_angle=opening)
    blocks, _ = assemble(geometry, plant, TunnelConfig(turbulence="none"))
    return calm(blocks, speed)


@lru_cache(4)  # a search looks at the same hover several times
def linear(geometry: GeometryConfig, speed: float, opening: float) -> Linear:
    """Return the dynamics of the plates in a hover at a speed [m/s] and opening [rad]."""
    probe = Probe(calm_plates(geometry, speed, opening))
    slopes = np.array([probe.slope(cause) for cause in CAUSES]).T  # (6, 13)
    A, B = np.zeros((STATES, STATES)), np.zeros((STATES, 4))
    A[:3], A[6:] = slopes[:3, :STATES], slopes[3:, :STATES]
    A[3:6, 6:] = np.eye(3)
    B[:3], B[6:] = slopes[:3, STATES:], slopes[3:, STATES:]
    return Linear(A, B)


def stiffness(geometry: GeometryConfig, speed: float, opening: float) -> float:
    """Return f_αα alone: roll acceleration per roll angle [1/s2]."""
    probe = Probe(calm_plates(geometry, speed, opening))
    change = probe.accelerations("qx", DIFFERENCE) - probe.accelerations("qx", -DIFFERENCE)
    return float(change[3]) / (2 * DIFFERENCE)


@dataclass(frozen=True, slots=True)
class Point:
    """A robot at its hover."""

    geometry: GeometryConfig
    coefficient: float  # of drag
    opening: float  # [rad]
    low: float  # [rad] smallest and largest opening
    high: float

    @property
    def speed(self) -> float:
        """The updraft [m/s]."""
        return speed_at(self.geometry, self.coefficient, self.opening)

    @property
    def reach(self) -> float:
        """The angle [rad] that every flap can turn in both directions from the hover."""
        return max(min(self.opening - self.low, self.high - self.opening), 0.0)

    @property
    def linear(self) -> Linear:
        return linear(self.geometry, self.speed, self.opening)


def point_of(config: LabConfig) -> Point:
    """Return a profile's robot at its design hover."""
    opening, limits = config.plant.hover_angle, config.allocation
    return Point(config.geometry, coefficient_of(config), opening, limits.opening_min, limits.opening_max)
