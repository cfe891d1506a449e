"""Trajectories in the commander's memory (pptraj.c, pptraj_compressed.c).

Type 0: pieces of four polynomials (x, y, z, yaw, eight float32 each, ascending powers) and a duration [s]. Type 1,
compressed: a start and pieces of Bezier points in mm and tenths of a degree, the last one with the duration 0.
"""

import struct
from math import isfinite, pi

from firmware_py.crazyflie.planner import Path, Piece, bezier
from firmware_py.wire import WireError
from firmware_py.wire.high_level import Define

MEMORY_SIZE = 4096
LOCATION_MEMORY = 1
POLYNOMIALS, COMPRESSED = 0, 1  # types
POINTS = (0, 1, 3, 7)  # by the two bits of an axis; the first point is the end of the piece before
MILLIMETRE = 1e-3
TENTH_DEGREE = pi / 1800.0

_POLYNOMIALS = struct.Struct("<33f")
_START = struct.Struct("<4h")
_HEAD = struct.Struct("<BH")


def decode_trajectory(memory: bytes | bytearray, definition: Define) -> Path:
    """Return the path of a definition; `WireError` when the memory does not hold one."""
    pieces: tuple[Piece, ...]
    try:
        if definition.type == POLYNOMIALS:
            pieces = tuple(
                _polynomials(memory, definition.offset + number * _POLYNOMIALS.size)
                for number in range(definition.pieces)
            )
        else:
            pieces = tuple(_decompress(memory, definition.offset))
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
