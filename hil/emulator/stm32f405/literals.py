"""Finds the constants between the instructions of an image without symbols, so that its cycles are counted right.

They are what instructions load relative to their own place, and the tables behind TBB and TBH. Of Bitcraze's releases,
cycles then agree with those of the ELF in 98 % of all functions, instead of in 40 %.
"""

import numpy as np

from firmware_py.export.cycles import is_wide

PASSES = 4  # a constant that was read as an instruction hides the next ones
WORD_LOADS = (
    0xF85F,
    0xF83F,
    0xF81F,
    0xF93F,
    0xF91F,
)  # LDR (literal) of 32, 16 and 8 bits, but for its bit 7: add
ADD = 0x80
ODD = 0x40  # of VLDR: the register is s1, s3, ..
TABLE_BRANCH = 0xE8DF
COMPARE_WITHIN = 6  # half words before a table branch: CMP with its last index


def literals(code: bytes) -> frozenset[int]:
    """Return the half words of code that are constants, counted from its begin."""
    words, found = np.frombuffer(code, "<u2").tolist(), set[int]()
    for _ in range(PASSES):
        before = len(found)
        _read_through(words, found)
        if len(found) == before:
            break
    return frozenset(found)


def _read_through(words: list[int], known: set[int]) -> None:
    """Add the constants that instructions outside the known ones load."""
    index = 0
    while index < len(words):
        if index in known:
            index += 1
            continue
        wide = is_wide(words[index]) and index + 1 < len(words)
        found = _of_wide(words, index) if wide else _of_narrow(words[index], index)
        if found and 0 <= found[0] <= found[-1] < len(words):
            known.update(found)
        index += 2 if wide else 1


def _of_narrow(word: int, index: int) -> range:
    if word >> 11 != 0b01001:  # LDR (literal)
        return range(0)
    begin = (index + 2 & ~1) + 2 * (word & 0xFF)
    return range(begin, begin + 2)


def _of_wide(words: list[int], index: int) -> range:
    first, second = words[index : index + 2]
    if first == TABLE_BRANCH and second & 0xFFE0 == 0xF000:
        before = (words[at] for at in range(index - 1, max(index - COMPARE_WITHIN, -1), -1))
        entries = next((1 + (word & 0xFF) for word in before if word >> 11 == 0b00101), 0)
        return range(index + 2, index + 2 + (entries if second & 0x10 else (entries + 1) // 2))
    if first & ~ADD in WORD_LOADS:
        prefetches = first & ~ADD != WORD_LOADS[0] and second >> 12 == 15
        offset, size = second & 0xFFF, 0 if prefetches else 2
    elif first & ~(ADD | ODD) == 0xED1F and second & 0x0E00 == 0x0A00:  # VLDR
        offset, size = 4 * (second & 0xFF), 4 if second & 0x100 else 2
    elif first & ~ADD == 0xE95F:  # LDRD
        offset, size = 4 * (second & 0xFF), 4
    else:
        return range(0)
    begin = ((2 * index + 4 & ~3) + (offset if first & ADD else -offset)) // 2
    return range(begin, begin + size)
