"""Debugging information and names: line programs as pyelftools reads them, and what an image's symbols stand for."""

import re
from copy import deepcopy
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import pytest
from elftools.dwarf.lineprogram import LineProgram
from elftools.dwarf.ranges import BaseAddressEntry, RangeEntry
from elftools.elf.elffile import ELFFile
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("unicorn")
pytest.importorskip("ziglang")

from firmware_py.export.elf import Symbol
from hil.emulator.stm32f405.debug_info import DebugInfo, _line_states, _ranges, _size
from hil.emulator.stm32f405.image import Image, has_symbols
from hil.errors import LabError
from support.stm32_firmware import build, flash_binary


def uleb(value: int) -> bytes:
    return bytes((value & 0x7F,)) if value < 0x80 else bytes((value & 0x7F | 0x80,)) + uleb(value >> 7)


def sleb(value: int) -> bytes:
    byte, rest = value & 0x7F, value >> 7
    return (
        bytes((byte,))
        if rest in (0, -1) and (rest < 0) == bool(byte & 0x40)
        else bytes((byte | 0x80,)) + sleb(rest)
    )


NUMBER = st.integers(0, 2**20).map(uleb)
OPERATIONS = st.one_of(
    st.integers(13, 255).map(lambda special: bytes((special,))),
    st.sampled_from([1, 6, 7, 8, 10, 11]).map(lambda plain: bytes((plain,))),
    st.tuples(st.sampled_from([2, 4, 5, 12]), NUMBER).map(lambda one: bytes((one[0],)) + one[1]),
    st.integers(-5000, 5000).map(lambda lines: b"\3" + sleb(lines)),
    st.integers(0, 2**16 - 1).map(lambda by: b"\x09" + by.to_bytes(2, "little")),
    st.integers(0, 2**32 - 1).map(lambda address: b"\0\5\2" + address.to_bytes(4, "little")),
    st.just(b"\0\1\1"),
    st.just(b"\0\2\4\7"),  # a discriminator
)


@pytest.fixture(scope="module")
def program() -> Any:
    """A line program of the tests' firmware, for its header."""
    dwarf = ELFFile(BytesIO(build().read_bytes())).get_dwarf_info()
    return dwarf.line_program_for_CU(next(dwarf.iter_CUs()))


@pytest.mark.long
@settings(max_examples=100)
@given(st.lists(OPERATIONS, max_size=30), st.sampled_from([1, 2]), st.booleans())
def test_a_line_program_has_the_rows_that_pyelftools_reads(
    program: Any, operations: list[bytes], step: int, default: bool
) -> None:
    header = deepcopy(program.header)
    header["minimum_instruction_length"], header["default_is_stmt"] = step, int(default)
    code = b"".join(operations)
    made = LineProgram(header, BytesIO(b"before" + code + b"behind"), program.structs, 6, 6 + len(code))
    expected = [
        (state.address, state.file, state.line, state.end_sequence or bool(state.is_stmt), state.end_sequence)
        for state in (entry.state for entry in made.get_entries())
        if state is not None
    ]
    rows = [
        (row.address, row.file, row.line, row.is_end or row.is_statement, row.is_end)
        for row in _line_states(made)
    ]
    assert rows == expected


def set_address(address: int) -> bytes:
    return b"\0\5\2" + address.to_bytes(4, "little")


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize("version", [4, 5])
def test_an_address_has_the_line_of_the_piece_that_begins_there_and_none_behind_it(
    program: Any, order: tuple[int, int], version: int
) -> None:
    """Two pieces of code, in any order, one behind the other; what the linker dropped is at 0."""
    pieces = [
        set_address(at) + b"\3" + sleb(line) + b"\1" + b"\3\1\1" + set_address(at + 16) + b"\0\1\1"
        for at, line in ((0x0800_4000, 9), (0x0800_4010, 19))
    ]
    code = set_address(0) + b"\1\0\1\1" + b"".join(pieces[number] for number in order)
    header = deepcopy(program.header)
    header["version"] = version
    made = LineProgram(header, BytesIO(code), program.structs, 0, len(code))
    debug = DebugInfo(Made(line_program_for_CU=lambda unit: made, get_aranges=lambda: None), Path("x"))
    files = [Path(entry.name.decode()).name for entry in header["file_entry"]]
    name = files[1 if version >= 5 else 0]
    top = Made(attributes={"DW_AT_name": Made(value=f"some/folder/{name}".encode())})
    debug.__dict__["_units"] = [
        (0x0800_4000, 0x0800_4100, Made(cu_offset=0, get_top_DIE=lambda: top)),
        (0x0800_5000, 0x0800_5100, Made(cu_offset=9, get_top_DIE=lambda: Made(attributes={}))),
    ]
    places = [debug.line_at(at) for at in (0x0800_4000, 0x0800_400F, 0x0800_4010, 0x0800_401F, 0x0800_4020)]
    assert places == [f"{name}:11", f"{name}:11", f"{name}:21", f"{name}:21", ""]
    found = [debug.address_of(line) for line in (f"{name}:11", f"{name}:21", f"{name}:12", "other.c:11")]
    assert found == [0x0800_4000, 0x0800_4010, 0, 0]


def attributes(**values: Any) -> dict[str, Any]:
    """Return attributes of an entry; a pair is a value and its form."""
    pairs = {name: one if isinstance(one, tuple) else (one, "DW_FORM_data4") for name, one in values.items()}
    return {f"DW_AT_{name}": Made(value=value, form=form) for name, (value, form) in pairs.items()}


def test_the_code_of_a_unit_is_in_one_piece_or_in_many_relative_to_a_base_or_not() -> None:
    def ranges(entries: list[Any] = [], **values: Any) -> list[tuple[int, int]]:  # noqa: B006
        unit = Made(get_top_DIE=lambda: Made(attributes=attributes(**values)))
        return _ranges(
            unit, Made(get_range_list_at_offset=lambda offset, unit: entries if offset == 7 else [])
        )

    assert ranges() == ranges(low_pc=0x100) == []
    assert (
        ranges(low_pc=0x100, high_pc=0x20)
        == ranges(low_pc=0x100, high_pc=(0x120, "DW_FORM_addr"))
        == [(0x100, 0x120)]
    )
    pieces = [RangeEntry(0, 8, 1, 2, False), RangeEntry(8, 8, 0x11, 0x12, True), BaseAddressEntry(16, 0x200),
              RangeEntry(24, 8, 1, 2, False), RangeEntry(32, 8, 0x21, 0x22, True)]  # fmt: skip
    found = [(0x101, 0x102), (0x11, 0x12), (0x201, 0x202), (0x21, 0x22)]
    assert ranges(pieces, low_pc=0x100, ranges=7) == found
    assert ranges(pieces[:2], ranges=7) == [(1, 2), (0x11, 0x12)]


def test_an_array_has_the_size_of_all_its_dimensions_however_they_are_counted() -> None:
    def kind(tag: str, of: Any = None, dimensions: list[dict[str, int]] = [], **values: int) -> Any:  # noqa: B006
        children = [Made(attributes=attributes(**one)) for one in dimensions]
        own = attributes(**values) | (attributes(type=0) if of else {})
        return Made(tag=f"DW_TAG_{tag}", attributes=own, iter_children=lambda: children,
                    get_DIE_from_attribute=lambda name: of)  # fmt: skip

    word = kind("typedef", kind("volatile_type", kind("const_type", kind("base_type", byte_size=4))))
    array = kind("array_type", word, [{"upper_bound": 1}, {"count": 3}, {"upper_bound": 4}, {"count": 7}, {}])
    pointer = kind("pointer_type", word)
    assert (_size(word), _size(array), _size(pointer)) == (4, 4 * 2 * 3 * 5 * 7, 4)
    assert _size(kind("array_type", pointer, [{"count": 2}, {"count": 5}])) == 40
    assert _size(kind("typedef")) == _size(kind("subroutine_type")) == 0


def test_a_name_stands_for_exactly_one_thing_and_a_pointer_names_what_it_points_to(tmp_path: Path) -> None:
    image = Image(build())
    twice = [Symbol("twice", 0x2001_0000 + at, 4, False, True) for at in (0, 8)]
    image._variables |= {"twice": twice, "pointer": [Symbol("pointer", 0x2001_0010, 4, False, True)],
                         "object": [Symbol("object", 0x2001_0020, 16, False, True)],
                         "wide": [Symbol("wide", 0x2001_0030, 8, False, True)],
                         "constant": [Symbol("constant", 0x0800_5000, 4, False, True)]}  # fmt: skip
    with pytest.raises(LabError, match=r"2 variables or functions are called twice$"):
        image.symbol("twice")
    assert (image.has("twice"), image.has("pointer")) == (False, True)
    memory = {0x2001_0010: 0x2001_0024, 0x2001_0030: 0x2001_0028, 0x0800_5000: 0x2001_002C}

    def read(address: int) -> int:
        return memory.get(address, 0)

    assert image.name_of(0x2001_0024, read) == "pointer"
    assert image.name_of(0x2001_0028, read) == image.name_of(0x2001_002C, read) == "object"
    assert image.name_of(0x2001_0040, read) == "0x20010040"
    place = image.place(image.symbol("go_wrong").address)
    assert re.fullmatch(r"go_wrong \(firmware\.c:\d+\)", place)
    image.debug = DebugInfo(None, image.path)
    assert image.place(image.symbol("go_wrong").address) == "go_wrong", "without lines"
    (tmp_path / "plain.bin").write_bytes(flash_binary(build()))
    assert (has_symbols(build()), has_symbols(tmp_path / "plain.bin")) == (True, False)
    with pytest.raises(LabError, match=r"gone\.elf: No such file"):
        has_symbols(tmp_path / "gone.elf")
