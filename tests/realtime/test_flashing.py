"""Flashing through the virtual dongle: byte for byte, with progress, verified, and one line for whatever goes wrong."""

import os
import random
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cflib.bootloader import Bootloader
from cflib.bootloader.boottypes import TargetTypes
from cflib.bootloader.cloader import Cloader

from ground_station.errors import LinkError
from ground_station.flashing import check_image, flash
from support.paths import ROOT
from support.plugged_dongle import plug
from support.serving import FLOATY, Served, serve

START = 0x0800_4000
LOSSES = ["0", pytest.param("0.1", marks=pytest.mark.long)]


def image_of(size: int, seed: int = 1) -> bytes:
    return struct.pack("<II", 0x2002_0000, START + 9) + random.Random(seed).randbytes(size - 8)


@pytest.fixture(scope="module", params=LOSSES)
def served(request: pytest.FixtureRequest) -> Iterator[Served]:
    with serve(
        "--radio",
        "--radio-port",
        "0",
        *(f"--set=radio.{way}_loss={request.param}" for way in ("uplink", "downlink")),
    ) as served:
        plug(served)
        yield served


def test_an_image_is_there_byte_for_byte_and_the_board_starts(served: Served) -> None:
    pages = 12  # the bootloader takes 10 at once
    image, seen = image_of(pages * 1024 - 77), []
    served.forget()
    flash(served.radio_uris[0], image, lambda *news: seen.append(news))
    for phase in ("writing", "checking"):
        done = [bytes_done for name, bytes_done, _ in seen if name == phase]
        assert done == sorted(done)
        assert done[-1] == len(image)
    assert {total for *_, total in seen} == {len(image)}
    served.wait_for("gyro zero", 30.0)  # it has restarted
    tool = Bootloader(served.radio_uris[0])
    assert tool.start_bootloader(warm_boot=True)
    there = b"".join(tool._cload.read_flash(TargetTypes.STM32, 16 + page) for page in range(pages))
    assert there[: len(image)] == image
    assert tool.reset_to_firmware()
    tool.close()


def test_the_command_reports_what_it_wrote_and_read_back(served: Served, tmp_path: Path) -> None:
    (tmp_path / "cf2.bin").write_bytes(image_of(2 * 1024 + 77))
    served.forget()
    command = [*FLOATY, "deploy", "flash", "--uri", served.radio_uris[0], str(tmp_path / "cf2.bin")]
    environment = served.environment
    environment["PYTHONPATH"] = os.pathsep.join((environment["PYTHONPATH"], str(ROOT)))
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "2125 bytes written and read back; the board starts\n"
    served.wait_for("gyro zero", 30.0)


def test_a_flash_that_forgets_a_byte_is_noticed(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    upload = Cloader.upload_buffer

    def forgetful(loader: Cloader, target: int, page: int, address: int, part: Any) -> None:
        upload(loader, target, page, address, part[:-1] + bytes((part[-1] ^ 1,)))

    monkeypatch.setattr(Cloader, "upload_buffer", forgetful)
    served.forget()
    with pytest.raises(LinkError, match=r"differs from the image in bytes 0\.\.1023$"):
        flash(served.radio_uris[0], image_of(1500), lambda *news: None)
    served.wait_for("power button pressed", 60.0)
    served.wait_for("gyro zero", 30.0)


@pytest.mark.parametrize("uri", ["udp://127.0.0.1:19850", "usb://0", "radio://0/80/3M", ""])
def test_only_radio_flashes(uri: str) -> None:
    with pytest.raises(LinkError, match="expected radio://"):
        flash(uri, image_of(100), lambda *news: None)


@pytest.mark.parametrize(
    "image",
    [
        b"", b"\x7fELF" + bytes(100), bytes(1000), image_of(2000)[:-1999],
        struct.pack("<II", 0x2002_0000, START + 100) + bytes(200),  # no Thumb address
        struct.pack("<II", 0x2002_0000, 0x0800_0101) + bytes(200),  # starts the bootloader
        struct.pack("<II", 0x3000_0000, START + 101) + bytes(200),
    ],
)  # fmt: skip
def test_an_invalid_firmware_is_not_sent(image: bytes) -> None:
    with pytest.raises(LinkError, match="not an image for the board"):
        check_image(image)


def test_an_image_must_fit() -> None:
    check_image(image_of(1008 * 1024))
    with pytest.raises(LinkError, match="1032192 fit"):
        check_image(image_of(1008 * 1024 + 1))
