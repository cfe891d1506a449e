"""`floaty deploy flash` as a user meets it: on the virtual dongle, in a process of its own."""

import os
import random
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from cflib.bootloader import Bootloader
from cflib.bootloader.boottypes import TargetTypes

from support.paths import ROOT
from support.plugged_dongle import plug
from support.serving import Served, serve

PAGE = 1024
NOBODY = "radio://0/11/2M/E7E7E7E7AA"


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with serve("--radio", "--radio-port", "0") as served:
        yield served


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "cf2.bin"
    path.write_bytes(struct.pack("<II", 0x2002_0000, 0x0800_41C1) + random.Random(4).randbytes(2 * PAGE + 77))
    return path


def flash(served: Served, *arguments: object) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "hil.commands", "deploy", "flash", *map(str, arguments)]
    dongle, here = served.environment["PYTHONPATH"], str(ROOT)
    environment = {**served.environment, "PYTHONPATH": os.pathsep.join((dongle, here))}
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)


def test_the_image_is_in_flash_as_cflib_reads_it_and_the_board_starts(served: Served, image: Path) -> None:
    served.forget()
    done = flash(served, "--uri", served.radio_uris[0], image)
    assert (done.returncode, done.stderr) == (0, "")
    content = image.read_bytes()
    assert done.stdout == f"{len(content)} bytes written and read back; the board starts\n"
    served.wait_for("gyro zero", 30.0)
    plug(served)
    tool = Bootloader(served.radio_uris[0])
    assert tool.start_bootloader(warm_boot=True)
    tool.get_target(TargetTypes.STM32)
    there = b"".join(tool._cload.read_flash(TargetTypes.STM32, 16 + n) for n in range(3))
    assert tool.reset_to_firmware()
    tool.close()
    assert there[: len(content)] == content


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--uri", NOBODY, "cf2.bin"], f"{NOBODY}: no answer"),
        (["--uri", "udp://127.0.0.1:19850", "cf2.bin"], "udp://127.0.0.1:19850: expected radio://"),
        (["--uri", NOBODY, "nowhere.bin"], "nowhere.bin: No such file"),
        (["--uri", NOBODY, "cf2.elf"], "cf2.elf: not an image for the board"),
        (["cf2.bin"], "Missing option '--uri'"),
    ],
)
def test_what_cannot_be_flashed_is_one_line_and_exit_code_two(
    served: Served, image: Path, arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    image.with_suffix(".elf").write_bytes(b"\x7fELF" + bytes(500))
    monkeypatch.chdir(image.parent)
    done = flash(served, *arguments)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.startswith("floaty: ")
    assert done.stderr.count("\n") == 1
