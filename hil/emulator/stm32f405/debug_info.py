"""Reads an image's debugging information (DWARF): lines of addresses, members of structures, and callers, by unwinding
stack frames with the call frame information.

Each compilation unit is read at its first use.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from operator import itemgetter
from os.path import join, normpath
from pathlib import Path
from struct import unpack_from
from typing import Any, NamedTuple

from firmware_py.export.elf import FLASH, FLASH_SIZE, call_frames
from hil.errors import LabError, hint

FLASH_FROM, FLASH_TO = FLASH, FLASH + FLASH_SIZE
SP, LR, PC = 13, 14, 15
DEEPEST = 32
SHARED = 0xFFFF_FFFF  # in .debug_frame (32-bit DWARF), the mark of an entry that functions share


class CallFrames:
    """The rules of one image. Only the entries of functions in a backtrace are decoded, of thousands."""

    def __init__(self, dwarf: Any) -> None:
        self._dwarf = dwarf
        section = None if dwarf is None else dwarf.debug_frame_sec
        self._content = section.stream.getvalue() if section else b""
        self._entries = sorted(self._headers())

    def _headers(self) -> Iterator[tuple[int, int, int, int]]:
        """Yield begin and end of a function's code, and the places of its entry and of the shared one."""
        at = 0
        while at < len(self._content):
            length, shared, begin, size = unpack_from("<4I", self._content, at)
            if shared != SHARED:
                yield begin, begin + size, at, shared
            at += 4 + length

    def backtrace(self, registers: dict[int, int], read_word: Callable[[int], int]) -> Iterator[int]:
        """Yield the pc, then an address in the caller, in its caller, and so on, as far as the rules go.

        `registers` has at least sp (13), lr (14) and pc (15); `read_word` reads the stack.
        """
        yield registers[PC]
        if self._rules_at(registers[PC]) is None:  # a jump outside all functions has not changed the stack
            registers = registers | {PC: (registers[LR] & ~1) - 1}
            yield registers[PC]
        for _ in range(DEEPEST):
            registers = self._caller(registers, read_word)
            if not registers:
                return
            yield registers[PC]

    def _caller(self, registers: dict[int, int], read_word: Callable[[int], int]) -> dict[int, int]:
        """Return the caller's registers at its call; empty when unknown."""
        rules = self._rules_at(registers[PC])
        if rules is None or rules["cfa"].reg not in registers:
            return {}
        frame = registers[rules["cfa"].reg] + rules["cfa"].offset
        before = dict(registers)
        for number, rule in rules.items():
            if isinstance(number, int) and number <= LR and rule.type == "OFFSET":
                before[number] = read_word(frame + rule.arg)
        before[SP] = frame
        # A return address follows its call and may lie behind the function; the byte before is inside the call.
        before[PC] = (before[LR] & ~1) - 1
        return before if (before[PC], frame) != (registers[PC], registers[SP]) else {}

    def _rules_at(self, address: int) -> dict[Any, Any] | None:
        """Return the rule that unwinds a function's frame at an address."""
        index = bisect_right(self._entries, address, key=itemgetter(0)) - 1
        begin, end, at, shared = self._entries[index] if index >= 0 else (0, 0, 0, 0)
        if not begin <= address < end:
            return None
        # Only two entries; the second refers to the first, which is at 0.
        content = self._entry(shared) + self._entry(at)[:4] + bytes(4) + self._entry(at)[8:]
        common, own = call_frames(self._dwarf, content)
        # A function that saves nothing on its stack has only the rows with which all functions begin.
        rows = [row for row in own.get_decoded().table if row["pc"] <= address] or common.get_decoded().table
        return rows[-1] if rows else None

    def _entry(self, at: int) -> bytes:
        return self._content[at : at + 4 + int(unpack_from("<I", self._content, at)[0])]


# Opcodes of line programs (DWARF 5, 7.22).
COPY, ADVANCE_PC, ADVANCE_LINE, SET_FILE, NEGATE_STATEMENT, CONST_ADD_PC, FIXED_ADVANCE_PC = (
    1,
    2,
    3,
    4,
    6,
    8,
    9,
)
END_SEQUENCE, SET_ADDRESS = 1, 2  # extended ones
AGGREGATES = ("DW_TAG_structure_type", "DW_TAG_union_type")
TRANSPARENT = ("DW_TAG_typedef", "DW_TAG_volatile_type", "DW_TAG_const_type")
POINTER_SIZE = 4


@dataclass(frozen=True, slots=True)
class Member:
    """The place of a member in its structure."""

    offset: int
    size: int


@dataclass(frozen=True, slots=True)
class Structure:
    """A structure's layout; members of members have dotted names, those of anonymous ones their own."""

    name: str
    size: int
    members: dict[str, Member]

    def __getitem__(self, name: str) -> Member:
        try:
            return self.members[name]
        except KeyError:
            raise LabError(f"struct {self.name} has no member {name}; {hint(name, self.members)}") from None


@dataclass(frozen=True, slots=True)
class LineRow:
    """Code of one line: from an address up to another, which are equal where the line only begins there."""

    begin: int
    end: int
    path: str  # as the compiler was called
    line: int  # 0: the compiler's own code
    is_statement: bool  # False: code that was moved away from the line's statement


class DebugInfo:
    """Answers by address and by name; nothing is known without `dwarf`. `path` is for messages."""

    def __init__(self, dwarf: Any, path: Path) -> None:
        self._dwarf, self._path = dwarf, path
        self._lines: dict[int, list[tuple[int, str]]] = {}

    @cached_property
    def frames(self) -> CallFrames:
        """Return the rules to find a function's callers."""
        return CallFrames(self._dwarf)

    def line_at(self, address: int) -> str:
        """Return file and line of a code address as `file.c:12`, empty if unknown."""
        unit = self._unit_at(address)
        if unit is None:
            return ""
        table = self._table(unit)
        index = bisect_right(table, address, key=itemgetter(0)) - 1
        return table[index][1] if index >= 0 else ""

    def address_of(self, line: str) -> int:
        """Return the first code address of `file.c:12`, 0 if that file has none."""
        file = line.partition(":")[0]
        units = (unit for _, _, unit in self._units if Path(_name(unit.get_top_DIE())).name == file)
        return next((address for unit in units for address, place in self._table(unit) if place == line), 0)

    @cached_property
    def rows(self) -> list[LineRow]:
        """Return all line rows of the code in flash, by address."""
        found = (row for unit in self._dwarf.iter_CUs() for row in self._rows_of(unit))
        return sorted(found, key=lambda row: (row.begin, row.end))

    def _rows_of(self, unit: Any) -> Iterator[LineRow]:
        program = self._dwarf.line_program_for_CU(unit)
        if program is None:
            return
        paths, first = _paths(unit, program), 0 if program["version"] >= 5 else 1
        before = None
        for state in _line_states(program):
            is_empty = before is not None and state.is_end and before.address == state.address
            if before is not None and not is_empty and FLASH_FROM <= before.address < FLASH_TO:
                path = paths[before.file - first] if 0 <= before.file - first < len(paths) else ""
                yield LineRow(before.address, state.address, path, before.line, before.is_statement)
            before = None if state.is_end else state

    def structure(self, name: str, address: int) -> Structure:
        """Return `struct name` of the file with a function's address; raises `LabError` if it has none."""
        return self._described("struct", name, address, AGGREGATES, "DW_AT_byte_size")

    def variable(self, name: str, address: int) -> Structure:
        """Return a variable's structure in the file of a function; raises `LabError` without such a variable."""
        return self._described("variable", name, address, ("DW_TAG_variable",), "DW_AT_type")

    def _described(self, what: str, name: str, address: int, tags: tuple[str, ...], has: str) -> Structure:
        unit = self._unit_at(address)
        for entry in unit.iter_DIEs() if unit is not None else ():
            if entry.tag in tags and has in entry.attributes and _name(entry) == name:
                kind = entry if entry.tag in AGGREGATES else _stripped(entry.get_DIE_from_attribute(has))
                return Structure(name, _size(kind), dict(_members(kind, "", 0)))
        raise LabError(f"{self._path}: {what} {name} is not described around 0x{address:08x}")

    @cached_property
    def _units(self) -> list[tuple[int, int, Any]]:
        """Return start, end and compilation unit of every piece of code."""
        if self._dwarf is None:
            return []
        lists = self._dwarf.range_lists()
        pieces = []
        for unit in self._dwarf.iter_CUs():
            for low, high in _ranges(unit, lists):
                if low:  # code dropped by the linker is at 0
                    pieces.append((low, high, unit))
        return sorted(pieces, key=itemgetter(0))

    @cached_property
    def _index(self) -> Any:
        """Return GCC's index, which saves reading every unit; other compilers omit it."""
        return None if self._dwarf is None else self._dwarf.get_aranges()

    def _unit_at(self, address: int) -> Any:
        offset = self._index.cu_offset_at_addr(address) if self._index is not None else None
        if offset is not None:
            return self._dwarf.get_CU_at(offset)
        index = bisect_right(self._units, address, key=itemgetter(0)) - 1
        return self._units[index][2] if index >= 0 and address < self._units[index][1] else None

    def _table(self, unit: Any) -> list[tuple[int, str]]:
        if unit.cu_offset not in self._lines:
            self._lines[unit.cu_offset] = self._line_table(unit)
        return self._lines[unit.cu_offset]

    def _line_table(self, unit: Any) -> list[tuple[int, str]]:
        program = self._dwarf.line_program_for_CU(unit)
        if program is None:
            return []
        first = 0 if program["version"] >= 5 else 1
        files = [Path(entry.name.decode(errors="replace")).name for entry in program["file_entry"]]
        table = []
        for state in _line_states(program):
            if not state.address:
                continue
            index = state.file - first
            known = not state.is_end and 0 <= index < len(files) and state.line
            table.append((state.address, f"{files[index]}:{state.line}" if known else ""))
        # At one address the last row counts, but a piece's beginning takes precedence over another's end.
        return sorted(table, key=lambda row: (row[0], bool(row[1])))


def _ranges(unit: Any, lists: Any) -> list[tuple[int, int]]:
    """Return begin and end of the code of a compilation unit."""
    top = unit.get_top_DIE()
    attributes = top.attributes
    low = attributes["DW_AT_low_pc"].value if "DW_AT_low_pc" in attributes else 0
    if "DW_AT_ranges" in attributes:
        ranges = lists.get_range_list_at_offset(attributes["DW_AT_ranges"].value, unit)
        found, base = [], low
        for entry in ranges:
            if hasattr(entry, "base_address"):
                base = entry.base_address
            else:
                begin = 0 if entry.is_absolute else base
                found.append((begin + entry.begin_offset, begin + entry.end_offset))
        return found
    if "DW_AT_high_pc" not in attributes:
        return []
    high = attributes["DW_AT_high_pc"]
    return [(low, high.value if high.form == "DW_FORM_addr" else low + high.value)]


class LineState(NamedTuple):
    """A row of a line program, as the debugging information has it."""

    address: int
    file: int
    line: int
    is_statement: bool
    is_end: bool  # of a piece of code


def _line_states(program: Any) -> Iterator[LineState]:
    """Yield the rows of a line program (DWARF 5, 6.2.5); pyelftools' own reader takes seven times as long."""
    program.stream.seek(program.program_start_offset)
    code: bytes = program.stream.read(program.program_end_offset - program.program_start_offset)
    header, step = program.header, program["minimum_instruction_length"]
    base, span, least = header["opcode_base"], header["line_range"], header["line_base"]
    lengths, default, at = header["standard_opcode_lengths"], bool(header["default_is_stmt"]), 0
    address, file, line, is_statement = 0, 1, 1, default

    def number(signed: bool = False) -> int:
        nonlocal at
        value, shift = 0, 0
        while True:
            byte = code[at]
            at, value, shift = at + 1, value | (byte & 0x7F) << shift, shift + 7
            if byte < 0x80:
                return value - (1 << shift) if signed and byte & 0x40 else value

    while at < len(code):
        opcode, at = code[at], at + 1
        if opcode >= base:
            address += step * ((opcode - base) // span)
            line += least + (opcode - base) % span
            yield LineState(address, file, line, is_statement, False)
        elif opcode == 0:
            end = number()
            end += at
            if code[at] == END_SEQUENCE:
                yield LineState(address, file, line, is_statement, True)
                address, file, line, is_statement = 0, 1, 1, default
            elif code[at] == SET_ADDRESS:
                address = int.from_bytes(code[at + 1 : end], "little")
            at = end
        elif opcode == COPY:
            yield LineState(address, file, line, is_statement, False)
        elif opcode == ADVANCE_PC:
            address += step * number()
        elif opcode == ADVANCE_LINE:
            line += number(signed=True)
        elif opcode == SET_FILE:
            file = number()
        elif opcode == NEGATE_STATEMENT:
            is_statement = not is_statement
        elif opcode == CONST_ADD_PC:
            address += step * ((255 - base) // span)
        elif opcode == FIXED_ADVANCE_PC:
            address, at = address + int.from_bytes(code[at : at + 2], "little"), at + 2
        else:
            for _ in range(lengths[opcode - 1]):
                number()


def _paths(unit: Any, program: Any) -> list[str]:
    """Return the path of each file of a line program."""
    attribute = unit.get_top_DIE().attributes.get("DW_AT_comp_dir")
    here = attribute.value if attribute else b""
    given = program["include_directory"]
    folders = list(given) if program["version"] >= 5 else [here, *given]
    joined = (
        join(here, folders[one.dir_index] if one.dir_index < len(folders) else b"", one.name)
        for one in program["file_entry"]
    )
    return [normpath(path.decode(errors="replace")) for path in joined]


def _name(entry: Any) -> str:
    attribute = entry.attributes.get("DW_AT_name")
    return attribute.value.decode(errors="replace") if attribute else ""


def _members(entry: Any, prefix: str, base: int) -> list[tuple[str, Member]]:
    """Return the members of a structure and of its inner structures, each with its full name."""
    found = []
    for child in entry.iter_children():
        if child.tag != "DW_TAG_member":
            continue
        location = child.attributes.get("DW_AT_data_member_location")
        offset = base + (location.value if location else 0)
        kind = _stripped(child.get_DIE_from_attribute("DW_AT_type"))
        name = prefix + _name(child)
        if _name(child):
            found.append((name, Member(offset, _size(kind))))
        if kind.tag in AGGREGATES:
            found += _members(kind, f"{name}." if _name(child) else prefix, offset)
    return found


def _stripped(kind: Any) -> Any:
    """Return a type without its typedefs and qualifiers."""
    while kind.tag in TRANSPARENT and "DW_AT_type" in kind.attributes:
        kind = kind.get_DIE_from_attribute("DW_AT_type")
    return kind


def _size(kind: Any) -> int:
    """Return the size of a type in bytes, 0 if unknown."""
    kind = _stripped(kind)
    if "DW_AT_byte_size" in kind.attributes:
        return int(kind.attributes["DW_AT_byte_size"].value)
    if kind.tag == "DW_TAG_pointer_type":
        return POINTER_SIZE
    if kind.tag != "DW_TAG_array_type":
        return 0
    count = 1
    for dimension in kind.iter_children():
        if "DW_AT_count" in dimension.attributes:
            count *= dimension.attributes["DW_AT_count"].value
        elif "DW_AT_upper_bound" in dimension.attributes:
            count *= dimension.attributes["DW_AT_upper_bound"].value + 1
    return count * _size(kind.get_DIE_from_attribute("DW_AT_type"))
