"""Debugging information and names: line programs as pyelftools reads them, and what an image's symbols stand for."""

import re
from copy import deepcopy
from io import BytesIO
from pathlib import Path
from typing import Any

import pytest
from elftools.dwarf.lineprogram import LineProgram
from elftools.elf.elffile import ELFFile
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("unicorn")
pytest.importorskip("ziglang")

from firmware_py.export.elf import Symbol
from hil.emulator.stm32f405.debug_info import DebugInfo, _line_states
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
