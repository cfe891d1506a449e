"""Both bootloaders of the board, as bytes in and bytes out: target FF is the STM32, target FE the nRF51.

A page is loaded into a buffer in packets of up to 25 bytes, written to flash with one command, and can be read back.
Writing replaces a page and takes no time. The flashed contents are kept and can be compared. A board that executes an
image starts what was written; firmware in Python starts with any contents. Facts: cflib's bootloader module and Bitcraze's
two bootloaders.
"""

import struct
from dataclasses import dataclass, field

HEADER = 0xFF
STM32, NRF51 = 0xFF, 0xFE
PROTOCOL_VERSION = 0x10
PAGE_SIZE = 1024
CHUNK = 25  # bytes of a page in one packet

GET_INFO, GET_MAPPING, LOAD_BUFFER, WRITE_FLASH, READ_FLASH = 0x10, 0x12, 0x14, 0x18, 0x1C
SECTORS = bytes((4, 16, 1, 64, 7, 128))  # of the STM32F405: pairs of count and size [pages]

_INFO = struct.Struct("<4H12sB")  # page size, buffer pages, flash pages, first page, processor, protocol
_PLACE = struct.Struct("<HH")  # page, offset
_WRITE = struct.Struct("<HHH")  # buffer page, flash page, pages
DONE, OUT_OF_RANGE = bytes((1, 0)), bytes((0, 1))  # done, error


@dataclass(slots=True)
class FlashTarget:
    """One processor's flash and the buffer in front of it."""

    number: int
    buffer_pages: int
    flash_pages: int
    first_page: int  # the bootloader lies below it
    written: bool = field(default=False, init=False)  # since the last start
    flash: bytearray = field(init=False, repr=False)
    buffer: bytearray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.flash = bytearray(b"\xff" * (self.flash_pages * PAGE_SIZE))
        self.buffer = bytearray(self.buffer_pages * PAGE_SIZE)


class Bootloader:
    """Answers the packets of a flashing tool. `stm32` and `nrf51` keep their contents."""

    def __init__(self) -> None:
        self.stm32 = FlashTarget(STM32, buffer_pages=10, flash_pages=1024, first_page=16)
        self.nrf51 = FlashTarget(NRF51, buffer_pages=1, flash_pages=232, first_page=88)
        self.malformed = 0

    def load(self, flash: bytes) -> None:
        """Put what the STM32 executes into its flash."""
        self.stm32.flash[: len(flash)] = flash

    def take_written(self) -> bytes:
        """Return the STM32's flash if it was written to since the last call, else nothing."""
        written, self.stm32.written = self.stm32.written, False
        return bytes(self.stm32.flash) if written else b""

    def answer(self, packet: bytes) -> bytes | None:
        """Return the answer to a packet, None when it needs none; malformed packets are counted."""
        if len(packet) < 3 or packet[0] != HEADER or packet[1] not in (STM32, NRF51):
            return None
        target = self.stm32 if packet[1] == STM32 else self.nrf51
        command, parameters = packet[2], packet[3:]
        try:
            reply = _execute(target, command, parameters)
        except struct.error:
            self.malformed += 1
            return None
        return None if reply is None else packet[:3] + reply


def _execute(target: FlashTarget, command: int, parameters: bytes) -> bytes | None:
    if command == GET_INFO:
        sizes = PAGE_SIZE, target.buffer_pages, target.flash_pages, target.first_page
        return _INFO.pack(*sizes, bytes(12), PROTOCOL_VERSION)
    if command == GET_MAPPING and target.number == STM32:
        return SECTORS
    if command == LOAD_BUFFER:
        start = _offset(parameters)
        data = parameters[_PLACE.size :][: max(0, len(target.buffer) - start)]
        target.buffer[start : start + len(data)] = data
        return None
    if command == READ_FLASH:
        start = _offset(parameters)
        return parameters[: _PLACE.size] + target.flash[start : start + CHUNK]
    if command == WRITE_FLASH:
        return _write(target, *_WRITE.unpack_from(parameters))
    return None


def _offset(parameters: bytes) -> int:
    page, offset = _PLACE.unpack_from(parameters)
    return int(page * PAGE_SIZE + offset)


def _write(target: FlashTarget, buffer_page: int, page: int, pages: int) -> bytes:
    """Copy whole pages from the buffer to the flash."""
    if (
        page < target.first_page
        or page + pages > target.flash_pages
        or buffer_page + pages > target.buffer_pages
    ):
        return OUT_OF_RANGE
    data = target.buffer[buffer_page * PAGE_SIZE : (buffer_page + pages) * PAGE_SIZE]
    target.flash[page * PAGE_SIZE : (page + pages) * PAGE_SIZE] = data
    target.written = True
    return DONE
