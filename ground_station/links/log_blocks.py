"""Telemetry over CRTP, sans I/O: the log blocks of a flight, requested from the board's log service as cflib does it.

Delete all blocks, create each, start each: one request after the other, repeated until it is answered. Each block is sampled
at its own instants. Here they share a time stamp, the instant at which the block of the controller was sampled last; that
one is started first, so that the others of its period follow it.
"""

from collections.abc import Callable, Mapping, Sequence

from firmware_py.wire import WireError, log
from firmware_py.wire.crtp import Packet, encode
from firmware_py.wire.log import LogCommand
from firmware_py.wire.telemetry import (
    ALL_BLOCKS,
    CONTROL,
    PERIOD_MS,
    TIMESTAMP_MASK,
    Sample,
    TelemetryBlock,
)
from ground_station.controls import ControlsError, Dialogue, Exchange, Script

START_ORDER = tuple(sorted(ALL_BLOCKS, key=lambda block: block is not CONTROL))


class LogBlocks:
    """`transmit` takes the instant and a packet; `table` returns the numbers of the board's log variables.

    `blocks` are started in their order.
    """

    def __init__(
        self,
        transmit: Callable[[int, bytes], object],
        table: Callable[[], Mapping[str, int]],
        blocks: Sequence[TelemetryBlock] = START_ORDER,
    ) -> None:
        self.notices: list[str] = []  # lines for the user: blocks that the board cannot send
        self._transmit = transmit
        self._table = table
        self._wanted = blocks
        self._dialogue: Dialogue[Packet] = Dialogue()
        self._blocks: dict[int, TelemetryBlock] = {}  # those that the board can send
        self._controlled_ms = 0  # the last time stamp of CONTROL

    @property
    def requested(self) -> bool:
        """Whether telemetry that the board can send was requested."""
        return bool(self._blocks)

    def request(self, now_us: int) -> None:
        """Request all blocks, or go on requesting them."""
        if not self._dialogue.busy:
            self._dialogue.begin(now_us, self._script())
        self.repeat(now_us)

    def repeat(self, now_us: int) -> None:
        """Repeat unanswered requests; call it again and again."""
        answer = self._dialogue.answer(now_us)
        if answer is not None and answer.error:
            self.notices.append(f"telemetry: {answer.error}")

    def receive(self, now_us: int, packet: Packet) -> Sequence[Sample]:
        """Return the telemetry in a packet of the log port, empty for an answer; `WireError` if it is malformed."""
        if packet.channel != log.CHANNEL_DATA:
            self._dialogue.receive(now_us, packet)
            return ()
        number, timestamp_ms, values = log.decode_data(packet.data)
        block = self._blocks.get(number)
        if block is None:
            raise WireError(f"log block {number}: not one of ours")
        if block is CONTROL:
            self._controlled_ms = timestamp_ms
        timestamp_ms -= (timestamp_ms - self._controlled_ms & TIMESTAMP_MASK) % PERIOD_MS
        return (Sample(block, timestamp_ms & TIMESTAMP_MASK, block.unpack(values)),)

    def _script(self) -> Script[Packet]:
        table = self._table()
        names = {block: [variable.name for variable in block.variables] for block in self._wanted}
        missing = [name for names_of in names.values() for name in names_of if name not in table]
        if missing:
            self.notices.append(f"the board has no {', '.join(missing)}: without these blocks of telemetry")
        blocks = [block for block in self._wanted if not set(missing) & set(names[block])]
        self._blocks = {block.id: block for block in blocks}
        if not blocks:
            return ()
        yield from self._do(log.request(LogCommand.RESET))
        for block in blocks:
            items = [(variable.type, table[variable.name]) for variable in block.variables]
            for packet in log.creation(block.id, items):
                yield from self._do(packet)
        for block in blocks:
            yield from self._do(
                log.request(LogCommand.START, block.id, block.period_ms // log.PERIOD_UNIT_MS)
            )
        return ()

    def _do(self, request: Packet) -> Script[Packet]:
        """Send a request until it is answered; the answer begins with the same bytes."""
        head = request.data[:2]

        def take(got: Packet) -> Packet | None:
            is_answer = (
                got.channel == log.CHANNEL_CONTROL and got.data[: len(head)] == head and len(got.data) > 2
            )
            return got if is_answer else None

        answer = yield Exchange(lambda now_us: self._transmit(now_us, encode(request)), take)
        if answer.data[2] not in (log.OK, log.EEXIST):
            raise ControlsError(f"log request {request.data.hex()}: error {answer.data[2]}")
        return ()
