"""Flashing of a firmware image by radio, through the bootloader that every Crazyflie carries.

The board restarts into its bootloader, takes the image in pages, is read back, and starts it only if every byte
matches. The bootloader works by radio alone: neither USB nor UDP can flash. The only file besides the link that uses cflib.
"""

import contextlib
import re
import struct
from collections.abc import Callable

from cflib.bootloader.boottypes import TargetTypes
from cflib.bootloader.cloader import Cloader

from ground_station.errors import LinkError
from ground_station.links.crazyradio import URIS, first_line, start_cflib

Progress = Callable[[str, int, int], None]  # "writing" or "checking", bytes done, bytes in total

START = 0x0800_4000  # of the firmware in the flash of the STM32F405; the bootloader lies below
FLASH_END = 0x0810_0000
MEMORIES = ((0x2000_0000, 0x2002_0000), (0x1000_0000, 0x1001_0000))  # where the stack may begin
QUIET_S = 0.2  # without an answer no packet is in flight any more
READ_TRIES = 3
AGAIN = "press its button and flash again"


def check_image(image: bytes) -> None:
    """Raise `LinkError` for an image that is no firmware for the board: its first words are the stack and the start."""
    if len(image) > FLASH_END - START:
        raise LinkError(f"an image of {len(image)} bytes: {FLASH_END - START} fit")
    if len(image) >= 8:
        stack, entry = struct.unpack_from("<II", image)
        on_stack = any(low < stack <= high for low, high in MEMORIES)
        if on_stack and entry & 1 and START <= entry < START + len(image):
            return
    raise LinkError("not an image for the board: build/cf2.bin of the app is one")


def flash(uri: str, image: bytes, progress: Progress) -> None:
    """Write an image, compare it, and start it; `LinkError` has the reason for a failure in one line.

    After a failure the board waits in its bootloader, at an address of its own: only its button brings it back to `uri`.
    """
    if not re.fullmatch(URIS[0], uri):
        raise LinkError(f"{uri}: expected radio://0/80/2M/E7E7E7E7E7: the bootloader listens only to radio")
    check_image(image)
    start_cflib()
    loader = Cloader(uri)
    try:
        _enter(loader, uri)
        _write(loader, image, progress)
        _verify(loader, image, progress)
        if not loader.reset_to_firmware(TargetTypes.NRF51):
            raise LinkError(f"{uri}: flashed and verified, but it does not restart: press its button")
    except LinkError:
        raise
    except Exception as error:  # cflib raises bare exceptions
        raise LinkError(f"{uri}: {first_line(str(error))}") from error
    finally:
        loader.close()


def _enter(loader: Cloader, uri: str) -> None:
    """Restart the board into its bootloader and ask it for the sizes of its flash."""
    loader.open_bootloader_uri(uri)
    if loader.link is None:
        raise LinkError(f"{uri}: no driver for this link")
    if not loader.reset_to_bootloader(TargetTypes.NRF51):
        raise LinkError(f"{uri}: no answer: is the board on?")
    if not loader.check_link_and_get_info(TargetTypes.STM32):
        raise LinkError(f"{uri}: its bootloader does not answer")


def _write(loader: Cloader, image: bytes, progress: Progress) -> None:
    """Write page by page, as many at once as the bootloader's buffer holds."""
    target = loader.targets[TargetTypes.STM32]
    size, pages = target.page_size, target.buffer_pages
    for first in range(0, len(image), size * pages):
        places = range(first, min(first + size * pages, len(image)), size)
        for number, at in enumerate(places):
            loader.upload_buffer(TargetTypes.STM32, number, 0, image[at : at + size])
            progress("writing", at, len(image))
        if not loader.write_flash(TargetTypes.STM32, 0, target.start_page + first // size, len(places)):
            code = loader.error_code
            raise LinkError(
                f"{loader.uri}: writing at byte {first} failed (bootloader's code {code}): {AGAIN}"
            )
    progress("writing", len(image), len(image))


def _verify(loader: Cloader, image: bytes, progress: Progress) -> None:
    """Read every page back."""
    target = loader.targets[TargetTypes.STM32]
    size = target.page_size
    for at in range(0, len(image), size):
        part, page = image[at : at + size], target.start_page + at // size
        end = at + len(part)
        if not any(_read(loader, page)[: len(part)] == part for _ in range(READ_TRIES)):
            raise LinkError(
                f"{loader.uri}: the flash differs from the image in bytes {at}..{end - 1}: {AGAIN}"
            )
        progress("checking", end, len(image))


def _read(loader: Cloader, page: int) -> bytes:
    """Return a page, empty when it cannot be read; cflib takes a late answer for that of the next request."""
    _drain(loader, 0.0)
    with contextlib.suppress(struct.error):
        if content := loader.read_flash(TargetTypes.STM32, page):
            return bytes(content)
    _drain(loader, QUIET_S)
    return b""


def _drain(loader: Cloader, wait_s: float) -> None:
    """Drop the answers that wait, and those that come less than a time apart."""
    while loader.link.receive_packet(wait_s) is not None:
        pass
