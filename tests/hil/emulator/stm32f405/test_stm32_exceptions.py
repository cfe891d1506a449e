"""Exceptions of the emulated microcontroller, register by register, as ARM's ARMv7-M Architecture Reference Manual has them.

Each experiment is code of tests/firmware_stm32/exceptions.c. The expected values are the manual's (B1.5); those of frames,
masking and order were also what `qemu-system-arm -M netduinoplus2` (QEMU 7.2) recorded.
"""

import pytest

from support.stm32_machine import FirmwareOnChip

FRAMES, MASKING, ORDER, SYSTICK, SLEEP, IT_BLOCKS, CODE_IN_RAM = range(1, 8)
SVC = 11
FPCA = 4
PADDED, ALL_FLAGS, THUMB = 1 << 9, 0xF800_0000, 1 << 24
FILLED = [*(0x1100 + n for n in range(13)), 0x110E]  # r0 to r12, lr
STACKED = [0x1100, 0x1101, 0x1102, 0x1103, 0x110C, 0x110E]
FP_FILLED = [0x2200 + n for n in range(32)]
FPSCR = 0x03C0_0000
RUN_US = 200_000

COMPILERS = pytest.mark.parametrize("compiler", ["clang", pytest.param("gcc", marks=pytest.mark.long)])


def recorded(scenario: int, compiler: str) -> tuple[list[int], FirmwareOnChip]:
    machine = FirmwareOnChip(compiler, scenario=scenario)
    while machine.chip.now_us < RUN_US and not machine.peek("finished"):
        machine.run(machine.chip.now_us + 2_000)
    assert machine.peek("finished") == 1, machine.image.place(machine.chip.register("pc"))
    return machine.peek_all("record", machine.peek("recorded")), machine


class Records:
    """Takes what was noted from the front."""

    def __init__(self, words: list[int]) -> None:
        self.words = words

    def take(self, count: int) -> list[int]:
        taken, self.words = self.words[:count], self.words[count:]
        return taken

    def registers(self) -> tuple[list[int], int, int, int]:
        """What FRAME_EXPERIMENT keeps: r0 to r12 and lr, the flags, the stack pointer afterwards and before."""
        kept = self.take(19)
        return kept[:14], kept[14], kept[15], kept[18]


@COMPILERS
def test_an_exception_stacks_eight_words_and_restores_every_register(compiler: str) -> None:
    records = Records(recorded(FRAMES, compiler)[0])
    for padded in (False, True):
        exc_return, number, control, msp, _ = records.take(5)
        frame = records.take(8)
        registers, flags, after, before = records.registers()
        assert exc_return == 0xFFFF_FFF9  # to thread mode, main stack, no floats
        assert (number, control & 7) == (SVC, 0)
        assert frame[:6] == STACKED
        assert frame[7] == ALL_FLAGS | THUMB | (PADDED if padded else 0)
        assert (before % 8 == 4) == padded
        assert msp == before - 0x20 - (4 if padded else 0)
        assert (registers, flags, after) == (FILLED, ALL_FLAGS, before)


@COMPILERS
def test_a_task_s_exception_is_stacked_on_its_own_stack(compiler: str) -> None:
    words, machine = recorded(FRAMES, compiler)
    records = Records(words[2 * (5 + 8 + 19) :])
    exc_return, number, control, msp, psp = records.take(5)
    frame = records.take(8)
    (after,) = records.take(1)
    top = machine.image.symbol("process_stack").address + machine.image.symbol("process_stack").size
    assert (exc_return, number, control & 7) == (0xFFFF_FFFD, SVC, 0)
    assert (psp, after) == (top - 0x20, top)
    assert msp > psp
    assert frame[3] == 0x3300


@COMPILERS
def test_an_exception_with_floats_stacks_twenty_six_words_and_restores_all_floats(compiler: str) -> None:
    words, _ = recorded(FRAMES, compiler)
    records = Records(words[2 * (5 + 8 + 19) + 5 + 8 + 1 :])
    exc_return, number, control, msp, _ = records.take(5)
    frame = records.take(26)
    registers, flags, after, before = records.registers()
    assert exc_return == 0xFFFF_FFE9  # to thread mode, main stack, floats
    assert (number, control & FPCA) == (SVC, 0)
    assert frame[:6] == STACKED
    assert frame[8:24] == FP_FILLED[:16]
    assert frame[24] == FPSCR
    assert msp == before - 0x68
    assert (registers, flags, after) == (FILLED, ALL_FLAGS, before)
    assert records.take(32) == FP_FILLED
    assert records.words == []


@COMPILERS
def test_a_masked_interrupt_is_taken_exactly_at_unmasking(compiler: str) -> None:
    (count, place, count_again, place_again, here, there), _ = recorded(MASKING, compiler)
    # BASEPRI 0x50, BASEPRI_MAX 0x70 and BASEPRI 0x60 hold an interrupt of priority 0x60 back, BASEPRI 0x70 does not;
    # PRIMASK does. Three instructions counted before each.
    assert (count, place) == (3, here)
    assert (count_again, place_again) == (6, there)


@COMPILERS
def test_the_most_urgent_comes_first_then_the_lowest_number_on_one_frame(compiler: str) -> None:
    words, _ = recorded(ORDER, compiler)
    frames = [words[i : i + 3] for i in (0, 3, 6)]
    assert [number for number, _, _ in frames] == [1, 0, 3]
    assert {msp for _, msp, _ in frames} == {frames[0][1]}  # tail-chained: nothing is unstacked in between
    assert {exc_return for _, _, exc_return in frames} == {0xFFFF_FFF9}
    assert words[9] == 200


@COMPILERS
def test_only_the_more_urgent_interrupts_a_handler(compiler: str) -> None:
    words, _ = recorded(ORDER, compiler)
    outer, nested, resumed, equal, done = words[10:13], words[13:16], words[16], words[17:20], words[20]
    assert (outer[0], outer[2]) == (0, 0xFFFF_FFF9)
    assert (nested[0], nested[2]) == (1, 0xFFFF_FFF1)  # back to a handler
    assert outer[1] - nested[1] in (0x20, 0x24, 0x28, 0x30, 0x38)  # a frame, and what the handler had pushed
    assert resumed == 100
    assert (equal[0], equal[1], equal[2]) == (3, outer[1], 0xFFFF_FFF9)
    assert done == 300


@COMPILERS
def test_systick_counts_down_and_wraps_with_its_period(compiler: str) -> None:
    (cleared, wraps, highest, silent, ticks), _ = recorded(SYSTICK, compiler)
    assert cleared == 0  # a write of whatever value clears it
    assert 99 <= wraps <= 101  # of 0.1 ms in 10 ms; reading COUNTFLAG clears it
    assert 16_000 < highest <= 16_799
    assert silent == 0
    assert 99 <= ticks <= 101


@COMPILERS
def test_wfi_sleeps_until_an_interrupt_even_a_masked_one(compiler: str) -> None:
    (woken_us, masked, taken, again_us, twice), _ = recorded(SLEEP, compiler)
    assert 999 <= woken_us <= 1001
    assert (masked, taken) == (0, 1)
    assert 1999 <= again_us <= 2002
    assert twice == 2


@COMPILERS
def test_it_blocks_survive_interrupts(compiler: str) -> None:
    (first, second, third, fourth, ticks, _), _ = recorded(IT_BLOCKS, compiler)
    assert (first, second, third, fourth) == (40_000, 0, 40_000, 0)
    assert ticks > 100


@COMPILERS
def test_code_in_ram_is_executed_as_it_was_written_last(compiler: str) -> None:
    returned, _ = recorded(CODE_IN_RAM, compiler)
    assert returned == [n for n in range(6) for _ in range(2)]
