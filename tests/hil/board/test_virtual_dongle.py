"""The dongle, the air and the board's radio chip on simulated time; the host's side of safelink is cflib's own code."""

import struct
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from cflib.crtp.radiodriver import _RadioDriverThread
from cflib.drivers.crazyradio import _radio_ack
from hypothesis import given
from hypothesis import strategies as st

from hil.board.dongle import VirtualDongle
from hil.emulator.crazyflie import syslink
from hil.emulator.crazyflie.config import RadioConfig
from hil.emulator.crazyflie.nrf51 import RESET_DELAY_US, AirSettings, Band, Nrf51, Power
from hil.emulator.crazyflie.shockburst import Air, air_us, exchange_us, syslink_us
from hil.emulator.events import EventQueue

ADDRESS = bytes.fromhex("E7E7E7E7E7")
CHIP = bytes.fromhex("0110A7F10AC0")
NULL = b"\xff"
RSSI_ACK_SIZE = 3


class Stm:
    """Records what reaches the STM32."""

    battery_V = 3.75
    running = True

    def __init__(self) -> None:
        self.packets: list[bytes] = []
        self.broadcasts: list[bytes] = []
        self.polls = 0
        self.starts: list[int] = []
        self.stops: list[int] = []

    def start(self, now_us: int) -> None:
        assert not self.running
        self.starts.append(now_us)
        self.running = True

    def stop(self, now_us: int) -> None:
        assert self.running
        self.stops.append(now_us)
        self.running = False

    def catch_up(self, now_us: int) -> None:
        pass

    def retuned(self, now_us: int) -> None:
        """Nothing."""

    def greet(self, now_us: int) -> None:
        pass

    def received(self, now_us: int, data: bytes, broadcast: bool) -> None:
        (self.broadcasts if broadcast else self.packets).append(data)

    def polled(self, now_us: int) -> None:
        self.polls += 1


class DongleAndBoard:
    """One dongle and one board; `to_peers` are the packets that the board sends to others."""

    def __init__(self, seed: int = 1, **radio: float) -> None:
        config = RadioConfig.model_validate(
            {"uplink_loss": 0.0, "downlink_loss": 0.0, "usb_jitter_us": 0, **radio}
        )
        self.events, self.stm = EventQueue(), Stm()
        self.to_peers: list[tuple[AirSettings, bytes]] = []
        uniform = np.random.default_rng(seed).random
        band = Band(self.events, uniform, lambda *sent: self.to_peers.append(sent))
        settings = AirSettings(80, 2_000_000, ADDRESS)
        self.board = Nrf51(settings, CHIP, 8, band, self.stm, Air.of(config))
        self.dongle = VirtualDongle(config, self.events, np.random.default_rng(seed), self.board)
        self.tune(80, 2, ADDRESS)

    def tune(self, channel: int, rate: int, address: bytes) -> None:
        self.dongle.control(0x01, channel, b"")
        self.dongle.control(0x02, 0, address)
        self.dongle.control(0x03, rate, b"")

    def exchange(self, packet: bytes) -> bytes:
        """What the host reads from the dongle."""
        answers: list[bytes] = []
        self.dongle.transmit(self.events.now_us, packet, lambda _, answer: answers.append(answer))
        while not answers:
            assert self.events.next_us is not None
            self.events.run(self.events.next_us)
        (answer,) = answers
        return answer

    def wait(self, duration_us: int) -> None:
        self.events.run(self.events.now_us + duration_us)

    # What cflib's driver thread calls
    def send_packet(self, packet: bytes) -> _radio_ack:
        answer = self.exchange(bytes(packet))
        ack = _radio_ack()
        ack.ack, ack.retry, ack.data = bool(answer[0] & 1), answer[0] >> 4, answer[1:]
        return ack


def test_a_packet_arrives_and_the_answer_is_the_signal_strength() -> None:
    bench = DongleAndBoard()
    answer = bench.exchange(b"\x10hello")
    assert (answer[0], answer[1] & 0xF3, answer[2:]) == (1, 0xF3, bytes((1, 40)))
    bench.wait(1000)
    assert bench.stm.packets == [b"\x10hello"]


def test_empty_packets_do_not_reach_the_processor() -> None:
    bench = DongleAndBoard()
    for header in (0xFF, 0xF3, 0xF7, 0xFB):
        bench.exchange(bytes((header,)))
    bench.wait(1000)
    assert bench.stm.packets == []
    assert bench.stm.polls == 4


@pytest.mark.parametrize(("rate", "bits_per_second"), [(0, 250_000), (1, 1_000_000), (2, 2_000_000)])
@pytest.mark.parametrize("size", [1, 4, 28, 31])
def test_an_exchange_takes_its_time_on_the_air_and_on_usb(rate: int, bits_per_second: int, size: int) -> None:
    bench = DongleAndBoard()
    bench.board.settings = AirSettings(80, bits_per_second, ADDRESS)
    bench.tune(80, rate, ADDRESS)
    bench.exchange(bytes([0x10] * size))
    assert bench.events.now_us == pytest.approx(
        500 + exchange_us(size, RSSI_ACK_SIZE, bits_per_second), abs=2
    )


def test_the_hosts_jitter_delays_answers_and_stays_within_its_bound() -> None:
    bench, waits = DongleAndBoard(usb_jitter_us=400), []
    for _ in range(300):
        start_us = bench.events.now_us
        bench.exchange(NULL)
        waits.append(bench.events.now_us - start_us)
    least = 500 + exchange_us(1, RSSI_ACK_SIZE, 2_000_000)
    assert least - 2 <= min(waits) < least + 30
    assert least + 370 < max(waits) <= least + 400


@pytest.mark.parametrize("setting", [(81, 2, ADDRESS), (80, 1, ADDRESS), (80, 2, ADDRESS[:4] + b"\x02")])
def test_no_board_answers_on_another_channel_rate_or_address(setting: tuple[int, int, bytes]) -> None:
    bench = DongleAndBoard()
    bench.tune(*setting)
    bench.dongle.control(0x03, 3, b"")  # no rate: it stays
    assert bench.exchange(b"\x10hello") == b"\x00"
    bench.wait(1000)
    assert bench.stm.packets == []


@pytest.mark.parametrize(
    ("rate", "bits_per_second", "retry_us"), [(0, 250_000, 1500), (1, 1_000_000, 500), (2, 2_000_000, 500)]
)
@pytest.mark.parametrize("retries", [0, 3, 15])
@pytest.mark.parametrize(
    ("channel", "lost"), [(81, {}), (80, {"uplink_loss": 1.0}), (80, {"downlink_loss": 1.0})]
)
def test_giving_up_takes_as_long_as_the_tries(
    rate: int, bits_per_second: int, retry_us: int, retries: int, channel: int, lost: dict[str, float]
) -> None:
    bench = DongleAndBoard(**lost)
    bench.board.settings = AirSettings(80, bits_per_second, ADDRESS)
    bench.tune(channel, rate, ADDRESS)
    bench.dongle.control(0x06, 0x70 | retries, b"")  # of which the lower half counts
    assert bench.exchange(b"\x10hello") == b"\x00"
    try_us = 130 + (73 + 8 * 6) * 1e6 / bits_per_second + retry_us
    assert bench.events.now_us == pytest.approx(500 + (retries + 1) * try_us, abs=retries + 1)


@pytest.mark.parametrize(("channel", "hears"), [(80, True), (81, False)])
def test_a_broadcast_reaches_a_board_on_its_channel_once_unanswered(channel: int, hears: bool) -> None:
    bench = DongleAndBoard()
    bench.tune(channel, 2, bytes.fromhex("FFE7E7E7E7"))
    bench.dongle.control(0x10, 0, b"")
    answers: list[bytes] = []
    first, second = b"\x85" + bytes(range(31)), b"\x85" + bytes(range(31, 62))
    for transfer in (b"\x6d\x08pose", first + second):  # longer ones are two packets
        bench.dongle.transmit(bench.events.now_us, transfer, lambda _, answer: answers.append(answer))
        bench.wait(5000)
    assert bench.stm.broadcasts == ([b"\x6d\x08pose", first, second] if hears else [])
    assert bench.stm.packets == answers == []


def test_a_packet_that_is_to_be_answered_is_one_and_cut_at_32_bytes() -> None:
    bench = DongleAndBoard()
    bench.exchange(b"\x10" + bytes(60))
    bench.wait(5000)
    assert bench.stm.packets == [b"\x10" + bytes(31)]


def test_a_broadcast_does_not_count_in_the_conversation_with_one_board() -> None:
    bench = DongleAndBoard()
    host = cflib_host(bench)
    next(host)
    for number in range(10):
        bench.tune(80, 2, bytes.fromhex("FFE7E7E7E7"))
        bench.dongle.control(0x10, 0, b"")
        bench.dongle.transmit(bench.events.now_us, b"\x6d\x08pose", lambda _, answer: None)
        bench.wait(5000)
        bench.tune(80, 2, ADDRESS)
        bench.dongle.control(0x10, 1, b"")
        host.send(bytes((0x10, number)))
    bench.wait(1000)
    assert [packet[1] for packet in bench.stm.packets] == list(range(10))
    assert len(bench.stm.broadcasts) == 10


@pytest.mark.parametrize("address", [ADDRESS, bytes.fromhex("FFE7E7E7E7")])
def test_without_acknowledgements_a_packet_is_sent_once_unanswered(address: bytes) -> None:
    bench, answers = DongleAndBoard(uplink_loss=0.4), []
    bench.tune(80, 2, address)
    bench.dongle.control(0x10, 0, b"")
    for _ in range(2000):
        bench.dongle.transmit(bench.events.now_us, b"\x10hello", lambda _, answer: answers.append(answer))
        bench.wait(2000)
    received = bench.stm.packets if address == ADDRESS else bench.stm.broadcasts
    assert len(received) / 2000 == pytest.approx(0.6, abs=0.04)
    assert answers == []


@pytest.mark.parametrize(
    ("command", "value", "channel", "rate"),
    [(1, 90, 90, 2), (1, 126, 80, 2), (2, 0, 80, 0), (2, 1, 80, 1), (2, 3, 80, 2), (3, 2, 80, 2)],
    ids=["channel", "no channel", "250K", "1M", "no rate", "power"],
)
def test_a_command_tunes_the_radio_until_the_reset(command: int, value: int, channel: int, rate: int) -> None:
    bench = DongleAndBoard()
    assert bench.exchange(bytes((0xFF, 0x03, command, value)))[0] & 1  # answered where it was asked
    bench.wait(5000)
    assert bench.stm.packets == []
    bench.tune(channel, rate, ADDRESS)
    assert bench.exchange(NULL)[0] & 1
    if (channel, rate) != (80, 2):
        bench.tune(80, 2, ADDRESS)
        assert bench.exchange(NULL) == b"\x00"


def cflib_host(bench: DongleAndBoard) -> Iterator[bytes | None]:
    """cflib's driver with safelink: takes packets by `send`, yields what it would hand to its client."""
    driver = _RadioDriverThread(bench, None, None, None, None, None, None)
    for _ in range(10):
        if tuple(bench.send_packet(b"\xff\x05\x01").data) == (0xFF, 0x05, 0x01):
            break
    else:
        raise AssertionError("no safelink")
    driver._curr_up = driver._curr_down = 0
    received: bytes | None = None
    while True:
        packet = yield received
        out = bytearray(packet or NULL)
        while not (ack := driver._send_packet_safe(bench, out)).ack:
            pass
        received = bytes(ack.data) if ack.data and ack.data[0] & 0xF3 != 0xF3 else None


@pytest.mark.long
@pytest.mark.parametrize(
    ("up", "down", "ber"),
    [(0.0, 0.0, 0.0), (0.1, 0.1, 0.0), (0.5, 0.0, 0.0), (0.0, 0.5, 0.0), (0.3, 0.3, 1e-3)],
)
def test_safelink_brings_everything_once_and_in_order(up: float, down: float, ber: float) -> None:
    bench = DongleAndBoard(
        uplink_loss=up, downlink_loss=down, uplink_bit_error_rate=ber, downlink_bit_error_rate=ber
    )
    host = cflib_host(bench)
    next(host)
    sent_up = [struct.pack("<BH", 0x10, n) for n in range(300)]
    sent_down = [struct.pack("<BH", 0x50, n) for n in range(300)]
    waiting, received = list(sent_down), []
    for packet in [*sent_up, *[None] * 320]:
        while waiting and bench.board.send(bench.events.now_us, waiting[0]):
            waiting.pop(0)
        answer = host.send(packet)
        if answer is not None:
            received.append(bytes((answer[0] & 0xF3,)) + answer[1:])
    bench.wait(1000)
    assert received == sent_down
    assert [bytes((packet[0] & 0xF3,)) + packet[1:] for packet in bench.stm.packets] == sent_up


@pytest.mark.parametrize("direction", ["uplink_loss", "downlink_loss"])
def test_retries_are_counted_in_the_status_and_take_time(direction: str) -> None:
    bench = DongleAndBoard(**{direction: 0.5})
    seen = set()
    for _ in range(200):
        start_us = bench.events.now_us
        answer = bench.exchange(b"\x10hello")
        if answer != b"\x00":
            retries = answer[0] >> 4
            seen.add(retries)
            expected_us = 500 + exchange_us(6, 3, 2_000_000) + retries * (130 + (73 + 48) // 2 + 500)
            assert bench.events.now_us - start_us == pytest.approx(expected_us, abs=4)
    assert seen == {0, 1, 2, 3}


def test_the_ninth_packet_finds_the_queue_full_until_the_first_has_arrived() -> None:
    bench = DongleAndBoard()
    board, events = bench.board, bench.events
    assert [board.send(0, b"\x50") for _ in range(9)] == [True] * 8 + [False]
    assert bench.exchange(NULL) == b"\x01\x50"
    assert not board.send(events.now_us, b"\x50")
    bench.exchange(NULL)
    assert board.send(events.now_us, b"\x50")


@pytest.mark.parametrize(("size", "carried"), [(31, True), (32, False)])
def test_an_answer_carries_only_what_the_radio_chip_has_by_then(size: int, carried: bool) -> None:
    bench, packet = DongleAndBoard(usb_us=200), bytes([0x50] * size)
    assert bench.board.send(0, packet)
    heard_us = 200 + 130 + air_us(1, 2_000_000)
    assert (syslink_us(packet) <= heard_us) is carried
    assert (bench.exchange(NULL)[1:] == packet) is carried
    assert (bench.exchange(NULL)[1:] == packet) is not carried


def boot_address(answer: bytes) -> bytes:
    """As cflib's cloader computes it."""
    return bytes.fromhex("B1" + answer[3:7][::-1].hex())


def into_bootloader(bench: DongleAndBoard) -> None:
    bench.exchange(b"\xff\xfe\xff")
    answer = bench.exchange(NULL)[1:]
    assert answer == b"\xff\xfe\xff" + CHIP
    bench.exchange(b"\xff\xfe\xf0\x00")
    bench.wait(RESET_DELAY_US + 1000)
    bench.tune(0, 2, boot_address(answer))


def test_the_bootloader_is_at_the_address_that_cflib_computes_and_back() -> None:
    bench = DongleAndBoard()
    into_bootloader(bench)
    assert bench.board.power is Power.BOOTLOADER
    assert len(bench.stm.stops) == 1
    assert bench.exchange(b"\xff\xff\x10") == b"\x01"  # no contents: anything else breaks cflib's flashing
    info = bench.exchange(NULL)
    assert info[1:4] == b"\xff\xff\x10"
    assert 0 < bench.events.now_us - bench.board.heard_us < 1000  # then nobody presses its button
    bench.exchange(b"\xff\xfe\xf0\x01")
    bench.wait(RESET_DELAY_US + 1000)
    assert bench.board.power is Power.RUNNING
    assert len(bench.stm.starts) == 1
    assert bench.exchange(NULL) == b"\x00"  # not there any more
    bench.tune(80, 2, ADDRESS)
    assert bench.exchange(NULL)[0] & 1


def test_the_bootloader_does_not_know_safelink() -> None:
    bench = DongleAndBoard()
    into_bootloader(bench)
    assert all(bench.exchange(b"\xff\x05\x01") == b"\x01" for _ in range(10))


@pytest.mark.parametrize(("safelink", "passed_on"), [(0, 4), (1, 1)])
def test_every_received_try_is_passed_on_unless_safelink_knows_it(safelink: int, passed_on: int) -> None:
    bench = DongleAndBoard(downlink_loss=1.0)
    bench.exchange(bytes((0xFF, 0x05, safelink)))
    assert bench.exchange(b"\x14hello") == b"\x00"
    bench.wait(1000)
    assert bench.stm.packets == [b"\x14hello"] * passed_on


@pytest.mark.parametrize("command", [b"\xff\xfe", b"\xff\xfe\xf0\x00"], ids=["none", "a reset not announced"])
def test_other_commands_to_the_radio_chip_do_nothing(command: bytes) -> None:
    bench = DongleAndBoard()
    assert bench.exchange(command)[0] == 1
    bench.wait(RESET_DELAY_US + 1000)
    assert (bench.board.power, bench.stm.stops) == (Power.RUNNING, [])


ACTS = {
    "all off": lambda bench: bench.exchange(b"\xf3\xfe\x01"),
    "system off": lambda bench: bench.exchange(b"\xf3\xfe\x02"),
    "system on": lambda bench: bench.exchange(b"\xf3\xfe\x03"),
    "reset": lambda bench: (bench.exchange(b"\xff\xfe\xff"), bench.exchange(b"\xff\xfe\xf0\x01")),
    "bootloader": lambda bench: (bench.exchange(b"\xff\xfe\xff"), bench.exchange(b"\xff\xfe\xf0\x00")),
    "power cycle": lambda bench: bench.board.power_cycle(bench.events.now_us),
    "button": lambda bench: bench.board.press_button(bench.events.now_us),
}


def test_power_switch() -> None:
    bench = DongleAndBoard()
    powers = Power.RUNNING, Power.RADIO_ONLY, Power.RUNNING, Power.OFF, Power.RUNNING
    for act, power in zip(("system on", "system off", "system on", "all off", "button"), powers, strict=True):
        ACTS[act](bench)
        assert bench.board.power is power
        assert bool(bench.exchange(b"\x10hello")[0] & 1) == (power is not Power.OFF)
        bench.wait(1000)
    assert len(bench.stm.packets) == 3


@pytest.mark.parametrize("meanwhile", [
    lambda bench: bench.board.command(0, syslink.SWITCH_OFF, b""),
    lambda bench: bench.board.tune(AirSettings(37, 2_000_000, ADDRESS)),
])  # fmt: skip
def test_a_board_that_listens_no_more_when_the_packet_comes_does_not_answer(
    meanwhile: Callable[[DongleAndBoard], None],
) -> None:
    bench, answers = DongleAndBoard(), list[bytes]()
    bench.dongle.transmit(0, b"\x10hello", lambda _, answer: answers.append(answer))
    meanwhile(bench)
    bench.wait(10_000)
    assert (answers, bench.stm.packets) == ([b"\x00"], [])


def test_what_a_board_answered_before_it_was_switched_off_does_not_answer_a_later_try() -> None:
    bench, answers = DongleAndBoard(), list[bytes]()
    draws = [0.0, 0.9, 0.9]  # the first answer is lost, the second try and its answer are not
    bench.dongle._transmitter._uniform = lambda: draws.pop(0)
    bench.board.air.uplink_loss, bench.board.air.downlink_loss = 0.0, 0.5
    bench.dongle.transmit(0, b"\x10hello", lambda _, answer: answers.append(answer))
    bench.wait(600)
    assert len(bench.stm.packets) == 1
    bench.board.command(600, syslink.SWITCH_OFF, b"")
    bench.wait(10_000)
    assert answers == [b"\x00"]


@pytest.mark.long
@given(st.lists(st.sampled_from(sorted(ACTS)), max_size=8))
def test_the_processor_runs_exactly_while_the_board_is_on_whatever_is_switched(acts: list[str]) -> None:
    """It is neither started while it runs nor stopped while it does not."""
    bench = DongleAndBoard()
    for act in acts:
        ACTS[act](bench)
        bench.wait(RESET_DELAY_US + 1000)
        assert bench.stm.running == (bench.board.power is Power.RUNNING)


@pytest.mark.parametrize("how", ["reset", "power cycle", "button"])
def test_a_radio_chip_that_starts_has_forgotten_its_queue_its_answer_and_safelink(how: str) -> None:
    bench = DongleAndBoard()
    board = bench.board
    for packet in (b"\xff\x05\x01", b"\xf3\xfe\xff", b"\xf3\xfe\x01" if how == "button" else NULL):
        bench.exchange(packet)
    for data in (b"\x10first", b"\x10second"):
        assert board.send(bench.events.now_us, data)
    if how == "reset":
        bench.exchange(b"\xf7\xfe\xf0\x01")
        bench.wait(RESET_DELAY_US)
    elif how == "power cycle":
        board.power_cycle(bench.events.now_us)
    else:
        board.press_button(bench.events.now_us)
    for packet in 2 * (
        b"\x10one",
        b"\x10two",
    ):  # the same counters: with safelink the second would be a repetition
        answer = bench.exchange(packet)
        assert (answer[1] & 0xF3, answer[2:]) == (0xF3, bytes((1, 40)))
    bench.wait(1000)
    assert bench.stm.packets == 2 * [b"\x10one", b"\x10two"]


def test_the_battery_voltage_is_answered() -> None:
    bench = DongleAndBoard()
    bench.exchange(b"\xf3\xfe\x04")
    assert bench.exchange(NULL)[1:] == b"\xff\xfe\x04" + struct.pack("<f", 3.75)


def test_a_packet_to_peers_goes_to_all_boards_on_the_channel() -> None:
    bench = DongleAndBoard()
    bench.board.command(0, syslink.RADIO_CHANNEL, b"\x51")
    bench.board.command(0, syslink.PEER_BROADCAST, b"\x03hello")
    to_all = AirSettings(81, 2_000_000, bytes.fromhex("FFE7E7E7E7"))
    assert bench.to_peers == [(to_all, b"\xff\x83hello")]


@pytest.mark.parametrize(("channel", "heard"), [(80, [b"\xff\x83hello"]), (81, [])])
def test_a_packet_of_a_peer_reaches_a_board_on_its_channel(channel: int, heard: list[bytes]) -> None:
    bench = DongleAndBoard()
    settings = AirSettings(channel, 2_000_000, bytes.fromhex("FFE7E7E7E7"))
    bench.board.hear_peer(0, settings, b"\xff\x83hello")
    bench.wait(2_000)
    assert bench.stm.broadcasts == heard


def test_packets_of_peers_are_lost_like_others() -> None:
    bench = DongleAndBoard(uplink_loss=0.25)
    settings = AirSettings(80, 2_000_000, bytes.fromhex("FFE7E7E7E7"))
    for _ in range(400):
        bench.board.hear_peer(bench.events.now_us, settings, b"\xff\x80x")
        bench.wait(1_000)
    assert len(bench.stm.broadcasts) == pytest.approx(300, abs=4 * (400 * 0.25 * 0.75) ** 0.5)


def test_a_peer_packet_of_a_host_is_passed_on_and_answered_at_once_without_contents() -> None:
    bench = DongleAndBoard()
    assert bench.exchange(b"\xf3\x81hi") == b"\x01"
    bench.wait(1_000)
    assert bench.stm.packets == [b"\xf3\x81hi"]


@pytest.mark.parametrize(
    ("kind", "data", "settings"),
    [
        (syslink.RADIO_CHANNEL, b"\x7d", AirSettings(125, 2_000_000, ADDRESS)),
        (syslink.RADIO_CHANNEL, b"\x7e", AirSettings(80, 2_000_000, ADDRESS)),
        (syslink.RADIO_RATE, b"\x00", AirSettings(80, 250_000, ADDRESS)),
        (syslink.RADIO_RATE, b"\x03", AirSettings(80, 2_000_000, ADDRESS)),
        (syslink.RADIO_ADDRESS, bytes((5, 4, 3, 2, 1)), AirSettings(80, 2_000_000, bytes((1, 2, 3, 4, 5)))),
        (syslink.RADIO_ADDRESS, b"\x05", AirSettings(80, 2_000_000, ADDRESS)),
    ],
)
def test_the_processor_tunes_its_radio(kind: int, data: bytes, settings: AirSettings) -> None:
    bench = DongleAndBoard()
    bench.board.command(0, kind, data)
    assert bench.board.settings == settings


@pytest.mark.parametrize(
    ("kind", "power"), [(syslink.SWITCH_OFF, Power.OFF), (syslink.STM32_OFF, Power.RADIO_ONLY)]
)
def test_the_processor_switches_the_board_off(kind: int, power: Power) -> None:
    bench = DongleAndBoard()
    bench.board.command(500, kind, b"")
    assert bench.stm.stops == []  # not within the processor's own step
    bench.wait(1_000)
    assert bench.stm.stops == [500]
    assert bench.board.power is power
