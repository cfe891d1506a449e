"""Attitudes as plain Python floats: quaternions, Euler angles, rotations.

Quaternions are Hamilton, `(w, x, y, z)`, of unit length; `q_WB` turns a vector's B coordinates into W
coordinates. Euler angles are zyx (yaw about z, then pitch about the new y, then roll about the new x) in rad.
Single attitudes are tuples because one numpy call costs more than the arithmetic; a whole flight's attitudes
are converted as one array.
"""

from math import pi, remainder, tau

import numpy as np
from numpy.typing import NDArray

from firmware_py.elementary import asin, atan2, cos, sin

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)


def multiply(q_AB: Quaternion, q_BC: Quaternion) -> Quaternion:
    """Return `q_AC`: the rotation `q_BC` followed by `q_AB`."""
    aw, ax, ay, az = q_AB
    bw, bx, by, bz = q_BC
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q_AB: Quaternion) -> Quaternion:
    """Return `q_BA`, the opposite rotation."""
    w, x, y, z = q_AB
    return (w, -x, -y, -z)


def rotate(q_AB: Quaternion, v_B: Vector) -> Vector:
    """Return `v_A`, the coordinates in A of the vector `v_B`."""
    w, x, y, z = q_AB
    a, b, c = v_B
    # v + 2 w (u x v) + 2 u x (u x v), u = (x, y, z)
    tx = 2.0 * (y * c - z * b)
    ty = 2.0 * (z * a - x * c)
    tz = 2.0 * (x * b - y * a)
    return (a + w * tx + y * tz - z * ty, b + w * ty + z * tx - x * tz, c + w * tz + x * ty - y * tx)


def rotation_matrix(q_AB: Quaternion) -> NDArray[np.float64]:
    """Return `R_AB`, (3, 3), with `v_A = R_AB @ v_B`."""
    return np.array([rotate(q_AB, axis) for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]).T


def yaw_quaternion(yaw: float) -> Quaternion:
    """Return the rotation by `yaw` about z."""
    return (cos(0.5 * yaw), 0.0, 0.0, sin(0.5 * yaw))


def from_euler_zyx(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the attitude with these zyx angles."""
    cr, sr = cos(0.5 * roll), sin(0.5 * roll)
    cp, sp = cos(0.5 * pitch), sin(0.5 * pitch)
    cy, sy = cos(0.5 * yaw), sin(0.5 * yaw)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def to_euler_zyx(q: Quaternion) -> Vector:
    """Return `(roll, pitch, yaw)`: roll and yaw in -pi..pi, pitch in -pi/2..pi/2 (where roll and yaw merge)."""
    w, x, y, z = q
    return (
        atan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z),
        asin(max(-1.0, min(1.0, 2.0 * (w * y - z * x)))),
        atan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z),
    )


def in_goal_frame(p_WB: Vector, q_WB: Quaternion, p_WG: Vector, yaw: float) -> tuple[Vector, Quaternion]:
    """Return `(p_GB, q_GB)`: a pose in the goal frame, which is upright at `p_WG`, turned by `yaw` about z."""
    dx = p_WB[0] - p_WG[0]
    dy = p_WB[1] - p_WG[1]
    dz = p_WB[2] - p_WG[2]
    c, s = cos(yaw), sin(yaw)
    p_GB = (c * dx + s * dy, c * dy - s * dx, dz)  # Rz(-yaw) (p_WB - p_WG)
    return p_GB, multiply(conjugate(yaw_quaternion(yaw)), q_WB)


def euler_zyx_of(q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Do `to_euler_zyx` for a whole flight: quaternions (N, 4) to roll, pitch, yaw (N, 3) [rad]."""
    w, x, y, z = q.T
    roll = np.arctan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    return np.stack((roll, pitch, yaw), axis=1)


def wrap_angle(angle: float) -> float:
    """Return the same direction in -pi..pi, pi itself included and -pi not."""
    wrapped = remainder(angle, tau)
    return pi if wrapped == -pi else wrapped
