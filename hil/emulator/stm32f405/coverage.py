"""Which functions, lines and branches of an unmodified image ran, from the blocks that the machine has counted.

A line runs as often as the instruction of its statements that runs most; instructions that the compiler has moved to
other places do not count for it. A branch is a conditional jump with two ways: B<c>, CBZ, CBNZ, and a jump at the end of
an IT block. Conditional instructions that do not jump, and jumps through tables, have no branches here. Code in RAM is
not counted.
"""

from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from firmware_py.export.cycles import is_wide
from firmware_py.export.elf import FLASH, FLASH_SIZE
from hil.emulator.stm32f405.debug_info import LineRow
from hil.emulator.stm32f405.image import Image
from hil.errors import LabError

BEGUN, FELL, JUMPED = 0, 1, 2  # columns of the counts, see `Chip.passages`
ALWAYS = 0xE  # a condition
IT = 0xBF00


@dataclass(frozen=True, slots=True)
class FunctionCoverage:
    """A function by its first and last line."""

    name: str
    line: int
    last: int
    count: int  # of its first instruction, to which a loop may return


@dataclass(frozen=True, slots=True)
class BranchCoverage:
    """A conditional jump; `number` counts those of its line from 0."""

    line: int
    number: int
    jumped: int
    fell: int  # how often it went on with the next instruction


@dataclass(frozen=True)
class FileCoverage:
    """A source file by its path as the compiler was called; `lines` are those with code, with their counts."""

    path: str
    lines: dict[int, int] = field(default_factory=dict)
    functions: list[FunctionCoverage] = field(default_factory=list)
    branches: list[BranchCoverage] = field(default_factory=list)

    @cached_property
    def lines_run(self) -> int:
        return sum(count > 0 for count in self.lines.values())


class ImageLines:
    """The lines, functions and branches of an image. Raises `LabError` for one without lines."""

    def __init__(self, image: Image) -> None:
        self._image = image
        self.rows = [row for row in image.debug.rows if row.line and row.path]
        if not self.rows:
            raise LabError(f"{image.path}: its DWARF has no lines of code in flash; build it with -g")
        filled = [row for row in self.rows if row.end > row.begin]
        self._begins = [row.begin for row in filled]
        self._filled = filled
        self._functions = list(self._with_places())
        self._branches = [
            (row, at, at + size) for at, size in _branches(image) if (row := self.row_at(at)) is not None
        ]

    def row_at(self, address: int) -> LineRow | None:
        """Return the line whose code an address is, None outside all of them."""
        index = bisect_right(self._begins, address) - 1
        row = self._filled[index] if index >= 0 else None
        return row if row is not None and address < row.end else None

    def _with_places(self) -> Iterator[tuple[str, int, int, LineRow]]:
        """Yield name, address and last line of every function with lines, once per address, with its first row."""
        known = {one.address: one for one in reversed(self._image.functions)}
        places = sorted(known.values(), key=lambda one: one.address)
        ends = [one.address for one in places[1:]] + [FLASH + FLASH_SIZE]
        for one, following in zip(places, ends, strict=True):
            at = bisect_left(self.rows, one.address, key=attrgetter("begin"))
            row = self.rows[at] if at < len(self.rows) else None
            if row is None or row.begin != one.address:
                continue
            end = min(one.address + one.size, following) if one.size else following
            first, last = (bisect_right(self._begins, at - 1) for at in (one.address, end))
            own = [other.line for other in self._filled[first:last] if other.path == row.path]
            yield one.name, one.address, max(own, default=row.line), row

    def coverage(self, counts: NDArray[np.uint64]) -> list[FileCoverage]:
        """Return the coverage of every source file, by path; `counts` are those of `Chip.passages`."""
        runs = runs_of(counts)
        files: dict[str, FileCoverage] = {}
        numbers: Counter[tuple[str, int]] = Counter()  # of branches, by line
        for row in self.rows:
            if not row.is_statement:
                continue
            begin = (row.begin - FLASH) // 2
            count = int(runs[begin : max((row.end - FLASH) // 2, begin + 1)].max())
            lines = files.setdefault(row.path, FileCoverage(row.path)).lines
            lines[row.line] = max(count, lines.get(row.line, 0))
        for name, address, last, row in self._functions:
            if row.path in files:
                count = int(runs[(address - FLASH) // 2])
                files[row.path].functions.append(FunctionCoverage(name, row.line, last, count))
        for row, _, end in self._branches:
            if row.path in files:
                _, fell, jumped = counts[(end - FLASH) // 2].tolist()
                branch = BranchCoverage(row.line, numbers[row.path, row.line], jumped, fell)
                files[row.path].branches.append(branch)
                numbers[row.path, row.line] += 1
        for file in files.values():
            file.functions.sort(key=lambda one: (one.line, one.name))
            file.branches.sort(key=lambda one: (one.line, one.number))
        return [files[path] for path in sorted(files)]


def runs_of(counts: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Return how often the instruction at each half word of flash ran, from the counts of `Chip.passages`."""
    ended = counts[:-1, FELL:].sum(axis=1)
    return np.cumsum(counts[:-1, BEGUN].astype(np.int64) - ended.astype(np.int64))


def _branches(image: Image) -> Iterator[tuple[int, int]]:
    """Yield address and size of every conditional jump in the functions of an image."""
    words = np.frombuffer(image.code[: len(image.code) // 2 * 2], "<u2").tolist()
    begin = image.base
    places = sorted({one.address for one in image.functions if begin <= one.address < begin + 2 * len(words)})
    for first, following in pairwise([*places, begin + 2 * len(words)]):
        at, end, left = (first - begin) // 2, (following - begin) // 2, 0
        while at < end:
            code = words[at]
            if at in image.constants:
                at, left = at + 1, 0
                continue
            wide = is_wide(code) and at + 1 < len(words)
            second = words[at + 1] if wide else 0
            if _is_conditional(code, second) or (left == 1 and _jumps(code, second)):
                yield begin + 2 * at, 4 if wide else 2
            left = max(left - 1, 0)
            if code & 0xFF00 == IT and code & 15 and code >> 4 & 15 != ALWAYS:
                left = 5 - ((code & 15) & -(code & 15)).bit_length()
            at += 2 if wide else 1


def _is_conditional(code: int, second: int) -> bool:
    """Return whether an instruction is B<c> or CB{N}Z (A7.7.12, A7.7.21)."""
    if code >> 11 == 0b11110:
        return second & 0xD000 == 0x8000 and code >> 6 & 15 < ALWAYS
    return (code & 0xF000 == 0xD000 and code >> 8 & 15 < ALWAYS) or code & 0xF500 == 0xB100


def _jumps(code: int, second: int) -> bool:
    """Return whether an unconditional instruction is a jump: B, BX, BL, BLX, or a POP or load into pc."""
    if code >> 11 == 0b11110:
        return second & 0x9000 == 0x9000
    if code & 0xFE50 == 0xE810:  # LDM, POP
        return bool(second >> 15)
    return code & 0xF800 == 0xE000 or code & 0xFF00 in (0x4700, 0xBD00)
