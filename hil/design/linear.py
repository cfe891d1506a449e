"""The linear dynamics of a geometry about its level hover: the full plate model by central differences, poles per axis.

States: velocity x, y, z (W), small turns about x, y, z, rates about x, y, z (B). Inputs: the paper's u1..u4 [rad].
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.world.config import GeometryConfig, PlantConfig, TunnelConfig
from hil.world.correction import DIFFERENCE, Constants, accelerations, calm, slope
from hil.world.plant import assemble
from hil.world.plates import State

CAUSES = ("vx", "vy", "vz", "qx", "qy", "qz", "ox", "oy", "oz", "u1", "u2", "u3", "u4")
STATES = 9
AXES = {"roll": (1, 3, 6), "pitch": (0, 4, 7), "yaw": (8,), "height": (2,)}  # states of each, by input u1..u4
Matrix = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Linear:
    """x' = A x + B u about a hover."""

    A: Matrix  # (9, 9)
    B: Matrix  # (9, 4)

    @property
    def constants(self) -> Constants:
        """The constants by the paper's names."""
        A, B = self.A, self.B
        chosen = {
            "roll_u1": B[6, 0], "roll_roll": A[6, 3], "roll_rate": A[6, 6], "y_u1": B[1, 0], "y_roll": A[1, 3],
            "pitch_u2": B[7, 1], "pitch_pitch": A[7, 4], "pitch_rate": A[7, 7], "x_u2": B[0, 1], "x_pitch": A[0, 4],
            "yaw_u3": B[8, 2], "yaw_rate": A[8, 8], "z_u4": B[2, 3], "z_vz": A[2, 2], "y_vy": A[1, 1], "x_vx": A[0, 0],
            "roll_vy": A[6, 1], "pitch_vx": A[7, 0],
        }  # fmt: skip
        return Constants(**{name: float(value) for name, value in chosen.items()})

    def poles(self, axis: str) -> list[complex]:
        """Return the open-loop poles [1/s] of an axis with the velocity that it drives, the slowest oscillation first."""
        chosen = list(AXES[axis])
        found = np.linalg.eigvals(self.A[np.ix_(chosen, chosen)])
        return sorted(map(complex, found), key=lambda pole: (-abs(pole.imag), -pole.real, -pole.imag))

    def steady(self, axis: str) -> float:
        """Return the sideways acceleration per input [m/s2] once the attitude has followed, in its usual direction.

        Negative: the robot steers in the opposite direction to the paper's; NaN for yaw and height.
        """
        f = self.constants
        if axis == "pitch":
            return f.x_u2 - f.x_pitch * f.pitch_u2 / f.pitch_pitch
        return -(f.y_u1 - f.y_roll * f.roll_u1 / f.roll_roll) if axis == "roll" else math.nan

    def growth(self, axis: str) -> float:
        """Return the largest real part of an axis' poles [1/s]: positive when it falls over by itself."""
        return max(pole.real for pole in self.poles(axis))


def calm_plates(geometry: GeometryConfig, speed: float, opening: float) -> State:
    """Return the plate model, level and at rest at a hover, at a speed [m/s] and opening [rad]."""
    plant = PlantConfig(variant="plate", airspeed=speed, hover_angle=opening)
    s, _ = assemble(geometry, plant, TunnelConfig(turbulence="none"))
    return calm(s, speed)


def linear(geometry: GeometryConfig, speed: float, opening: float) -> Linear:
    """Return the dynamics of the plates at a hover that carries the weight, at a speed [m/s] and opening [rad]."""
    c = calm_plates(geometry, speed, opening)
    slopes = np.array([slope(c, cause) for cause in CAUSES]).T  # (6, 13)
    A, B = np.zeros((STATES, STATES)), np.zeros((STATES, 4))
    A[:3], A[6:] = slopes[:3, :STATES], slopes[3:, :STATES]
    A[3:6, 6:] = np.eye(3)
    B[:3], B[6:] = slopes[:3, STATES:], slopes[3:, STATES:]
    return Linear(A, B)


def stiffness(geometry: GeometryConfig, speed: float, opening: float) -> float:
    """Return f_αα alone: roll acceleration per roll angle [1/s2]."""
    c = calm_plates(geometry, speed, opening)
    change = accelerations(c, "qx", DIFFERENCE) - accelerations(c, "qx", -DIFFERENCE)
    return float(change[3]) / (2 * DIFFERENCE)
