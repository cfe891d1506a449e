"""The commands of the high-level commander on port 8.

A command is one byte, mostly followed by the groups that it addresses, and its fields.
Facts: crazyflie-firmware 2a18fc29, cflib 0.1.34.
"""

import struct
from enum import IntEnum
from math import isfinite
from typing import NamedTuple

from firmware_py.wire import WireError, check_size
from firmware_py.wire.crtp import header

PORT = 8
MAX_TRAJECTORIES = 10


class PathCommand(IntEnum):
    """The first byte. Commands that end in 1 are older than cflib's."""

    SET_GROUP_MASK = 0
    TAKE_OFF_1 = 1
    LAND_1 = 2
    STOP = 3
    GO_TO_1 = 4
    START_1 = 5
    DEFINE = 6
    TAKE_OFF = 7
    LAND = 8
    TAKE_OFF_WITH_VELOCITY = 9
    LAND_WITH_VELOCITY = 10
    SPIRAL = 11
    GO_TO = 12
    START = 13


class Vertical(NamedTuple):
    """TAKE_OFF and LAND."""

    groups: int
    height: float
    yaw: float
    current_yaw: bool
    duration: float


class VerticalWithVelocity(NamedTuple):
    """TAKE_OFF_WITH_VELOCITY and LAND_WITH_VELOCITY."""

    groups: int
    height: float
    relative: bool
    yaw: float
    current_yaw: bool
    velocity: float


class GoTo(NamedTuple):
    groups: int
    relative: bool
    linear: bool
    x: float
    y: float
    z: float
    yaw: float
    duration: float


class Start(NamedTuple):
    """START, of a defined trajectory."""

    groups: int
    relative: bool
    relative_yaw: bool
    reverse: bool
    trajectory: int
    timescale: float


class Define(NamedTuple):
    trajectory: int
    location: int
    type: int
    offset: int
    pieces: int


_LAYOUTS = {
    PathCommand.SET_GROUP_MASK: struct.Struct("<B"),
    PathCommand.TAKE_OFF_1: struct.Struct("<Bff"),
    PathCommand.LAND_1: struct.Struct("<Bff"),
    PathCommand.STOP: struct.Struct("<B"),
    PathCommand.GO_TO_1: struct.Struct("<BBfffff"),
    PathCommand.START_1: struct.Struct("<BBBBf"),
    PathCommand.DEFINE: struct.Struct("<BBBIB"),
    PathCommand.TAKE_OFF: struct.Struct("<Bff?f"),
    PathCommand.LAND: struct.Struct("<Bff?f"),
    PathCommand.TAKE_OFF_WITH_VELOCITY: struct.Struct("<Bf?f?f"),
    PathCommand.LAND_WITH_VELOCITY: struct.Struct("<Bf?f?f"),
    PathCommand.SPIRAL: struct.Struct("<BBBfffff"),
    PathCommand.GO_TO: struct.Struct("<B??fffff"),
    PathCommand.START: struct.Struct("<B???Bf"),
}


def decode(data: bytes) -> tuple[PathCommand, tuple[float, ...]]:
    """Return the command and its fields as on the wire; `WireError` for an unknown one or a number that is not finite."""
    try:
        command = PathCommand(data[0])
    except (IndexError, ValueError):
        raise WireError(f"high-level command {data.hex()}: unknown") from None
    layout = _LAYOUTS[command]
    check_size(f"high-level command {command.name.lower()}", data, 1 + layout.size)
    fields = layout.unpack_from(data, 1)
    if not all(isfinite(value) for value in fields):
        raise WireError(f"high-level command {command.name.lower()} {fields}: must be finite")
    return command, fields


def encode(command: PathCommand, *fields: float) -> bytes:
    """Return the complete packet of a command with its fields, in the order on the wire."""
    return bytes((header(PORT, 0), command)) + _LAYOUTS[command].pack(*fields)
