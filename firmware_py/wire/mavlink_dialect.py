"""MAVLink's messages: pymavlink's dialect `development`, which is `common` and newer ones, and what it lacks."""

import struct
from typing import Any, TypeAlias

import pymavlink.dialects.v20.development as dialect

Message: TypeAlias = dialect.MAVLink_message
"""One message of the dialect, its fields as attributes; pymavlink's classes carry no types."""


class ProtocolVersion(dialect.MAVLink_message):  # type: ignore[misc]
    """PROTOCOL_VERSION, in hundredths, without the revisions of the standard; the board sends it and nobody reads it."""

    id = 300
    msgname = "PROTOCOL_VERSION"
    crc_extra = 217

    def __init__(self, version: int, least: int, most: int) -> None:
        super().__init__(self.id, self.msgname)
        self._payload = struct.pack("<HHH16x", version, least, most)

    def pack(self, codec: Any) -> bytes:
        frame: bytes = self._pack(codec, self.crc_extra, self._payload)
        return frame


class Timesync(dialect.MAVLink_timesync_message):  # type: ignore[misc]
    """TIMESYNC with its addressee; 0: all."""

    def __init__(self, tc1: int, ts1: int, system: int, component: int) -> None:
        super().__init__(tc1, ts1)
        self._target = system, component

    def pack(self, codec: Any) -> bytes:
        payload = struct.pack("<qqBB", self.tc1, self.ts1, *self._target)
        frame: bytes = self._pack(codec, self.crc_extra, payload)
        return frame


def address(message: Message, payload: bytes) -> None:
    """Give a received TIMESYNC its addressee."""
    if message.get_type() == "TIMESYNC":
        message.target_system, message.target_component = payload.ljust(18, b"\0")[16:18]


def sender_of(message: Message) -> tuple[int, int]:
    """Return the sender of a message: system and component."""
    return message.get_srcSystem(), message.get_srcComponent()


KINDS: dict[int, Any] = dialect.mavlink_map  # pymavlink's class of each message
NUMBERS: dict[str, int] = {kind.msgname: kind.id for kind in (*KINDS.values(), ProtocolVersion)}
