"""The contents of the memories of every Crazyflie: the EEPROM's configuration block and a deck's one-wire memory."""

import struct
from dataclasses import dataclass
from zlib import crc32

from firmware_py.wire import WireError

TYPE_EEPROM = 0x00
TYPE_TRAJECTORIES = 0x12
TYPE_TESTER = 0x15
TYPE_DECKS = 0x19
TYPE_DECK_BOOTLOADERS = 0x20

CONFIG_SIZE = 21
ONE_WIRE_SIZE = 112

_CONFIG = struct.Struct("<4sBBBffBI")
_CONFIG_MAGIC = b"0xBC"
_CONFIG_VERSION = 1
_ONE_WIRE = struct.Struct("<BIBB")
_ONE_WIRE_MAGIC = 0xEB
_ONE_WIRE_NAME = 1
_ONE_WIRE_REVISION = 2


@dataclass(frozen=True, slots=True)
class RadioSettings:
    """The part of the configuration block that Floaty uses."""

    channel: int = 80
    data_rate: int = 2  # 2: 2 Mbit/s
    address: int = 0xE7E7E7E7E7  # 40 bits


def encode_config(settings: RadioSettings) -> bytes:
    """Return the configuration block, version 1."""
    address = settings.address
    block = _CONFIG.pack(
        _CONFIG_MAGIC, _CONFIG_VERSION, settings.channel, settings.data_rate, 0.0, 0.0,
        address >> 32, address & 0xFFFFFFFF,
    )  # fmt: skip
    return block + bytes((sum(block) & 0xFF,))


def decode_config(block: bytes) -> RadioSettings:
    """Return the settings in a configuration block; `WireError` when it is malformed or its checksum is wrong."""
    if len(block) < CONFIG_SIZE or sum(block[: CONFIG_SIZE - 1]) & 0xFF != block[CONFIG_SIZE - 1]:
        raise WireError(f"configuration block {block[:CONFIG_SIZE].hex()}: wrong length or sum")
    magic, version, channel, data_rate, _, _, upper, lower = _CONFIG.unpack_from(block)
    if magic != _CONFIG_MAGIC or version != _CONFIG_VERSION:
        raise WireError(f"configuration block {magic!r} version {version}: unknown")
    return RadioSettings(channel, data_rate, upper << 32 | lower)


def encode_one_wire(vendor: int, product: int, name: str, revision: str) -> bytes:
    """Return the 112 bytes of a deck's memory."""
    header = _ONE_WIRE.pack(_ONE_WIRE_MAGIC, 0, vendor, product)
    elements = b"".join(
        bytes((kind, len(text))) + text.encode("latin-1")
        for kind, text in ((_ONE_WIRE_NAME, name), (_ONE_WIRE_REVISION, revision))
    )
    table = bytes((0, len(elements))) + elements
    data = header + bytes((crc32(header) & 0xFF,)) + table + bytes((crc32(table) & 0xFF,))
    return data.ljust(ONE_WIRE_SIZE, b"\xff")
