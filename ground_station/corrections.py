"""From a motion capture frame and a goal to the correction: the pose of the body in the goal frame.

The goal frame G stands at the goal's position, upright, turned by the goal's yaw. The board always flies to
the origin of G; goals and absolute positions never leave the ground.
"""

from dataclasses import dataclass
from math import cos, sin

from firmware_py.geometry import conjugate, multiply, yaw_quaternion
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal


@dataclass(frozen=True, slots=True)
class Correction:
    """The pose of the body in the goal frame and how long ago it was so."""

    p_GB: tuple[float, float, float]  # [m]
    q_GB: tuple[float, float, float, float]  # w x y z
    age_us: int  # since the exposure, when the correction leaves the ground station


def correct(frame: MocapFrame, goal: Goal, now_us: int) -> Correction:
    """The correction of `frame` with respect to `goal`, made at `now_us`."""
    dx = frame.p_WB[0] - goal.p_WG[0]
    dy = frame.p_WB[1] - goal.p_WG[1]
    dz = frame.p_WB[2] - goal.p_WG[2]
    c, s = cos(goal.yaw), sin(goal.yaw)
    return Correction(
        p_GB=(c * dx + s * dy, c * dy - s * dx, dz),  # Rz(-yaw) (p_WB - p_WG)
        q_GB=multiply(conjugate(yaw_quaternion(goal.yaw)), frame.q_WB),
        age_us=now_us - frame.t_us,
    )
