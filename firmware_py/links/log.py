"""The log service: clients group variables into blocks, the board sends each block at its period.

Periods count in 10 ms, or with the newer command in 1 ms; 0 sends a block once. As in the Crazyflie firmware, items are
added one by one: those before a refused one stay, and so does a block whose creation failed. When the partner is gone, the
next block that is due deletes them all.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from firmware_py.links.crtp_stack import CrtpStack, Task
from firmware_py.rtos import FOREVER
from firmware_py.wire import WireError, log, toc
from firmware_py.wire.crtp import PORT_LOG, Packet
from firmware_py.wire.log import E2BIG, EEXIST, ENOENT, ENOEXEC, ENOMEM, ITEM, OK, LogCommand
from firmware_py.wire.scalars import LOG_SCALARS, Scalar

MAX_BLOCKS = 16
MAX_VARIABLES = 128  # in all blocks together
COMMANDS = frozenset(LogCommand)


@dataclass(frozen=True, slots=True)
class LogVariable:
    """A variable for the log: `group.name`, type and unit (empty for a pure number), and a function that reads it."""

    name: str
    scalar: Scalar
    unit: str
    read: Callable[[], int | float]


Item = tuple[Scalar, Callable[[], int | float]]  # compiled code would turn an integer into a float


@dataclass(slots=True)
class LogBlock:
    """Variables that are sent together. `due_tick` is None while the block is stopped."""

    items: list[Item] = field(default_factory=list)
    layout: struct.Struct = field(default_factory=lambda: struct.Struct("<"))
    period_ms: int = 0
    due_tick: int | None = None

    def values(self) -> bytes:
        """Return the present values as bytes."""
        values = [read() for _, read in self.items]
        try:
            return self.layout.pack(*values)
        except (
            struct.error,
            OverflowError,
        ):  # one does not fit its type, or is a fraction where its type is whole
            cast = (item[0].cast(value) for item, value in zip(self.items, values, strict=True))
            return self.layout.pack(*cast)


class LogService:
    """Owns the blocks; its task waits for requests and for the next block that is due."""

    def __init__(self, stack: CrtpStack, variables: Sequence[LogVariable]) -> None:
        self.toc = toc.Toc.of(PORT_LOG, ((item.scalar.log_number, item.name) for item in variables))
        self.blocks: dict[int, LogBlock] = {}
        self._variables = variables
        self._stack = stack
        self._requests = stack.open_port(PORT_LOG)
        stack.kernel.create_task("LOG", 1, self._task)

    def answer(self, packet: Packet) -> tuple[bytes, ...]:
        """Return the reply to one request; raises `WireError` for a malformed one."""
        data = packet.data
        if packet.channel == toc.CHANNEL:
            return (self.toc.answer(data, bytes((MAX_BLOCKS, MAX_VARIABLES))),)
        if packet.channel != log.CHANNEL_CONTROL or not data:
            raise WireError(f"log request on channel {packet.channel}: {data.hex()}")
        number = data[1] if len(data) > 1 else 0
        return (bytes((data[0], number, self._control(data[0], number, data[2:]))),)

    def _control(self, command: int, number: int, rest: bytes) -> int:
        """Execute a command; return the status."""
        if command == LogCommand.RESET:
            self.blocks.clear()
            return OK
        if command == LogCommand.CREATE:
            return self._create(number, rest)
        if command not in COMMANDS:
            return ENOEXEC
        block = self.blocks.get(number)
        if block is None:
            return ENOENT
        if command == LogCommand.APPEND:
            return self._append(block, rest)
        if command == LogCommand.DELETE:
            del self.blocks[number]
        elif command == LogCommand.STOP:
            block.due_tick = None
        else:
            self._start(block, command, rest)
        return OK

    def _create(self, number: int, rest: bytes) -> int:
        if number in self.blocks:
            return EEXIST
        if len(self.blocks) >= MAX_BLOCKS:
            return ENOMEM
        block = self.blocks[number] = LogBlock()
        return self._append(block, rest)

    def _append(self, block: LogBlock, rest: bytes) -> int:
        """Add the complete items in `rest`: a full packet of cflib's ends with the type byte of one more."""
        for offset in range(0, len(rest) - ITEM.size + 1, ITEM.size):
            kind, number = ITEM.unpack_from(rest, offset)
            scalar = LOG_SCALARS.get(kind & 0x0F)
            if scalar is None:
                return ENOENT
            layout = struct.Struct(block.layout.format + scalar.format)
            if layout.size > log.MAX_VALUES:
                return E2BIG
            if sum(len(other.items) for other in self.blocks.values()) == MAX_VARIABLES:
                return ENOMEM
            if number >= len(self._variables):
                return ENOENT
            block.items.append((scalar, self._variables[number].read))
            block.layout = layout
        return OK

    def _start(self, block: LogBlock, command: int, rest: bytes) -> None:
        width = 2 if command == LogCommand.START_MS else 1
        if len(rest) < width:
            raise WireError("a log block started without a period")
        period = int.from_bytes(rest[:width], "little")
        block.period_ms = period if command == LogCommand.START_MS else period * log.PERIOD_UNIT_MS
        block.due_tick = self._stack.kernel.tick_count + block.period_ms

    def _task(self) -> Task:
        kernel = self._stack.kernel
        while True:
            due = [block.due_tick for block in self.blocks.values() if block.due_tick is not None]
            packet = yield from self._requests.receive(
                max(0, min(due) - kernel.tick_count) if due else FOREVER
            )
            if packet is not None:
                yield from self._stack.answer(packet, self.answer)
            for number, block in list(self.blocks.items()):
                if block.due_tick is None or block.due_tick > kernel.tick_count:
                    continue
                if not self._stack.connected:
                    self.blocks.clear()
                    yield from self._stack.hang_up()
                    break
                yield from self._send(number, block, kernel.tick_count)

    def _send(self, number: int, block: LogBlock, tick: int) -> Task:
        """Send a block that is due; the next time is planned from this one, missed ones are skipped."""
        yield from self._stack.kernel.work(self._stack.cost.log_us)
        yield from self._stack.offer(log.encode_data(number, tick, block.values()))
        assert block.due_tick is not None
        late = tick - block.due_tick
        period = block.period_ms
        block.due_tick = tick + period - late % period if period else None
