"""An image is read as its linker laid it out, or refused in one line."""

import ctypes
import shutil
import subprocess
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from struct import pack, pack_into
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from elftools.elf.elffile import ELFFile
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.export.cycles import count
from firmware_py.export.elf import Elf, Symbol
from hil.emulator.stm32f405.image import Image
from hil.errors import LabError
from support import stm32_firmware
from support.stm32_firmware import SOURCES, flash_binary

COMPILERS = pytest.mark.parametrize("compiler", ["clang", "gcc"])
FIRMWARE = (SOURCES / "firmware.c").read_text(encoding="utf-8")


def refused(path: Path, elf: Path | None = None) -> str:
    with pytest.raises(LabError) as caught:
        Image(path, elf)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.fixture(scope="module")
def elf() -> Path:
    return stm32_firmware.build()


@pytest.fixture
def changed(tmp_path: Path, elf: Path):
    """A copy of the firmware with a number of a given format at a given offset."""

    def change(offset: int, layout: str, value: int) -> Path:
        content = bytearray(elf.read_bytes())
        pack_into(layout, content, offset, value)
        (tmp_path / "changed.elf").write_bytes(content)
        return tmp_path / "changed.elf"

    return change


@COMPILERS
def test_memory_given_away_is_that_of_the_sections(compiler: str) -> None:
    path = stm32_firmware.build(compiler)
    with path.open("rb") as file:
        sections = [(s["sh_addr"], s["sh_size"]) for s in ELFFile(file).iter_sections() if s["sh_flags"] & 2]
    flash, ram, ccm = Image(path).memory
    assert (flash.name, ram.name, ccm.name) == ("flash", "RAM", "CCM")
    assert flash.used == len(flash_binary(path))
    assert flash.size == 0x10_0000 - 0x4000
    assert ram.used == sum(size for address, size in sections if address >> 28 == 2) > 0
    assert ccm.used == sum(size for address, size in sections if address >> 28 == 1)
    assert (ram.free, ccm.size) == (0x2_0000 - ram.used, 0x1_0000)


@COMPILERS
def test_an_image_is_what_a_programmer_writes_into_flash(compiler: str) -> None:
    path = stm32_firmware.build(compiler)
    image = Image(path)
    binary = flash_binary(path)
    assert image.base == 0x0800_4000
    assert len(image.code) == len(binary) > 4000
    assert image.code.replace(b"\xff", b"\x00") == binary.replace(b"\xff", b"\x00")
    assert image.initial_stack_pointer == 0x2001_F000
    assert image.function_at(image.reset) == "Reset_Handler"


def test_flash_between_segments_is_erased(elf: Path, changed) -> None:
    at = 52 + 32 + 12  # where the second segment is loaded to
    behind = int.from_bytes(elf.read_bytes()[at : at + 4], "little")
    whole, code = Elf(elf).code, Elf(changed(at, "<I", behind + 64)).code
    gap = behind - Elf(elf).base
    assert code == whole[:gap] + b"\xff" * 64 + whole[gap:]


@pytest.mark.long
@COMPILERS
@pytest.mark.parametrize("function", ["Reset_Handler", "assertFail", "vTaskSwitchContext"])
def test_an_address_is_reported_as_function_and_line(compiler: str, function: str) -> None:
    image = Image(stm32_firmware.build(compiler))
    first = next(
        n for n, text in enumerate(FIRMWARE.splitlines(), 1) if f"void {function}(" in text and "{" in text
    )
    # An optimised function may begin with its second statement.
    places = [f"{function} (firmware.c:{line})" for line in range(first, first + 3)]
    assert image.place(image.symbol(function).address) in places


def test_lines_are_those_of_binutils() -> None:
    if shutil.which("arm-none-eabi-addr2line") is None:
        pytest.skip("arm-none-eabi-addr2line is not installed: nothing to compare lines with")
    path = stm32_firmware.build("gcc")
    image = Image(path)
    addresses = range(image.base + 0x188, image.base + len(image.code), 2)
    command = ["arm-none-eabi-addr2line", "-s", "-e", str(path), *map(hex, addresses)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    lines = [line.partition(" ")[0] for line in said]
    ours = [image.debug.line_at(address) for address in addresses]
    assert sum(line.startswith("firmware.c:") for line in lines) > 1000
    # Of constants behind the last instruction only binutils says a line.
    differ = [(a, b) for a, b in zip(ours, lines, strict=True) if a != b and "?" not in b]
    assert len(differ) < 8
    assert {a for a, _ in differ} <= {""}


@pytest.mark.long
@pytest.mark.parametrize("compiler", ["clang", "gcc"])
def test_a_line_has_its_first_address_also_in_units_of_many_pieces(compiler: str) -> None:
    """With a section for each function, lines of code are those that coverage counts, as gcov confirms."""
    debug = Image(stm32_firmware.build(compiler, ("-g", "-ffunction-sections"))).debug
    first: dict[str, int] = {}
    for row in debug.rows:
        if row.line:
            first.setdefault(f"{Path(row.path).name}:{row.line}", row.begin)
    assert len(first) > 400
    assert {place: debug.address_of(place) for place in first} == first
    assert debug.address_of("firmware.c:1") == debug.address_of("other.c:200") == 0
    pieces = sorted((low, high) for low, high, _ in debug._units if low < high)  # but for what was dropped
    assert len(pieces) > 50
    assert all(high <= low for (_, high), (low, _) in pairwise(pieces))
    assert {place.partition(":")[0] for place in (debug.line_at(low) for low, _ in pieces)} <= {
        "firmware.c", "exceptions.c", "measured.c",
    }  # fmt: skip


def test_an_address_between_functions_has_no_place() -> None:
    image = Image(stm32_firmware.build())
    assert image.place(0x0800_0100) == "0x08000100, outside every function"
    assert image.place(0x2000_0000) == "0x20000000, outside every function"


class Item(ctypes.LittleEndianStructure):
    _fields_ = tuple(
        (name, ctypes.c_uint32) for name in ("pxNext", "pxPrevious", "pvOwner", "pxContainer", "xItemValue")
    )


class Task(ctypes.LittleEndianStructure):
    _fields_ = (
        ("pxTopOfStack", ctypes.c_uint32), ("pcTaskName", ctypes.c_char * 8), ("pxStack", ctypes.c_uint32),
        ("uxPriority", ctypes.c_uint32), ("uxBasePriority", ctypes.c_uint32), ("xEventListItem", Item),
        ("xStateListItem", Item), ("ucNotifyState", ctypes.c_uint8 * 1),
    )  # fmt: skip


@COMPILERS
def test_members_lie_where_the_c_compiler_puts_them(compiler: str) -> None:
    image = Image(stm32_firmware.build(compiler))
    task = image.debug.structure("tskTaskControlBlock", image.symbol("vTaskSwitchContext").address)
    assert task.size == ctypes.sizeof(Task)
    for name, *_ in Task._fields_:
        field = getattr(Task, name)
        assert (task[name].offset, task[name].size) == (field.offset, field.size), name
    for name, *_ in Item._fields_:
        assert (
            task[f"xStateListItem.{name}"].offset == Task.xStateListItem.offset + getattr(Item, name).offset
        )
    # Members of an anonymous union belong to the structure around it.
    assert image.debug.structure("SNAPSHOT_DATA", image.reset)["file.line"].offset == 12


def test_symbols_are_those_of_the_file_and_marks_of_code_and_data_are_no_variables(elf: Path) -> None:
    with elf.open("rb") as file:
        symbols = list(ELFFile(file).get_section_by_name(".symtab").iter_symbols())
    expected = []
    for one in symbols:
        kind, place = one["st_info"]["type"], one["st_value"]
        is_variable = kind == "STT_OBJECT" or (kind == "STT_NOTYPE" and one.name[:1] != "$")
        place &= ~1 if kind == "STT_FUNC" else ~0
        expected.append(Symbol(one.name, place, one["st_size"], kind == "STT_FUNC", is_variable))
    assert {symbol.name for symbol in expected} >= {"$t", "$d"}
    assert Elf(elf).symbols == expected


def test_an_unknown_name_is_refused_with_the_nearest(elf: Path) -> None:
    image = Image(elf)
    with pytest.raises(
        LabError, match="no variable or function is called xTickCont; did you mean xTickCount"
    ):
        image.symbol("xTickCont")
    with pytest.raises(LabError, match="struct xNOTHING is not described"):
        image.debug.structure("xNOTHING", image.reset)
    with pytest.raises(LabError, match="has no member uxPriorty; did you mean uxPriority"):
        image.debug.structure("tskTaskControlBlock", image.reset)["uxPriorty"]
    assert image.has("xTickCount")
    assert not image.has("xTickCont")


def test_a_bin_has_the_names_of_its_elf(elf: Path, tmp_path: Path) -> None:
    binary = tmp_path / "cf2.bin"
    binary.write_bytes(flash_binary(elf))
    image = Image(binary, elf)
    assert (image.base, image.reset) == (0x0800_4000, Image(elf).reset)
    assert image.code == binary.read_bytes()
    assert image.has("xTickCount")


def test_a_bin_of_another_build_is_refused_at_the_first_byte_that_differs(elf: Path, tmp_path: Path) -> None:
    binary = tmp_path / "cf2.bin"
    content = bytearray(flash_binary(elf))
    binary.write_bytes(content[:-4])
    assert "ends at" in refused(binary, elf)
    content[0x200] ^= 1
    binary.write_bytes(content)
    assert "differs at 0x08004200" in refused(binary, elf)


def test_a_file_of_another_kind_is_refused(elf: Path, tmp_path: Path) -> None:
    text = tmp_path / "cf2.bin"
    text.write_bytes(b"no firmware at all" * 40)
    assert "no vector table at 0x08004000: the stack pointer there" in refused(text)
    assert f"{text}: not an ELF file" in refused(elf.with_name("firmware.c"), text)
    assert "goes with a .bin" in refused(elf, elf)
    assert "No such file" in refused(tmp_path / "missing.elf")


def test_another_machine_is_refused_by_its_name(changed) -> None:
    assert "built for RISC-V" in refused(changed(18, "<H", 243))
    assert "built for machine 9999" in refused(changed(18, "<H", 9999))
    assert "built for big-endian" in refused(changed(5, "<B", 2))
    assert "64-bit ELF file (x86-64)" in refused(Path(shutil.which("true") or "/bin/true"))
    assert "not linked" in refused(changed(44, "<H", 0))


@COMPILERS
def test_a_bin_without_an_elf_has_the_places_and_constants_of_its_elf(compiler: str, tmp_path: Path) -> None:
    elf = Image(stm32_firmware.build(compiler))
    binary = tmp_path / "cf2.bin"
    binary.write_bytes(elf.code)
    image = Image(binary)
    assert (image.base, image.reset, image.code, image.named) == (elf.base, elf.reset, elf.code, False)
    assert image.place(image.reset) == f"0x{image.reset:08x}"
    right, found = (count(elf.code, constants).cycles for constants in (elf.constants, image.constants))
    spans = [(f.address - elf.base, f.size) for f in Elf(elf.path).symbols if f.is_function and f.size]
    same = [
        np.array_equal(*(np.diff(one[at // 2 : (at + size) // 2 + 1]) for one in (right, found)))
        for at, size in spans
    ]
    assert np.mean(same) > 0.9


ROOM = (1 << 20) - 0x4000  # behind the bootloader


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "its flash holds 0 bytes, no vector table"),
        (b"\xff" * 4096, "no vector table at 0x08004000: the stack pointer there, 0xfffffffc"),
        (b"\x00\x00\x02\x20\x01\x50\x00\x08", "the reset vector there, 0x08005001, is not Thumb code"),
        (b"\x00\x00\x02\x20\x09\x40\x00\x08" + bytes(1 << 20), "do not fit into the 1048576 bytes of flash"),
        (
            b"\xff" * (ROOM + 4),
            f"{ROOM + 4} bytes from 0x08004000 on do not fit into the 1048576 bytes of flash",
        ),
        (b"\xff" * ROOM, "no vector table at 0x08004000: the stack pointer there"),  # fits
        (
            b"\x00\x00\x02\x20\x09\x40\x00\x08" + 30 * b"\x01\x50\x00\x08",
            "truncated: 128 bytes from 0x08004000 on",
        ),
    ],
)
def test_a_bin_that_cannot_start_is_refused(content: bytes, expected: str, tmp_path: Path) -> None:
    (tmp_path / "cf2.bin").write_bytes(content)
    assert expected in refused(tmp_path / "cf2.bin")


@pytest.mark.parametrize(
    ("inside", "behind", "whole"),
    [(0, 24, True), (0, 25, False), (2500, 30, True), (2500, 31, False)],
)
@pytest.mark.parametrize(("at", "beyond"), [(0, 0x080F_FFFF), (None, None)])
def test_a_bin_leads_behind_its_end_at_most_as_often_as_whole_ones(
    inside: int, behind: int, whole: bool, at: int | None, beyond: int | None, tmp_path: Path
) -> None:
    """An address of its first byte or just behind its last is inside; one outside of the flash is none."""
    base, size = 0x0800_4000, 4 * (2 + max(inside, 1) + behind + 3)
    within = [base if at == 0 else base + size] * max(inside - 1, 0)
    after = [beyond or base + size + 1] * behind
    words = [0x2002_0000, base + 9, *within, *after, base - 1, 0x0810_0000, 0x0810_0001]
    words += [0] * (size // 4 - len(words))
    (tmp_path / "cf2.bin").write_bytes(np.array(words, "<u4").tobytes())
    if whole:
        (flash,) = Image(tmp_path / "cf2.bin").memory
        assert (flash.name, flash.used, flash.size) == ("flash", size, 0x0810_0000 - base)
    else:
        assert f"truncated: {size} bytes from 0x08004000 on, and {behind} addresses" in refused(
            tmp_path / "cf2.bin"
        )


@pytest.mark.parametrize("fraction", [0.0001, 0.001, 0.3, 0.9, 0.9999])
def test_a_truncated_file_is_refused(elf: Path, tmp_path: Path, fraction: float) -> None:
    short = tmp_path / "short.elf"
    content = elf.read_bytes()
    short.write_bytes(content[: max(4, int(fraction * len(content)))])
    assert "truncated: " in refused(short)


def test_a_stripped_file_is_refused_with_what_is_lost() -> None:
    assert "stripped, it has no symbols" in refused(stm32_firmware.build("clang", ("-g", "-Wl,-s")))
    assert "stripped of debugging information (DWARF): without it the task list" in refused(
        stm32_firmware.build("clang", ("-g0",))
    )


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ("0x00000000", "outside the flash"),
        ("0x080FF000", "flash has 1048576 bytes"),
        ("0x20008000", "no vector table: nothing is loaded into flash"),
    ],
)
def test_an_image_for_another_place_than_flash_is_refused(origin: str, expected: str) -> None:
    path = stm32_firmware.build(script=("ORIGIN = 0x08004000", f"ORIGIN = {origin}"))
    assert expected in refused(path)


def test_a_vector_table_that_no_cortex_m_could_start_from_is_refused(elf: Path, changed) -> None:
    vectors = int.from_bytes(elf.read_bytes()[56:60], "little")  # offset of the first segment
    assert "the stack pointer there, 0x60000000, is outside the RAM" in refused(
        changed(vectors, "<I", 0x6000_0000)
    )
    assert "the reset vector there, 0x08004200, is not Thumb code" in refused(
        changed(vectors + 4, "<I", 0x0800_4200)
    )
    assert "the reset vector there, 0x08090001" in refused(changed(vectors + 4, "<I", 0x0809_0001))


@pytest.mark.long
@settings(max_examples=60)
@given(damage=st.lists(st.tuples(st.integers(-700, 179), st.integers(0, 255)), min_size=1, max_size=4))
def test_a_file_with_damaged_headers_is_read_or_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, damage: list[tuple[int, int]]
) -> None:
    content = bytearray(stm32_firmware.build().read_bytes())
    for place, byte in damage:
        content[place + 4 if place >= 0 else place] = byte
    damaged = tmp_path_factory.getbasetemp() / "damaged.elf"
    damaged.write_bytes(content)
    with suppress(LabError):
        Image(damaged)


UNREAD: Any = None


def test_only_the_address_of_a_function_loses_its_lowest_bit_and_marks_are_no_variables() -> None:
    names, entries = b"\0", []
    for name, kind, address in (
        ("code", 2, 0x801), ("byte", 1, 0x803), ("label", 0, 0x805), ("$d", 0, 0x807), ("section", 3, 0x809),
    ):  # fmt: skip
        entries.append(pack("<IIIBBH", len(names), address, 4, 0x10 | kind, 0, 1))
        names += name.encode() + b"\0"
    file = {".symtab": Table(b"".join(entries)), 7: Table(names)}
    made = SimpleNamespace(get_section_by_name=file.get, get_section=file.get)
    found = [(one.name, one.address, one.is_function, one.is_variable) for one in Elf._symbols(UNREAD, made)]
    assert found == [
        ("code", 0x800, True, False), ("byte", 0x803, False, True), ("label", 0x805, False, True),
        ("$d", 0x807, False, False), ("section", 0x809, False, False),
    ]  # fmt: skip


class Table:
    """A section of an ELF file."""

    def __init__(self, content: bytes) -> None:
        self.content = content

    def data(self) -> bytes:
        return self.content

    def __getitem__(self, key: str) -> int:
        return {"sh_link": 7}[key]


def test_the_half_words_between_two_marks_are_constants_with_one_that_is_begun() -> None:
    for end, expected in ((0x8000107, {0, 1, 2, 3}), (0x8000108, {0, 1, 2, 3}), (0x8000106, {0, 1, 2})):
        marks = [Symbol(name, at, 0, False, False) for name, at in (("$d", 0x8000100), ("$t.1", end))]
        read: Any = SimpleNamespace(symbols=[*marks, Symbol("$d", 0x8000200, 0, False, False)])
        assert Elf.constants(read, 0x8000100, 0x100) == expected
