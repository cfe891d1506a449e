"""A Crazyradio dongle: vendor requests in, one packet and its acknowledgement per exchange, boards that may hear it.

It repeats a packet until it is acknowledged, up to the host's setting; each try and each answer can be lost on its
own. Times on the air, turn-rounds, retry delays and USB transfers are those of `virtual_radio`; here the host is real
software, so every exchange happens, empty polls included. Radios that send at the same time do not disturb each other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from hil.devices.config import RadioConfig
from hil.devices.nrf51 import Nrf51, RadioSettings
from hil.devices.radio import MAX_PACKET, RETRIES, TURN_ROUND_US, air_us
from hil.events import EventQueue

Answer = Callable[[int, bytes], None]  # (now_us, what the host reads from the dongle)

SET_CHANNEL, SET_ADDRESS, SET_RATE, SET_RETRIES, SET_ACKS = 0x01, 0x02, 0x03, 0x06, 0x10  # vendor requests
RATES = (250_000, 1_000_000, 2_000_000)  # by number of the vendor request
ACKNOWLEDGED = 0x01  # status byte; retries are in its upper half
NOT_ACKNOWLEDGED = b"\x00"


@dataclass(slots=True)
class DongleCounters:
    """Exchanges of one dongle."""

    exchanges: int = 0
    retried: int = 0
    unanswered: int = 0


@dataclass(slots=True)
class _Exchange:
    """A packet on its way; `tries` counts those that were begun."""

    packet: bytes
    board: Nrf51
    answer: Answer
    again_us: int
    tries_left: int
    tries: int = 0


class VirtualDongle:
    """One dongle that reaches `boards`, each through its own air."""

    def __init__(
        self, config: RadioConfig, events: EventQueue, rng: np.random.Generator, boards: Sequence[Nrf51]
    ) -> None:
        self.counters = DongleCounters()
        self._config = config
        self._events = events
        self._rng = rng
        self._boards = boards
        self._settings = RadioSettings(2, 2_000_000, b"\xe7" * 5)
        self._retries = RETRIES
        self._acks = True

    def control(self, request: int, value: int, data: bytes) -> None:
        """Execute a vendor request; those that change nothing here (power, retry delay, carrier) are accepted."""
        old = self._settings
        if request == SET_CHANNEL:
            self._settings = RadioSettings(value, old.bits_per_second, old.address)
        elif request == SET_ADDRESS and len(data) == 5:
            self._settings = RadioSettings(old.channel, old.bits_per_second, data)
        elif request == SET_RATE and value < len(RATES):
            self._settings = RadioSettings(old.channel, RATES[value], old.address)
        elif request == SET_RETRIES:
            self._retries = value & 0x0F
        elif request == SET_ACKS:
            self._acks = bool(value)

    def transmit(self, now_us: int, packet: bytes, answer: Answer) -> None:
        """Send a packet of 1..32 bytes; `answer` is called once, unless acknowledgements are switched off."""
        packet = packet[:MAX_PACKET]
        self.counters.exchanges += 1
        rate = self._settings.bits_per_second
        heard_us = self._config.usb_us + TURN_ROUND_US + air_us(len(packet), rate)
        again_us = TURN_ROUND_US + air_us(len(packet), rate) + (1500 if rate == RATES[0] else 500)
        board = next((board for board in self._boards if board.hears(self._settings)), None)
        if board is None or not packet:
            self._give_up(now_us + 2 * self._config.usb_us + (self._retries + 1) * again_us, answer)
            return
        exchange = _Exchange(packet, board, answer, again_us, self._retries + 1)
        self._try(now_us + heard_us + self._jitter_us(board.air.uplink_jitter_us), exchange)

    def _try(self, heard_us: int, exchange: _Exchange) -> None:
        """Repeat the packet until the board hears it."""
        loss = exchange.board.air.lost_up(len(exchange.packet))
        while exchange.tries_left:
            exchange.tries_left -= 1
            exchange.tries += 1
            if not self._happens(loss):
                self._events.at(heard_us, lambda now_us: self._heard(now_us, exchange))
                return
            heard_us += exchange.again_us
        self._give_up(heard_us + self._config.usb_us, exchange.answer)

    def _heard(self, now_us: int, exchange: _Exchange) -> None:
        """The board answers; the dongle hears that, or tries again."""
        if not exchange.board.hears(self._settings):  # switched off meanwhile
            self._give_up(now_us + exchange.tries_left * exchange.again_us, exchange.answer)
            return
        payload = exchange.board.hear(now_us, exchange.packet)
        if not self._acks:
            return
        if self._happens(exchange.board.air.lost_down(len(payload))):
            self._try(now_us + exchange.again_us, exchange)
            return
        retries = exchange.tries - 1
        self.counters.retried += retries
        jitter_us = self._jitter_us(self._config.usb_jitter_us + exchange.board.air.downlink_jitter_us)
        back_us = TURN_ROUND_US + air_us(len(payload), self._settings.bits_per_second) + self._config.usb_us
        status = bytes((ACKNOWLEDGED | retries << 4,))
        self._events.at(now_us + back_us + jitter_us, lambda t_us: exchange.answer(t_us, status + payload))

    def _give_up(self, at_us: int, answer: Answer) -> None:
        self.counters.unanswered += 1
        if self._acks:
            self._events.at(at_us, lambda now_us: answer(now_us, NOT_ACKNOWLEDGED))

    def _jitter_us(self, limit_us: float) -> int:
        return int(self._rng.random() * limit_us) if limit_us else 0

    def _happens(self, chance: float) -> bool:
        return chance > 0.0 and self._rng.random() < chance
