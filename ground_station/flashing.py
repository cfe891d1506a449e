"""A Crazyflie build into the flash of a board, over cflib's bootloader: write, read back, start.

The STM32 keeps its old firmware until the first page is written; its bootloader, and the radio chip, are left alone. When
what is read back is not what was written, everything is written once more, because whole sectors are erased at a time.
"""

import struct
import zlib
from collections.abc import Callable

import cflib.crtp
from cflib.bootloader.boottypes import TargetTypes
from cflib.bootloader.cloader import Cloader

from ground_station.errors import LinkError

ATTEMPTS = 2  # to write the whole image
CALLS = 2  # for the bootloader, each answered within five seconds
FLASH = (0x0800_4000, 0x0810_0000)  # STM32F405, behind the bootloader
MEMORIES = ((0x2000_0000, 0x2002_0000), (0x1000_0000, 0x1001_0000))  # RAM and CCM, where a stack can begin
VECTORS = struct.Struct("<II")  # first stack pointer, address of the first instruction

Progress = Callable[[str, int, int], None]  # what is being done, pages done, pages in all


def check_image(image: bytes) -> None:
    """Raise `LinkError` for bytes that cannot be the .bin of a Crazyflie build: the board would not start."""
    if len(image) >= VECTORS.size:
        stack, start = VECTORS.unpack_from(image)
        begin, end = FLASH
        inside = begin <= start < begin + len(image) <= end
        if inside and start & 1 and any(low < stack <= high for low, high in MEMORIES):
            return
    raise LinkError(
        f"{len(image)} bytes that are not the .bin of a Crazyflie build for flash from 0x{FLASH[0]:08x} on"
    )


def flash(uri: str, image: bytes, progress: Progress) -> int:
    """Write an image, read it back and start it; returns the CRC-32 of what was read. Raises `LinkError`.

    `uri` is that of the running board, radio://…; a board that answers nowhere is left as it is.
    """
    check_image(image)
    if not uri.startswith("radio://"):
        raise LinkError(f"{uri}: a board is flashed over radio://… only")
    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers()
    loader = Cloader(uri)
    try:
        _enter(loader, uri)
        pages = _pages(loader, image)
        for _ in range(ATTEMPTS):
            _write(loader, pages, progress)
            if (different := _first_different(loader, pages, progress)) is None:
                break
        else:
            raise LinkError(
                f"{uri}: page {different} cannot be read back as it was written, {ATTEMPTS} times"
            )
        if not loader.reset_to_firmware(TargetTypes.NRF51):
            raise LinkError(f"{uri}: the image is in flash, but the board does not leave its bootloader")
    finally:
        loader.close()
    return zlib.crc32(image)


def write_image(loader: Cloader, image: bytes, progress: Progress) -> None:
    """Write an image with a bootloader that has told about its STM32, and read it back. Raises `LinkError`."""
    pages = _pages(loader, image)
    for _ in range(ATTEMPTS):
        _write(loader, pages, progress)
        different = _first_different(loader, pages, progress)
        if different is None:
            return
    raise LinkError(f"page {different} cannot be read back as it was written, {ATTEMPTS} times")


def _enter(loader: Cloader, uri: str) -> None:
    """Bring the board into its bootloader."""
    for _ in range(CALLS):
        try:
            loader.open_bootloader_uri(uri)
        except Exception as error:  # cflib's drivers raise plain ones
            raise LinkError(f"{uri}: {str(error).splitlines()[0] if str(error) else error!r}") from None
        if loader.reset_to_bootloader(TargetTypes.NRF51):
            if loader.check_link_and_get_info(TargetTypes.STM32):
                return
            break
    raise LinkError(f"{uri}: no answer from the bootloader")


def _pages(loader: Cloader, image: bytes) -> list[bytes]:
    """Return the image page by page; `LinkError` when it does not fit."""
    target = loader.targets[TargetTypes.STM32]
    room = (target.flash_pages - target.start_page) * target.page_size
    if len(image) > room:
        raise LinkError(f"{len(image)} bytes do not fit into the board's {room}")
    return [image[begin : begin + target.page_size] for begin in range(0, len(image), target.page_size)]


def _write(loader: Cloader, pages: list[bytes], progress: Progress) -> None:
    """Write all pages, as many at a time as the bootloader has buffers."""
    target = loader.targets[TargetTypes.STM32]
    for begin in range(0, len(pages), target.buffer_pages):
        batch = pages[begin : begin + target.buffer_pages]
        for number, page in enumerate(batch):
            loader.upload_buffer(target.addr, number, 0, page)
            progress("writing", begin + number, len(pages))
        if not loader.write_flash(target.addr, 0, target.start_page + begin, len(batch)):
            raise LinkError(f"page {begin}: the bootloader cannot write it, error {loader.error_code}")
    progress("writing", len(pages), len(pages))


def _first_different(loader: Cloader, pages: list[bytes], progress: Progress) -> int | None:
    """Read everything back; returns the first page that is not as written."""
    target = loader.targets[TargetTypes.STM32]
    for number, page in enumerate(pages):
        while loader.link.receive_packet(0) is not None:  # a late answer would be taken for the next one
            pass
        read = loader.read_flash(target.addr, target.start_page + number)
        if read is None:
            raise LinkError(f"page {number}: the bootloader does not answer")
        if read[: len(page)] != page:
            return number
        progress("reading back", number + 1, len(pages))
    return None
