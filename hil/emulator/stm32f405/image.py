"""The flashed image: the ELF of an STM32F405 or a .bin, with the names of its addresses if there is an ELF.

An image that cannot run here is refused in one line.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from hashlib import sha256
from operator import attrgetter
from pathlib import Path
from struct import unpack_from

import numpy as np

from firmware_py.export.elf import ERASED, FLASH, FLASH_SIZE, MAGIC, MEMORIES, Elf, Symbol, read
from firmware_py.export.errors import ExportError
from hil.emulator.stm32f405.debug_info import DebugInfo
from hil.emulator.stm32f405.literals import literals
from hil.errors import LabError, hint

BASES = (FLASH + 0x4000, FLASH)  # of a .bin: behind the Crazyflie's boot loader, or at the start
# Of the words that are addresses in flash; of whole releases, 0.006 and up to 21 lie behind the end, by chance.
BEHIND_SHARE, BEHIND_LEAST = 0.012, 24


@dataclass(frozen=True, slots=True)
class MemoryUse:
    """How much of a memory the linker has allocated."""

    name: str
    used: int  # [bytes]
    size: int

    @property
    def free(self) -> int:
        return self.size - self.used


class Image:
    """An image and its symbols. Raises `LabError` with one line if it cannot run on an STM32F405.

    `content` is that of `path`, when it has been read already. A .bin without an ELF has no names.
    """

    def __init__(self, path: Path, elf: Path | None = None, content: bytes | None = None) -> None:
        self.path = path
        self.named = True  # whether symbols and lines are known
        self._functions: list[Symbol] = []
        self._variables: dict[str, list[Symbol]] = {}
        try:
            self._read(read(path) if content is None else content, elf)
        except ExportError as error:
            raise LabError(str(error)) from None

    def _read(self, content: bytes, elf_path: Path | None) -> None:
        if content[:4] == MAGIC:
            if elf_path is not None:
                raise LabError(f"--elf {elf_path}: goes with a .bin; {self.path} is an ELF file itself")
            elf = Elf(self.path, content)
        elif elf_path is None:
            self._read_unnamed(content)
            return
        else:
            elf = Elf(elf_path)
        self.base = elf.base  # of the vector table
        self.code = elf.code if elf_path is None else _same(self.path, content, elf)
        self._check_vectors()
        self.memory = tuple(_memory_use(elf, self.code))
        self._take_names(elf)
        self.constants = elf.constants(self.base, len(self.code))  # half words without instructions

    def _read_unnamed(self, content: bytes) -> None:
        """Read a .bin of which nothing else is known: it lies where its reset vector leads, behind a boot loader or not."""
        self.code = content + ERASED * (-len(content) % 4)
        self.base = next((base for base in BASES if self._leads_into(base)), BASES[0])
        self._check_vectors()
        self._check_end()
        self.memory = (MemoryUse("flash", len(self.code), FLASH + FLASH_SIZE - self.base),)
        self.named, self.constants = False, literals(self.code)
        self.debug = DebugInfo(None, self.path)

    def _leads_into(self, base: int) -> bool:
        return len(self.code) >= 8 and 0 <= unpack_from("<I", self.code, 4)[0] - base < len(self.code)

    def _check_end(self) -> None:
        """Refuse a .bin that ends before its code: words that lead behind its end are none of a whole one's addresses."""
        end = self.base + len(self.code)
        words = np.frombuffer(self.code, "<u4")
        behind = np.count_nonzero((words > end) & (words < FLASH + FLASH_SIZE))
        inside = np.count_nonzero((words >= self.base) & (words <= end))
        if behind > max(BEHIND_SHARE * inside, BEHIND_LEAST):
            raise LabError(
                f"{self.path}: truncated: {len(self.code)} bytes from 0x{self.base:08x} on, and {behind} "
                "addresses in it lie behind that"
            )

    def _take_names(self, elf: Elf) -> None:
        if not elf.symbols:
            raise LabError(
                f"{elf.path}: stripped, it has no symbols: without them its tasks, its variables and the place of a crash "
                "have no names; flash it as it is, and give here the ELF from before `strip`"
            )
        if elf.dwarf is None:
            raise LabError(
                f"{elf.path}: stripped of debugging information (DWARF): without it the task list, stacks and source lines "
                "of a crash cannot be read; give here the ELF from before `strip`, or build it with -g"
            )
        self.debug = DebugInfo(elf.dwarf, elf.path)
        functions = [one for one in elf.symbols if one.is_function and one.address >= FLASH]
        self._functions = sorted(functions, key=attrgetter("address"))
        for symbol in elf.symbols:
            if symbol.is_variable:
                self._variables.setdefault(symbol.name, []).append(symbol)

    def _called(self, name: str) -> list[Symbol]:
        return self._variables.get(name) or [
            function for function in self._functions if function.name == name
        ]

    def symbol(self, name: str) -> Symbol:
        """Return a variable or function by its name; raises `LabError` for none or several."""
        found = self._called(name)
        if len(found) == 1:
            return found[0]
        if found:
            raise LabError(f"{self.path}: {len(found)} variables or functions are called {name}")
        near = hint(name, self._variables, "it was built without that")
        raise LabError(f"{self.path}: no variable or function is called {name}; {near}")

    def has(self, name: str) -> bool:
        """Return whether exactly one variable or function has that name."""
        return len(self._called(name)) == 1

    def variable_at(self, address: int) -> str:
        """Return the name of the variable around an address, empty outside all of them."""
        found = (one for one in self._all_variables() if one.address <= address < one.address + one.size)
        return next((one.name for one in found), "")

    def name_of(self, address: int, read_word: Callable[[int], int]) -> str:
        """Return the name of an object: that of a variable that points to it, else its own, else its address."""
        for symbol in self._all_variables():
            in_memory = any(base <= symbol.address < base + size for _, base, size in MEMORIES)
            if symbol.size == 4 and in_memory and read_word(symbol.address) == address:
                return symbol.name
        return self.variable_at(address) or f"0x{address:08x}"

    def _all_variables(self) -> Iterator[Symbol]:
        return (symbol for named in self._variables.values() for symbol in named)

    @property
    def sha256(self) -> str:
        """Return the digest of what is in flash."""
        return sha256(self.code).hexdigest()

    @property
    def functions(self) -> list[Symbol]:
        """Return the functions in flash and RAM, by address; several names of one are all there."""
        return self._functions

    def function_at(self, address: int) -> str:
        """Return the name of the function around an address, empty outside all of them."""
        index = bisect_right(self._functions, address, key=attrgetter("address")) - 1
        function = self._functions[index] if index >= 0 else None
        return function.name if function and address < function.address + function.size else ""

    def place(self, address: int) -> str:
        """Return a code address as text: function and line if known, else the number."""
        name = self.function_at(address)
        if not self.named:
            return f"0x{address:08x}"
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
        stack, entry = unpack_from("<2I", self.code)
        stack &= ~3  # as the register does, B1.4.7
        if not any(base < stack <= base + size for _, base, size in MEMORIES):
            raise LabError(
                f"{self.path}: no vector table at 0x{self.base:08x}: the stack pointer there, 0x{stack:08x}, "
                "is outside the RAM of an STM32F405"
            )
        if not self.base <= entry & ~1 < end or not entry & 1:
            raise LabError(
                f"{self.path}: no vector table at 0x{self.base:08x}: the reset vector there, 0x{entry:08x}, "
                f"is not Thumb code between 0x{self.base:08x} and 0x{end:08x}"
            )
        self.initial_stack_pointer, self.reset = stack, entry & ~1


def has_symbols(path: Path) -> bool:
    """Return whether a debugger reads a file: an ELF. Raises `LabError` when it cannot be read."""
    try:
        return read(path)[:4] == MAGIC
    except ExportError as error:
        raise LabError(str(error)) from None


def _same(path: Path, content: bytes, elf: Elf) -> bytes:
    """Return the content of a .bin if it equals the segments of its ELF."""
    for segment in elf.in_flash:
        begin, data = segment.load - elf.base, segment.data
        there = content[begin : begin + len(data)]
        if there != data:
            first = next((i for i, (a, b) in enumerate(zip(there, data, strict=False)) if a != b), len(there))
            what = "ends" if first == len(there) else "differs"
            raise LabError(
                f"{path}: not made of the ELF that --elf names: it {what} at 0x{segment.load + first:08x}"
            )
    return content


def _memory_use(elf: Elf, code: bytes) -> Iterator[MemoryUse]:
    """Yield the use of flash by code, and of the others by variables, including the start-up code's and its stack."""
    yield MemoryUse("flash", len(code), FLASH + FLASH_SIZE - elf.base)
    for name, base, size in MEMORIES:
        used = (segment.size for segment in elf.segments if base <= segment.address < base + size)
        yield MemoryUse(name, sum(used), size)
