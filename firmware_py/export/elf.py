"""ELF files for an STM32F405: segments, symbols and the compiler's debug information (DWARF).

The headers are checked here, so that every file that does not fit this processor is refused with a reason of one line.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from struct import iter_unpack, unpack_from
from typing import Any, TypeVar

from firmware_py.export.errors import ExportError
from firmware_py.extras import install_command

FLASH, FLASH_SIZE = 0x0800_0000, 0x10_0000
RAM, RAM_SIZE = 0x2000_0000, 0x2_0000
CCM, CCM_SIZE = 0x1000_0000, 0x1_0000  # core-coupled memory, RM0090 section 2.3
MEMORIES = (("RAM", RAM, RAM_SIZE), ("CCM", CCM, CCM_SIZE))  # volatile
MAGIC = b"\x7fELF"
ERASED = b"\xff"
HEADER_SIZE, PROGRAM_SIZE, ARM, BITS_32, LITTLE_ENDIAN = 52, 32, 40, 1, 1
LOADED, WRITABLE = 1, 2  # PT_LOAD, PF_W
NO_TYPE, OBJECT, FUNCTION = 0, 1, 2  # STT_NOTYPE, STT_OBJECT, STT_FUNC
MACHINES = {3: "x86", 8: "MIPS", 62: "x86-64", 94: "Xtensa", 183: "AArch64", 243: "RISC-V"}

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Segment:
    """A piece that is loaded as one; in memory it has `size` bytes, those behind `data` begin as zeros."""

    load: int
    address: int
    data: bytes
    size: int
    writable: bool


@dataclass(frozen=True, slots=True)
class Symbol:
    """A function or a variable; the address of a function has no Thumb bit."""

    name: str
    address: int
    size: int  # [bytes], 0: not known
    is_function: bool
    is_variable: bool


class Elf:
    """A linked file. `content` is that of `path`, when it has been read already. Raises `ExportError` with one line."""

    def __init__(self, path: Path, content: bytes | None = None) -> None:
        self.path = path
        self._content = read(path) if content is None else content
        self._check_header()
        self.segments = self._segments()

    @cached_property
    def symbols(self) -> list[Symbol]:
        """Return all symbols; empty when the file is stripped."""
        return self._parsed(self._symbols)

    @cached_property
    def dwarf(self) -> Any:
        """Return the debug information, as pyelftools reads it; None when it is stripped."""
        return self._parsed(
            lambda file: file.get_dwarf_info() if file.get_section_by_name(".debug_info") else None
        )

    @cached_property
    def in_flash(self) -> list[Segment]:
        """Return the segments in flash. Raises `ExportError` for segments elsewhere, and when there are none."""
        segments = [one for one in self.segments if one.data and not _is_in_ram(one.load)]
        for segment in segments:
            if segment.load < FLASH:
                raise ExportError(
                    f"{self.path}: a segment is loaded to 0x{segment.load:08x} (runs at 0x{segment.address:08x}): "
                    f"outside the flash of an STM32F405, from 0x{FLASH:08x} on"
                )
            end = segment.load + len(segment.data)
            if end > FLASH + FLASH_SIZE:
                raise ExportError(
                    f"{self.path}: a segment ends at 0x{end:08x}: flash has {FLASH_SIZE} bytes from 0x{FLASH:08x} on"
                )
        if not segments:
            raise ExportError(
                f"{self.path}: no vector table: nothing is loaded into flash, from 0x{FLASH:08x} on"
            )
        return segments

    @property
    def base(self) -> int:
        """Return the lowest address that is written in flash: that of the vector table."""
        return min(segment.load for segment in self.in_flash)

    @cached_property
    def code(self) -> bytes:
        """Return the content of flash from `base` on; gaps between segments are erased."""
        base = self.base
        code = bytearray(ERASED * (max(one.load + len(one.data) for one in self.in_flash) - base))
        for segment in self.in_flash:
            code[segment.load - base : segment.load - base + len(segment.data)] = segment.data
        return bytes(code)

    def constants(self, base: int, size: int) -> frozenset[int]:
        """Return the half words from `base` on that are not instructions: those between the symbols $d and $t."""
        marks = sorted(
            (symbol.address, symbol.name[:2])
            for symbol in self.symbols
            if symbol.name[:2] in ("$d", "$t") and base <= symbol.address < base + size
        )
        found: set[int] = set()
        for (begin, kind), (end, _) in pairwise([*marks, (base + size, "$t")]):
            if kind == "$d":
                found.update(range((begin - base) // 2, (end - base + 1) // 2))
        return frozenset(found)

    def _check_header(self) -> None:
        """Refuse a file that is not a 32-bit ARM executable or is shorter than its header states."""
        path, content = self.path, self._content
        if content[:4] != MAGIC:
            raise ExportError(f"{path}: not an ELF file")
        if len(content) < HEADER_SIZE:
            raise ExportError(
                f"{path}: truncated: {len(content)} bytes, the header of an ELF file alone has {HEADER_SIZE}"
            )
        machine = unpack_from("<H", content, 18)[0]
        if content[4] != BITS_32:
            raise ExportError(
                f"{path}: a 64-bit ELF file ({MACHINES.get(machine, machine)}); a Cortex-M4 has 32 bits"
            )
        if machine != ARM or content[5] != LITTLE_ENDIAN:
            name = (
                "big-endian" if content[5] != LITTLE_ENDIAN else MACHINES.get(machine, f"machine {machine}")
            )
            raise ExportError(f"{path}: built for {name}; a Cortex-M4 is a little-endian ARM")
        programs, sections = unpack_from("<II", content, 28)
        program_count, section_size, section_count = unpack_from("<3H", content, 44)
        if not program_count:
            raise ExportError(f"{path}: an object file that was not linked")
        self._check_size(programs + PROGRAM_SIZE * program_count, sections + section_size * section_count)

    def _check_size(self, *ends: int) -> None:
        if max(ends) > len(self._content):
            raise ExportError(f"{self.path}: truncated: {len(self._content)} of at least {max(ends)} bytes")

    def _segments(self) -> list[Segment]:
        begin, count = unpack_from("<I", self._content, 28)[0], unpack_from("<H", self._content, 44)[0]
        found = []
        for index in range(count):
            place = begin + PROGRAM_SIZE * index
            kind, offset, address, load, length, in_memory, flags = unpack_from("<7I", self._content, place)
            self._check_size(offset + length)
            if kind == LOADED:
                data = self._content[offset : offset + length]
                found.append(Segment(load, address, data, in_memory, bool(flags & WRITABLE)))
        return found

    def _parsed(self, take: Callable[[Any], T]) -> T:
        """Return what pyelftools finds."""
        try:
            from elftools.common.exceptions import DWARFError, ELFError
            from elftools.construct import ConstructError
            from elftools.elf.elffile import ELFFile
        except ImportError:
            raise ExportError(f"pyelftools is missing: {install_command('deploy')}") from None
        try:
            return take(ELFFile(BytesIO(self._content)))
        except (ELFError, DWARFError, ConstructError, struct.error, ValueError, KeyError, OSError) as error:
            raise ExportError(f"{self.path}: damaged ELF file: {' '.join(str(error).split())}") from None

    def _symbols(self, file: Any) -> list[Symbol]:
        table = file.get_section_by_name(".symtab")
        if table is None:
            return []
        names = file.get_section(table["sh_link"]).data()
        found = []
        for place, value, size, info, _, _ in iter_unpack("<IIIBBH", table.data()):
            name, kind = _text(names, place), info & 15
            is_variable = kind == OBJECT or (kind == NO_TYPE and not name.startswith("$"))
            address = value & ~1 if kind == FUNCTION else value
            found.append(Symbol(name, address, size, kind == FUNCTION, is_variable))
        return found


def read(path: Path) -> bytes:
    """Return a file's content. Raises `ExportError`."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ExportError(f"{path}: {error.strerror or error}") from None


def call_frames(dwarf: Any, content: bytes) -> list[Any]:
    """Return the entries of a part of .debug_frame, as pyelftools reads them."""
    from elftools.dwarf.callframe import CallFrameInfo

    return list(CallFrameInfo(BytesIO(content), len(content), 0, dwarf.structs).get_entries())


def _is_in_ram(address: int) -> bool:
    return any(base <= address < base + size for _, base, size in MEMORIES)


def _text(strings: bytes, offset: int) -> str:
    """Return a string of a table of strings."""
    return strings[offset : strings.index(0, offset)].decode(errors="replace")
