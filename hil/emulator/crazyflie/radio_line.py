"""The nRF51's end of the serial line to the STM32: radio packets, battery, signal strength, deck memories, commands.

The radio itself is separate: `hil.emulator.crazyflie.nrf51` for real programs, a modelled one in lockstep. Facts: Bitcraze's
crazyflie2-nrf-firmware.
"""

import struct
from typing import Protocol

from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.decks import Decks
from hil.emulator.crazyflie.nrf51 import SIGNAL_DBM, is_to_peers
from hil.emulator.crazyflie.parts import RADIO_BUSY, SYSLINK_USART
from hil.emulator.stm32f405.chip import Chip
from hil.emulator.stm32f405.processor import ChipProcessor

REPORT_PERIOD_US = 10_000  # of battery and signal strength, once the STM32 has asked for them
# On an idle radio link; the nRF51 passes every packet on, also an empty one. Not between the packets of a busy link: a host
# polls once per exchange, and more than one frame per tick overflows the queue of a Crazyflie that starts, whose firmware
# switches to SYSLINK only at its tick after a transfer (its DMA interrupt gives a semaphore and does not yield).
POLL_PERIOD_US = 2_000
GATE_US = 3_000_000  # without the command READY the radio starts this long after a reset
CONSOLE, CONSOLE_MASK = 0x00, 0xF3
ECHOED = (
    syslink.RADIO_CHANNEL,
    syslink.RADIO_RATE,
    syslink.RADIO_ADDRESS,
    syslink.RADIO_POWER,
    syslink.RADIO_READY,
)
NOT_PLUGGED_IN, NO_CURRENT_A, ROOM_C = (
    0,
    0.0,
    25.0,
)  # flags, charge current and temperature of the battery's report
VERSION = b"emulated (CF21)\0"


class Outside(Protocol):
    """Where the radio chip's other pins lead to."""

    def read_battery_mv(self) -> int:
        """Return the supply voltage."""

    def radio_send(self, data: bytes) -> bool:
        """Take a packet to the host; False while the radio's queue is full."""

    def radio_command(self, kind: int, data: bytes) -> None:
        """Take a command to the radio chip, as in syslink."""

    def debug_write(self, text: str) -> None:
        """Take a line of the console."""


class RadioLine:
    """Serves the line of one board; with `polls`, empty radio packets arrive by themselves once the radio has started."""

    def __init__(
        self, chip: Chip, processor: ChipProcessor, decks: Decks, outside: Outside, polls: bool
    ) -> None:
        self._chip, self._decks, self._outside = chip, decks, outside
        self._waiting: list[bytes] = []  # for the radio, whose queue is full
        self._signal = 0  # of the last packet
        self._line = b""  # of the console
        self._reporting = False
        self.reset(0)
        processor.every(REPORT_PERIOD_US, self._report)
        if polls:
            processor.every(POLL_PERIOD_US, self._poll_idle_link)

    def reset(self, now_us: int) -> None:
        """Poll only when the STM32 is ready again: after a reset its host has lost it."""
        self._decoder = syslink.Decoder()
        self._heard_us = now_us + GATE_US - POLL_PERIOD_US  # the last packet

    def received(self, data: bytes, broadcast: bool = False) -> None:
        """Deliver a packet of the radio, and fetch one."""
        self._flush()
        self._heard_us, self._signal = self._chip.now_us, SIGNAL_DBM
        if is_to_peers(data):
            kind = syslink.PEER_BROADCAST if broadcast else syslink.PEER
            data = bytes((data[1] & 0x0F, SIGNAL_DBM)) + data[2:]  # its port comes first
        else:
            kind = syslink.RAW_BROADCAST if broadcast else syslink.RAW
        self._feed(kind, data)

    def sent(self) -> None:
        """Do what the STM32 has asked for."""
        for kind, data in self._decoder.decode_frames(self._chip.sent(SYSLINK_USART)):
            self._execute(kind, data)

    def _execute(self, kind: int, data: bytes) -> None:
        if kind == syslink.RAW and data:
            if data[0] & CONSOLE_MASK == CONSOLE:
                self._print(data[1:])
            self._waiting.append(data)
            self._flush()
            return
        if syslink.SCAN_MEMORIES <= kind <= syslink.WRITE_MEMORY:
            self._feed(kind, self._decks.answer(kind, data))
        elif kind == syslink.VERSION:
            self._feed(kind, VERSION)
        elif kind == syslink.BATTERY_REPORTS:
            self._reporting = True
        elif kind in ECHOED:
            self._feed(kind, data)
        if kind == syslink.RADIO_READY:
            self._heard_us = self._chip.now_us
        self._outside.radio_command(kind, data)

    def _flush(self) -> None:
        """Hand packets to the radio; while its queue is full it takes no more bytes of the STM32."""
        while self._waiting and self._outside.radio_send(self._waiting[0]):
            self._waiting.pop(0)
        self._chip.pin(*RADIO_BUSY, bool(self._waiting))

    def _print(self, text: bytes) -> None:
        *lines, self._line = (self._line + text).split(b"\n")
        for line in lines:
            self._outside.debug_write(line.decode(errors="replace"))

    def _poll_idle_link(self, now_us: int) -> None:
        if now_us - self._heard_us >= POLL_PERIOD_US:
            self.received(syslink.EMPTY)

    def _report(self, now_us: int) -> None:
        if self._reporting:
            volts = self._outside.read_battery_mv() / 1000
            self._feed(syslink.BATTERY, struct.pack("<Bfff", NOT_PLUGGED_IN, volts, NO_CURRENT_A, ROOM_C))
            self._feed(syslink.SIGNAL, bytes((self._signal,)))

    def _feed(self, kind: int, data: bytes) -> None:
        self._chip.feed(SYSLINK_USART, syslink.encode(kind, data))
