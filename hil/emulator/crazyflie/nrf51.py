"""The board's radio chip, which also controls its power: safelink, power switch, reset.

Every received packet is acknowledged with the head of a queue of 8. Safelink's counters are in the headers' two spare
bits: a repeated packet is not passed on again, and an answer is repeated until the host's counter confirms it. With an
empty queue the firmware acknowledges with its signal strength, the bootloader with an empty packet. The firmware also
receives packets to all boards on its channel, of a host or of another board, which are not acknowledged. Facts: Bitcraze's
nRF51 crazyflie2-nrf-firmware and crazyflie2-nrf-bootloader.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum, auto
from functools import partial
from typing import Protocol

from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.bootloader import HEADER, NRF51, Bootloader
from hil.emulator.crazyflie.shockburst import (
    TURN_ROUND_US,
    Air,
    BoardEnd,
    Safelink,
    Waiting,
    air_us,
    syslink_us,
)
from hil.emulator.events import EventQueue

NULL, NULL_MASK = 0xF3, 0xF3  # an empty packet's header; the other bits are safelink's
SIGNAL_STRENGTH = 1  # type of the answer that carries it
SIGNAL_DBM = 40  # below 0 dBm: a board in the same room
SAFELINK = 5  # type of the packet that switches it
RADIO = 3  # type of the packets that set channel, data rate and power of the radio itself
PEERS, PEERS_MASK = 0x80, 0xF0  # type of the packets of other boards; its lower half is their port
RESET_DELAY_US = 100_000
RETUNE_DELAY_US = 1_000  # the answer leaves first
BROADCAST = bytes.fromhex("FFE7E7E7E7")  # address of all boards
CHANNEL_MAX = 125  # higher ones are ignored; the nRF51's firmware compares the old channel by mistake
# [bit/s] by number, in vendor requests, commands and the configuration block.
RATES = (250_000, 1_000_000, 2_000_000)

ALL_OFF, SYSTEM_OFF, SYSTEM_ON, BATTERY, RESET, RESET_INIT = 0x01, 0x02, 0x03, 0x04, 0xF0, 0xFF
SET_CHANNEL, SET_RATE = 1, 2  # commands of the type RADIO; that for the power changes nothing here


@dataclass(frozen=True, slots=True)
class AirSettings:
    """The settings that two radios must share to hear each other."""

    channel: int  # 0..CHANNEL_MAX, 2400 MHz + channel
    bits_per_second: int
    address: bytes  # 5 bytes


class Power(Enum):
    """Which parts of the board are powered, and what runs."""

    OFF = auto()
    RADIO_ONLY = auto()  # the STM32 is off
    RUNNING = auto()
    BOOTLOADER = auto()  # both processors


class PoweredProcessor(Protocol):
    """The STM32 behind the radio chip."""

    @property
    def battery_V(self) -> float:
        """Supply voltage."""

    def start(self, now_us: int) -> None:
        """Boot the firmware."""

    def stop(self, now_us: int) -> None:
        """Lose power."""

    def greet(self, now_us: int) -> None:
        """Note that a new client is on the radio."""

    def received(self, now_us: int, data: bytes, broadcast: bool) -> None:
        """Take a packet from the radio."""

    def polled(self, now_us: int) -> None:
        """Note an empty packet from the radio."""

    def retuned(self, now_us: int) -> None:
        """Note that a client has moved the radio to another channel or data rate."""


ToPeers = Callable[[AirSettings, bytes], object]


@dataclass(frozen=True, slots=True)
class Band:
    """What is around a radio chip; `uniform` draws from 0..1 which packets of other boards are lost.

    `to_peers` gets the packets for other boards.
    """

    events: EventQueue
    uniform: Callable[[], float]
    to_peers: ToPeers = lambda *_: None


class Nrf51:
    """One board's radio chip; `settings` are those of its firmware, `chip` the 6 bytes of its factory address.

    `air` has the losses of packets between it and its partner.
    """

    def __init__(
        self,
        settings: AirSettings,
        chip: bytes,
        queue: int,
        band: Band,
        processor: PoweredProcessor,
        air: Air,
        wire_us: Callable[[bytes], int] = syslink_us,
    ) -> None:
        self.air = air
        self._wire_us = wire_us  # how long a packet takes to the STM32, or from it
        self.power = Power.RUNNING
        self.settings = settings  # while the firmware runs, which may change them
        self.bootloader = Bootloader()
        self.heard_us = 0  # the last packet
        self._bootloader_settings = AirSettings(0, 2_000_000, bytes((0xB1, *chip[3::-1])))
        self._chip = chip
        self._capacity = queue
        self._band, self._events = band, band.events
        self._processor = processor
        self._forget()

    def _forget(self) -> None:
        """Clear the memory."""
        self._end, self._safelink = BoardEnd(self._capacity), Safelink(False)
        self._service = b""
        self._answer = b""  # sent last, to be repeated
        self._reset_armed = False

    def tune(self, settings: AirSettings) -> None:
        """Set its radio, as a firmware that boots does."""
        self.settings = settings

    def command(self, now_us: int, kind: int, data: bytes) -> None:
        """Execute a command of the STM32, as in syslink."""
        if kind == syslink.PEER_BROADCAST and data:
            self._band.to_peers(replace(self.settings, address=BROADCAST), peer_packet(data))
        elif kind in (syslink.RADIO_CHANNEL, syslink.RADIO_RATE) and len(data) == 1:
            self.settings = self._tuned(SET_CHANNEL if kind == syslink.RADIO_CHANNEL else SET_RATE, data[0])
        elif kind == syslink.RADIO_ADDRESS and len(data) == 5:
            self.settings = replace(self.settings, address=data[::-1])
        elif kind in (syslink.SWITCH_OFF, syslink.STM32_OFF):
            power = Power.OFF if kind == syslink.SWITCH_OFF else Power.RADIO_ONLY
            self._events.at(now_us, partial(self._switch_off, power))

    def hears(self, settings: AirSettings) -> bool:
        """Whether a packet sent with these settings reaches this board."""
        if self.power is Power.OFF:
            return False
        booting = self.power is Power.BOOTLOADER
        return settings == (self._bootloader_settings if booting else self.settings)

    def hears_all(self, settings: AirSettings) -> bool:
        """Whether a packet to all boards sent with these settings reaches this board."""
        firmware = self.power in (Power.RADIO_ONLY, Power.RUNNING)
        return firmware and settings == replace(self.settings, address=BROADCAST)

    def send(self, now_us: int, data: bytes) -> bool:
        """Take a packet of the STM32 for the ground; False when the queue is full."""
        return self._end.put(Waiting(now_us + self._wire_us(data), now_us, data))

    def _reply(self, now_us: int, data: bytes) -> None:
        """Put a packet of its own into the queue."""
        self._end.put(Waiting(now_us, now_us, data))

    def hear(self, now_us: int, data: bytes) -> bytes:
        """Take a packet from the air and return the acknowledgement's payload."""
        self.heard_us = now_us
        if self.power is Power.BOOTLOADER:
            answer = self._next_answer(now_us)
            self._bootload(now_us, data)
            return answer
        kind = _kind(data)
        if kind == NRF51:
            answer = self._next_answer(now_us)
            self._command(now_us, data)
            return answer
        if is_to_peers(data):
            self._take(now_us, data, broadcast=False)
            return b""
        if kind == SAFELINK and len(data) == 3:
            self._service = data
            answer = self._next_answer(now_us)
            self._safelink = Safelink(bool(data[2]))
            self._processor.greet(now_us)
            return answer
        self._safelink, new, arrived = self._safelink.hear(data[0] >> 3 & 1, data[0] >> 2 & 1)
        if new:
            self._take(now_us, data, broadcast=False)
        return self._next_answer(now_us) if arrived else self._answer

    def hear_peer(self, now_us: int, settings: AirSettings, packet: bytes) -> None:
        """Let a packet of another board arrive, unless it is lost."""
        if self._band.uniform() >= self.air.lost_up(len(packet)):
            heard_us = now_us + TURN_ROUND_US + air_us(len(packet), settings.bits_per_second)
            self._events.at(heard_us, partial(self._take_of_peer, settings, packet))

    def _take_of_peer(self, settings: AirSettings, packet: bytes, now_us: int) -> None:
        if self.hears_all(settings):
            self.overhear(now_us, packet)

    def overhear(self, now_us: int, data: bytes) -> None:
        """Take a packet to all boards from the air."""
        if _kind(data) == NRF51:
            self._command(now_us, data)
        else:
            self._take(now_us, data, broadcast=True)

    def _take(self, now_us: int, data: bytes, broadcast: bool) -> None:
        """Execute a packet of the firmware."""
        if _kind(data) == RADIO and len(data) > 3:
            self._events.at(now_us + RETUNE_DELAY_US, partial(self._retune, data[2], data[3]))
        elif len(data) > 1 or data[0] & NULL_MASK != NULL:
            self._events.at(now_us + self._wire_us(data), partial(self._pass_on, data, broadcast))
        elif self.power is Power.RUNNING:
            self._processor.polled(now_us)

    def _retune(self, command: int, value: int, now_us: int) -> None:
        """Set the radio until the next start of the processor, which sets it to the values in its EEPROM."""
        wanted = self._tuned(command, value)
        if wanted != self.settings:
            self.settings = wanted
            self._processor.retuned(now_us)

    def _tuned(self, command: int, value: int) -> AirSettings:
        """Return its settings after a command, unchanged by a wrong one."""
        if command == SET_CHANNEL and value <= CHANNEL_MAX:
            return replace(self.settings, channel=value)
        if command == SET_RATE and value < len(RATES):
            return replace(self.settings, bits_per_second=RATES[value])
        return self.settings

    def _next_answer(self, now_us: int) -> bytes:
        """Return the answer after the one that has arrived."""
        down = self._safelink.down << 2
        self._end.confirm()
        if self._service:
            self._answer, self._service = self._service, b""
        elif packet := self._end.answer(now_us):
            counted = bytes((packet[0] & NULL_MASK | down,)) + packet[1:]
            self._answer = counted if self._safelink.on else packet
        elif self.power is Power.BOOTLOADER:
            self._answer = b""
        else:
            self._answer = bytes((NULL | down, SIGNAL_STRENGTH, SIGNAL_DBM))
        return self._answer

    def _pass_on(self, data: bytes, broadcast: bool, now_us: int) -> None:
        if self.power is Power.RUNNING:
            self._processor.received(now_us, data, broadcast)

    # Power and resets

    def _command(self, now_us: int, data: bytes) -> None:
        """Execute a command to the nRF51 itself."""
        command = data[2] if len(data) > 2 else None
        if command == RESET_INIT:
            self._reset_armed = True
            self._reply(now_us, bytes((HEADER, NRF51, RESET_INIT)) + self._chip)
        elif command == RESET and len(data) == 4 and self._reset_armed:
            self._reset_later(now_us, data)
        elif command == ALL_OFF:
            self._switch_off(Power.OFF, now_us)
        elif command == SYSTEM_OFF and self.power is Power.RUNNING:
            self._switch_off(Power.RADIO_ONLY, now_us)
        elif command == SYSTEM_ON and self.power is Power.RADIO_ONLY:
            self._start(now_us)
        elif command == BATTERY:
            volts = struct.pack("<f", self._processor.battery_V)
            self._reply(now_us, bytes((HEADER, NRF51, BATTERY)) + volts)

    def _bootload(self, now_us: int, data: bytes) -> None:
        """Execute a packet in the bootloader."""
        if data[:3] == bytes((HEADER, NRF51, RESET_INIT)):
            self._reply(now_us, data[:3] + self._chip)
        elif data[:3] == bytes((HEADER, NRF51, RESET)):
            self._reset_later(now_us, data)
        elif (reply := self.bootloader.answer(data)) is not None:
            self._reply(now_us, reply)

    def _reset_later(self, now_us: int, data: bytes) -> None:
        """Reset, into the bootloader if the command's argument is 0."""
        into_bootloader = len(data) > 3 and data[3] == 0
        self._events.at(now_us + RESET_DELAY_US, partial(self._reset, into_bootloader))

    def _reset(self, into_bootloader: bool, now_us: int) -> None:
        if self.power is Power.OFF:
            return
        self._stop_processor(now_us)
        self._forget()
        if into_bootloader:
            self.power = Power.BOOTLOADER
        else:
            self._start(now_us)

    def _switch_off(self, power: Power, now_us: int) -> None:
        self._stop_processor(now_us)
        self.power = power

    def _stop_processor(self, now_us: int) -> None:
        if self.power is Power.RUNNING:
            self._processor.stop(now_us)

    def _start(self, now_us: int) -> None:
        self.power = Power.RUNNING
        self._processor.start(now_us)

    def power_cycle(self, now_us: int) -> None:
        """Switch off and on, which brings the radio back to the settings in the EEPROM."""
        self._stop_processor(now_us)
        self._forget()
        self._start(now_us)

    def press_button(self, now_us: int) -> None:
        """Start the firmware of a board that is off or in its bootloader."""
        if self.power in (Power.OFF, Power.BOOTLOADER):
            self._forget()
            self._start(now_us)


def _kind(data: bytes) -> int | None:
    """Return the type of a packet to the radio chip, None for one to the processor."""
    return data[1] if len(data) > 1 and data[0] & NULL_MASK == NULL else None


def peer_packet(data: bytes) -> bytes:
    """Return the packet on the air of what a board sends to the others: its port, and the content."""
    return bytes((NULL | 0x0C, PEERS | data[0] & 0x0F)) + data[1:]


def is_to_peers(data: bytes) -> bool:
    """Whether a packet is one from board to board, which the radio chip passes on in its own kind of frame."""
    kind = _kind(data)
    return kind is not None and kind & PEERS_MASK == PEERS
