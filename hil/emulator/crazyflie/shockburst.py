"""Enhanced ShockBurst between a dongle and a board: one packet up, and in its acknowledgement one down.

`Transmitter` is the dongle's radio: it repeats a packet until it hears the answer. `BoardEnd` is the queue of the board's
radio chip, `Safelink` the state of the protocol that delivers every packet once. The polling host is separate:
`hil.board.radio` models one and skips empty polls, a dongle has a real one. Figures: Crazyradio, nRF24L01+, Bitcraze's
nRF51 firmware and its documentation. Radios that send at the same time do not disturb each other.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from typing import Final, NamedTuple

from firmware_py.elementary import power
from hil.emulator.crazyflie.config import RadioConfig
from hil.emulator.events import EventQueue

MAX_PACKET: Final = 32  # bytes, of the nRF24
RETRIES: Final = 3  # by the dongle (ARC), as cflib sets it
TURN_ROUND_US: Final = 130  # nRF24: settling before each transmission
FRAME_BITS: Final = 73  # preamble 8, address 40, control field 9, CRC 16
SYSLINK_FRAME_BYTES: Final = 6  # start 2, type, length, checksum 2
SYSLINK_BYTE_US: Final = 10  # the line between nRF51 and STM32: 1 Mbaud, 10 bits per byte


def air_us(size: int, bits_per_second: int) -> int:
    """Time on the air of a packet with `size` bytes of payload."""
    return (FRAME_BITS + 8 * size) * 1_000_000 // bits_per_second


def exchange_us(up_size: int, down_size: int, bits_per_second: int) -> int:
    """Duration of a packet and its answer, with both turn-rounds, without USB."""
    return 2 * TURN_ROUND_US + air_us(up_size, bits_per_second) + air_us(down_size, bits_per_second)


def again_us(size: int, bits_per_second: int) -> int:
    """From one try to the next: the dongle's retry delay (ARD) counts from the end of its packet."""
    retry_delay_us = 1500 if bits_per_second == 250_000 else 500
    return TURN_ROUND_US + air_us(size, bits_per_second) + retry_delay_us


def syslink_us(data: bytes) -> int:
    """Between nRF51 and STM32."""
    return (len(data) + SYSLINK_FRAME_BYTES) * SYSLINK_BYTE_US


def packet_loss(loss: float, bit_error_rate: float, size: int) -> float:
    """Return the chance that a packet with `size` bytes of payload is lost as a whole or by a wrong bit."""
    if not bit_error_rate:
        return loss
    return 1.0 - (1.0 - loss) * power(1.0 - bit_error_rate, FRAME_BITS + 8 * size)


@dataclass(slots=True)
class Air:
    """Losses and delays of one board's packets on the air; faults change them in flight."""

    uplink_loss: float  # per try, 0..1
    downlink_loss: float
    uplink_bit_error_rate: float  # 0..1
    downlink_bit_error_rate: float
    uplink_jitter_us: float
    downlink_jitter_us: float

    @classmethod
    def of(cls, config: RadioConfig) -> Air:
        """Return the values of the profile."""
        return cls(*(getattr(config, field.name) for field in fields(cls)))

    def lost_up(self, size: int) -> float:
        """Return the chance that a packet of `size` bytes to the board is lost."""
        return packet_loss(self.uplink_loss, self.uplink_bit_error_rate, size)

    def lost_down(self, size: int) -> float:
        """Return the chance that an answer of `size` bytes is lost."""
        return packet_loss(self.downlink_loss, self.downlink_bit_error_rate, size)


@dataclass(slots=True)
class AirCounters:
    exchanges: int = 0
    retried: int = 0  # repetitions by the dongle
    unanswered: int = 0  # exchanges in which all tries were lost


@dataclass(slots=True)
class RadioExchange:
    """A packet of `size` bytes and its answer.

    `hear(now_us)` is called whenever a try reaches the board and returns the size of its answer; None: it has none.
    `ended(repetitions, now_us)` is called once, when the host knows; None: no answer was heard.
    """

    size: int
    bits_per_second: int
    air: Air
    retries: int
    hear: Callable[[int], int | None]
    ended: Callable[[int | None, int], None]


class Transmitter:
    """The radio of a dongle, with its USB transfers; `uniform` draws from 0..1."""

    def __init__(self, config: RadioConfig, events: EventQueue, uniform: Callable[[], float]) -> None:
        self.counters = AirCounters()
        self._config = config
        self._events = events
        self._uniform = uniform

    def send(self, start_us: int, exchange: RadioExchange) -> None:
        """Take a packet from the host at `start_us`; 1 + `retries` tries at most follow, each in both directions."""
        self.counters.exchanges += 1
        size, rate, usb_us = exchange.size, exchange.bits_per_second, self._config.usb_us
        next_us = again_us(size, rate)
        given_up_us = start_us + 2 * usb_us + (exchange.retries + 1) * next_us + self._jitter_us(exchange.air)
        heard_us, loss = start_us + usb_us + TURN_ROUND_US + air_us(size, rate), exchange.air.lost_up(size)
        for tried in range(exchange.retries + 1):
            if not self._happens(loss):
                heard = partial(self._heard, exchange, tried, given_up_us)
                self._events.at(heard_us + tried * next_us, heard)
                return
        self._give_up(exchange, given_up_us)

    def _heard(self, exchange: RadioExchange, first: int, given_up_us: int, now_us: int) -> None:
        """Let the board hear the packet and answer; draw the outcome of that and of all further tries at once."""
        ack_size = exchange.hear(now_us)
        if ack_size is None:
            self._give_up(exchange, given_up_us)
            return
        loss, ack_loss = exchange.air.lost_up(exchange.size), exchange.air.lost_down(ack_size)
        for tried in range(first, exchange.retries + 1):
            if tried > first:
                now_us += again_us(exchange.size, exchange.bits_per_second)
                if self._happens(loss):
                    continue
                self._events.at(now_us, exchange.hear)
            if not self._happens(ack_loss):
                self.counters.retried += tried
                back_us = TURN_ROUND_US + air_us(ack_size, exchange.bits_per_second) + self._config.usb_us
                back_us += self._jitter_us(exchange.air)
                self._events.at(now_us + back_us, partial(exchange.ended, tried))
                return
        self._give_up(exchange, given_up_us)

    def _give_up(self, exchange: RadioExchange, at_us: int) -> None:
        self.counters.retried += exchange.retries
        self.counters.unanswered += 1
        self._events.at(at_us, partial(exchange.ended, None))

    def _jitter_us(self, air: Air) -> int:
        jitter_us = self._config.usb_jitter_us + air.downlink_jitter_us
        return int(self._uniform() * jitter_us) if jitter_us else 0

    def _happens(self, chance: float) -> bool:
        return chance > 0.0 and self._uniform() < chance


@dataclass(slots=True)
class Waiting:
    """A packet in a queue; queues are first in, first out."""

    ready_us: int  # not before this instant
    sent_us: int
    data: bytes


class Safelink(NamedTuple):
    """The state of safelink on board: one bit per direction.

    On, a packet whose bit is that of the last one is a repetition, and so is the answer to it. Off, all are new.
    """

    on: bool
    up: int = 1
    down: int = 1

    def hear(self, up: int, down: int) -> tuple[Safelink, bool, bool]:
        """Return the state after a packet with the host's bits, whether it is new, and whether the last answer arrived."""
        new, arrived = not self.on or up != self.up, not self.on or down != self.down
        return Safelink(self.on, self.up ^ new, self.down ^ arrived), new, arrived


class BoardEnd:
    """The board's half of an exchange: what it has to send.

    The head of the queue stays there until the answer that carries it has arrived, and counts towards `capacity`.
    """

    def __init__(self, capacity: int) -> None:
        self.queue: deque[Waiting] = deque()
        self._capacity = capacity
        self._answering = False  # with the head of the queue

    def put(self, packet: Waiting) -> bool:
        """Take a packet for the ground; False when the queue is full."""
        if len(self.queue) >= self._capacity:
            return False
        self.queue.append(packet)
        return True

    def confirm(self) -> Waiting | None:
        """Forget and return the packet of the last answer, which has arrived."""
        self._answering, was_answering = False, self._answering
        return self.queue.popleft() if was_answering else None

    def answer(self, now_us: int) -> bytes | None:
        """Return the packet that an answer carries now; None: it is empty."""
        if not self._answering:
            self._answering = bool(self.queue) and self.queue[0].ready_us <= now_us
        return self.queue[0].data if self._answering else None
