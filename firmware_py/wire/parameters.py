"""Parameters on the wire: the commands of the parameter port and "set by name".

Channel 0 is the TOC, 1 reads, 2 writes, 3 carries the other commands. Set by name needs no TOC and works on every Crazyflie.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum

from firmware_py.wire import WireError
from firmware_py.wire.crtp import PORT_PARAMETERS, Packet, encode
from firmware_py.wire.scalars import PARAMETER_SCALARS, Scalar

CHANNEL_READ = 1
CHANNEL_WRITE = 2
CHANNEL_MISC = 3

TYPE_EXTENDED = 0x10  # bits of the type byte in the TOC
TYPE_READ_ONLY = 0x40
EXTENDED_PERSISTENT = 1

ABSOLUTE = "extPose.absolute"  # the kind of poses over CRTP, a uint8

OK, ENOENT, EACCES, EINVAL = 0, 2, 13, 22  # status bytes are errno's

_IDENT = struct.Struct("<H")


class Misc(IntEnum):
    """Commands of channel 3."""

    SET_BY_NAME = 0
    VALUE_UPDATED = 1
    EXTENDED_TYPE = 2
    STORE = 3
    STATE = 4
    CLEAR = 5
    DEFAULT = 6
    EXTENDED_TYPE_V2 = 7
    DEFAULT_V2 = 8


@dataclass(frozen=True, slots=True)
class SetByName:
    """The request to set `group.name`."""

    name: str
    scalar: Scalar
    value: float


def encode_set_by_name(request: SetByName) -> bytes:
    """Return the complete packet; `WireError` when the name is too long."""
    data = _name_bytes(request.name) + bytes((request.scalar.parameter_number,))
    return encode(Packet(PORT_PARAMETERS, CHANNEL_MISC, data + request.scalar.pack(request.value)))


def encode_pose_kind(absolute: bool) -> bytes:
    """Return the complete packet that sets the kind of the poses that follow."""
    return encode_set_by_name(SetByName(ABSOLUTE, Scalar.U8, int(absolute)))


def decode_set_by_name(data: bytes) -> SetByName:
    """Return the request in the data of a channel 3 packet."""
    parts = data[1:].split(b"\0", 2)
    if data[:1] != bytes((Misc.SET_BY_NAME,)) or len(parts) < 3 or not parts[2]:
        raise WireError(f"not a set by name: {data.hex()}")
    scalar = PARAMETER_SCALARS.get(parts[2][0])
    if scalar is None:
        raise WireError(f"set by name: type {parts[2][0]:#04x} is unknown")
    try:
        name = f"{parts[0].decode('ascii')}.{parts[1].decode('ascii')}"
    except UnicodeDecodeError as error:
        raise WireError(f"set by name: a name of other than ASCII letters: {data.hex()}") from error
    return SetByName(name, scalar, scalar.unpack(parts[2][1:]))


def encode_set_by_name_reply(name: str, status: int) -> bytes:
    """Return the data of the reply: the names again and a status."""
    return _name_bytes(name) + bytes((status,))


def encode_ident(number: int) -> bytes:
    """Return a parameter's number."""
    return _IDENT.pack(number)


def decode_ident(data: bytes, offset: int = 0) -> int:
    """Return the parameter's number at `offset`."""
    if len(data) < offset + _IDENT.size:
        raise WireError(f"a parameter request of {len(data)} bytes has no number")
    number: int = _IDENT.unpack_from(data, offset)[0]
    return number


def _name_bytes(name: str) -> bytes:
    group, _, variable = name.partition(".")
    return bytes((Misc.SET_BY_NAME,)) + f"{group}\0{variable}\0".encode("ascii")
