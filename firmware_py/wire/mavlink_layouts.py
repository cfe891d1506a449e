"""The layouts of MAVLink's messages, from pymavlink's dialect `common`, and messages that this dialect lacks.

pymavlink's own encoder and decoder take about twice as long, and the encoder writes into the message.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, TypeAlias

import pymavlink.dialects.v20.common as dialect
from pymavlink.dialects.v20.common import MAVLink_message

Message: TypeAlias = MAVLink_message
"""One message of the dialect, its fields as attributes; pymavlink's classes carry no types."""


@dataclass(frozen=True, slots=True)
class Layout:
    """The layout of a kind of message in its payload."""

    create: Any  # pymavlink's class of the message
    payload: struct.Struct
    crc_seed: bytes
    read: Callable[[Any], Any]  # the fields of a message in wire order
    arrays: tuple[int, ...]  # how many values each field has, in wire order; empty when all have one
    order: tuple[int, ...]  # which of the wire's fields is the constructor's first, second, ...

    def pack(self, message: Message) -> bytes:
        """Return the payload, its trailing zeros included."""
        fields = self.read(message)
        if not self.arrays:
            return self.payload.pack(*fields)
        flat: list[Any] = []
        for field, length in zip(fields, self.arrays, strict=True):
            if length == 1:
                flat.append(field)
            else:
                flat.extend(field)
        return self.payload.pack(*flat)

    def unpack(self, payload: bytes) -> Message:
        """Return the message; missing bytes of the payload are zero, and surplus ones belong to a newer dialect."""
        size = self.payload.size
        flat = self.payload.unpack(payload[:size].ljust(size, b"\0"))
        fields: tuple[Any, ...] | list[Any] = flat
        if self.arrays:
            fields, first = [], 0
            for length in self.arrays:
                fields.append(flat[first] if length == 1 else list(flat[first : first + length]))
                first += length
        return self.create(*[fields[i] for i in self.order])


def _stored(name: str, kind: str) -> str:
    """Return the attribute in which pymavlink's classes keep a field's bytes or number."""
    return f"_{name}_raw" if kind == "char" else name


def _layout(kind: Any) -> Layout:
    """Return the layout of one of pymavlink's message classes."""
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    names = [_stored(name, types[name]) for name in kind.ordered_fieldnames]
    get = attrgetter(*names)
    return Layout(
        create=kind,
        payload=kind.unpacker,
        crc_seed=bytes((kind.crc_extra,)),
        read=get if len(names) > 1 else lambda message: (get(message),),
        arrays=tuple(kind.lengths) if max(kind.lengths) > 1 else (),
        order=tuple(kind.orders),
    )


class _Later(MAVLink_message):  # type: ignore[misc]
    """A message that pymavlink leaves out as work in progress; a subclass describes it as pymavlink's classes do."""

    id: int
    msgname: str
    fieldnames: tuple[str, ...]
    fieldtypes: tuple[str, ...]

    def __init__(self, *fields: Any) -> None:
        super().__init__(self.id, self.msgname)
        self._fieldnames = self.fieldnames
        for name, kind, field in zip(self.fieldnames, self.fieldtypes, fields, strict=True):
            setattr(self, _stored(name, kind), field)


class ProtocolVersion(_Later):
    """PROTOCOL_VERSION, in hundredths."""

    id = 300
    msgname = "PROTOCOL_VERSION"
    fieldnames = ordered_fieldnames = (
        *("version", "min_version", "max_version"),
        *("spec_version_hash", "library_version_hash"),
    )
    fieldtypes = ("uint16_t", "uint16_t", "uint16_t", "uint8_t", "uint8_t")
    lengths = (1, 1, 1, 8, 8)
    orders = (0, 1, 2, 3, 4)
    unpacker = struct.Struct("<HHH8B8B")
    crc_extra = 217


class AvailableModes(_Later):
    """AVAILABLE_MODES, one of the board's modes."""

    id = 435
    msgname = "AVAILABLE_MODES"
    fieldnames = ("number_modes", "mode_index", "standard_mode", "custom_mode", "properties", "mode_name")
    fieldtypes = ("uint8_t", "uint8_t", "uint8_t", "uint32_t", "uint32_t", "char")
    ordered_fieldnames = (*fieldnames[3:5], *fieldnames[:3], "mode_name")
    lengths = (1, 1, 1, 1, 1, 1)
    orders = (2, 3, 4, 0, 1, 5)
    unpacker = struct.Struct("<IIBBB35s")
    crc_extra = 134


class CurrentMode(_Later):
    id = 436
    msgname = "CURRENT_MODE"
    fieldnames = ("standard_mode", "custom_mode", "intended_custom_mode")
    fieldtypes = ("uint8_t", "uint32_t", "uint32_t")
    ordered_fieldnames = (*fieldnames[1:], "standard_mode")
    lengths = (1, 1, 1)
    orders = (2, 0, 1)
    unpacker = struct.Struct("<IIB")
    crc_extra = 193


LAYOUTS = {number: _layout(kind) for number, kind in dialect.mavlink_map.items()}
LAYOUTS |= {kind.id: _layout(kind) for kind in (ProtocolVersion, AvailableModes, CurrentMode)}
NUMBERS: dict[str, int] = {layout.create.msgname: number for number, layout in LAYOUTS.items()}


def crc16(data: bytes) -> int:
    """CRC-16/MCRF4XX, the checksum of every frame."""
    return int(dialect.x25crc(data).crc)
