"""The pieces of NatNet packets; every length is checked, so that no bytes can do harm."""

import struct
from typing import Any

from firmware_py.geometry import Vector
from ground_station.errors import MocapError

Version = tuple[int, int]

_U32 = struct.Struct("<I")
_VECTOR = struct.Struct("<3f")


class Reader:
    """Reads a packet of `version`; reading beyond its end raises `MocapError`."""

    def __init__(self, data: bytes, version: Version) -> None:
        self.version = version
        self._data = data
        self._at = 0

    @property
    def left(self) -> int:
        """Bytes not read yet."""
        return len(self._data) - self._at

    def read_bytes(self, size: int) -> bytes:
        """Return the next bytes."""
        at = self._advance(size)
        return self._data[at : at + size]

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Return the next values of a layout."""
        return layout.unpack_from(self._data, self._advance(layout.size))

    def u32(self) -> int:
        """Return the next number of 4 bytes."""
        value: int = self.unpack(_U32)[0]
        return value

    def vector(self) -> Vector:
        """Return the next three floats."""
        x, y, z = self.unpack(_VECTOR)
        return x, y, z

    def text(self) -> str:
        """Return the next text, which ends with a zero."""
        end = self._data.find(b"\0", self._at)
        if end < 0:
            raise MocapError(f"NatNet packet of {len(self._data)} bytes: text at {self._at} does not end")
        raw = self._data[self._at : end]
        self._at = end + 1
        return raw.decode("utf-8", "replace")

    def texts(self) -> None:
        """Skip a count and as many texts."""
        for _ in range(self.count(1)):
            self.text()

    def count(self, size: int) -> int:
        """Return the next count, of items of at least `size` bytes each."""
        count = self.u32()
        if count * size > self.left:
            raise MocapError(
                f"NatNet packet of {len(self._data)} bytes: {count} items of {size} bytes at {self._at}"
            )
        return count

    def section(self, size: int) -> int:
        """Return the count at the start of a section of a frame; from 4.1 on its bytes follow it."""
        count = self.count(size)
        if self.version >= (4, 1):
            self.u32()
        return count

    def _advance(self, size: int) -> int:
        at = self._at
        if size > len(self._data) - at:
            raise MocapError(
                f"NatNet packet of {len(self._data)} bytes ends before {size} bytes at {at} are read"
            )
        self._at = at + size
        return at
