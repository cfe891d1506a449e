"""The Crazyradio between ground station and board in lockstep, with a modelled host that polls without pause.

One exchange carries at most one packet in each direction: the host hands a packet (or an empty poll) to the dongle over USB,
and the board's answer goes back to it. When the dongle's retries fail, the host sends the same packet again; safelink's
counters ensure delivery exactly once and in order. `hil.emulator.crazyflie.shockburst` models radio loss.

Exchanges with a payload are events. The empty polls in between are not: when a packet is ready, the current poll is
computed (the first of a pause) or drawn (any later one: the host's jitter has made its phase uniform). Connecting and
disconnecting are not modelled: the host repeats for ever.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Final

import numpy as np

from firmware_py.elementary import power
from hil.emulator.crazyflie.config import RadioConfig
from hil.emulator.crazyflie.shockburst import (
    MAX_PACKET,
    RETRIES,
    TURN_ROUND_US,
    Air,
    BoardEnd,
    RadioExchange,
    Safelink,
    Transmitter,
    Waiting,
    again_us,
    air_us,
    exchange_us,
    syslink_us,
)
from hil.emulator.events import EventQueue

Receiver = Callable[[int, bytes], object]  # (now_us, packet)

POLL_BYTES: Final = 1  # an empty poll is one header byte
EMPTY_ACK_BYTES: Final = 3  # with an empty queue the nRF51 reports its signal strength


@dataclass(slots=True)
class DirectionCounters:
    """Packets of one direction. Sent packets are delivered, waiting, in progress, or (uplink) dropped."""

    sent: int = 0  # accepted
    dropped: int = 0  # uplink: the oldest was dropped; downlink: the newest was refused
    delivered: int = 0
    queue_high_water: int = 0
    latency_sum_us: int = 0  # of the delivered, from sender to receiver
    latency_max_us: int = 0

    def count_delivery(self, latency_us: int) -> None:
        self.delivered += 1
        self.latency_sum_us += latency_us
        self.latency_max_us = max(self.latency_max_us, latency_us)


class VirtualRadio:
    """Carries packets of 1..32 bytes in both directions through `medium`; `connect` it before use."""

    def __init__(
        self,
        config: RadioConfig,
        events: EventQueue,
        rng: np.random.Generator,
        medium: Air | None = None,
        wire_us: Callable[[bytes], int] = syslink_us,
    ) -> None:
        """`wire_us`: a packet's time between the board's two chips."""
        self.medium = medium or Air.of(config)
        self._wire_us = wire_us
        self.up, self.down = DirectionCounters(), DirectionCounters()
        self._config, self._events, self._rng = config, events, rng
        self._uniforms: list[float] = []
        self._transmitter = Transmitter(config, events, self._uniform)
        self.air = self._transmitter.counters  # of the simulated exchanges
        self._board, self._safelink = BoardEnd(config.downlink_queue), Safelink(True)
        self._up_queue: deque[Waiting] = deque()
        self._busy = False  # an exchange is planned or in progress
        self._idle_since_us = 0
        self._counter = 0  # safelink's, of both directions
        self._uploading: Waiting | None = None  # kept until it is answered
        self._answer_size: int | None = None  # of the exchange in progress, once the board has heard it

    def connect(
        self, on_board: Receiver, on_ground: Receiver, on_poll: Callable[[int], object] = lambda now_us: None
    ) -> None:
        """Set the receivers of the uplink, the downlink, and empty polls that fetch a packet."""
        self._on_board, self._on_ground, self._on_poll = on_board, on_ground, on_poll

    def uplink(self, now_us: int, data: bytes) -> None:
        """Take a packet for the board; drop the oldest when the host's queue is full."""
        _check_size(data)
        queue, counters = self._up_queue, self.up
        counters.sent += 1
        if len(queue) >= self._config.uplink_queue:
            queue.popleft()
            counters.dropped += 1
        delay_us = int(self._uniform() * self.medium.uplink_jitter_us) if self.medium.uplink_jitter_us else 0
        queue.append(Waiting(now_us + delay_us, now_us, data))
        counters.queue_high_water = max(counters.queue_high_water, len(queue))
        if delay_us:
            self._events.at(now_us + delay_us, self._wake_for_uplink)
        self._wake_for_uplink(now_us)

    def downlink(self, now_us: int, data: bytes) -> bool:
        """Take a packet for the ground; False when the nRF51's queue is full and the sender must wait."""
        _check_size(data)
        counters, ready_us = self.down, now_us + self._wire_us(data)
        if not self._board.put(Waiting(ready_us, now_us, data)):
            counters.dropped += 1
            return False
        counters.sent += 1
        counters.queue_high_water = max(counters.queue_high_water, len(self._board.queue))
        if not self._busy:
            start_us, end_us, answered = self._poll_at(ready_us)
            poll_us = self._config.usb_us + TURN_ROUND_US + air_us(POLL_BYTES, self._config.bits_per_second)
            if ready_us <= start_us + poll_us:  # in time for this poll's answer
                self._plan(start_us, True, now_us)
            else:
                self._plan(end_us, answered, now_us)
        return True

    # The host: time and packet of the next exchange.

    def _wake_for_uplink(self, now_us: int) -> None:
        """Plan the exchange of a ready packet; on an idle link it follows the empty poll in progress."""
        if not self._busy and self._up_queue and self._up_queue[0].ready_us <= now_us:
            _, end_us, answered = self._poll_at(now_us)
            self._plan(end_us, answered, now_us)

    def _plan(self, start_us: int, answered: bool, now_us: int) -> None:
        """Begin at `start_us`; if the previous poll was not answered, the host repeats it first."""
        self._busy = True
        if start_us > now_us:
            self._events.at(start_us, self._begin if answered else self._exchange)
        else:  # the poll has begun without a packet
            self._exchange(start_us)

    def _begin(self, now_us: int) -> None:
        """Take the packet that is ready, if any, when the host is free."""
        if self._up_queue and self._up_queue[0].ready_us <= now_us:
            self._uploading = self._up_queue.popleft()
        self._exchange(now_us)

    def _poll_at(self, t_us: int) -> tuple[int, int, bool]:
        """Return the empty poll in progress at `t_us` on an idle link: start, end, whether answered."""
        config = self._config
        host_us = 2 * config.usb_us + config.usb_jitter_us // 2
        length_us = host_us + exchange_us(POLL_BYTES, EMPTY_ACK_BYTES, config.bits_per_second)
        since_us, answered = self._idle_since_us, True
        if t_us >= since_us + length_us:
            heard = 1.0 - self.medium.lost_up(POLL_BYTES)
            lost = 1.0 - heard * (1.0 - self.medium.lost_down(EMPTY_ACK_BYTES))
            if lost:
                repeat_us = again_us(POLL_BYTES, config.bits_per_second)
                lengths, weights, total = _polls_met(lost, length_us, host_us, repeat_us)
                rest, kind = self._uniform() * total, 0
                while kind <= RETRIES and rest >= weights[kind]:
                    rest -= weights[kind]
                    kind += 1
                length_us, answered = lengths[kind], kind <= RETRIES
            since_us = t_us - int(self._uniform() * length_us)
        return since_us, since_us + length_us, answered

    # One exchange

    def _exchange(self, start_us: int) -> None:
        """Hand a packet or poll to the dongle."""
        self._answer_size = None
        size, rate = (
            len(self._uploading.data) if self._uploading else POLL_BYTES,
            self._config.bits_per_second,
        )
        exchange = RadioExchange(size, rate, self.medium, RETRIES, self._hear, self._ended)
        self._transmitter.send(start_us, exchange)

    def _hear(self, now_us: int) -> int:
        """Receive the packet on board, pass it on if it is new, and answer; every retry gets the same answer."""
        if self._answer_size is None:
            self._safelink, new, _ = self._safelink.hear(self._counter, self._counter)
            if new and self._uploading is not None:
                deliver = partial(self._deliver_up, self._uploading)
                self._events.at(now_us + self._wire_us(self._uploading.data), deliver)
            else:
                self._on_poll(now_us)
            answer = self._board.answer(now_us)
            self._answer_size = EMPTY_ACK_BYTES if answer is None else len(answer)
        return self._answer_size

    def _ended(self, repetitions: int | None, now_us: int) -> None:
        """Complete the exchange when its answer is at the host, or repeat it."""
        if repetitions is None:
            self._exchange(now_us)
            return
        self._counter ^= 1
        self._uploading = None
        received = self._board.confirm()  # the next poll would confirm it, but may not be simulated
        if self._board.queue or (self._up_queue and self._up_queue[0].ready_us <= now_us):
            self._begin(now_us)
        else:
            self._busy = False
            self._idle_since_us = now_us
        if received is not None:
            self.down.count_delivery(now_us - received.sent_us)
            self._on_ground(now_us, received.data)

    def _deliver_up(self, packet: Waiting, now_us: int) -> None:
        self.up.count_delivery(now_us - packet.sent_us)
        self._on_board(now_us, packet.data)

    def _uniform(self) -> float:
        """Return a random number of 0..1; drawn in blocks, as one numpy call costs as much as fifty numbers."""
        if not self._uniforms:
            self._uniforms = self._rng.random(256).tolist()
        return self._uniforms.pop()


@lru_cache(maxsize=8)
def _polls_met(
    lost: float, length_us: int, host_us: int, again_us: int
) -> tuple[tuple[int, ...], tuple[float, ...], float]:
    """Return poll lengths [us] by number of repetitions, and the chance to meet each: frequency times length."""
    answered = [length_us + tries * again_us for tries in range(RETRIES + 1)]
    failed = host_us + (RETRIES + 1) * again_us
    weights = [(1.0 - lost) * power(lost, tries) * length for tries, length in enumerate(answered)]
    weights.append(power(lost, RETRIES + 1) * failed)
    return (*answered, failed), tuple(weights), sum(weights)


def _check_size(data: bytes) -> None:
    if not 1 <= len(data) <= MAX_PACKET:
        raise ValueError(f"a radio packet of {len(data)} bytes: 1..{MAX_PACKET} are possible")
