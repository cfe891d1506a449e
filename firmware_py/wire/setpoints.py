"""Set-points of clients: port 7 (crtp_commander_generic.c), and roll, pitch, yaw and thrust on port 3.

Only a position (with a yaw) and the place in a full state are read: nothing else is flown. Facts: crazyflie-firmware
2a18fc29, cflib 0.1.34. The firmware stops with a failed assertion when a set-point has another size; here it is refused.
"""

import struct
from math import degrees, radians, remainder, tau

from firmware_py.elementary import atan2
from firmware_py.geometry import Vector
from firmware_py.wire import check_size
from firmware_py.wire.crtp import PORT_GENERIC_SETPOINT, header
from firmware_py.wire.localisation import unpack_quaternion

CHANNEL_SETPOINT, CHANNEL_NOTICE = 0, 1
NOTICE_SIZE, ATTITUDE_SIZE = 5, 14  # [bytes], the last on port 3
STOP, PPM, FULL_STATE, POSITION = 0, 3, 6, 7  # first byte on the channel of set-points
# Sizes with the first byte. Of STOP and of other first bytes, which mean the null set-point, any size is taken.
SIZES = {1: 17, 2: 17, 4: 17, 5: 17, FULL_STATE: 29, POSITION: 17, 8: 17, 9: 17, 10: 17, 11: 16}

_POSITION = struct.Struct("<x4f")  # [m], yaw [deg]
_FULL_STATE = struct.Struct("<x9hI3h")  # position [mm], velocity [mm/s], acceleration, quaternion, rates
_MILLIMETRE = 1e-3


def is_null(data: bytes) -> bool:
    """Return whether a set-point wants no motion at all."""
    return data[0] != PPM and data[0] not in SIZES


def decode_place(data: bytes) -> tuple[Vector, float] | None:
    """Return position [m] and yaw [rad] of a set-point, None when it gives no position."""
    kind = data[0]
    if kind in SIZES:
        check_size(f"a set-point of type {kind}", data, SIZES[kind])
    if kind == POSITION:
        x, y, z, yaw = _POSITION.unpack(data)
        return (x, y, z), remainder(radians(yaw), tau) if abs(yaw) < 1e9 else yaw
    if kind == FULL_STATE:
        fields = _FULL_STATE.unpack(data)
        x, y, z = (value * _MILLIMETRE for value in fields[:3])
        qw, qx, qy, qz = unpack_quaternion(fields[9])
        return (x, y, z), atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)
    return None


def encode_place(p: Vector, yaw: float) -> bytes:
    """Return the complete packet of a position set-point [m, rad]."""
    place = _POSITION.pack(*p, degrees(yaw))[1:]
    return bytes((header(PORT_GENERIC_SETPOINT, CHANNEL_SETPOINT), POSITION)) + place


def encode_end() -> bytes:
    """Return the complete packet after the last set-point: the high-level commander takes over at once."""
    return bytes((header(PORT_GENERIC_SETPOINT, CHANNEL_NOTICE),)) + bytes(NOTICE_SIZE)
