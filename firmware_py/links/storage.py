"""Parameter values that survive a power cycle: a checked list of names and bytes in the upper part of the EEPROM.

Layout from address 1024: `FPS1`, length of the list u16, CRC-32 of the list u32, then for each parameter the length of
its name, the name, the length of its value, the value. A list that fails these checks counts as empty.
"""

import struct
from collections.abc import Mapping
from zlib import crc32

START = 1024  # below lies the configuration block
_HEAD = struct.Struct("<4sHI")
_MAGIC = b"FPS1"


class ParameterStorage:
    """The list in the EEPROM; `eeprom` is the memory itself."""

    def __init__(self, eeprom: bytearray) -> None:
        self._eeprom = eeprom

    @property
    def size(self) -> int:
        """Bytes available for the list."""
        return len(self._eeprom) - START

    @property
    def used(self) -> int:
        """Bytes used by the list."""
        return _HEAD.size + len(_records(self.load()))

    def load(self) -> dict[str, bytes]:
        """Return the stored values by name."""
        magic, length, checksum = _HEAD.unpack_from(self._eeprom, START)
        begin = START + _HEAD.size
        records = bytes(self._eeprom[begin : begin + length])
        if magic != _MAGIC or len(records) != length or crc32(records) != checksum:
            return {}
        values: dict[str, bytes] = {}
        while records:
            name, records = _split(records)
            value, records = _split(records)
            values[name.decode("latin-1")] = value
        return values

    def store(self, name: str, value: bytes) -> bool:
        """Store a value under a name; False when the memory is full."""
        return self.store_all({name: value})

    def store_all(self, values: Mapping[str, bytes]) -> bool:
        """Store values under their names; False, and nothing stored, when the memory is full."""
        return self._write(self.load() | dict(values))

    def clear(self, name: str) -> bool:
        """Delete a value; False when there was none."""
        values = self.load()
        return values.pop(name, None) is not None and self._write(values)

    def _write(self, values: dict[str, bytes]) -> bool:
        records = _records(values)
        content = _HEAD.pack(_MAGIC, len(records), crc32(records)) + records
        if START + len(content) > len(self._eeprom):
            return False
        self._eeprom[START : START + len(content)] = content
        return True


def _records(values: Mapping[str, bytes]) -> bytes:
    """The list without its head."""
    return b"".join(
        bytes((len(name),)) + name.encode("latin-1") + bytes((len(value),)) + value
        for name, value in values.items()
    )


def _split(records: bytes) -> tuple[bytes, bytes]:
    """Split off the first counted string."""
    end = 1 + (records[0] if records else 0)
    return records[1:end], records[end:]
