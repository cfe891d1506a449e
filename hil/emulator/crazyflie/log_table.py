"""An image's log variables and parameters, found by the firmware's own tables and read from the chip's memory.

A table is an array of entries in flash; special entries begin and end a group. A number in a table of contents counts the
other entries. In an image without symbols the table is the longest run of whole groups.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

from firmware_py.wire.scalars import LOG_SCALARS, PARAMETER_SCALARS, Scalar
from hil.emulator.stm32f405.chip import Chip
from hil.emulator.stm32f405.image import Image

GROUP, START, TYPE = 0x80, 0x01, 0x0F  # of the firmware's log.h and param.h
LOG_BY_FUNCTION, READ_ONLY = 0x40, 0x40
FLAGS = 0x20  # an entry of the core
NAME_LENGTH = 32


@dataclass(frozen=True, slots=True)
class ImageVariable:
    """A variable of the image's table of contents."""

    name: str
    scalar: Scalar
    read: Callable[[], float]
    unit: str = ""  # the table knows none


@dataclass(frozen=True, slots=True)
class ImageParameter:
    """A parameter of the image, by its number in the table of contents."""

    number: int
    scalar: Scalar
    writable: bool
    read: Callable[[], float]


def log_table(image: Image, chip: Chip) -> list[ImageVariable]:
    """Return the log variables of an image; none when it has no table."""
    return [
        ImageVariable(name, scalar, partial(_read, chip, address, scalar))
        for _, name, kind, address in _entries(image, chip, "log", "<BxxxII")
        if not kind & LOG_BY_FUNCTION and (scalar := LOG_SCALARS.get(kind & TYPE)) is not None
    ]


def log_numbers(image: Image, chip: Chip) -> dict[str, int]:
    """Return the numbers of an image's log variables by name, also of those that a function reads."""
    return {name: number for number, name, _, _ in _entries(image, chip, "log", "<BxxxII")}


def parameter_table(image: Image, chip: Chip) -> dict[str, ImageParameter]:
    """Return the parameters of an image by name, but those that a function reads; none when it has no table."""
    return {
        name: ImageParameter(number, scalar, not kind & READ_ONLY, partial(_read, chip, address, scalar))
        for number, name, kind, address in _entries(image, chip, "param", "<BxxxII8x")
        if address and (scalar := PARAMETER_SCALARS.get(kind & TYPE)) is not None
    }


def _entries(image: Image, chip: Chip, table: str, layout: str) -> Iterator[tuple[int, str, int, int]]:
    """Yield number, name, type and address of each variable in a table."""
    begin, end = _place(image, table, layout)
    size, group, number = struct.calcsize(layout), "", 0
    for at in range(begin, end - size + 1, size):
        kind, name_at, address = struct.unpack(layout, chip.read(at, size))
        name = chip.read(name_at, NAME_LENGTH).split(b"\0")[0].decode(errors="replace") if name_at else ""
        if kind & GROUP:
            group = name if kind & START else ""
        else:
            yield number, f"{group}.{name}", kind, address
            number += 1


def _place(image: Image, table: str, layout: str) -> tuple[int, int]:
    """Return begin and end of a table, equal when there is none."""
    if not image.named:
        return _found_place(image, struct.calcsize(layout))
    ends = [f"_{table}_{end}" for end in ("start", "stop")]
    begin, end = (image.symbol(name).address for name in ends) if all(map(image.has, ends)) else (0, 0)
    return begin, end


def _found_place(image: Image, size: int) -> tuple[int, int]:
    """Return begin and end of the longest run of groups of entries with this size [bytes]."""
    code, longest, at = image.code, (0, 0), 0
    while at <= len(code) - size:
        end = _end_of_group(image, at, size)
        begin, at = at, max(end, at + 4)
        while end and (further := _end_of_group(image, end, size)):
            at = end = further
        longest = max(longest, (begin, max(end, begin)), key=lambda run: run[1] - run[0])
    return longest[0] + image.base, longest[1] + image.base


def _end_of_group(image: Image, at: int, size: int) -> int:
    """Return where a group of entries that begins at an offset ends; 0 if there is none."""
    code = image.code
    if at > len(code) - size or code[at] & ~FLAGS != GROUP | START or not _is_entry(image, at):
        return 0
    for place in range(at + size, len(code) - size + 1, size):
        if code[place] & ~FLAGS == GROUP:
            return place + size
        if code[place] & GROUP or not _is_entry(image, place):
            return 0
    return 0


def _is_entry(image: Image, at: int) -> bool:
    """Return whether an entry has a name in flash."""
    kind, name = struct.unpack_from("<2I", image.code, at)
    text = image.code[name - image.base :][:NAME_LENGTH] if name > image.base else b""
    return kind >> 16 == 0 and text[:1].isalnum() and text.partition(b"\0")[0].isascii()


def _read(chip: Chip, address: int, scalar: Scalar) -> float:
    return scalar.unpack(chip.read(address, scalar.size))
