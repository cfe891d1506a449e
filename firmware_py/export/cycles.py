"""Where the instructions of a Thumb-2 image begin, and how many cycles each takes on a Cortex-M4F.

Cycles are those of ARM's Cortex-M4 Technical Reference Manual (DDI 0439), instruction set summary and FPU instruction set,
with the upper figure where it gives a range, plus one where a sum, product or quotient of floats goes into the next one. The
refill after a jump and the flash's wait states depend on the path through the code: the emulated chip adds them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DIVIDE = 12  # SDIV, UDIV: 2 to 12
FLOAT_DIVIDE = 14  # VDIV, VSQRT
FLOAT_MULTIPLY_ADD = 3  # VMLA, VMLS, VFMA and their negations


@dataclass(frozen=True, slots=True)
class Cycles:
    """Prefix sums over an image: entry i counts what begins before half word i."""

    instructions: NDArray[np.uint32]
    cycles: NDArray[np.uint32]


def count(code: bytes, constants: frozenset[int] = frozenset()) -> Cycles:
    """Return the prefix sums of an image of half words; `constants` are the half words that are not code."""
    words = np.frombuffer(code, "<u2").tolist()
    instructions = np.zeros(len(words) + 1, np.uint32)
    cycles = np.zeros(len(words) + 1, np.uint32)
    index, written = 0, -1
    while index < len(words):
        if index in constants:
            index, written = index + 1, -1
            continue
        wide = is_wide(words[index]) and index + 1 < len(words)
        instructions[index + 1] = 1
        if wide:
            first, second = words[index], words[index + 1]
            cycles[index + 1] = _wide_cycles(first, second) + (written in _read_registers(first, second))
            written = _written_register(first, second)
        else:
            cycles[index + 1] = _narrow_cycles(words[index])
            written = -1
        index += 2 if wide else 1
    return Cycles(np.cumsum(instructions, dtype=np.uint32), np.cumsum(cycles, dtype=np.uint32))


def is_wide(half_word: int) -> bool:
    """Return whether an instruction that begins with this half word has a second one."""
    return half_word >> 11 in (0b11101, 0b11110, 0b11111)


def _narrow_cycles(code: int) -> int:
    if 0x4800 <= code < 0xA000:  # LDR, STR in all sizes
        return 2
    if code & 0xF600 == 0xB400:  # PUSH, POP
        return 1 + (code & 0x1FF).bit_count()
    if 0xC000 <= code < 0xD000:  # STMIA, LDMIA
        return 1 + (code & 0xFF).bit_count()
    return 1


def _wide_cycles(first: int, second: int) -> int:
    if _is_float(second) and first & 0xEE00 == 0xEC00:
        if first & 0xFFE0 == 0xEC40:  # VMOV of two core registers
            return 2
        single = first & 0x0120 == 0x0100  # VLDR, VSTR; otherwise VLDM, VSTM, VPUSH, VPOP
        words = 1 + (second >> 8 & 1) if single else second & 0xFF
        return 1 + words
    if _is_float_arithmetic(first, second):
        operation = first >> 4 & 0b1011
        if operation == 0b1000 or (operation == 0b1011 and first & 0xF == 1 and second & 0xC0 == 0xC0):
            return FLOAT_DIVIDE
        return FLOAT_MULTIPLY_ADD if operation in (0b0000, 0b0001, 0b1001, 0b1010) else 1
    if first & 0xFE40 == 0xE800:  # LDM, STM, PUSH, POP
        return 1 + second.bit_count()
    if first & 0xFE40 == 0xE840:  # LDRD, STRD, TBB, TBH
        return 3
    if first & 0xFE00 == 0xF800:  # LDR, STR in all sizes
        return 2
    if first & 0xFFD0 == 0xFB90:
        return DIVIDE
    return 1


def _is_float(second: int) -> bool:
    return second & 0x0E00 == 0x0A00  # coprocessors 10 and 11


def _is_float_arithmetic(first: int, second: int) -> bool:
    return first & 0xFF00 == 0xEE00 and _is_float(second) and second & 0x0010 == 0


def _is_three_operand(first: int, second: int) -> bool:
    return _is_float_arithmetic(first, second) and first & 0xB0 != 0xB0


def _written_register(first: int, second: int) -> int:
    """Return the single register that a sum, product or quotient is written to, -1 for others."""
    return (second >> 12) << 1 | first >> 6 & 1 if _is_three_operand(first, second) else -1


def _read_registers(first: int, second: int) -> tuple[int, ...]:
    """Return the single registers that a sum, product or quotient is made of, none for others."""
    if not _is_three_operand(first, second):
        return ()
    return ((first & 0xF) << 1 | second >> 7 & 1, (second & 0xF) << 1 | second >> 5 & 1)
