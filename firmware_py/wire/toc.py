"""Tables of contents: how a client learns the names and types of log variables and parameters (version 2).

Requests `03` (count and checksum) and `02 id` (one entry) on channel 0 of the log and the parameter port. A client
caches tables by checksum alone, in one place for both ports: equal tables on two ports must not have equal checksums.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from zlib import crc32

from firmware_py.wire import WireError

CHANNEL = 0
ITEM = 2
INFO = 3
MAX_NAME = 24  # group and name, without the dot

_INFO = struct.Struct("<BHI")
_ITEM_REQUEST = struct.Struct("<BH")


@dataclass(frozen=True, slots=True)
class Toc:
    """Entries in the order of their ids, and the checksum over them."""

    entries: tuple[bytes, ...]  # type, group 0 name 0
    crc: int

    @classmethod
    def of(cls, port: int, items: Iterable[tuple[int, str]]) -> "Toc":
        """Make the table of a port from pairs of type byte and `group.name`."""
        entries = tuple(_entry(type_byte, name) for type_byte, name in items)
        return cls(entries, crc32(b"".join(entries), port))

    def answer(self, request: bytes, limits: bytes = b"") -> bytes:
        """Return the reply to a request; `limits` ends the reply to `03`. An unknown id gets the bare command back."""
        if request[:1] == bytes((INFO,)):
            return _INFO.pack(INFO, len(self.entries), self.crc) + limits
        if request[:1] != bytes((ITEM,)) or len(request) < _ITEM_REQUEST.size:
            raise WireError(f"TOC request {request.hex()}: only 03 and 02 with an id are known")
        number: int = _ITEM_REQUEST.unpack_from(request)[1]
        if number >= len(self.entries):
            return bytes((ITEM,))
        return _ITEM_REQUEST.pack(ITEM, number) + self.entries[number]


def _entry(type_byte: int, name: str) -> bytes:
    group, _, variable = name.partition(".")
    if not group or not variable or len(group) + len(variable) > MAX_NAME:
        raise WireError(f"{name}: must be group.name with at most {MAX_NAME} letters")
    return bytes((type_byte,)) + group.encode("ascii") + b"\0" + variable.encode("ascii") + b"\0"
