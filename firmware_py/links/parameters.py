"""The parameter service: read, write and keep the values that may be changed while the board runs.

A write is refused when the value is not a number or out of range: the console reports the range. Either way the reply has
the value in force. Persistent parameters can be stored in the upper part of the EEPROM and are applied at the next
boot. Layout from address 1024: `FPS1`, length of the list u16, CRC-32 of the list u32, then for each parameter the length of
its name, the name, the length of its value, the value. A list that fails these checks counts as empty.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from zlib import crc32

from firmware_py.links.console import Notices
from firmware_py.links.crtp_stack import CrtpStack
from firmware_py.wire import WireError, toc
from firmware_py.wire.crtp import PORT_PARAMETERS, Packet
from firmware_py.wire.parameters import (
    CHANNEL_MISC,
    CHANNEL_READ,
    CHANNEL_WRITE,
    EACCES,
    EINVAL,
    ENOENT,
    EXTENDED_PERSISTENT,
    OK,
    TYPE_EXTENDED,
    TYPE_READ_ONLY,
    Misc,
    decode_ident,
    decode_set_by_name,
    encode_ident,
    encode_set_by_name_reply,
)
from firmware_py.wire.scalars import Scalar

START = 1024  # the configuration block is below
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
        if magic != _MAGIC or crc32(records) != checksum:
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
    """Return the list without its head."""
    return b"".join(
        bytes((len(name),)) + name.encode("latin-1") + bytes((len(value),)) + value
        for name, value in values.items()
    )


def _split(records: bytes) -> tuple[bytes, bytes]:
    """Split off the first counted string."""
    end = 1 + (records[0] if records else 0)
    return records[1:end], records[end:]


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter: `group.name`, type and unit, how to read and write it, and its limits.

    Without `write` it is read only. `minimum` and `maximum` are inclusive.
    """

    name: str
    scalar: Scalar
    unit: str
    read: Callable[[], float]
    write: Callable[[float], object] | None = None
    minimum: float = 0.0
    maximum: float = 0.0
    persistent: bool = False

    @property
    def type_byte(self) -> int:
        """The type with its flags, as in the TOC."""
        flags = TYPE_READ_ONLY if self.write is None else 0
        return self.scalar.parameter_number | flags | (TYPE_EXTENDED if self.persistent else 0)

    def value(self) -> bytes:
        """Return the value in force as bytes on the wire."""
        return self.scalar.pack(self.read())

    def set(self, value: float) -> int:
        """Set the value; return a status. NaN fails the comparison."""
        if self.write is None:
            return EACCES
        if not self.minimum <= value <= self.maximum:
            return EINVAL
        self.write(value)
        return OK


class ParameterService:
    """Answers on port 2; the values at boot, before stored ones are applied, are the defaults."""

    def __init__(
        self, stack: CrtpStack, parameters: Sequence[Parameter], storage: ParameterStorage, notices: Notices
    ) -> None:
        self.toc = toc.Toc.of(PORT_PARAMETERS, ((item.type_byte, item.name) for item in parameters))
        self._parameters = parameters
        self._numbers = {parameter.name: number for number, parameter in enumerate(parameters)}
        self._defaults = [parameter.value() for parameter in parameters]
        self._storage = storage
        self._notices = notices
        for name, value in storage.load().items():
            parameter = parameters[self._numbers[name]] if name in self._numbers else None
            if parameter is not None and parameter.persistent and len(value) == parameter.scalar.size:
                parameter.set(parameter.scalar.unpack(value))
        stack.serve("PARAM", 1, PORT_PARAMETERS, self.answer)

    def answer(self, packet: Packet) -> tuple[bytes, ...]:
        """Return the replies to one request; raises `WireError` for a malformed one."""
        data = packet.data
        if packet.channel == toc.CHANNEL:
            return (self.toc.answer(data),)
        if packet.channel == CHANNEL_MISC:
            return self._misc(data)
        number = decode_ident(data)
        ident = encode_ident(number)
        if number >= len(self._parameters):
            return (ident + bytes((ENOENT,)),)
        parameter = self._parameters[number]
        if packet.channel == CHANNEL_READ:
            return (ident + bytes((OK,)) + parameter.value(),)
        assert packet.channel == CHANNEL_WRITE
        if parameter.write is None:
            return ()
        # The Crazyflie firmware reads whatever its buffer holds behind a write that is too short; zeros here.
        value = data[2 : 2 + parameter.scalar.size].ljust(parameter.scalar.size, b"\0")
        self._set(parameter, parameter.scalar.unpack(value))
        return (ident + parameter.value() + data[2 + parameter.scalar.size :],)

    def _set(self, parameter: Parameter, value: float) -> int:
        status = parameter.set(value)
        if status == EINVAL:
            allowed = f"{parameter.minimum:g}..{parameter.maximum:g} {parameter.unit}".rstrip()
            self._notices.refuse(parameter.name, f"{parameter.name} = {value:g} refused: allowed {allowed}")
        return status

    def _set_by_name(self, data: bytes) -> tuple[bytes, ...]:
        """Set, reply, and notify clients that have read the value before."""
        request = decode_set_by_name(data)
        number = self._numbers.get(request.name)
        if number is None:
            return (encode_set_by_name_reply(request.name, ENOENT),)
        parameter = self._parameters[number]
        if request.scalar is not parameter.scalar:
            return (encode_set_by_name_reply(request.name, EINVAL),)
        status = self._set(parameter, request.value)
        reply = encode_set_by_name_reply(request.name, status)
        if status != OK:
            return (reply,)
        return reply, bytes((Misc.VALUE_UPDATED,)) + encode_ident(number) + parameter.value()

    def _misc(self, data: bytes) -> tuple[bytes, ...]:
        if data[:1] == bytes((Misc.SET_BY_NAME,)):
            return self._set_by_name(data)
        number = decode_ident(data, 1)
        command, head = data[0], data[:3]
        known = number < len(self._parameters)
        parameter = self._parameters[number] if known else self._parameters[0]
        persistent = known and parameter.persistent
        if command == Misc.EXTENDED_TYPE:
            return (head + bytes((EXTENDED_PERSISTENT if persistent else ENOENT,)),)
        if command == Misc.EXTENDED_TYPE_V2:
            return (head + (bytes((OK, EXTENDED_PERSISTENT)) if persistent else bytes((ENOENT,))),)
        if command in (Misc.DEFAULT, Misc.DEFAULT_V2):
            if not known or parameter.write is None:
                return (head + bytes((ENOENT,)),)
            return (head + (b"" if command == Misc.DEFAULT else bytes((OK,))) + self._defaults[number],)
        if command not in (Misc.STORE, Misc.STATE, Misc.CLEAR):
            raise WireError(f"parameter command {command} is unknown")
        if not known or (command != Misc.STATE and not persistent):
            return (head + bytes((ENOENT,)),)
        if command == Misc.STATE:
            stored = self._storage.load().get(parameter.name)
            return (head + bytes((stored is not None,)) + self._defaults[number] + (stored or b""),)
        if command == Misc.STORE:
            done = self._storage.store(parameter.name, parameter.value())
        else:
            done = self._storage.clear(parameter.name)
        return (head + bytes((OK if done else ENOENT,)),)
