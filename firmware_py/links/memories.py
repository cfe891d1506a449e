"""Memories on port 4, in the order of the Crazyflie firmware: the EEPROM, the commander's trajectories, the memory tester,
the memories of decks and of their bootloaders, which are empty: as on the flashed board there is no deck.

Channel 0 lists them, 1 reads, 2 writes. The tester's byte at any address is the address modulo 256: reading
returns it, writing compares with it and counts differences.
"""

import struct
from collections.abc import Sequence

from firmware_py.links.crtp_stack import CrtpStack
from firmware_py.wire import WireError
from firmware_py.wire.crtp import PORT_MEMORIES, Packet
from firmware_py.wire.memories import (
    TYPE_DECK_BOOTLOADERS,
    TYPE_DECKS,
    TYPE_EEPROM,
    TYPE_TESTER,
    TYPE_TRAJECTORIES,
)

INFO, READ, WRITE = 0, 1, 2  # channels
GET_COUNT, GET_INFO = 1, 2
MAX_READ = 24
TESTER_SIZE = 0x1000
EEPROM_SIZE = 0x1FFF  # one byte less than the chip has
DECKS_VERSION, DECKS_SIZE = 3, 0x5000_0000
BOOTLOADERS_VERSION, BOOTLOADERS_SIZE = 1, 0x1_8000
OK, EIO = 0, 5

_INFO = struct.Struct("<BBBI8s")
_ADDRESS = struct.Struct("<BI")
_NO_SERIAL = bytes(8)  # only one-wire memories have one


class ClientMemory:
    """A memory of real bytes as clients see it; the service checks addresses."""

    def __init__(self, type: int, content: bytearray, size: int | None = None) -> None:
        self.type = type
        self.size = len(content) if size is None else size
        self._content = content

    def read(self, address: int, length: int) -> bytes:
        """Return `length` bytes."""
        return bytes(self._content[address : address + length])

    def write(self, address: int, data: bytes) -> None:
        """Store bytes."""
        self._content[address : address + len(data)] = data


class NoDecks(ClientMemory):
    """A memory of decks where there are none: a version, then zeros."""

    def __init__(self, type: int, version: int, size: int) -> None:
        super().__init__(type, bytearray((version,)), size=size)

    def read(self, address: int, length: int) -> bytes:
        return super().read(address, length).ljust(length, b"\0")

    def write(self, address: int, data: bytes) -> None:
        """Ignore it."""


class Tester(ClientMemory):
    """The memory tester; `errors` counts wrong bytes."""

    def __init__(self) -> None:
        super().__init__(TYPE_TESTER, bytearray(index & 0xFF for index in range(TESTER_SIZE)))
        self.errors = 0

    def write(self, address: int, data: bytes) -> None:
        """Compare with the expected bytes."""
        self.errors += sum(a != b for a, b in zip(data, self.read(address, len(data)), strict=True))


class MemoryService:
    """Serves memories; their number is their index."""

    def __init__(self, stack: CrtpStack, memories: Sequence[ClientMemory]) -> None:
        self._memories = memories
        stack.serve("MEM", 1, PORT_MEMORIES, self.answer)

    def answer(self, packet: Packet) -> tuple[bytes, ...]:
        """Return the reply to one request; raises `WireError` for a malformed one."""
        data = packet.data
        if packet.channel == INFO:
            return (self._info(data),)
        if packet.channel not in (READ, WRITE) or len(data) < _ADDRESS.size:
            raise WireError(f"memory request on channel {packet.channel}: {data.hex()}")
        number, address = _ADDRESS.unpack_from(data)
        head, rest = data[: _ADDRESS.size], data[_ADDRESS.size :]
        if packet.channel == READ:
            if not rest:
                raise WireError("a memory read without a length")
            if rest[0] > MAX_READ or not self._covers(number, address, rest[0]):
                return (head + bytes((EIO,)),)
            return (head + bytes((OK,)) + self._memories[number].read(address, rest[0]),)
        if not self._covers(number, address, len(rest)):
            return (head + bytes((EIO,)),)
        self._memories[number].write(address, rest)
        return (head + bytes((OK,)),)

    def _info(self, data: bytes) -> bytes:
        if data[:1] == bytes((GET_COUNT,)):
            return bytes((GET_COUNT, len(self._memories)))
        if data[:1] != bytes((GET_INFO,)) or len(data) < 2:
            raise WireError(f"memory information {data.hex()}: unknown")
        if data[1] >= len(self._memories):
            return data[:2]
        memory = self._memories[data[1]]
        return _INFO.pack(GET_INFO, data[1], memory.type, memory.size, _NO_SERIAL)

    def _covers(self, number: int, address: int, length: int) -> bool:
        return number < len(self._memories) and address + length <= self._memories[number].size


def memories(eeprom: bytearray, tester: Tester, trajectories: bytearray) -> tuple[ClientMemory, ...]:
    """Return the memories of a Floaty board."""
    return (
        ClientMemory(TYPE_EEPROM, eeprom, size=EEPROM_SIZE),
        ClientMemory(TYPE_TRAJECTORIES, trajectories),
        tester,
        NoDecks(TYPE_DECKS, DECKS_VERSION, DECKS_SIZE),
        NoDecks(TYPE_DECK_BOOTLOADERS, BOOTLOADERS_VERSION, BOOTLOADERS_SIZE),
    )
