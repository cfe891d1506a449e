"""The trajectories in the high-level commander's memory.

Type 0 are pieces of four polynomials (x, y, z, yaw, eight float32 each, ascending powers) and a duration [s]; type 1 is
compressed: a start and pieces of Bezier points in mm and tenths of a degree, the last one with the duration 0. A path is
read when it is started: later writes to the memory do not change it. Facts: crazyflie-firmware 2a18fc29, cflib.
"""

import struct
from math import isfinite, pi

from firmware_py.planner import Path, Piece, bezier
from firmware_py.wire import WireError
from firmware_py.wire.high_level import Define

MEMORY_SIZE = 4096
LOCATION_MEMORY = 1
TYPE_POLYNOMIALS, TYPE_COMPRESSED = 0, 1
POINTS = (0, 1, 3, 7)  # by the two bits of an axis; the first point is the end of the piece before
MILLIMETRE = 1e-3
TENTH_DEGREE = pi / 1800.0

_POLYNOMIALS = struct.Struct("<33f")
_START = struct.Struct("<4h")
_HEAD = struct.Struct("<BH")


def decode_trajectory(memory: bytes | bytearray, definition: Define) -> Path:
    """The path that a definition stands for; `WireError` when the memory does not hold one."""
    if definition.location != LOCATION_MEMORY:
        raise WireError(f"trajectory {definition.trajectory} is not defined")
    pieces: tuple[Piece, ...]
    try:
        if definition.type == TYPE_POLYNOMIALS:
            pieces = tuple(
                _polynomials(memory, definition.offset + number * _POLYNOMIALS.size)
                for number in range(definition.pieces)
            )
        elif definition.type == TYPE_COMPRESSED:
            pieces = tuple(_decompress(memory, definition.offset))
        else:
            raise WireError(f"trajectory type {definition.type} is unknown")
    except struct.error:
        raise WireError(f"trajectory {definition.trajectory} reaches beyond its memory") from None
    if not pieces or not all(piece.duration > 0.0 for piece in pieces):
        raise WireError(f"trajectory {definition.trajectory} has no pieces, or one that takes no time")
    return Path(pieces)


def _polynomials(memory: bytes | bytearray, offset: int) -> Piece:
    values = _POLYNOMIALS.unpack_from(memory, offset)
    if not all(isfinite(value) for value in values):
        raise WireError("a trajectory's coefficients must be finite")
    return Piece(values[32], (values[0:8], values[8:16], values[16:24], values[24:32]))


def _decompress(memory: bytes | bytearray, offset: int) -> list[Piece]:
    units = (MILLIMETRE, MILLIMETRE, MILLIMETRE, TENTH_DEGREE)
    ends = [value * unit for value, unit in zip(_START.unpack_from(memory, offset), units, strict=True)]
    offset += _START.size
    pieces: list[Piece] = []
    while True:
        kinds, duration_ms = _HEAD.unpack_from(memory, offset)
        offset += _HEAD.size
        if duration_ms == 0:
            return pieces
        duration = duration_ms * 1e-3
        axes = []
        for axis, unit in enumerate(units):
            count = POINTS[kinds >> 2 * axis & 3]
            layout = struct.Struct(f"<{count}h")
            points = [ends[axis], *(value * unit for value in layout.unpack_from(memory, offset))]
            offset += layout.size
            axes.append(bezier(points, duration))
            ends[axis] = points[-1]
        x, y, z, yaw = axes
        pieces.append(Piece(duration, (x, y, z, yaw)))
