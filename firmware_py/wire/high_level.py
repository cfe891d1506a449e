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
MAX_TRAJECTORIES = 31


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


class Groups(NamedTuple):
    """SET_GROUP_MASK and STOP."""

    groups: int


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


class SpiralFields(NamedTuple):
    """SPIRAL."""

    groups: int
    sideways: bool
    clockwise: bool
    angle: float
    first_radius: float
    last_radius: float
    ascent: float
    duration: float


Fields = Groups | Vertical | VerticalWithVelocity | GoTo | Start | Define | SpiralFields
# The fields of each command, their layout, and those behind the second that older commands lack.
_FORMS: dict[PathCommand, tuple[type[Fields], struct.Struct, tuple[float, ...]]] = {
    command: (kind, struct.Struct(layout), tuple(lacking))
    for command, kind, layout, *lacking in (
        (PathCommand.SET_GROUP_MASK, Groups, "<B"),
        (PathCommand.TAKE_OFF_1, Vertical, "<Bff", 0.0, False),
        (PathCommand.LAND_1, Vertical, "<Bff", 0.0, False),
        (PathCommand.STOP, Groups, "<B"),
        (PathCommand.GO_TO_1, GoTo, "<B?fffff", False),
        (PathCommand.START_1, Start, "<B??Bf", False),
        (PathCommand.DEFINE, Define, "<BBBIB"),
        (PathCommand.TAKE_OFF, Vertical, "<Bff?f"),
        (PathCommand.LAND, Vertical, "<Bff?f"),
        (PathCommand.TAKE_OFF_WITH_VELOCITY, VerticalWithVelocity, "<Bf?f?f"),
        (PathCommand.LAND_WITH_VELOCITY, VerticalWithVelocity, "<Bf?f?f"),
        (PathCommand.SPIRAL, SpiralFields, "<B??fffff"),
        (PathCommand.GO_TO, GoTo, "<B??fffff"),
        (PathCommand.START, Start, "<B???Bf"),
    )
}


def decode(data: bytes) -> tuple[PathCommand, Fields]:
    """Return the command and its fields; `WireError` for an unknown one or numbers that give no path."""
    try:
        command = PathCommand(data[0])
    except (IndexError, ValueError):
        raise WireError(f"high-level command {data.hex()}: unknown") from None
    kind, layout, lacking = _FORMS[command]
    check_size(f"high-level command {command.name.lower()}", data, 1 + layout.size)
    fields = layout.unpack_from(data, 1)
    if not all(isfinite(value) for value in fields):
        raise WireError(f"high-level command {command.name.lower()} {fields}: must be finite")
    named = kind._make((*fields[:2], *lacking, *fields[2:])[: len(kind._fields)])
    _check_time(named)
    return command, named


def _check_time(fields: Fields) -> None:
    """Raise `WireError` for a time in which no path can be flown."""
    if isinstance(fields, GoTo) and fields.linear and not fields.duration > 0.0:
        raise WireError(f"a linear go_to of {fields.duration:g} s: must be above 0")
    if isinstance(fields, SpiralFields) and not fields.duration > 0.0:
        raise WireError(f"a spiral of {fields.duration:g} s: must be above 0")
    if isinstance(fields, Start) and not fields.timescale > 0.0:
        raise WireError(f"time scale {fields.timescale:g}: must be above 0")


def encode(command: PathCommand, *fields: float) -> bytes:
    """Return the complete packet of a command with its fields, in the order on the wire."""
    return bytes((header(PORT, 0), command)) + _FORMS[command][1].pack(*fields)
