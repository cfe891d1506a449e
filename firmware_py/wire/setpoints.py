"""Set-points on port 7 with a position: a position with a yaw, and the full state, whose motion is ignored.

Facts: crazyflie-firmware 2a18fc29 (crtp_commander_generic.c), cflib 0.1.34.
"""

import struct
from math import degrees, isfinite, radians, remainder, tau

from firmware_py.elementary import atan2
from firmware_py.geometry import Vector
from firmware_py.wire import WireError, check_size
from firmware_py.wire.crtp import PORT_GENERIC_SETPOINT, check_place, header
from firmware_py.wire.localisation import unpack_quaternion

CHANNEL_SETPOINT, CHANNEL_NOTICE = 0, 1
STOP_SIZE, NOTICE_SIZE, ATTITUDE_SIZE = 1, 5, 14  # [bytes], the last on port 3
STOP, FULL_STATE, POSITION = 0, 6, 7  # first byte on the channel of set-points
NAMES = {
    1: "velocity", 2: "height and attitude", 4: "PPM", 5: "hover", FULL_STATE: "full state", POSITION: "position",
    8: "velocity", 9: "height and attitude", 10: "hover", 11: "manual",
}  # fmt: skip

_POSITION = struct.Struct("<x4f")  # [m], yaw [deg]
_FULL_STATE = struct.Struct("<x9hI3h")  # position [mm], velocity, acceleration, quaternion, rates
_MILLIMETRE = 1e-3


def decode_place(data: bytes) -> tuple[Vector, float]:
    """Return position [m] and yaw [rad] of a set-point that is `POSITION` or `FULL_STATE`."""
    layout = _POSITION if data[0] == POSITION else _FULL_STATE
    check_size(f"a {NAMES[data[0]]} set-point", data, layout.size)
    fields = layout.unpack(data)
    if data[0] == POSITION:
        x, y, z, yaw = fields
        check_place((x, y, z))
        if not isfinite(yaw):
            raise WireError(f"a position set-point with the yaw {yaw}: must be finite")
        return (x, y, z), remainder(radians(yaw), tau)
    x, y, z = (value * _MILLIMETRE for value in fields[:3])
    qw, qx, qy, qz = unpack_quaternion(fields[9])
    return (x, y, z), atan2(2.0 * (qw * qz + qx * qy), qw * qw + qx * qx - qy * qy - qz * qz)


def encode_place(p: Vector, yaw: float) -> bytes:
    """Return the complete packet of a position set-point [m, rad]."""
    place = _POSITION.pack(*p, degrees(yaw))[1:]
    return bytes((header(PORT_GENERIC_SETPOINT, CHANNEL_SETPOINT), POSITION)) + place


def encode_end() -> bytes:
    """Return the complete packet after the last set-point: the high-level commander takes over at once."""
    return bytes((header(PORT_GENERIC_SETPOINT, CHANNEL_NOTICE),)) + bytes(NOTICE_SIZE)
