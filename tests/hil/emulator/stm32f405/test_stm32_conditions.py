"""Instructions that an IT block makes conditional (A7.7.38), on the emulated microcontroller."""

from struct import unpack

import pytest

from support.stm32_bench import FLASH, RAM, Bench

# cmp r0, #0; itt ne; ldrne r1, [r4]; strne r1, [r5]; cmp r0, r0; bx lr, which goes to: adds r7, #5
CODE = bytes.fromhex("0028 1cbf 2168 2960 8042 7047 0537")
LOAD, AFTER_BRANCH = FLASH + 0x0C, FLASH + 0x14
NOP = bytes.fromhex("00bf")
ACROSS_PAGES = bytes.fromhex("0028 08bf 0137 0537")  # cmp r0, #0; it eq; addeq r7, #1; adds r7, #5
PAGE = 1024  # of what unicorn maps at once
GPIO = 0x4002_0000
NULL = 0x10
NO_MEMORY = 0x3000_0000
WRITES, BOTH = 2, 4
THIRD_OF_NE = 0x1C00  # ITSTATE 0x1c of XPSR: NE, and one more instruction follows


def executed(load: int, store: int, watched: tuple[int, int] | None = None) -> Bench:
    """Execute CODE with pages of memory that were never used before."""
    bench = Bench(CODE)
    for name, value in (("r0", 1), ("r4", load), ("r5", store), ("r7", 0), ("lr", AFTER_BRANCH | 1)):
        bench.chip.set_register(name, value)
    if watched:
        bench.chip.watch(*watched, 4, True)
    bench.wait(10)
    return bench


@pytest.mark.parametrize(
    ("load", "store", "watched"),
    [
        (RAM + 0x2000, RAM + 0x4000, None),
        (GPIO, RAM + 0x4000, None),
        (RAM + 0x2000, GPIO, None),
        (RAM + 0x2000, NULL, None),
        (RAM, RAM + 0x40, (BOTH, RAM)),
        (RAM, RAM + 0x40, (WRITES, RAM + 0x40)),
    ],
    ids=[
        "two-pages", "peripheral-read", "peripheral-written", "null-pointer", "read-watched",
        "write-watched",
    ],
)  # fmt: skip
def test_an_it_block_leaves_no_condition(load: int, store: int, watched: tuple[int, int] | None) -> None:
    assert executed(load, store, watched).chip.register("r7") == 5


def test_a_block_across_two_pages_keeps_its_condition() -> None:
    bench = Bench(NOP * (PAGE // 2 - 6) + ACROSS_PAGES)  # the vectors take four, CMP and IT the last two
    bench.chip.set_register("r0", 1)
    bench.wait(10)
    assert bench.chip.register("r7") == 5


def test_a_load_that_faults_in_an_it_block_stacks_its_condition() -> None:
    chip = executed(NO_MEMORY, RAM).chip
    pc, xpsr = unpack("<2I", chip.read(chip.register("msp") + 24, 8))
    assert (pc, xpsr & 0x0600_FC00) == (LOAD, THIRD_OF_NE)
