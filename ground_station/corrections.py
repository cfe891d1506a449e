"""From a motion capture frame and a goal to the correction: the pose of the body in the goal frame.

The goal frame G stands at the goal's position, upright, turned by the goal's yaw. The board always flies to
the origin of G; over CRTP goals and absolute positions never leave the ground.
"""

from dataclasses import dataclass

from firmware_py.geometry import in_goal_frame
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal


@dataclass(slots=True)
class Correction:
    """The pose of the body in the goal frame and its age."""

    p_GB: tuple[float, float, float]  # [m]
    q_GB: tuple[float, float, float, float]  # w x y z
    age_us: int  # from the exposure to the arrival on board


def correct(frame: MocapFrame, goal: Goal, arrival_us: int) -> Correction:
    """The correction of `frame` with respect to `goal`, which the board has at `arrival_us`."""
    p_GB, q_GB = in_goal_frame(frame.p_WB, frame.q_WB, goal.p_WG, goal.yaw)
    return Correction(p_GB, q_GB, age_us=arrival_us - frame.t_us)
