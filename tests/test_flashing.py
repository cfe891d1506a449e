"""`floaty deploy flash` on the virtual dongle; what lies in flash afterwards is read by cflib itself."""

import os
import random
import struct
import subprocess
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import pytest
from cflib.bootloader import Bootloader
from cflib.bootloader.boottypes import TargetTypes
from cflib.bootloader.cloader import Cloader
from cflib.crtp.crtpstack import CRTPPacket
from serving import Served, serve
from test_board_server import plug
from test_bootloader import DirectLink

from ground_station.errors import LinkError
from ground_station.flashing import check_image, flash, write_image
from hil.bootloader import Bootloader as VirtualBootloader

PAGE = 1024
START = 0x0800_4000
LOAD_BUFFER = 0x14


def firmware(size: int, stack: int = 0x2001_FFF0, start: int = START + 0x1C1) -> bytes:
    """Random bytes behind the vectors of an STM32 image."""
    return struct.pack("<II", stack, start) + random.Random(size).randbytes(size - 8)


@pytest.fixture(scope="module", params=["loss=0", "loss=0.1"][: 1 + ("FLOATY_LONG" in os.environ)])
def served(request: pytest.FixtureRequest) -> Iterator[Served]:
    with serve(
        "--radio", "--radio-port", "0", "--udp", "0", "--poses", "0", "--faults", request.param
    ) as served:
        yield served


def floaty(served: Served, *arguments: object) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, "-m", "hil.cli", *map(str, arguments)]
    return subprocess.run(
        command, env=served.environment, capture_output=True, text=True, timeout=120, check=False
    )


def read_by_cflib(served: Served, pages: int) -> bytes:
    """What lies in the STM32's flash behind its bootloader."""
    plug(served)
    tool = Bootloader(served.radio_uris[0])
    assert tool.start_bootloader(warm_boot=True)
    tool.get_target(TargetTypes.STM32)
    found = b"".join(tool._cload.read_flash(TargetTypes.STM32, 16 + n) for n in range(pages))
    assert tool.reset_to_firmware()
    tool.close()
    return found


def test_an_image_is_flashed_byte_for_byte_and_the_board_starts(served: Served, tmp_path: Path) -> None:
    image = firmware(12 * PAGE + 77)
    (tmp_path / "cf2.bin").write_bytes(image)
    done = floaty(served, "deploy", "flash", "--uri", served.radio_uris[0], tmp_path / "cf2.bin")
    assert (done.returncode, done.stderr) == (0, "")
    assert (
        done.stdout
        == f"{len(image)} bytes written and read back, CRC-32 {zlib.crc32(image):08x}; the board starts\n"
    )
    assert read_by_cflib(served, 13)[: len(image)] == image


@pytest.mark.parametrize("served", ["loss=0"], indirect=True)
def test_a_board_that_is_not_there_is_one_line_and_exit_code_two(served: Served, tmp_path: Path) -> None:
    (tmp_path / "cf2.bin").write_bytes(firmware(PAGE))
    done = floaty(served, "deploy", "flash", "--uri", "radio://0/11/2M/E7E7E7E7AA", tmp_path / "cf2.bin")
    assert done.returncode == 2
    assert "radio://0/11/2M/E7E7E7E7AA: no answer from the bootloader" in done.stderr
    assert done.stderr.count("\n") == 1


class Spoilt(DirectLink):
    """A link that changes one bit of the packets with these numbers on the way to the bootloader."""

    def __init__(self, bootloader: VirtualBootloader, numbers: range) -> None:
        super().__init__(bootloader)
        self._numbers = numbers
        self._loads = 0

    def send_packet(self, packet: CRTPPacket) -> None:
        if packet.data[1] == LOAD_BUFFER:
            self._loads += 1
            if self._loads in self._numbers:
                packet.data[-1] ^= 0x10
        super().send_packet(packet)


def spoilt_loader(numbers: range) -> tuple[Cloader, VirtualBootloader]:
    board = VirtualBootloader()
    loader = Cloader("direct")
    loader.link = Spoilt(board, numbers)
    assert loader.check_link_and_get_info(TargetTypes.STM32)
    return loader, board


def test_an_image_that_was_spoilt_on_the_way_is_written_again() -> None:
    image, steps = firmware(3 * PAGE + 5), []
    loader, board = spoilt_loader(range(60, 61))
    write_image(loader, image, lambda *step: steps.append(step))
    assert board.stm32.flash[16 * PAGE :][: len(image)] == image
    assert [what for what, done, _ in steps if done == 0] == ["writing", "writing"]
    assert steps[-1] == ("reading back", 4, 4)


def test_an_image_that_is_spoilt_both_times_is_refused_with_its_page() -> None:
    loader, _ = spoilt_loader(range(60, 1000))
    with pytest.raises(LinkError, match="page 0 cannot be read back as it was written, 2 times"):
        write_image(loader, firmware(3 * PAGE + 5), lambda *step: None)


def test_an_image_that_does_not_fit_is_refused() -> None:
    loader, board = spoilt_loader(range(0))
    with pytest.raises(LinkError, match="1048577 bytes do not fit into the board's 1032192"):
        write_image(loader, bytes(1024 * PAGE + 1), lambda *step: None)
    assert board.stm32.flash.count(0xFF) == len(board.stm32.flash)


@pytest.mark.parametrize(
    "image",
    [
        b"",
        b"\x7fELF" + bytes(2000),
        b"PK\x03\x04" + bytes(2000),
        firmware(PAGE, start=START + 0x1C0),  # not Thumb
        firmware(PAGE, start=0x0800_01C1),  # linked for the bootloader's place
        firmware(PAGE, start=START + PAGE + 1),  # behind its end
        firmware(PAGE, stack=0x2002_0004),
        firmware(PAGE, stack=0x2000_0000),
        firmware(0x10_0000),  # longer than the flash
    ],
    ids=lambda image: f"{len(image)} bytes {image[:8].hex()}",
)
def test_what_cannot_start_on_the_board_is_refused_before_anything_is_sent(image: bytes) -> None:
    with pytest.raises(LinkError, match=f"{len(image)} bytes that are not"):
        flash("radio://0/80/2M/E7E7E7E7E7", image, lambda what, done, pages: None)


@pytest.mark.parametrize("stack", [0x2002_0000, 0x1001_0000])
def test_both_memories_may_hold_the_stack(stack: int) -> None:
    check_image(firmware(PAGE, stack=stack))


def test_only_the_radio_reaches_the_bootloader() -> None:
    with pytest.raises(LinkError, match="over radio"):
        flash("udp://127.0.0.1:19850", firmware(PAGE), lambda what, done, pages: None)
