"""Flashing page by page, on a bootloader whose flash is an array and whose answers may come late."""

import struct
from contextlib import nullcontext
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("cflib")

from cflib.bootloader.boottypes import TargetTypes

from ground_station import flashing
from ground_station.errors import LinkError
from ground_station.flashing import READ_TRIES, _verify, _write, check_image, flash

URI = "radio://0/80/2M/E7E7E7E7E7"
SIZE, PAGES, START = 8, 3, 16
BASE = 0x0800_4000


class Loader:
    """Three pages of buffer; reads fail `failing` times, in both ways of cflib, each with two more answers on their way."""

    uri, error_code = URI, 7

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

    def read_flash(self, target: int, page: int) -> bytes | None:
        assert not self.late  # it would be taken for the answer
        if self.failing:
            self.failing -= 1
            self.late = [b"late", b"late"]
            if self.failing % 2:
                raise struct.error
            return None
        return bytes(self.flash[page * SIZE : (page + 1) * SIZE])


@pytest.mark.parametrize("size", [1, 8, 24, 25, 47, 48])
def test_every_page_is_written_at_its_place_and_read_back(size: int) -> None:
    image, told = bytes(range(1, size + 1)), []
    loader: Any = Loader(failing=READ_TRIES - 1)
    _write(loader, image, lambda *news: told.append(news))
    _verify(loader, image, lambda *news: told.append(news))
    pages = range(0, size, SIZE)
    assert loader.flash[START * SIZE : START * SIZE + size] == image
    behind = (START + len(pages)) * SIZE  # the last page that is written
    assert set(loader.flash[: START * SIZE] + loader.flash[behind:]) == {0xFF}
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


class Board(Loader):
    """A board that can be flashed but for one step, which `fails`; `steps` are those it was asked for."""

    def __init__(self, uri: str, fails: str) -> None:
        super().__init__()
        self.steps: list[str] = []
        self.fails, self.late = fails, []
        assert uri == URI

    def step(self, name: str, *of: object) -> bool:
        self.steps.append(" ".join((name, *map(str, of))))
        return name != self.fails

    def open_bootloader_uri(self, uri: str) -> None:
        if not self.step("open", uri):
            raise Exception("Couldn't load link driver: Cannot find a Crazyradio Dongle\nTraceback")
        if self.fails == "driver":
            self.link = None

    def reset_to_bootloader(self, target: int) -> bool:
        return self.step("stop", target)

    def check_link_and_get_info(self, target: int) -> bool:
        return self.step("info", target)

    def reset_to_firmware(self, target: int) -> bool:
        return self.step("start", target)

    def write_flash(self, target: int, page: int, first: int, count: int) -> bool:
        return self.step("write", target) and super().write_flash(target, page, first, count)

    def read_flash(self, target: int, page: int) -> bytes:
        content = super().read_flash(target, page)
        assert content is not None
        return content if self.step("read", target) else content[:2] + b"?" + content[3:]

    def close(self) -> None:
        self.step("close")


NRF, STM = TargetTypes.NRF51, TargetTypes.STM32
ALL = [
    f"open {URI}",
    f"stop {NRF}",
    f"info {STM}",
    f"write {STM}",
    f"read {STM}",
    f"read {STM}",
    f"start {NRF}",
    "close",
]


@pytest.mark.parametrize(("fails", "why"), [
    ("", ""), ("open", "Cannot find a Crazyradio Dongle"), ("driver", "no driver for this link"),
    ("stop", "no answer: is the board on?"), ("info", "its bootloader does not answer"),
    ("write", "writing at byte 0 failed (bootloader's code 7): press its button and flash again"),
    ("read", "the flash differs from the image in bytes 0..7: press its button and flash again"),
    ("start", "flashed and verified, but it does not restart: press its button"),
])  # fmt: skip
def test_a_flash_takes_every_step_or_says_which_one_failed_and_closes_the_radio(
    monkeypatch: pytest.MonkeyPatch, fails: str, why: str
) -> None:
    boards: list[Board] = []

    def loader(uri: str) -> Board:
        boards.append(Board(uri, fails))
        return boards[0]

    monkeypatch.setattr(flashing, "Cloader", loader)
    said = ""
    try:
        flash(URI, struct.pack("<II", 0x2002_0000, BASE + 9) + bytes(4), lambda *news: None)
    except LinkError as error:
        said = str(error)
    assert said == (f"{URI}: {why}" if why else "")
    taken = [step for step, before in pairwise([*boards[0].steps[::-1], ""]) if step != before][::-1]
    expected = [step for step, before in pairwise([*ALL[::-1], ""]) if step != before][::-1]
    last = next((n for n, step in enumerate(expected) if step.split()[0] == (fails or "start")), 0)
    assert taken == [*expected[: last + 1], "close"]


def image_of(size: int) -> bytes:
    return struct.pack("<II", 0x2002_0000, BASE + 9) + bytes(size - 8)


@pytest.mark.parametrize("uri", ["udp://127.0.0.1:19850", "usb://0", "radio://0/80/3M", ""])
def test_only_radio_flashes(uri: str) -> None:
    with pytest.raises(LinkError, match="expected radio://"):
        flash(uri, image_of(100), lambda *news: None)


@pytest.mark.parametrize(
    "image",
    [
        b"", b"\x7fELF" + bytes(100), bytes(1000), image_of(2000)[:-1999],
        struct.pack("<II", 0x2002_0000, BASE + 100) + bytes(200),  # no Thumb address
        struct.pack("<II", 0x2002_0000, 0x0800_0101) + bytes(200),  # starts the bootloader
        struct.pack("<II", 0x3000_0000, BASE + 101) + bytes(200),
        struct.pack("<II", 0x2000_0000, BASE + 101) + bytes(200),  # an empty stack
        struct.pack("<II", 0x2002_0000, BASE + 209) + bytes(200),  # starts behind its end
    ],
)  # fmt: skip
def test_an_invalid_firmware_is_not_sent(image: bytes) -> None:
    with pytest.raises(LinkError, match="not an image for the board"):
        check_image(image)


@pytest.mark.parametrize(("low", "high"), [(0x1000_0000, 0x1001_0000), (0x2000_0000, 0x2002_0000)])
def test_the_stack_begins_in_memory_or_at_its_end(low: int, high: int) -> None:
    for stack, fits in ((low, False), (low + 4, True), (high, True), (high + 4, False)):
        with nullcontext() if fits else pytest.raises(LinkError, match="not an image for the board"):
            check_image(struct.pack("<II", stack, BASE + 101) + bytes(200))


def test_an_image_must_fit() -> None:
    check_image(image_of(1008 * 1024))
    with pytest.raises(LinkError, match="1032192 fit"):
        check_image(image_of(1008 * 1024 + 1))
