"""The board's end of the log service, as plain as it can be: it grants what it is asked for, and remembers it."""

from collections.abc import Sequence

from firmware_py.wire import log
from firmware_py.wire.crtp import PORT_LOG, Packet, decode, encode
from firmware_py.wire.telemetry import ALL_BLOCKS, TelemetryBlock

NAMES = [variable.name for block in ALL_BLOCKS for variable in block.variables]
TABLE = {name: number for number, name in enumerate(NAMES)}  # of contents


class LogBoard:
    """`answer` every packet that a station sends; `blocks` has (type, name) by number, `periods` those that run [10 ms]."""

    def __init__(self) -> None:
        self.requests: list[bytes] = []
        self.blocks: dict[int, list[tuple[int, str]]] = {}
        self.periods: dict[int, int] = {}

    def answer(self, raw: bytes) -> bytes | None:
        packet = decode(raw)
        if (packet.port, packet.channel) != (PORT_LOG, log.CHANNEL_CONTROL):
            return None
        self.requests.append(packet.data)
        command, number, rest = packet.data[0], packet.data[1] if len(packet.data) > 1 else 0, packet.data[2:]
        is_there = command == log.LogCommand.CREATE and number in self.blocks
        if command == log.LogCommand.RESET:
            self.blocks, self.periods = {}, {}
        elif command in (log.LogCommand.CREATE, log.LogCommand.APPEND) and not is_there:
            items = [log.ITEM.unpack_from(rest, offset) for offset in range(0, len(rest), log.ITEM.size)]
            self.blocks.setdefault(number, []).extend((kind, NAMES[index]) for kind, index in items)
        elif command == log.LogCommand.START:
            self.periods[number] = rest[0]
        return encode(Packet(PORT_LOG, log.CHANNEL_CONTROL, bytes((command, number, log.EEXIST * is_there))))


def data_packet(block: TelemetryBlock, timestamp_ms: int, values: Sequence[float]) -> bytes:
    """The whole packet with the values of a block's log variables."""
    return log.encode_data(block.id, timestamp_ms, block.layout.pack(*values))
