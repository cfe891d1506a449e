"""The other messages with a position or a pose: plain position, packed positions, packed poses.

Packed items carry the last byte of the receiving robot's address; positions are int16 millimetres, the
quaternion is "smallest three": the largest component is omitted, the others take a sign and nine bits each. It is unpacked
in float32, as the exported app does.
"""

import struct
from collections.abc import Iterable
from math import sqrt

import numpy as np

from firmware_py.geometry import Quaternion, Vector
from firmware_py.wire import WireError
from firmware_py.wire.crtp import Correction, check_pose

POSITIONS = (0, 2)  # channels of positions without attitude, one and packed
EMERGENCY_STOP = 3  # type bytes of the generic channel
EMERGENCY_STOP_WATCHDOG = 4
EXT_POSE_PACKED = 9

_PACKED_POSE = struct.Struct("<B3hI")
_MILLIMETRE = 1e-3
_SHARE = np.float32(1 / (511 * sqrt(2)))  # of one step in a quaternion's component


def decode_packed_poses(data: bytes) -> list[tuple[int, Correction]]:
    """Return pairs of address byte and pose in the data of a generic packet of type 9; the age is unknown."""
    items = data[1:]
    if data[:1] != bytes((EXT_POSE_PACKED,)) or not items or len(items) % _PACKED_POSE.size:
        raise WireError(f"packed poses of {len(items)} bytes: items have {_PACKED_POSE.size}")
    poses = []
    for address, x, y, z, packed in _PACKED_POSE.iter_unpack(items):
        p_GB = (x * _MILLIMETRE, y * _MILLIMETRE, z * _MILLIMETRE)
        q_GB = unpack_quaternion(packed)
        check_pose(p_GB, q_GB)
        poses.append((address, Correction(p_GB, q_GB, None)))
    return poses


def encode_packed_poses(poses: Iterable[tuple[int, Vector, Quaternion]]) -> bytes:
    """Return the data of a generic packet of type 9 with address byte, position [m] and attitude of each robot."""
    items = (
        _PACKED_POSE.pack(address, *(round(part / _MILLIMETRE) for part in p_GB), pack_quaternion(q_GB))
        for address, p_GB, q_GB in poses
    )
    return bytes((EXT_POSE_PACKED,)) + b"".join(items)


def unpack_quaternion(packed: int) -> tuple[float, float, float, float]:
    """Return the quaternion, w x y z, of 32 bits; not of unit length when they are not from one."""
    largest = packed >> 30
    xyzw = [0.0] * 4
    squares = np.float32(0.0)
    for i in (3, 2, 1, 0):
        if i == largest:
            continue
        value = np.float32(packed & 0x1FF) * _SHARE
        xyzw[i] = float(-value if packed & 0x200 else value)
        squares += value * value
        packed >>= 10
    xyzw[largest] = float(np.sqrt(max(np.float32(0.0), np.float32(1.0) - squares)))
    return xyzw[3], xyzw[0], xyzw[1], xyzw[2]


def pack_quaternion(q_GB: tuple[float, float, float, float]) -> int:
    """Return the 32 bits of a unit quaternion, w x y z."""
    w, x, y, z = q_GB
    xyzw = (x, y, z, w)
    largest = max(range(4), key=lambda i: abs(xyzw[i]))
    packed = largest
    for i in range(4):
        if i != largest:
            below = (xyzw[i] < 0) != (xyzw[largest] < 0)
            packed = packed << 10 | below << 9 | round(abs(xyzw[i]) / float(_SHARE))
    return packed
