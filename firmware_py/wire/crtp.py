"""CRTP, the Crazyflie's packet protocol: the header and the external pose.

A packet is one header byte and up to 30 bytes of data, little-endian. Here the quaternion changes its order
(x y z w on the wire, w x y z inside) and time its unit; everything inside is SI. Malformed bytes raise
`WireError`; the receiver counts it. Sources: Bitcraze's CRTP documentation, cflib 0.1.34; the tests
compare with cflib's own bytes.
"""

import struct
from dataclasses import dataclass
from typing import NamedTuple

from firmware_py.wire import WireError, check_size

MAX_DATA = 30

PORT_CONSOLE = 0
PORT_PARAMETERS = 2
PORT_COMMANDER = 3
PORT_MEMORIES = 4
PORT_LOG = 5
PORT_LOCALISATION = 6
CHANNEL_GENERIC = 1
EXT_POSE = 8  # type byte of the generic localisation channel
PORT_GENERIC_SETPOINT = 7
PORT_SUPERVISOR = 9
PORT_PLATFORM = 13
PORT_LINK = 15

FAR = 1000.0  # [m] larger than any tunnel
AGE_UNIT_US = 500
AGE_MAX_CODE = 254  # and everything older: 127 ms
AGE_UNKNOWN_CODE = 255

_RESERVED_BITS = 0x0C  # set by cflib, ignored by all receivers
_POSE = struct.Struct("<B7f")
_POSE_WITH_AGE = struct.Struct("<BB7fB")
_MIN_NORM2, _MAX_NORM2 = 0.9**2, 1.1**2


@dataclass(slots=True)
class Packet:
    """One CRTP packet: port 0..15, channel 0..3, 0..30 bytes of data."""

    port: int
    channel: int
    data: bytes


class Correction(NamedTuple):
    """The body's pose in the goal frame, at both ends of a link: measured `age_us` before it arrived.

    An absolute pose is the correction with respect to the origin of the world.
    """

    p_GB: tuple[float, float, float]  # [m]
    q_GB: tuple[float, float, float, float]  # w x y z, length 0.9..1.1
    age_us: int | None  # None: the sender does not know


def header(port: int, channel: int) -> int:
    """Return the header byte as cflib sends it."""
    return port << 4 | _RESERVED_BITS | channel


def encode(packet: Packet) -> bytes:
    """Return the bytes of any packet."""
    if len(packet.data) > MAX_DATA:
        raise WireError(f"{len(packet.data)} bytes of data: at most {MAX_DATA} fit a CRTP packet")
    return bytes((header(packet.port, packet.channel),)) + packet.data


def decode(raw: bytes) -> Packet:
    """Return the packet in `raw`; its reserved header bits are ignored."""
    if not 1 <= len(raw) <= 1 + MAX_DATA:
        raise WireError(f"a CRTP packet of {len(raw)} bytes: 1..{1 + MAX_DATA} are possible")
    return Packet(raw[0] >> 4, raw[0] & 3, raw[1:])


_POSE_HEADER = header(PORT_LOCALISATION, CHANNEL_GENERIC)


def encode_ext_pose(
    p_GB: tuple[float, float, float], q_GB: tuple[float, float, float, float], age_us: int | None
) -> bytes:
    """Return the complete packet of cflib's `send_extpose` and one more byte, the age.

    Stock firmware reads the pose and ignores the byte behind it. The sender checks its poses before.
    """
    x, y, z = p_GB
    qw, qx, qy, qz = q_GB
    return _POSE_WITH_AGE.pack(_POSE_HEADER, EXT_POSE, x, y, z, qx, qy, qz, qw, _age_code(age_us))


def decode_ext_pose(data: bytes) -> Correction:
    """Return the pose in the data of a generic localisation packet; without an age byte the age is unknown."""
    check_size("an external pose", data, _POSE.size, _POSE.size + 1)
    if data[0] != EXT_POSE:
        raise WireError(f"not an external pose: {data.hex()}")
    _, x, y, z, qx, qy, qz, qw = _POSE.unpack_from(data)
    p_GB, q_GB = (x, y, z), (qw, qx, qy, qz)
    check_pose(p_GB, q_GB)
    code = data[_POSE.size] if len(data) > _POSE.size else AGE_UNKNOWN_CODE
    return Correction(p_GB, q_GB, None if code == AGE_UNKNOWN_CODE else code * AGE_UNIT_US)


def _age_code(age_us: int | None) -> int:
    """Return half milliseconds, rounded, limited to 0..254."""
    if age_us is None:
        return AGE_UNKNOWN_CODE
    return max(0, min(AGE_MAX_CODE, (age_us + AGE_UNIT_US // 2) // AGE_UNIT_US))


def check_pose(p_GB: tuple[float, float, float], q_GB: tuple[float, float, float, float]) -> None:
    """Raise `WireError` for a pose that the board refuses, of the body or, over the radio, of its error."""
    w, x, y, z = q_GB
    if not _MIN_NORM2 <= w * w + x * x + y * y + z * z <= _MAX_NORM2:
        raise WireError(f"quaternion {q_GB}: its length must be 0.9..1.1")
    check_place(p_GB)


def check_place(p: tuple[float, float, float]) -> None:
    """Raise `WireError` for an impossible position. The comparisons are false for NaN, too."""
    if not all(abs(coordinate) <= FAR for coordinate in p):
        raise WireError(f"position {p} m: each coordinate must be within {FAR:g} m")
