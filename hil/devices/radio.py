"""The Crazyradio between ground station and board: a polling dongle, Enhanced ShockBurst, safelink.

The dongle asks without pause. One exchange carries at most one packet each way: the host hands a packet (or
an empty poll) to the dongle over USB, the dongle sends it, the board answers with an acknowledgement that
carries the head of its queue, and that goes back to the host. What is lost is repeated with the same contents
by the dongle (3 times), then by the host; safelink's counters make that exactly once and in order.

Exchanges that carry something are events. The empty polls in between are not: when something is ready, the
poll that it meets is computed (the first of the pause) or drawn (any later one: the host's jitter has made
its phase uniform). Figures: Crazyradio, nRF24L01+ and cflib, reference/crazyflie-clients-and-protocol.md part
3. Connecting and disconnecting are not modelled: the host repeats for ever.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache, partial

import numpy as np

from firmware_py.elementary import power
from hil.devices.config import RadioConfig
from hil.events import EventQueue

Receiver = Callable[[int, bytes], object]  # (now_us, packet)

MAX_PACKET = 32  # bytes, of the nRF24
RETRIES = 3  # by the dongle (ARC), as cflib sets it
TURN_ROUND_US = 130  # nRF24: settling before each transmission
FRAME_BITS = 73  # preamble 8, address 40, control field 9, CRC 16
POLL_BYTES = 1  # an empty poll is one header byte
EMPTY_ACK_BYTES = 3  # with nothing else to say the nRF51 reports its signal strength
SYSLINK_FRAME_BYTES = 6  # start 2, type, length, checksum 2
SYSLINK_BYTE_US = 10  # the line between nRF51 and STM32: 1 Mbaud, 10 bits per byte


@dataclass(slots=True)
class Air:
    """What the air does to packets of one board, whoever talks to it; faults change it in flight."""

    uplink_loss: float  # per try, 0..1
    downlink_loss: float
    uplink_bit_error_rate: float  # 0..1
    downlink_bit_error_rate: float
    uplink_jitter_us: float
    downlink_jitter_us: float

    @classmethod
    def of(cls, config: RadioConfig) -> Air:
        """Return what the profile says."""
        return cls(*(getattr(config, field.name) for field in fields(cls)))

    def lost_up(self, size: int) -> float:
        """The chance that a packet of `size` bytes to the board is lost."""
        return packet_loss(self.uplink_loss, self.uplink_bit_error_rate, size)

    def lost_down(self, size: int) -> float:
        """The chance that an answer of `size` bytes is lost."""
        return packet_loss(self.downlink_loss, self.downlink_bit_error_rate, size)


@dataclass(slots=True)
class DirectionCounters:
    """Packets of one direction. Sent packets are delivered, waiting, under way, or (uplink) dropped."""

    sent: int = 0  # accepted
    dropped: int = 0  # uplink: the oldest was dropped; downlink: the newest was refused
    delivered: int = 0
    queue_high_water: int = 0
    latency_sum_us: int = 0  # of the delivered, from sender to receiver
    latency_max_us: int = 0

    def count_delivery(self, latency_us: int) -> None:
        """One more packet has arrived."""
        self.delivered += 1
        self.latency_sum_us += latency_us
        if latency_us > self.latency_max_us:
            self.latency_max_us = latency_us


@dataclass(slots=True)
class AirCounters:
    """Exchanges that were simulated: those that carried something, and empty ones repeated before them."""

    exchanges: int = 0
    retried: int = 0  # repetitions by the dongle
    unanswered: int = 0  # exchanges in which all tries were lost


def air_us(size: int, bits_per_second: int) -> int:
    """Time on the air of a packet with `size` bytes of payload."""
    return (FRAME_BITS + 8 * size) * 1_000_000 // bits_per_second


def exchange_us(up_size: int, down_size: int, bits_per_second: int) -> int:
    """A packet and its answer, with both turn-rounds, without USB."""
    return 2 * TURN_ROUND_US + air_us(up_size, bits_per_second) + air_us(down_size, bits_per_second)


def packet_loss(loss: float, bit_error_rate: float, size: int) -> float:
    """The chance that a packet with `size` bytes of payload is lost as a whole or by a wrong bit."""
    if not bit_error_rate:
        return loss
    return 1.0 - (1.0 - loss) * power(1.0 - bit_error_rate, FRAME_BITS + 8 * size)


@dataclass(slots=True)
class _Waiting:
    """A packet in a queue; queues are first in, first out."""

    ready_us: int  # not before this instant
    sent_us: int
    data: bytes


class VirtualRadio:
    """Carries packets of 1..32 bytes both ways through `medium`; `connect` it before use."""

    def __init__(
        self, config: RadioConfig, events: EventQueue, rng: np.random.Generator, medium: Air | None = None
    ) -> None:
        self.medium = medium or Air.of(config)
        self.up = DirectionCounters()
        self.down = DirectionCounters()
        self.air = AirCounters()

        self._config = config
        self._events = events
        self._rng = rng
        self._uniforms: list[float] = []
        # Tables over the size of a packet: time on the air; from the begin of an exchange until the board has
        # heard it; from one try to the next (the dongle's ARD counts from the end of its packet).
        retry_delay_us = 1500 if config.bits_per_second == 250_000 else 500
        self._air_us = [air_us(size, config.bits_per_second) for size in range(MAX_PACKET + 1)]
        self._heard_after_us = [config.usb_us + TURN_ROUND_US + on_air_us for on_air_us in self._air_us]
        self._again_us = [TURN_ROUND_US + on_air_us + retry_delay_us for on_air_us in self._air_us]

        self._up_queue: deque[_Waiting] = deque()
        self._down_queue: deque[_Waiting] = deque()
        self._busy = False  # an exchange is planned or under way
        self._idle_since_us = 0
        # Of the exchange under way; kept until it is answered.
        self._uploading: _Waiting | None = None
        self._heard = False  # the board has it already
        self._downloading = False  # the answer carries the head of the board's queue
        self._tries_left = 0
        self._given_up_us = 0

    def connect(self, on_board: Receiver, on_ground: Receiver) -> None:
        """Name the receivers of the uplink and of the downlink."""
        self._on_board = on_board
        self._on_ground = on_ground

    def uplink(self, now_us: int, data: bytes) -> None:
        """Take a packet for the board; when the host's queue is full its oldest packet is dropped."""
        _check_size(data)
        queue, counters = self._up_queue, self.up
        counters.sent += 1
        if len(queue) >= self._config.uplink_queue:
            queue.popleft()
            counters.dropped += 1
        delay_us = int(self._uniform() * self.medium.uplink_jitter_us) if self.medium.uplink_jitter_us else 0
        queue.append(_Waiting(now_us + delay_us, now_us, data))
        counters.queue_high_water = max(counters.queue_high_water, len(queue))
        if delay_us:
            self._events.at(now_us + delay_us, self._wake_for_uplink)
        self._wake_for_uplink(now_us)

    def downlink(self, now_us: int, data: bytes) -> bool:
        """Take a packet for the ground; False when the nRF51's queue is full and the sender has to wait."""
        _check_size(data)
        queue, counters = self._down_queue, self.down
        if len(queue) >= self._config.downlink_queue:
            counters.dropped += 1
            return False
        counters.sent += 1
        ready_us = now_us + syslink_us(data)
        queue.append(_Waiting(ready_us, now_us, data))
        counters.queue_high_water = max(counters.queue_high_water, len(queue))
        if not self._busy:
            start_us, end_us, answered = self._poll_at(ready_us)
            if ready_us <= start_us + self._heard_after_us[POLL_BYTES]:  # in time for this poll's answer
                self._plan(start_us, True, now_us)
            else:
                self._plan(end_us, answered, now_us)
        return True

    # The host: when the next exchange begins, and with what.

    def _wake_for_uplink(self, now_us: int) -> None:
        """A packet may be ready at the host; on an idle link it follows the empty poll under way."""
        if not self._busy and self._up_queue and self._up_queue[0].ready_us <= now_us:
            _, end_us, answered = self._poll_at(now_us)
            self._plan(end_us, answered, now_us)

    def _plan(self, start_us: int, answered: bool, now_us: int) -> None:
        """Begin at `start_us`; if the poll before was not answered, the host has to repeat it first."""
        self._busy = True
        if start_us > now_us:
            self._events.at(start_us, self._begin if answered else self._exchange)
        else:  # the poll has begun, and empty
            self._exchange(start_us)

    def _begin(self, now_us: int) -> None:
        """The host is free: it takes the packet that is ready, if any."""
        if self._up_queue and self._up_queue[0].ready_us <= now_us:
            self._uploading = self._up_queue.popleft()
        self._exchange(now_us)

    def _poll_at(self, t_us: int) -> tuple[int, int, bool]:
        """The empty poll under way at `t_us` on an idle link: its begin, its end, whether it is answered."""
        config = self._config
        host_us = 2 * config.usb_us + config.usb_jitter_us // 2
        length_us = host_us + exchange_us(POLL_BYTES, EMPTY_ACK_BYTES, config.bits_per_second)
        since_us, answered = self._idle_since_us, True
        if t_us >= since_us + length_us:
            heard = 1.0 - self.medium.lost_up(POLL_BYTES)
            lost = 1.0 - heard * (1.0 - self.medium.lost_down(EMPTY_ACK_BYTES))
            if lost:
                lengths, weights, total = _polls_met(lost, length_us, host_us, self._again_us[POLL_BYTES])
                rest, kind = self._uniform() * total, 0
                while kind <= RETRIES and rest >= weights[kind]:
                    rest -= weights[kind]
                    kind += 1
                length_us, answered = lengths[kind], kind <= RETRIES
            since_us = t_us - int(self._uniform() * length_us)
        return since_us, since_us + length_us, answered

    # One exchange: up to 1 + RETRIES tries, each a packet and its answer. Either can be lost.

    def _exchange(self, start_us: int) -> None:
        """Try until the board hears the packet."""
        self.air.exchanges += 1
        size = self._up_size()
        again_us, loss = self._again_us[size], self.medium.lost_up(size)
        self._given_up_us = start_us + 2 * self._config.usb_us + (RETRIES + 1) * again_us + self._usb_jitter()
        for failed in range(RETRIES + 1):
            if not self._happens(loss):
                self._tries_left = RETRIES - failed
                self._events.at(start_us + self._heard_after_us[size] + failed * again_us, self._hear)
                return
        self._give_up()

    def _hear(self, now_us: int) -> None:
        """The board hears the packet, passes it on once, and answers; try on until the dongle hears that."""
        if self._uploading is not None and not self._heard:
            self._heard = True
            deliver = partial(self._deliver_up, self._uploading)
            self._events.at(now_us + syslink_us(self._uploading.data), deliver)
        if self._down_queue and self._down_queue[0].ready_us <= now_us:
            self._downloading = True
        size = self._up_size()
        ack_size = len(self._down_queue[0].data) if self._downloading else EMPTY_ACK_BYTES
        loss, ack_loss = self.medium.lost_up(size), self.medium.lost_down(ack_size)
        for failed in range(self._tries_left + 1):
            heard = failed == 0 or not self._happens(loss)
            if heard and not self._happens(ack_loss):
                self.air.retried += RETRIES - self._tries_left + failed
                answer_us = TURN_ROUND_US + self._air_us[ack_size]
                back_us = answer_us + self._config.usb_us + self._usb_jitter()
                self._events.at(now_us + failed * self._again_us[size] + back_us, self._answered)
                return
        self._give_up()

    def _give_up(self) -> None:
        """All tries were lost: the host repeats the exchange with the same contents."""
        self.air.retried += RETRIES
        self.air.unanswered += 1
        self._events.at(self._given_up_us, self._exchange)

    def _answered(self, now_us: int) -> None:
        """The answer is at the host: the exchange is complete in both directions."""
        received = self._down_queue.popleft() if self._downloading else None
        self._uploading, self._heard, self._downloading = None, False, False
        if self._down_queue or (self._up_queue and self._up_queue[0].ready_us <= now_us):
            self._begin(now_us)
        else:
            self._busy = False
            self._idle_since_us = now_us
        if received is not None:
            self.down.count_delivery(now_us - received.sent_us)
            self._on_ground(now_us, received.data)

    def _deliver_up(self, packet: _Waiting, now_us: int) -> None:
        self.up.count_delivery(now_us - packet.sent_us)
        self._on_board(now_us, packet.data)

    # Times and chances.

    def _up_size(self) -> int:
        return POLL_BYTES if self._uploading is None else len(self._uploading.data)

    def _usb_jitter(self) -> int:
        jitter_us = self._config.usb_jitter_us + self.medium.downlink_jitter_us
        return int(self._uniform() * jitter_us) if jitter_us else 0

    def _happens(self, chance: float) -> bool:
        return chance > 0.0 and self._uniform() < chance

    def _uniform(self) -> float:
        """The next number of 0..1, drawn in blocks: one call of numpy costs as much as fifty numbers."""
        if not self._uniforms:
            self._uniforms = self._rng.random(256).tolist()
        return self._uniforms.pop()


@lru_cache(maxsize=8)
def _polls_met(
    lost: float, length_us: int, host_us: int, again_us: int
) -> tuple[tuple[int, ...], tuple[float, ...], float]:
    """Lengths [us] of polls by number of repetitions, and how likely one meets them: by frequency and by length."""
    lengths = (
        *(length_us + tries * again_us for tries in range(RETRIES + 1)),
        host_us + (RETRIES + 1) * again_us,
    )
    weights = (
        *((1.0 - lost) * power(lost, tries) * lengths[tries] for tries in range(RETRIES + 1)),
        power(lost, RETRIES + 1) * lengths[-1],
    )
    return lengths, weights, sum(weights)


def syslink_us(data: bytes) -> int:
    """Between nRF51 and STM32."""
    return (len(data) + SYSLINK_FRAME_BYTES) * SYSLINK_BYTE_US


def _check_size(data: bytes) -> None:
    if not 1 <= len(data) <= MAX_PACKET:
        raise ValueError(f"a radio packet of {len(data)} bytes: 1..{MAX_PACKET} are possible")
