"""Flashing through the virtual dongle: byte for byte, with progress, verified, and one line for whatever goes wrong."""

import os
import random
import struct
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from cflib.bootloader import Bootloader
from cflib.bootloader.cloader import Cloader

from ground_station.flashing import _read, flash
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
    try:
        assert tool.start_bootloader(warm_boot=True)
        there = b"".join(page_of(tool._cload, 16 + page) for page in range(pages))
        assert there[: len(image)] == image
        assert tool.reset_to_firmware()
    finally:
        tool.close()  # what stays in its bootloader gets its button pressed


def page_of(loader: Cloader, page: int) -> bytes:
    """Return a page of the flash, or nothing after five tries."""
    return next(filter(None, (_read(loader, page) for _ in range(5))), b"")


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
