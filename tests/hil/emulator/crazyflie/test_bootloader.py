"""Both bootloaders, driven by cflib's own flashing code and by random bytes."""

import random
import struct
from pathlib import Path

import pytest
from cflib.bootloader import Bootloader as CflibBootloader
from cflib.bootloader import Target
from cflib.bootloader.boottypes import TargetTypes
from cflib.crtp.crtpstack import CRTPPacket
from hypothesis import given
from hypothesis import strategies as st

from hil.emulator.crazyflie.bootloader import DONE, OUT_OF_RANGE, PAGE_SIZE, Bootloader


class DirectLink:
    """A link of cflib's without anything in between."""

    uri = "direct"

    def __init__(self, bootloader: Bootloader) -> None:
        self._bootloader = bootloader
        self._answers: list[bytes] = []

    def send_packet(self, packet: CRTPPacket) -> None:
        answer = self._bootloader.answer(bytes((packet.header,)) + bytes(packet.data))
        if answer is not None:
            assert len(answer) <= 32
            self._answers.append(answer)

    def receive_packet(self, wait: float = 0) -> CRTPPacket | None:
        if not self._answers:
            return None
        answer = self._answers.pop(0)
        return CRTPPacket(answer[0], list(answer[1:]))


def loader(bootloader: Bootloader) -> CflibBootloader:
    tool = CflibBootloader("radio://0/0/2M")
    tool._cload.link = DirectLink(bootloader)
    assert tool._cload.check_link_and_get_info()
    assert tool.start_bootloader()
    return tool


def test_cflib_reads_the_sizes_of_both_processors() -> None:
    targets = loader(Bootloader())._cload.targets
    stm32, nrf51 = targets[TargetTypes.STM32], targets[TargetTypes.NRF51]
    assert (stm32.page_size, stm32.buffer_pages, stm32.flash_pages, stm32.start_page) == (1024, 10, 1024, 16)
    assert (nrf51.page_size, nrf51.buffer_pages, nrf51.flash_pages, nrf51.start_page) == (1024, 1, 232, 88)
    assert stm32.protocol_version == nrf51.protocol_version == 0x10


def test_cflib_reads_the_sectors_of_the_stm32() -> None:
    mapping = loader(Bootloader())._cload.mapping
    assert len(mapping) == 4 + 1 + 7
    assert mapping[-1] + 128 == 4 * 16 + 64 + 7 * 128  # pages: the whole flash


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # cflib leaves the file open
@pytest.mark.parametrize(("name", "start"), [("stm32", 16), ("nrf51", 88)])
@pytest.mark.parametrize("size", [1, 25, 1024, 1025, 10 * 1024, 30_321])
def test_cflib_flashes_exactly_its_bytes(
    tmp_path: Path, name: str, start: int, size: int, capsys: pytest.CaptureFixture[str]
) -> None:
    bootloader = Bootloader()
    image = random.Random(size).randbytes(size)
    (tmp_path / "image.bin").write_bytes(image)
    tool = loader(bootloader)
    tool.flash(str(tmp_path / "image.bin"), [Target("cf2", name, "fw", [], [])])
    flash = getattr(bootloader, name).flash
    begin, end = start * PAGE_SIZE, start * PAGE_SIZE + size
    assert flash[begin:end] == image
    after = -(-end // PAGE_SIZE) * PAGE_SIZE
    assert flash[:begin].count(0xFF) == begin
    assert flash[after:].count(0xFF) == len(flash) - after
    page = tool._cload.read_flash(getattr(TargetTypes, name.upper()), start)
    assert page == flash[begin : begin + PAGE_SIZE]


@pytest.mark.parametrize(
    ("buffer_page", "page", "pages", "answer"),
    [
        (0, 16, 10, DONE),
        (0, 1014, 10, DONE),
        (0, 15, 1, OUT_OF_RANGE),
        (0, 1015, 10, OUT_OF_RANGE),
        (1, 16, 10, OUT_OF_RANGE),
    ],
)
def test_writes_stay_inside_flash_and_buffer(buffer_page: int, page: int, pages: int, answer: bytes) -> None:
    request = struct.pack("<BBBHHH", 0xFF, 0xFF, 0x18, buffer_page, page, pages)
    assert Bootloader().answer(request) == request[:3] + answer


BOOTLOADER = Bootloader()


COMMANDS = st.builds(
    struct.Struct("<3BHH").pack,
    st.just(0xFF),
    st.sampled_from([0xFF, 0xFE]),
    st.sampled_from([0x10, 0x12, 0x14, 0x18, 0x1C]),
    st.integers(0, 0xFFFF) | st.integers(0, 10),
    st.integers(0, 0xFFFF) | st.integers(1000, 1024),
)


@pytest.mark.long
@given(
    st.builds(
        bytes.__add__, COMMANDS | st.sampled_from([b"\xff\xff", b"\xff\xfe", b""]), st.binary(max_size=25)
    )
)
def test_no_packet_breaks_it_and_every_answer_fits_a_radio_packet(packet: bytes) -> None:
    answer = BOOTLOADER.answer(packet)
    assert answer is None or (len(answer) <= 32 and answer[:3] == packet[:3])
    assert len(BOOTLOADER.stm32.flash) == 1024 * PAGE_SIZE
    assert len(BOOTLOADER.stm32.buffer) == 10 * PAGE_SIZE
    assert len(BOOTLOADER.nrf51.buffer) == PAGE_SIZE
