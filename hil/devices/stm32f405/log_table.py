"""The log variables of an image, found in the firmware's own table of them, and read in the chip's memory."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from firmware_py.wire.scalars import LOG_SCALARS, Scalar
from hil.devices.stm32f405.chip import Chip
from hil.devices.stm32f405.image import Image

GROUP, START, BY_FUNCTION, TYPE, ENTRY_BYTES = 0x80, 0x01, 0x40, 0x0F, 12  # of the firmware's log.h
NAME_LENGTH = 32


@dataclass(frozen=True, slots=True)
class LogVariable:
    """A variable of the image's table of contents."""

    name: str
    scalar: Scalar
    read: Callable[[], float]
    unit: str = ""  # the table knows none


def log_table(image: Image, chip: Chip) -> list[LogVariable]:
    """Return the log variables of an image; none when it has no table."""
    if not (image.has("_log_start") and image.has("_log_stop")):
        return []
    begin, end = image.symbol("_log_start").address, image.symbol("_log_stop").address
    variables, group = [], ""
    for at in range(begin, end - ENTRY_BYTES + 1, ENTRY_BYTES):
        kind, name_at, address = struct.unpack("<BxxxII", chip.read(at, ENTRY_BYTES))
        name = chip.read(name_at, NAME_LENGTH).split(b"\0")[0].decode(errors="replace") if name_at else ""
        if kind & GROUP:
            group = name if kind & START else ""
        elif not kind & BY_FUNCTION and kind & TYPE in LOG_SCALARS:
            scalar = LOG_SCALARS[kind & TYPE]
            variables.append(LogVariable(f"{group}.{name}", scalar, partial(_read, chip, address, scalar)))
    return variables


def _read(chip: Chip, address: int, scalar: Scalar) -> float:
    return scalar.unpack(chip.read(address, scalar.size))
