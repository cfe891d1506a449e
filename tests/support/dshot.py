"""DSHOT by its description (brushlesswhoop.com, "DSHOT and bidirectional DSHOT"): frames to an ESC, and its replies."""

from collections.abc import Sequence
from itertools import pairwise

CODES = (
    0x19, 0x1B, 0x12, 0x13, 0x1D, 0x15, 0x16, 0x17, 0x1A, 0x09, 0x0A, 0x0B, 0x1E, 0x0D, 0x0E, 0x0F
)  # fmt: skip
NIBBLES = {f"{code:05b}": nibble for nibble, code in enumerate(CODES)}
REPLY_BITS = 21


def frame_of(throttle: int, inverted: bool = False, request: int = 0) -> int:
    """Return 16 bits: throttle, request, checksum."""
    data = throttle << 1 | request
    checksum = (data ^ data >> 4 ^ data >> 8) & 15
    return data << 4 | (checksum ^ 15 if inverted else checksum)


def period_us(edges: Sequence[int], bit: float) -> int:
    """Return the electrical period [us] of a reply by the times of its edges, in units of which a bit takes `bit`."""
    gaps = [round((later - earlier) / bit) for earlier, later in pairwise(edges)]
    text = "1" + "".join("0" * (gap - 1) + "1" for gap in gaps)
    text = text[:REPLY_BITS].ljust(REPLY_BITS, "0")  # the last edge may be the return to rest
    value = 0
    for at in range(1, REPLY_BITS, 5):
        value = value << 4 | NIBBLES[text[at : at + 5]]
    assert (value ^ value >> 4 ^ value >> 8 ^ value >> 12) & 15 == 15, f"checksum of {value:#06x}"
    return (value >> 4 & 0x1FF) << (value >> 13)
