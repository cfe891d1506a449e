"""Thumb instructions as the image's readers see them, against capstone: jumps, IT blocks, and constants among the code."""

import re
from itertools import product
from struct import pack
from types import SimpleNamespace

import capstone
import numpy as np
import pytest

from hil.emulator.stm32f405 import coverage
from hil.emulator.stm32f405.literals import _of_narrow, _of_wide, literals

READER = capstone.Cs(capstone.CS_ARCH_ARM, capstone.CS_MODE_THUMB | capstone.CS_MODE_MCLASS)
CONDITIONS = ("eq", "ne", "hs", "lo", "mi", "pl", "vs", "vc", "hi", "ls", "ge", "lt", "gt", "le")
NOP = 0xBF00
LOADS = ("ldr", "ldrh", "ldrb", "ldrsh", "ldrsb", "vldr", "ldrd")
RNG = np.random.default_rng(3)
NARROW = (*range(0x4600, 0x4800), *range(0xB000, 0xE800))
WIDE = [
    (int(first), int(second)) for first, second in RNG.integers(0, 1 << 16, (120_000, 2)) if first >= 0xE800
]


def read(first: int, second: int = 0, at: int = 0) -> tuple[str, str]:
    """Return mnemonic and operands, or an empty text if the bytes are not an instruction."""
    one = next(READER.disasm(pack("<2H", first, second), at), None)
    return (one.mnemonic.removesuffix(".w"), one.op_str) if one is not None else ("", "")


@pytest.mark.long
def test_jumps_are_those_of_capstone() -> None:
    seen = set()
    for first, second in (*((first, 0) for first in NARROW), *WIDE):
        name, operands = read(first, second)
        if not name or name in ("bxns", "blxns"):  # of ARMv8-M
            continue
        conditional = name in ("cbz", "cbnz") or (name[0] == "b" and name[1:] in CONDITIONS)
        jumps = name in ("b", "bl", "bx", "blx") or (
            name in ("pop", "ldm", "ldmdb") and "pc" in operands.split("{")[1]
        )
        assert coverage._is_conditional(first, second) == conditional, (hex(first), hex(second), name)
        assert coverage._jumps(first, second) == jumps, (hex(first), hex(second), name, operands)
        seen |= {name} if conditional or jumps else set()
    assert len(seen) == 14 + 2 + 4 + 3


@pytest.mark.long
@pytest.mark.parametrize("mask", range(16))
@pytest.mark.parametrize("condition", [0, 7, 13, 14])
def test_the_last_instruction_of_an_it_block_may_jump(mask: int, condition: int) -> None:
    """The lowest 1 of the mask ends it (A7.7.38): a block has as many instructions as bits are left of and with it."""
    code = np.array([NOP, 0xBF00 | condition << 4 | mask, *4 * [0xE7FE], NOP], "<u2").tobytes()
    image = SimpleNamespace(
        code=code, base=0x100, functions=[SimpleNamespace(address=0x100)], constants=frozenset()
    )
    size = {0: 0, **{one: 4 - f"{one:04b}"[::-1].index("1") for one in range(1, 16)}}[mask]
    found = [] if condition == 14 or not mask else [(0x102 + 2 * size, 2)]
    assert list(coverage._branches(image)) == found  # type: ignore[arg-type]


def test_a_constant_ends_an_it_block() -> None:
    words = np.array([0xBF08, 0x1234, 0xE7FE, NOP], "<u2")  # IT EQ, a constant, B
    image = SimpleNamespace(
        code=words.tobytes(), base=0x100, functions=[SimpleNamespace(address=0x100)], constants={1}
    )
    assert list(coverage._branches(image)) == []  # type: ignore[arg-type]
    image.constants = {0}
    assert list(coverage._branches(image)) == []  # type: ignore[arg-type]


@pytest.mark.parametrize("index", [10, 11])
def test_constants_lie_where_capstone_has_them(index: int) -> None:
    """Relative to the word-aligned address four behind the instruction; a load of less than a word keeps its word."""
    words, kinds = [NOP] * 40, set()
    wide = (first | 0xF for first in range(0xE800, 0x1_0000, 0x10) for _ in range(24))
    for first in (*wide, *range(0x4800, 0x5000)):
        second = int(RNG.integers(0, 1 << 16))
        name, operands = read(first, second, 2 * index)
        loads = re.fullmatch(r"((?!d1[6-9]|d[23]).*), \[pc(?:, #(-?\w+))?\]", operands)  # 16 double registers
        words[index : index + 2] = first, second
        found = _of_narrow(first, index) if first < 0x8000 else _of_wide(words, index)
        expected = range(0)
        if name.split(".")[0] in LOADS and loads and not name.endswith(".16"):
            begin = ((2 * index + 4 & ~3) + int(loads[2] or "0", 0)) // 2
            expected = range(begin, begin + (4 if name == "ldrd" or operands.startswith("d") else 2))
            kinds.add(name + operands[0])
        left_out = re.match(r"d1[6-9]|d[23]", operands) or not name  # the chip has no d16 to d31
        if not left_out:
            assert found == expected, (hex(first), hex(second), name, operands)
    assert {"ldrr", "ldrhr", "ldrbr", "ldrshr", "ldrsbr", "vldrd", "vldrs", "ldrdr"} <= kinds


@pytest.mark.parametrize(("wide", "entries"), [(0, 1), (0, 4), (0, 5), (1, 1), (1, 5)])
def test_the_table_behind_a_table_branch_is_as_long_as_its_last_index(wide: int, entries: int) -> None:
    """TBB has bytes, TBH half words; CMP with the last index stands at most five half words before."""
    table = 0xE8DF, 0xF000 | wide << 4
    size = entries if wide else (entries + 1) // 2
    for between, before in product(range(6), range(2)):
        words = [*before * [NOP], 0x2800 | entries - 1, *between * [NOP], *table, *8 * [NOP]]
        begin = 3 + before + between
        expected = range(begin, begin + size) if between < 5 else range(0)
        assert literals(np.array(words, "<u2").tobytes()) == set(expected), between
