"""The other messages with a position or a pose: plain position, packed positions, packed poses.

Packed items carry the last byte of the receiving robot's address; positions are int16 millimetres, the
quaternion is "smallest three": the largest component is omitted, the others take a sign and nine bits each.
"""

import struct
from math import sqrt

from firmware_py.geometry import Vector
from firmware_py.wire import WireError, check_size
from firmware_py.wire.crtp import Correction, check_place, check_pose

CHANNEL_POSITION = 0
CHANNEL_PACKED = 2
EMERGENCY_STOP = 3  # type bytes of the generic channel
EMERGENCY_STOP_WATCHDOG = 4
EXT_POSE_PACKED = 9

_POSITION = struct.Struct("<3f")
_PACKED_POSITION = struct.Struct("<B3h")
_PACKED_POSE = struct.Struct("<B3hI")
_MILLIMETRE = 1e-3
_SHARE = 1 / (511 * sqrt(2))  # of one step in a quaternion's component


def decode_position(data: bytes) -> Vector:
    """Return the position [m] in the data of a channel 0 packet."""
    check_size("a position", data, _POSITION.size)
    x, y, z = _POSITION.unpack(data)
    check_place((x, y, z))
    return x, y, z


def decode_packed_positions(data: bytes) -> list[tuple[int, Vector]]:
    """Return pairs of address byte and position [m] in the data of a channel 2 packet."""
    if not data or len(data) % _PACKED_POSITION.size:
        raise WireError(f"packed positions of {len(data)} bytes: items have {_PACKED_POSITION.size}")
    return [
        (address, (x * _MILLIMETRE, y * _MILLIMETRE, z * _MILLIMETRE))
        for address, x, y, z in _PACKED_POSITION.iter_unpack(data)
    ]


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


def unpack_quaternion(packed: int) -> tuple[float, float, float, float]:
    """Return the quaternion, w x y z, of 32 bits; not of unit length when they are not from one."""
    largest = packed >> 30
    xyzw = [0.0] * 4
    squares = 0.0
    for i in (3, 2, 1, 0):
        if i == largest:
            continue
        value = (packed & 0x1FF) * _SHARE
        xyzw[i] = -value if packed & 0x200 else value
        squares += value * value
        packed >>= 10
    xyzw[largest] = sqrt(max(0.0, 1.0 - squares))
    return xyzw[3], xyzw[0], xyzw[1], xyzw[2]
