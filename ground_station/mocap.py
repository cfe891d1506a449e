"""What a motion capture system says about the robot."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class MocapFrame:
    """The body's pose in the world at one exposure of the cameras."""

    t_us: int  # the exposure, by the clock of the ground station
    p_WB: tuple[float, float, float]  # [m]
    q_WB: tuple[float, float, float, float]  # w x y z
    valid: bool  # False: the body was not tracked, the pose means nothing
