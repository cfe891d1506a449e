"""Syslink, the serial protocol between nRF51 and STM32: two start bytes, type, length, data, two sums (Fletcher's).

Facts: Bitcraze's syslink documentation and syslink.h of its firmware.
"""

from collections.abc import Iterator

START = b"\xbc\xcf"
RAW, RAW_BROADCAST = 0x00, 0x06  # radio packets
RADIO_CHANNEL, RADIO_RATE, SIGNAL, RADIO_ADDRESS, RADIO_POWER, RADIO_READY = (
    0x01,
    0x02,
    0x04,
    0x05,
    0x07,
    0x0B,
)
PEER, PEER_BROADCAST = 0x08, 0x0A  # port, signal strength (only to the STM32), data
SWITCH_OFF, STM32_OFF = 0x11, 0x1A
BATTERY, BATTERY_REPORTS = 0x13, 0x14  # flags, volts, amperes, degrees Celsius; start to report
SCAN_MEMORIES, MEMORY_INFO, READ_MEMORY, WRITE_MEMORY = 0x20, 0x21, 0x22, 0x23  # of decks
VERSION = 0x30
OVERHEAD = 6
EMPTY = b"\xff"  # a radio packet without contents


def encode(kind: int, data: bytes) -> bytes:
    body = bytes((kind, len(data))) + data
    return START + body + _sums(body)


class Decoder:
    """Cuts a stream of bytes into frames; `broken` counts those with wrong sums."""

    def __init__(self) -> None:
        self.broken = 0
        self._bytes = b""

    def decode_frames(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Yield type and data of every frame that is whole by now."""
        self._bytes += data
        while (begin := self._bytes.find(START)) >= 0:
            rest = self._bytes[begin:]
            if len(rest) < OVERHEAD or len(rest) < OVERHEAD + rest[3]:
                self._bytes = rest
                return
            end = OVERHEAD + rest[3]
            body = rest[2 : end - 2]
            if _sums(body) == rest[end - 2 : end]:
                self._bytes = rest[end:]
                yield body[0], body[2:]
            else:
                self.broken += 1
                self._bytes = rest[2:]
        self._bytes = self._bytes[-1:]  # it may be the first byte of the next start


def _sums(body: bytes) -> bytes:
    first = second = 0
    for byte in body:
        first = (first + byte) & 0xFF
        second = (second + first) & 0xFF
    return bytes((first, second))
