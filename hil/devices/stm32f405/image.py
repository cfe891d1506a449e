"""What is flashed: the ELF of an STM32F405, or the .bin that was made of one, with the names of its addresses.

Everything that cannot run here, or could not be inspected while it runs, is refused in one line.
"""

import struct
from bisect import bisect_right
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from struct import iter_unpack, unpack_from
from typing import Any

from firmware_py.export.arm_image import constants_of
from firmware_py.extras import install_command
from hil.devices.stm32f405.debug_info import DebugInfo
from hil.errors import LabError, hint

FLASH, FLASH_SIZE = 0x0800_0000, 0x10_0000
MEMORIES = (
    (0x2000_0000, 0x2_0000),
    (0x1000_0000, 0x1_0000),
)  # RAM and core-coupled memory, RM0090 section 2.3
ERASED = b"\xff"
HEADER_SIZE, ARM, BITS_32, LITTLE_ENDIAN = 52, 40, 1, 1
LOADED = 1  # PT_LOAD
NO_TYPE, OBJECT, FUNCTION = 0, 1, 2  # STT_NOTYPE, STT_OBJECT, STT_FUNC
MACHINES = {3: "x86", 8: "MIPS", 62: "x86-64", 94: "Xtensa", 183: "AArch64", 243: "RISC-V"}


@dataclass(frozen=True, slots=True)
class Symbol:
    """A function or a variable; the address of a function has no Thumb bit."""

    name: str
    address: int
    size: int  # [bytes], 0: not known


class Image:
    """An image and what its addresses mean. Raises `LabError` with one line for what cannot run on an STM32F405."""

    def __init__(self, path: Path, elf: Path | None = None) -> None:
        self.path = path
        content = _read(path)
        if content[:4] == b"\x7fELF":
            if elf is not None:
                raise LabError(f"--elf {elf}: goes with a .bin; {path} is an ELF file itself")
            elf_path, elf_content = path, content
        elif elf is None:
            raise LabError(f"{path}: not an ELF file; a .bin needs --elf FILE, the ELF that it was made of")
        else:
            elf_path, elf_content = elf, _read(elf)
        _check_header(elf_path, elf_content)
        segments = _flash_segments(elf_path, elf_content)
        self.base = min(address for address, _ in segments)  # of the vector table
        self.code = _joined(segments, self.base) if elf is None else _same(path, content, segments, self.base)
        self._check_vectors()
        self._functions, self._variables, self.debug, marks = _names(elf_path, elf_content)
        before = (self.base - FLASH) // 2
        found = constants_of(marks, self.base - FLASH + len(self.code))
        self.constants = frozenset(index - before for index in found)  # half words that are no instructions
        self._starts = [function.address for function in self._functions]

    @property
    def initial_stack_pointer(self) -> int:
        """Return what the core loads into the main stack pointer at reset."""
        return int(unpack_from("<I", self.code, 0)[0]) & ~3

    @property
    def reset(self) -> int:
        """Return the address of the first instruction, without the Thumb bit."""
        return int(unpack_from("<I", self.code, 4)[0]) & ~1

    def symbol(self, name: str) -> Symbol:
        """Return a variable or function by its name; raises `LabError` when there are none or several."""
        found = self._variables.get(name) or [f for f in self._functions if f.name == name]
        if len(found) == 1:
            return found[0]
        if found:
            raise LabError(f"{self.path}: {len(found)} variables or functions are called {name}")
        near = hint(name, self._variables, "it was built without that")
        raise LabError(f"{self.path}: no variable or function is called {name}; {near}")

    def has(self, name: str) -> bool:
        """Return whether exactly one variable or function has that name."""
        return len(self._variables.get(name) or [f for f in self._functions if f.name == name]) == 1

    def function_at(self, address: int) -> str:
        """Return the name of the function around an address, empty outside all of them."""
        index = bisect_right(self._starts, address) - 1
        function = self._functions[index] if index >= 0 else Symbol("", 0, 0)
        return function.name if address < function.address + function.size else ""

    def place(self, address: int) -> str:
        """Return an address of code in words: function and line as far as they are known, else the number."""
        name = self.function_at(address)
        if not name:
            return f"0x{address:08x}, outside every function"
        line = self.debug.line_at(address)
        return f"{name} ({line})" if line else name

    def _check_vectors(self) -> None:
        end = self.base + len(self.code)
        if end > FLASH + FLASH_SIZE:
            raise LabError(
                f"{self.path}: {len(self.code)} bytes from 0x{self.base:08x} on do not fit into the "
                f"{FLASH_SIZE} bytes of flash from 0x{FLASH:08x} on"
            )
        if len(self.code) < 8:
            raise LabError(f"{self.path}: its flash holds {len(self.code)} bytes, no vector table")
        stack, entry = self.initial_stack_pointer, unpack_from("<I", self.code, 4)[0]
        if not any(base < stack <= base + size for base, size in MEMORIES):
            raise LabError(
                f"{self.path}: no vector table at 0x{self.base:08x}: the stack pointer there, 0x{stack:08x}, "
                "is outside the RAM of an STM32F405"
            )
        if not self.base <= entry & ~1 < end or not entry & 1:
            raise LabError(
                f"{self.path}: no vector table at 0x{self.base:08x}: the reset vector there, 0x{entry:08x}, "
                f"is not Thumb code between 0x{self.base:08x} and 0x{end:08x}"
            )


def _text(strings: bytes, offset: int) -> str:
    """Return a string of a table of strings."""
    return strings[offset : strings.index(0, offset)].decode(errors="replace")


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise LabError(f"{path}: {error.strerror or error}") from None


def _check_header(path: Path, content: bytes) -> None:
    """Refuse what is no executable for a 32-bit ARM, or is shorter than its own header says."""
    if content[:4] != b"\x7fELF":
        raise LabError(f"{path}: not an ELF file")
    if len(content) < HEADER_SIZE:
        raise LabError(
            f"{path}: truncated: {len(content)} bytes, the header of an ELF file alone has {HEADER_SIZE}"
        )
    machine = unpack_from("<H", content, 18)[0]
    if content[4] != BITS_32:
        raise LabError(
            f"{path}: a 64-bit ELF file ({MACHINES.get(machine, machine)}); a Cortex-M4 has 32 bits"
        )
    if machine != ARM or content[5] != LITTLE_ENDIAN:
        name = "big-endian" if content[5] != LITTLE_ENDIAN else MACHINES.get(machine, f"machine {machine}")
        raise LabError(f"{path}: built for {name}; a Cortex-M4 is a little-endian ARM")
    programs, sections = unpack_from("<II", content, 28)
    program_size, program_count, section_size, section_count = unpack_from("<4H", content, 42)
    ends = [programs + program_size * program_count, sections + section_size * section_count]
    if not program_count:
        raise LabError(f"{path}: an object file that was not linked")
    if ends[0] <= len(content):
        for index in range(program_count):
            _, offset, _, _, size = unpack_from("<5I", content, programs + index * program_size)
            ends.append(offset + size)
    if max(ends) > len(content):
        raise LabError(f"{path}: truncated: {len(content)} of at least {max(ends)} bytes")


def _flash_segments(path: Path, content: bytes) -> list[tuple[int, bytes]]:
    """Return what a programmer writes into flash: load address and bytes of each segment.

    What an ELF loads into RAM is left out, as when it is flashed: it is lost at power-up.
    """
    programs, size, count = unpack_from("<I", content, 28)[0], *unpack_from("<2H", content, 42)
    segments = []
    for index in range(count):
        kind, offset, virtual, load, length = unpack_from("<5I", content, programs + index * size)
        if kind != LOADED or not length or any(base <= load < base + end for base, end in MEMORIES):
            continue
        if load < FLASH:
            raise LabError(
                f"{path}: a segment is loaded to 0x{load:08x} (runs at 0x{virtual:08x}): "
                f"outside the flash of an STM32F405, from 0x{FLASH:08x} on"
            )
        if load + length > FLASH + FLASH_SIZE:
            raise LabError(
                f"{path}: a segment ends at 0x{load + length:08x}: flash has {FLASH_SIZE} bytes from 0x{FLASH:08x} on"
            )
        segments.append((load, content[offset : offset + length]))
    if not segments:
        raise LabError(f"{path}: no vector table: nothing is loaded into flash, from 0x{FLASH:08x} on")
    return segments


def _joined(segments: list[tuple[int, bytes]], base: int) -> bytes:
    """Return the segments as one piece from `base` on, with erased flash between them."""
    code = bytearray(ERASED * (max(address + len(data) for address, data in segments) - base))
    for address, data in segments:
        code[address - base : address - base + len(data)] = data
    return bytes(code)


def _same(path: Path, content: bytes, segments: list[tuple[int, bytes]], base: int) -> bytes:
    """Return the content of a .bin, if it holds what the segments of its ELF do."""
    for address, data in segments:
        there = content[address - base : address - base + len(data)]
        if there != data:
            first = next((i for i, (a, b) in enumerate(zip(there, data, strict=False)) if a != b), len(there))
            what = "ends" if first == len(there) else "differs"
            raise LabError(
                f"{path}: not made of the ELF that --elf names: it {what} at 0x{address + first:08x}"
            )
    return content


def _names(
    path: Path, content: bytes
) -> tuple[list[Symbol], dict[str, list[Symbol]], DebugInfo, list[tuple[int, str]]]:
    """Return the functions by address, the variables by name, the debugging information, and what marks code and data."""
    try:
        from elftools.common.exceptions import DWARFError, ELFError
        from elftools.construct import ConstructError
        from elftools.elf.elffile import ELFFile
    except ImportError:
        raise LabError(f"pyelftools is missing: {install_command('deploy')}") from None
    try:
        elf: Any = ELFFile(BytesIO(content))
        table = elf.get_section_by_name(".symtab")
        if table is None or not table.num_symbols():
            raise LabError(
                f"{path}: stripped, it has no symbols: without them its tasks, its variables and the place of a crash "
                "have no names; flash it as it is, and give here the ELF from before `strip`"
            )
        names = elf.get_section(table["sh_link"]).data()
        symbols = [
            (info & 15, Symbol(_text(names, name), value, size))
            for name, value, size, info, _, _ in iter_unpack("<IIIBBH", table.data())
        ]
        if elf.get_section_by_name(".debug_info") is None:
            raise LabError(
                f"{path}: stripped of debugging information (DWARF): without it the task list, stacks and source lines "
                "of a crash cannot be read; give here the ELF from before `strip`, or build it with -g"
            )
        debug = DebugInfo(elf.get_dwarf_info(), path)
    except (ELFError, DWARFError, ConstructError, struct.error, ValueError, KeyError, OSError) as error:
        raise LabError(f"{path}: damaged ELF file: {' '.join(str(error).split())}") from None
    code = (
        Symbol(s.name, s.address & ~1, s.size)
        for kind, s in symbols
        if kind == FUNCTION and s.address >= FLASH
    )
    variables: dict[str, list[Symbol]] = {}
    for kind, symbol in symbols:
        if kind == OBJECT or (kind == NO_TYPE and not symbol.name.startswith("$")):
            variables.setdefault(symbol.name, []).append(symbol)
    marks = [(symbol.address, symbol.name) for _, symbol in symbols if symbol.name[:2] in ("$d", "$t")]
    return sorted(code, key=lambda function: function.address), variables, debug, marks
