"""The log service on the wire (version 2): requests for blocks of variables, and packets with their values.

Port 5: channel 0 is the table of contents, 1 creates, starts and stops blocks, 2 carries the data.
"""

import struct
from collections.abc import Sequence
from enum import IntEnum

from firmware_py.wire import WireError
from firmware_py.wire.crtp import MAX_DATA, PORT_LOG, Packet, header
from firmware_py.wire.scalars import Scalar

CHANNEL_CONTROL = 1
CHANNEL_DATA = 2
MAX_VALUES = 26  # bytes: 30 less the block's number and the time stamp
PERIOD_UNIT_MS = 10
OK, ENOENT, E2BIG, ENOEXEC, ENOMEM, EEXIST = 0, 2, 7, 8, 12, 17  # status bytes are errno's

ITEM = struct.Struct("<BH")  # type and number in the table of contents
MAX_ITEMS = (MAX_DATA - 2) // ITEM.size  # in one request

_HEAD = struct.Struct("<BBHB")
_HEADER = header(PORT_LOG, CHANNEL_DATA)


class LogCommand(IntEnum):
    """The first byte on channel 1; versions 0 and 1 of the protocol are not supported."""

    DELETE = 2
    START = 3
    STOP = 4
    RESET = 5
    CREATE = 6
    APPEND = 7
    START_MS = 8


def request(command: LogCommand, *rest: int) -> Packet:
    """Return a request on channel 1; the number of a block comes first."""
    return Packet(PORT_LOG, CHANNEL_CONTROL, bytes((command, *rest)))


def creation(block: int, items: Sequence[tuple[Scalar, int]]) -> list[Packet]:
    """Return the requests that create a block of variables, each with its type and its number in the table of contents."""
    packed = [ITEM.pack(scalar.log_number, number) for scalar, number in items]
    return [
        request(
            LogCommand.APPEND if first else LogCommand.CREATE,
            block,
            *b"".join(packed[first : first + MAX_ITEMS]),
        )
        for first in range(0, len(packed), MAX_ITEMS)
    ]


def encode_data(block: int, timestamp_ms: int, values: bytes) -> bytes:
    """Return the complete packet with a block's values, at most 26 bytes; the time stamp wraps after 2^24 ms."""
    if len(values) > MAX_VALUES:
        raise WireError(f"log block {block}: {len(values)} bytes of values, at most {MAX_VALUES} fit")
    return _HEAD.pack(_HEADER, block, timestamp_ms & 0xFFFF, timestamp_ms >> 16 & 0xFF) + values


def decode_data(data: bytes) -> tuple[int, int, bytes]:
    """Return `(block, time stamp [ms], values)` from the data of a log data packet."""
    if len(data) < 4:
        raise WireError(f"log data of {len(data)} bytes: at least 4 are needed")
    return data[0], int.from_bytes(data[1:4], "little"), data[4:]
