"""MAVLink's messages: pymavlink's dialect `development`, which is `common` and newer ones, and one that it lacks."""

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


KINDS: dict[int, Any] = dialect.mavlink_map  # pymavlink's class of each message
NUMBERS: dict[str, int] = {kind.msgname: kind.id for kind in (*KINDS.values(), ProtocolVersion)}
