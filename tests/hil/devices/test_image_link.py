"""The serial line between an image and its radio chip carries one frame per exchange of the radio."""

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.crazyflie import syslink
from hil.crazyflie.crazyflie import POLL_PERIOD_US
from hil.devices.board import VirtualBoard
from hil.devices.image_firmware import ChipImage, ImageFirmware
from hil.stm32f405.chip import build_machine
from hil.stm32f405.image import Image
from support.stm32_firmware import BUILD, build

FRAME = len(syslink.encode(syslink.RAW, syslink.EMPTY))


@pytest.fixture
def firmware() -> ImageFirmware:
    board = VirtualBoard(lambda *_: None, lambda *_: True, lambda *_: None)
    firmware = ImageFirmware(ChipImage(Image(build()), build_machine(BUILD)), board, None)
    firmware.kernel.run(21_000)  # between two polls
    return firmware


def received(firmware: ImageFirmware) -> int:
    """Return how many bytes the tests' own firmware has counted."""
    place = firmware.image.symbol("bytes_received").address
    return int.from_bytes(firmware.chip.read(place, 4), "little")


def test_a_busy_link_has_no_polls_beside_its_own(firmware: ImageFirmware) -> None:
    """A Crazyflie that boots empties its queue of 8 once per tick: half a frame more per millisecond resets it."""
    before = received(firmware)
    for now_us in range(22_000, 72_000, 1_000):
        firmware.radio_polled()
        firmware.kernel.run(now_us)
    assert received(firmware) - before == 50 * FRAME


def test_an_idle_link_is_polled(firmware: ImageFirmware) -> None:
    before = received(firmware)
    firmware.kernel.run(71_000)
    assert (received(firmware) - before) // FRAME == pytest.approx(50_000 / POLL_PERIOD_US, abs=1)
