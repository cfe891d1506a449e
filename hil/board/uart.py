"""The serial line between ground station and board: baud rate, buffers, interrupts by chunk, wrong bits, a cable.

A byte takes 10 bits on the line (8N1), without flow control. At either end a receiver gathers bytes and hands them over
as one chunk: when it has `interrupt_threshold` of them, or when the line has been silent for a byte's time. On board a
chunk waits in the receive buffer until `read` after the interrupt; bytes without room are lost (overrun). On the ground a
USB adapter adds a latency in each direction. Bit errors hit data bits; a wrong start or stop bit, which garbles the byte
as well, is not modelled separately. Events are planned per chunk.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from firmware_py.elementary import log_1p
from hil.board.config import SerialConfig
from hil.emulator.events import EventQueue

BYTE_BITS = 10  # start, 8 data, stop
HOST_BUFFER = 4096  # bytes; Linux, drivers/usb/serial: one page for what a program writes
NEVER = 2.0**60  # more bits than any flight sends
BYTE_TICKS = BYTE_BITS * 1_000_000  # a byte's time in units of 1/baud microseconds

Arrived = Callable[[bytes, int, int], None]  # (chunk, sent_us, now_us)


@dataclass(slots=True)
class LineCounters:
    """Bytes of one direction. Sent bytes are delivered, overrun, cut, or in transit; dropped ones were never sent."""

    sent_bytes: int = 0  # accepted from the sender
    dropped_bytes: int = 0  # no room at the sender
    delivered_bytes: int = 0
    overrun_bytes: int = 0  # no room on board
    cut_bytes: int = 0  # with the cable unplugged
    wrong_bits: int = 0
    busy_us: int = 0  # total time on the line
    deliveries: int = 0  # chunks
    latency_sum_us: int = 0  # of the deliveries, for a chunk's last byte, from sender to receiver

    def count_delivery(self, size: int, latency_us: int) -> None:
        self.delivered_bytes += size
        self.deliveries += 1
        self.latency_sum_us += latency_us


class _Line:
    """One direction. Time on the line is counted in ticks of 1/baud microseconds, so that nothing is rounded twice."""

    def __init__(
        self,
        config: SerialConfig,
        capacity: int,
        events: EventQueue,
        rng: np.random.Generator,
        arrived: Arrived,
    ) -> None:
        self.counters = LineCounters()
        self._baud, self._threshold = config.baud, config.interrupt_threshold
        self._capacity, self._events, self._rng, self._arrived = capacity, events, rng, arrived
        self._free_ticks = 0  # end of the last byte
        self._gathered = b""  # bytes that the silence after the last byte hands over
        self._silence = 0  # its number: a later byte cancels it
        self._rate = 0.0  # of wrong bits
        self._good_bits = 0  # before the next wrong one

    def room(self, now_us: int) -> int:
        """Bytes that the sender can take now."""
        waiting = (self._free_ticks - now_us * self._baud + BYTE_TICKS - 1) // BYTE_TICKS
        return self._capacity - max(0, waiting)

    def send(self, now_us: int, data: bytes, sent_us: int) -> None:
        """Queue bytes, and plan when the receiver hands them over."""
        counters, baud, threshold = self.counters, self._baud, self._threshold
        counters.sent_bytes += len(data)
        counters.busy_us = counters.sent_bytes * BYTE_TICKS // baud
        start_ticks = max(self._free_ticks, now_us * baud)
        before = len(self._gathered)
        chunk = self._gathered + data
        end = threshold
        while end <= len(chunk):
            end_ticks = start_ticks + (end - before) * BYTE_TICKS
            arrive = partial(self._arrived, chunk[end - threshold : end], sent_us)
            self._events.at(-(-end_ticks // baud), arrive)
            end += threshold
        self._free_ticks = start_ticks + len(data) * BYTE_TICKS
        self._gathered = chunk[end - threshold :]
        self._silence += 1
        if self._gathered:
            silent_us = -(-(self._free_ticks + BYTE_TICKS) // baud)
            self._events.at(silent_us, partial(self._hand_over, self._silence, sent_us))

    def _hand_over(self, silence: int, sent_us: int, now_us: int) -> None:
        if silence == self._silence:
            chunk, self._gathered = self._gathered, b""
            self._arrived(chunk, sent_us, now_us)

    def spoil(self, data: bytes, rate: float) -> bytes:
        """Return the data with bit errors at drawn distances."""
        if rate != self._rate:
            self._rate = rate
            self._good_bits = self._draw() if rate else 0
        if not rate:
            return data
        size = 8 * len(data)
        spoilt, bit = bytearray(data), self._good_bits
        while bit < size:
            spoilt[bit >> 3] ^= 1 << (bit & 7)
            self.counters.wrong_bits += 1
            bit += 1 + self._draw()
        self._good_bits = bit - size
        return bytes(spoilt)

    def _draw(self) -> int:
        """Return the number of good bits before a wrong one: the geometric distribution, inverted."""
        if self._rate == 1.0:
            return 0
        return int(min(log_1p(-self._rng.random()) / log_1p(-self._rate), NEVER))


class VirtualSerial:
    """Carries bytes in both directions; `connect` it before use.

    Plain attributes that may be changed in flight: `connected` (the cable), `uplink_bit_error_rate`,
    `downlink_bit_error_rate` (0..1).
    """

    def __init__(self, config: SerialConfig, events: EventQueue, rng: np.random.Generator) -> None:
        self.connected: bool = True
        self.uplink_bit_error_rate = config.uplink_bit_error_rate
        self.downlink_bit_error_rate = config.downlink_bit_error_rate
        self._config, self._events = config, events
        self._up = _Line(config, HOST_BUFFER, events, rng, self._arrive_up)
        self._down = _Line(config, config.transmit_buffer, events, rng, self._arrive_down)
        self.up, self.down = self._up.counters, self._down.counters
        self._received = bytearray()  # on board

    def connect(self, on_board: Callable[[int], object], on_ground: Callable[[int, bytes], object]) -> None:
        """Set the board's interrupt, after which it can `read`, and the ground's receiver (now_us, chunk)."""
        self._on_board, self._on_ground = on_board, on_ground

    def uplink(self, now_us: int, data: bytes) -> None:
        """Take bytes for the board; drop those without room at the host."""
        self._events.at(now_us + self._config.host_latency_us, partial(self._start_up, data, now_us))

    def _start_up(self, data: bytes, sent_us: int, now_us: int) -> None:
        taken = data[: self._up.room(now_us)]
        self.up.dropped_bytes += len(data) - len(taken)
        self._up.send(now_us, taken, sent_us)

    def _arrive_up(self, chunk: bytes, sent_us: int, now_us: int) -> None:
        counters = self.up
        if not self.connected:
            counters.cut_bytes += len(chunk)
            return
        taken = self._up.spoil(chunk, self.uplink_bit_error_rate)
        taken = taken[: self._config.receive_buffer - len(self._received)]
        self._received += taken
        counters.overrun_bytes += len(chunk) - len(taken)
        counters.count_delivery(len(taken), now_us - sent_us)
        self._on_board(now_us)

    @property
    def overruns(self) -> int:
        return self.up.overrun_bytes

    def read(self) -> bytes:
        """Return the bytes that arrived on board since the last call, and free them."""
        data = bytes(self._received)
        self._received.clear()
        return data

    def write(self, now_us: int, data: bytes) -> bool:
        """Take bytes for the ground; False when they do not fit into the board's transmit buffer."""
        if len(data) > self._down.room(now_us):
            self.down.dropped_bytes += len(data)
            return False
        self._down.send(now_us, data, now_us)
        return True

    def _arrive_down(self, chunk: bytes, sent_us: int, now_us: int) -> None:
        if not self.connected:
            self.down.cut_bytes += len(chunk)
            return
        chunk = self._down.spoil(chunk, self.downlink_bit_error_rate)
        self._events.at(now_us + self._config.host_latency_us, partial(self._deliver_down, chunk, sent_us))

    def _deliver_down(self, chunk: bytes, sent_us: int, now_us: int) -> None:
        self.down.count_delivery(len(chunk), now_us - sent_us)
        self._on_ground(now_us, chunk)
