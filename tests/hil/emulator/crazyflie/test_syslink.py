"""Syslink frames: their sums, streams in pieces, and what noise does to them."""

import pytest

from hil.emulator.crazyflie.syslink import Decoder, encode


def test_a_frame_has_both_sums_of_its_type_length_and_data() -> None:
    first = second = 0
    for byte in bytes.fromhex("0003f30a7f"):
        first = (first + byte) % 256
        second = (second + first) % 256
    assert encode(0, bytes.fromhex("f30a7f")) == bytes.fromhex("bccf0003f30a7f") + bytes((first, second))


def test_frames_are_found_in_whatever_pieces_they_come() -> None:
    stream = encode(0, b"ab") + b"\xbc" + encode(0x13, b"") + encode(0x20, bytes(range(32)))
    for size in (1, 2, 3, 7, len(stream)):
        decoder = Decoder()
        found = [
            f
            for begin in range(0, len(stream), size)
            for f in decoder.decode_frames(stream[begin : begin + size])
        ]
        assert found == [(0, b"ab"), (0x13, b""), (0x20, bytes(range(32)))]
        assert decoder.broken == 0


@pytest.mark.parametrize(("place", "bit"), [(5, 1), (3, 1), (3, 8), (2, 16), (9, 2)])
def test_a_frame_with_a_wrong_bit_is_counted_and_the_next_ones_are_found(place: int, bit: int) -> None:
    """Also in the length, which then reaches into the next frame."""
    broken = bytearray(encode(0, b"abcd"))
    broken[place] ^= bit
    decoder = Decoder()
    assert list(decoder.decode_frames(bytes(broken) + encode(1, b"x") + encode(2, b"y"))) == [
        (1, b"x"),
        (2, b"y"),
    ]
    assert decoder.broken == 1
