"""Messages that the board sends by itself, each at its own interval, which clients may change.

Intervals are whole ticks and count from boot: messages of one interval are made in the same tick and carry the same time
stamp, and a missed tick shifts nothing. On a full line the stream that has waited longest is next, so that each gets its
turn; a message that is due again before its turn is dropped and counted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from firmware_py.links.mavlink_stack import MavlinkStack, Task
from firmware_py.rtos import FOREVER, TICK_US
from firmware_py.wire.mavlink_dialect import NUMBERS, Message

DEFAULT, OFF = 0, -1  # intervals in SET_MESSAGE_INTERVAL
NONE_SUCH = 0  # interval in MESSAGE_INTERVAL
HEARTBEAT = NUMBERS["HEARTBEAT"]
LONGEST_TICKS = 1_000_000

_STATUS = ("SYS_STATUS", "BATTERY_STATUS", "ESTIMATOR_STATUS")
_ATTITUDE = ("ATTITUDE", "ATTITUDE_QUATERNION")
_POSITION = ("LOCAL_POSITION_NED",)
_SERVOS = ("SERVO_OUTPUT_RAW",)
_REST = ("NAMED_VALUE_FLOAT",)
GROUPS = {  # MAV_DATA_STREAM of the older REQUEST_DATA_STREAM
    0: (*_STATUS, *_ATTITUDE, *_POSITION, *_SERVOS, *_REST),
    2: _STATUS,
    3: _SERVOS,
    6: _POSITION,
    10: _ATTITUDE,
    12: _REST,
}


@dataclass(slots=True)
class Stream:
    """A kind of message; `make` returns those of one tick. An interval of None means off."""

    name: str
    default_ticks: int | None
    make: Callable[[int], Sequence[Message]]
    interval_ticks: int | None = None
    due_tick: int = 0
    waits_since: int | None = None  # tick; None: nothing is waiting for the line

    def start(self, interval_ticks: int | None, tick: int) -> None:
        """Send at this interval from now on."""
        self.interval_ticks = interval_ticks
        self.waits_since = None
        if interval_ticks is not None:
            self.due_tick = tick // interval_ticks * interval_ticks + interval_ticks


def interval_of(rate_hz: float) -> int | None:
    """Return the ticks between two messages, None for rate 0."""
    return max(1, round(1000 / rate_hz)) if rate_hz > 0 else None


class StreamService:
    """Sends the streams; `set_interval`, `interval_us` and `make` are for commands."""

    def __init__(self, stack: MavlinkStack, streams: Sequence[Stream]) -> None:
        self._stack = stack
        self._streams = {NUMBERS[stream.name]: stream for stream in streams}
        for stream in streams:
            stream.start(stream.default_ticks, 0)
        self._changed = stack.kernel.create_binary_semaphore("mavStreams")
        stack.handle("REQUEST_DATA_STREAM", self._take_request)
        stack.kernel.create_task("MAV-STREAM", 1, self._task)

    def set_interval(self, number: int, interval_us: int) -> bool:
        """Change how often a message is sent; False when there is no such message or no such interval.

        The interval of heartbeats cannot be changed: without them other clients lose the board.
        """
        stream = self._streams.get(number)
        if stream is None or interval_us < OFF or (number == HEARTBEAT and interval_us != DEFAULT):
            return False
        if interval_us == DEFAULT:
            ticks = stream.default_ticks
        elif interval_us == OFF:
            ticks = None
        else:
            ticks = min(LONGEST_TICKS, max(1, round(interval_us / TICK_US)))
        stream.start(ticks, self._stack.kernel.tick_count)
        self._changed.give_nowait()
        return True

    def interval_us(self, number: int) -> int:
        """Return how often a message is sent, as MESSAGE_INTERVAL reports it."""
        stream = self._streams.get(number)
        if stream is None:
            return NONE_SUCH
        return OFF if stream.interval_ticks is None else stream.interval_ticks * TICK_US

    def make(self, number: int) -> Sequence[Message]:
        """Return the messages of a stream as they are now; empty when there is no such stream."""
        stream = self._streams.get(number)
        return stream.make(self._stack.kernel.tick_count) if stream else ()

    def _take_request(self, request: Message) -> None:
        on = request.start_stop == 1 and request.req_message_rate > 0
        interval_us = 1_000_000 // request.req_message_rate if on else OFF
        for name in GROUPS.get(request.req_stream_id, ()):
            self.set_interval(NUMBERS[name], interval_us)

    def _task(self) -> Task:
        kernel, stack = self._stack.kernel, self._stack
        while True:
            tick, room = kernel.tick_count, stack.room
            messages: list[Message] = []
            for stream in self._waiting(tick):
                if len(messages) >= room:
                    break
                messages += stream.make(tick)
                stream.waits_since = None
            for message in messages:
                yield from stack.offer(message)
            yield from self._changed.take(self._pause(kernel.tick_count))

    def _waiting(self, tick: int) -> Sequence[Stream]:
        """Return the streams that have something to send, the one that has waited longest first."""
        waiting: list[tuple[int, int, Stream]] = []
        for stream in self._streams.values():
            since, interval = stream.waits_since, stream.interval_ticks
            if interval is not None and stream.due_tick <= tick:
                self._stack.unsent += since is not None
                since = stream.due_tick if since is None else since
                stream.start(interval, tick)
                stream.waits_since = since
            if since is not None:
                waiting.append((since, len(waiting), stream))
        return [stream for _, _, stream in sorted(waiting)]

    def _pause(self, tick: int) -> int:
        """Return the ticks until there is something to do."""
        streams = self._streams.values()
        if any(stream.waits_since is not None for stream in streams):
            return 1
        due = min((stream.due_tick for stream in streams if stream.interval_ticks is not None), default=None)
        return FOREVER if due is None else max(0, due - tick)
