"""From a motion capture system's frames to ours: the one place where its poses become p_WB and q_WB.

Frames: M as the system streams, C the same with z up, W the tunnel; D the rigid body as defined in the system,
its axes turned z up like those of M, B the robot. C is W turned by `yaw` and moved by `origin`, B likewise in D.
This file also chooses the body that is the robot.
"""

from collections.abc import Sequence

from firmware_py.geometry import Quaternion, Vector, conjugate, multiply, rotate, yaw_quaternion
from ground_station.config import Axes, CaptureConfig
from ground_station.errors import MocapError


def with_z_up(p: Vector, q: Quaternion) -> tuple[Vector, Quaternion]:
    """Turn a pose to z up from axes with y up, for world and body alike, by a quarter turn about x."""
    return (p[0], -p[2], p[1]), (q[0], q[1], -q[3], q[2])


class Alignment:
    """The pose of the tunnel in the system's frame, and of the robot in the rigid body's."""

    def __init__(self, capture: CaptureConfig) -> None:
        self.axes: Axes = capture.axes or ("y-up" if capture.system == "optitrack" else "z-up")
        self._p_CW = capture.origin
        self._q_WC = conjugate(yaw_quaternion(capture.yaw))
        self._p_DB = capture.body_offset
        self._q_DB = yaw_quaternion(capture.body_yaw)

    def to_world(self, p_MD: Vector, q_MD: Quaternion) -> tuple[Vector, Quaternion]:
        """Return p_WB and q_WB of a pose from the system."""
        p_CD, q_CD = with_z_up(p_MD, q_MD) if self.axes == "y-up" else (p_MD, q_MD)
        x, y, z = rotate(q_CD, self._p_DB)
        a, b, c = self._p_CW
        p_WB = rotate(self._q_WC, (p_CD[0] + x - a, p_CD[1] + y - b, p_CD[2] + z - c))
        return p_WB, multiply(multiply(self._q_WC, q_CD), self._q_DB)


def choose_body(wanted: str, names: Sequence[str]) -> str:
    """Return the name of the body to follow; `MocapError` when it is ambiguous."""
    if wanted in names:
        return wanted
    if not wanted and len(names) == 1:
        return names[0]
    what = f"no body {wanted!r}" if wanted else "body=NAME is missing"
    raise MocapError(f"{what}; there are: {', '.join(names) or 'none'}")
