"""The serial line between an image and its radio chip: packets, polls, reports and commands, by the tests' own firmware."""

from struct import unpack

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.board.image_firmware import ChipImage, ImageFirmware
from hil.board.pins import Requests, VirtualBoard
from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.radio_line import GATE_US, POLL_PERIOD_US, REPORT_PERIOD_US
from hil.emulator.stm32f405.chip import build_machine
from hil.emulator.stm32f405.image import Image
from support.stm32_firmware import build

LINE_US = 25_000  # the tests' firmware sends at least this often


class Line:
    """The firmware on a board; `say` lets it send a frame, `received` are the frames that have arrived."""

    def __init__(self) -> None:
        self.commands: list[tuple[int, bytes]] = []
        requests = Requests(radio_command=lambda now_us, kind, data: self.commands.append((kind, data)))
        board = VirtualBoard(lambda *_: None, lambda *_: True, lambda *_: None, requests=requests)
        self.firmware = ImageFirmware(ChipImage(Image(build()), build_machine()), board, None)
        self._seen = 0
        self._decoder = syslink.Decoder()
        self.wait(21_000)

    def wait(self, us: int) -> None:
        self.firmware.kernel.run(self.firmware.kernel.now_us + us)

    def say(self, kind: int, data: bytes = b"") -> None:
        frame = syslink.encode(kind, data)
        self.firmware.chip.write(self._at("outbox"), frame)
        self.firmware.chip.write(self._at("outbox_size"), len(frame).to_bytes(4, "little"))
        self.wait(LINE_US)

    def received(self) -> list[tuple[int, bytes]]:
        """Return the frames since the last call; at most 1024 bytes."""
        chip, inbox = self.firmware.chip, self.firmware.image.symbol("inbox")
        count = int.from_bytes(chip.read(self._at("bytes_received"), 4), "little")
        assert count - self._seen <= inbox.size
        ring = chip.read(inbox.address, inbox.size)
        new = bytes(ring[at % inbox.size] for at in range(self._seen, count))
        self._seen = count
        return list(self._decoder.decode_frames(new))

    def _at(self, name: str) -> int:
        return self.firmware.image.symbol(name).address


@pytest.fixture
def line() -> Line:
    return Line()


POLL = (syslink.RAW, syslink.EMPTY)


def test_the_radio_starts_when_the_firmware_is_ready(line: Line) -> None:
    line.wait(50_000)
    assert line.received() == []
    line.say(syslink.RADIO_READY)
    assert line.received()[0] == (syslink.RADIO_READY, b"")
    line.wait(50_000)
    polls = line.received()
    assert set(polls) == {POLL}
    assert len(polls) == pytest.approx(50_000 / POLL_PERIOD_US, abs=1)


@pytest.mark.long
def test_a_firmware_that_never_says_it_is_ready_is_polled_after_three_seconds(line: Line) -> None:
    line.wait(GATE_US - 25_000)
    assert line.received() == []
    line.wait(20_000)
    assert set(line.received()) == {POLL}


@pytest.mark.long
def test_a_busy_link_has_no_polls_beside_its_own(line: Line) -> None:
    """A Crazyflie that boots empties its queue of 8 once per tick: half a frame more per millisecond resets it."""
    line.say(syslink.RADIO_READY)
    line.firmware.radio_polled()
    line.wait(1_000)
    line.received()
    for _ in range(50):
        line.firmware.radio_polled()
        line.wait(1_000)
    assert len(line.received()) == 50


def test_battery_and_signal_strength_are_reported_on_request(line: Line) -> None:
    line.say(syslink.BATTERY_REPORTS)
    line.received()
    line.wait(100_000)
    reports = line.received()
    assert len(reports) == 2 * 100_000 // REPORT_PERIOD_US
    assert reports[1] == (syslink.SIGNAL, b"\0")  # no packet yet
    kind, data = reports[0]
    assert kind == syslink.BATTERY
    assert unpack("<Bfff", data) == pytest.approx((0, 3.9, 0.0, 25.0), abs=1e-6)
    line.firmware.radio_received(b"\x5d\x01")
    line.wait(REPORT_PERIOD_US)
    assert (syslink.SIGNAL, b"\x28") in line.received()  # -40 dBm


def test_packets_of_peers_carry_port_and_signal_strength(line: Line) -> None:
    line.firmware.radio_received(b"\xff\x83hello", broadcast=True)
    line.firmware.radio_received(b"\xf3\x84one")
    line.firmware.radio_received(b"\x5d\x01", broadcast=True)
    line.wait(2_000)
    assert line.received() == [
        (syslink.PEER_BROADCAST, b"\x03\x28hello"),
        (syslink.PEER, b"\x04\x28one"),
        (syslink.RAW_BROADCAST, b"\x5d\x01"),
    ]


@pytest.mark.long
def test_the_radio_chip_answers_for_its_version_and_the_decks_memories(line: Line) -> None:
    line.say(syslink.VERSION)
    line.say(syslink.SCAN_MEMORIES)
    (version, memories) = line.received()
    assert version == (syslink.VERSION, b"emulated (CF21)\0")
    assert memories == (syslink.SCAN_MEMORIES, b"\0")  # there are none
    assert [kind for kind, _ in line.commands] == [syslink.VERSION, syslink.SCAN_MEMORIES]


@pytest.mark.long
def test_settings_are_echoed_and_commands_reach_the_radio(line: Line) -> None:
    settings = [
        (syslink.RADIO_CHANNEL, b"\x50"),
        (syslink.RADIO_RATE, b"\x02"),
        (syslink.RADIO_ADDRESS, bytes(range(5))),
        (syslink.RADIO_POWER, b"\x00"),
    ]
    others = [(syslink.PEER_BROADCAST, b"\x01hi"), (syslink.SWITCH_OFF, b"")]
    for kind, data in settings + others:
        line.say(kind, data)
    assert line.received() == settings
    assert line.commands == settings + others
