"""Flashing page by page, on a bootloader whose flash is an array and whose answers may come late."""

import struct
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("cflib")

from cflib.bootloader.boottypes import TargetTypes

from ground_station.errors import LinkError
from ground_station.flashing import READ_TRIES, _verify, _write

SIZE, PAGES, START = 8, 3, 16


class Loader:
    """Three pages of buffer; reads fail `failing` times, each with two more answers on their way."""

    uri, error_code = "radio", 7

    def __init__(self, failing: int = 0) -> None:
        target = SimpleNamespace(page_size=SIZE, buffer_pages=PAGES, start_page=START)
        self.targets = {TargetTypes.STM32: target}
        self.link = SimpleNamespace(receive_packet=lambda timeout_s: self.late.pop() if self.late else None)
        self.buffer, self.flash = bytearray(SIZE * PAGES), bytearray(b"\xff" * 640)
        self.late: list[bytes] = [b"old", b"old"]
        self.failing, self.refuses_from = failing, 640

    def upload_buffer(self, target: int, page: int, address: int, part: bytes) -> None:
        self.buffer[page * SIZE + address : page * SIZE + address + len(part)] = part

    def write_flash(self, target: int, page: int, first: int, count: int) -> bool:
        if (first + count) * SIZE > self.refuses_from:
            return False
        self.flash[first * SIZE : (first + count) * SIZE] = self.buffer[: count * SIZE]
        return True

    def read_flash(self, target: int, page: int) -> bytes:
        assert not self.late  # it would be taken for the answer
        if self.failing:
            self.failing -= 1
            self.late = [b"late", b"late"]
            raise struct.error
        return bytes(self.flash[page * SIZE : (page + 1) * SIZE])


@pytest.mark.parametrize("size", [1, 8, 24, 25, 47, 48])
def test_every_page_is_written_at_its_place_and_read_back(size: int) -> None:
    image, told = bytes(range(1, size + 1)), []
    loader: Any = Loader(failing=READ_TRIES - 1)
    _write(loader, image, lambda *news: told.append(news))
    _verify(loader, image, lambda *news: told.append(news))
    pages = range(0, size, SIZE)
    assert loader.flash[START * SIZE : START * SIZE + size] == image
    assert set(loader.flash[: START * SIZE] + loader.flash[START * SIZE + 48 :]) == {0xFF}
    ends = [min(at + SIZE, size) for at in pages]
    assert told == [("writing", at, size) for at in (*pages, size)] + [
        ("checking", end, size) for end in ends
    ]


def test_what_is_not_written_or_not_read_names_its_bytes() -> None:
    loader: Any = Loader()
    loader.refuses_from = START * SIZE + 47
    with pytest.raises(LinkError, match=r"writing at byte 24 failed \(bootloader's code 7\)"):
        _write(loader, bytes(48), lambda *news: None)
    loader.flash[START * SIZE + 17] = 9
    with pytest.raises(LinkError, match=r"differs from the image in bytes 16..18"):
        _verify(loader, bytes(19), lambda *news: None)
    with pytest.raises(LinkError, match=r"differs from the image in bytes 0..7"):
        _verify(Loader(failing=READ_TRIES), bytes(8), lambda *news: None)  # type: ignore[arg-type]
