"""Where the robot is in the world: the estimator only has the error from the goal against which the last pose was taken."""

from dataclasses import dataclass

from firmware_py.core.structs import ATTITUDE, POSITION, RATE, VELOCITY, Control, Estimator
from firmware_py.geometry import Quaternion, Vector, from_euler_zyx, rotate, wrap_angle, yaw_quaternion
from firmware_py.links.mavlink_setpoints import SetpointService


@dataclass(frozen=True, slots=True)
class World:
    """Reads the running board; every call returns the present values."""

    estimator: Estimator
    control: Control
    setpoints: SetpointService

    def angles(self) -> Vector:
        """Roll, pitch, yaw of B in W."""
        roll, pitch, yaw = self.estimator.now[ATTITUDE : ATTITUDE + 3].tolist()
        return roll, pitch, wrap_angle(yaw + self.setpoints.frame[1])

    def q_WB(self) -> Quaternion:
        """The attitude."""
        return from_euler_zyx(*self.angles())

    def rates(self) -> Vector:
        """Body rates p, q, r [rad/s]."""
        p, q, r = self.estimator.now[RATE : RATE + 3].tolist()
        return p, q, r

    def motion(self) -> tuple[Vector, Vector]:
        """p_WB [m] and v_W [m/s]."""
        p_WG, yaw = self.setpoints.frame
        q_WG = yaw_quaternion(yaw)
        now = self.estimator.now
        x, y, z = rotate(q_WG, tuple(now[POSITION : POSITION + 3].tolist()))
        v_W = rotate(q_WG, tuple(now[VELOCITY : VELOCITY + 3].tolist()))
        return (p_WG[0] + x, p_WG[1] + y, p_WG[2] + z), v_W
