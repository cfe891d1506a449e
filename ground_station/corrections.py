"""From a motion capture frame and a goal to the correction: the pose of the body in the goal frame.

The goal frame G is at the goal's position, upright, turned by the goal's yaw. The board always flies to
the origin of G; over CRTP goals and absolute positions never leave the ground.
"""

from firmware_py.geometry import in_goal_frame
from firmware_py.wire.crtp import Correction
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal


def correct(frame: MocapFrame, goal: Goal, arrival_us: int) -> Correction:
    """Return the correction of `frame` with respect to `goal`, which the board has at `arrival_us`."""
    return Correction(
        *in_goal_frame(frame.p_WB, frame.q_WB, goal.p_WG, goal.yaw), age_us=arrival_us - frame.t_us
    )
