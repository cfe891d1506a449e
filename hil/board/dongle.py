"""A Crazyradio dongle: vendor requests in, one packet and its acknowledgement per exchange, a board within reach.

The host is real software, so every exchange is simulated, including empty polls; `hil.emulator.crazyflie.shockburst` loses
packets. With acknowledgements off, a packet is sent once and the host reads nothing. A board on its channel takes a
broadcast packet and does not answer.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from hil.emulator.crazyflie.config import RadioConfig
from hil.emulator.crazyflie.nrf51 import RATES, AirSettings, Nrf51
from hil.emulator.crazyflie.shockburst import MAX_PACKET, RETRIES, Air, RadioExchange, Transmitter
from hil.emulator.events import EventQueue

Answer = Callable[[int, bytes], None]  # (now_us, what the host reads from the dongle)

SET_CHANNEL, SET_ADDRESS, SET_RATE, SET_RETRIES, SET_ACKS = 0x01, 0x02, 0x03, 0x06, 0x10  # vendor requests
ACKNOWLEDGED = 0x01  # status byte; retries are in its upper half
NOT_ACKNOWLEDGED = b"\x00"
NOWHERE = Air(1.0, 1.0, 0.0, 0.0, 0.0, 0.0)  # to an absent board


class VirtualDongle:
    """One dongle that reaches a board, unless that is tuned elsewhere."""

    def __init__(
        self, config: RadioConfig, events: EventQueue, rng: np.random.Generator, board: Nrf51
    ) -> None:
        self._rng = rng
        self._transmitter = Transmitter(config, events, rng.random)
        self._board = board
        self._settings = AirSettings(2, 2_000_000, b"\xe7" * 5)
        self._retries = RETRIES
        self.acknowledges = True  # then each packet is answered

    def control(self, request: int, value: int, data: bytes) -> None:
        """Execute a vendor request; accept those without effect here (power, retry delay, carrier)."""
        if request == SET_CHANNEL:
            self._settings = replace(self._settings, channel=value)
        elif request == SET_ADDRESS and len(data) == 5:
            self._settings = replace(self._settings, address=data)
        elif request == SET_RATE and value < len(RATES):
            self._settings = replace(self._settings, bits_per_second=RATES[value])
        elif request == SET_RETRIES:
            self._retries = value & 0x0F
        elif request == SET_ACKS:
            self.acknowledges = bool(value)

    def transmit(self, now_us: int, packet: bytes, answer: Answer) -> None:
        """Send a packet of 1..32 bytes; call `answer` once, unless acknowledgements are switched off."""
        if not self.acknowledges and len(packet) > MAX_PACKET:  # two packets in one transfer
            half = len(packet) // 2
            self.transmit(now_us, packet[:half], answer)
            packet = packet[half:]
        packet = packet[:MAX_PACKET]
        settings, acks = self._settings, self.acknowledges
        retries = self._retries if acks else 0
        board, size = self._board, len(packet)
        if packet and board.hears_all(settings):
            overhear = partial(board.overhear, data=packet)
            ether = (size, settings.bits_per_second, board.air, retries)
            self._transmitter.send(now_us, RadioExchange(*ether, overhear, lambda *_: None))
        payload: bytes | None = None  # of the last answer
        air = board.air if packet and board.hears(settings) else NOWHERE

        def hear(now_us: int) -> int | None:
            nonlocal payload
            payload = None
            if air is NOWHERE or not board.hears(settings):  # switched off meanwhile
                return None
            payload = board.hear(now_us, packet)
            return len(payload) if acks else None

        def ended(repetitions: int | None, now_us: int) -> None:
            if repetitions is not None and payload is not None:
                answer(now_us, bytes((ACKNOWLEDGED | repetitions << 4,)) + payload)
            elif acks:
                answer(now_us, NOT_ACKNOWLEDGED)

        jitter_us = int(self._rng.random() * air.uplink_jitter_us) if air.uplink_jitter_us else 0
        exchange = RadioExchange(size, settings.bits_per_second, air, retries, hear, ended)
        self._transmitter.send(now_us + jitter_us, exchange)
