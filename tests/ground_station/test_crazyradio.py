"""The station's side of cflib: what it asks of a board and when, what it makes of packets, and when a link is lost."""

import threading
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace as Made
from typing import Any, ClassVar

import pytest

pytest.importorskip("cflib")

from cflib.crazyflie.link_statistics import LinkStatistics
from cflib.crazyflie.log import LogTocElement
from cflib.crazyflie.param import ParamTocElement
from cflib.crazyflie.toc import Toc
from cflib.crtp.crtpstack import CRTPPacket
from cflib.utils.callbacks import Caller

from firmware_py.wire import crtp
from firmware_py.wire.parameters import ABSOLUTE, encode_pose_kind
from firmware_py.wire.scalars import Scalar
from firmware_py.wire.telemetry import ALL_BLOCKS, CONTROL
from ground_station.config import LinkSettings
from ground_station.controls import Answer, ControlAction, ControlRequest
from ground_station.corrections import correct
from ground_station.errors import LinkError
from ground_station.links import crazyradio, live_link
from ground_station.links.crazyradio import ECHO, ECHO_HEADER, CrazyradioLink
from ground_station.links.crtp_controls import TocEntry
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal
from support.log_board import TABLE, LogBoard, data_packet

URI = "radio://0/80/2M"
PATIENCE_S = 30.0
CORRECTIONS = encode_pose_kind(absolute=False)
PARAMETERS = (
    (3, 0x08, "stabilizer", "estimator"), (9, 0x46, "imu_sensors", "BMP388"), (5, 0x06, *ABSOLUTE.split(".")),
    (6, 0x07, "twice", "float"), (7, 0x11, "stored", "gain"),
)  # fmt: skip


class Cflib:
    """cflib's Crazyflie, whose board answers requests for telemetry; `sent` are the packets."""

    protocol = 10
    answers = True  # connects
    safelinks: ClassVar[list[bool]] = [True]  # whether each link has safelink, the last one again and again

    def __init__(self, rw_cache: str) -> None:
        self.sent: list[bytes] = []
        self.callbacks: dict[int, list[Callable[[CRTPPacket], None]]] = defaultdict(list)
        self.closed = 0
        self.link: Made | None = None
        self.closed_links: list[str] = []
        for event in (
            "packet_received",
            "connected",
            "connection_failed",
            "connection_lost",
            "disconnected_link_error",
        ):
            setattr(self, event, Caller())
        self.link_statistics = LinkStatistics(self)
        self.connected.add_callback(lambda uri: self.link_statistics.start())
        self.platform = Made(get_protocol_version=lambda: self.protocol)
        self.param, self.log = Made(toc=Toc()), Made(toc=Toc())
        for number, kind, group, name in PARAMETERS:
            element = ParamTocElement(number, bytes((kind,)) + f"{group}\0{name}\0".encode())
            if element.is_extended():
                element.mark_persistent()
            self.param.toc.add_element(element)
        for full_name, number in TABLE.items():
            group, _, name = full_name.partition(".")
            self.log.toc.add_element(LogTocElement(number, b"\7" + f"{group}\0{name}\0".encode()))
        self.board = LogBoard()

    def add_port_callback(self, port: int, callback: Callable[[CRTPPacket], None]) -> None:
        self.callbacks[port].append(callback)

    def add_header_callback(self, callback: Callable[[CRTPPacket], None], port: int, channel: int) -> None:
        """Cflib's own pings are not answered."""

    def open_link(self, uri: str) -> None:
        safe = self.safelinks.pop(0) if self.safelinks[1:] else self.safelinks[0]
        self.link = Made(needs_resending=not safe, close=lambda: self.closed_links.append(uri))
        if self.answers:
            self.receive(bytes((0xFF, 1, 40)))
        if self.answers and safe:
            self.receive(bytes((0xF0,)))
            self.connected.call(uri)

    def close_link(self) -> None:
        self.closed += 1

    def send_packet(self, packet: CRTPPacket) -> None:
        data = bytes((packet.header, *packet.data))
        self.sent.append(data)
        if (answer := self.board.answer(data)) is not None:
            self.receive(answer)

    def receive(self, data: bytes) -> None:
        packet = CRTPPacket(data[0], list(data[1:]))
        self.packet_received.call(packet)
        for callback in self.callbacks[packet.port]:
            callback(packet)


class Air:
    """A link and its board on a simulated clock."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_us = 50_000_000
        self.boards: list[Cflib] = []
        for module in (crazyradio, live_link):
            monkeypatch.setattr(module, "clock_us", lambda: self.now_us)
        monkeypatch.setattr(crazyradio, "Crazyflie", self.board)
        self.link = CrazyradioLink(URI, LinkSettings(50.0, 1300, 0))

    def board(self, **options: Any) -> Cflib:
        self.boards.append(Cflib(**options))
        return self.boards[-1]

    def open(self) -> Cflib:
        self.link.open(lambda: False)
        self.talk()
        return self.boards[-1]

    def talk(self) -> list[Any]:
        """Send what waits, read what arrives, until nothing does; return the telemetry."""
        samples: list[Any] = []
        while True:
            done = threading.Event()
            self.link._do(done.set)
            assert done.wait(PATIENCE_S)
            pieces = self.link.received()
            for t_us, data in pieces:
                samples += self.link.receive(t_us, data)
            if not pieces:
                return samples

    def check(self, after_us: int) -> list[bytes]:
        """Return what a check sends after a while."""
        self.now_us += after_us
        before = len(self.boards[-1].sent)
        self.link.check()
        self.talk()
        return self.boards[-1].sent[before:]


@pytest.fixture
def air(monkeypatch: pytest.MonkeyPatch) -> Iterator[Air]:
    air = Air(monkeypatch)
    yield air
    air.link.close()
    for board in air.boards:
        board.link_statistics.stop()


def test_a_board_that_connects_is_told_of_corrections_and_asked_for_telemetry_each_time(air: Air) -> None:
    for count in (1, 2):
        board = air.open()
        assert len(air.boards) == count
        assert board.sent.count(CORRECTIONS) == 1
        assert set(board.board.periods) == {block.id for block in ALL_BLOCKS}
        air.link.close()
        assert board.closed == 1


def test_a_link_without_safelink_is_opened_anew_until_it_has_one(
    air: Air, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board with safelink on takes none of its packets but the first: cflib would wait for an answer for ever."""
    monkeypatch.setattr(Cflib, "safelinks", [False, False, True])
    monkeypatch.setattr(crazyradio, "POLL_S", 0.0)
    board = air.open()
    assert [one.closed_links for one in air.boards] == [[URI], [URI], []]
    assert board is air.boards[2]
    air.link.check()


def test_one_that_is_opened_anew_has_time_to_answer(air: Air, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Cflib, "safelinks", [False])
    monkeypatch.setattr(crazyradio, "POLL_S", 0.0)
    air.link._open()
    monkeypatch.setattr(Cflib, "answers", False)
    assert [air.link._connect() for _ in range(3)] == [False] * 3
    assert len(air.boards) == 2


def test_closing_waits_for_cflib_unless_the_link_is_lost_or_has_no_safelink(
    air: Air, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It takes up to a second, which a robot without corrections need not survive; until then an older one says nothing."""
    waited: list[float] = []

    class Closing(threading.Thread):
        def join(self, timeout: float | None = None) -> None:
            super().join()
            if self.name == "closing":
                waited.append(timeout or 0.0)

    monkeypatch.setattr(threading, "Thread", Closing)
    monkeypatch.setattr(crazyradio, "POLL_S", 0.0)
    monkeypatch.setattr(Cflib, "safelinks", [True, True, False, True])
    air.open()
    air.link.close()
    assert waited == [crazyradio.CFLIB_CLOSES_S]
    second = air.open()
    second.link = None
    second.connection_lost.call(URI, "Too many packets lost")
    air.link.close()
    last = air.open()
    for old in air.boards[:3]:
        old.link = Made(needs_resending=True)
        old.receive(bytes((0xFF, 1, 40)))
        old.disconnected_link_error.call(URI, "older")
    assert not air.link._unsafe
    air.link.check()
    assert (len(waited), last.closed) == (1, 0)


def test_a_lost_link_waits_for_no_job_that_hangs_and_forgets_the_queued_ones(air: Air) -> None:
    """cflib blocks for 2 s what is sent while it closes a lost link; the robot has no corrections meanwhile."""
    hangs, goes_on = threading.Event(), threading.Event()
    done: list[str] = []

    def hang() -> None:
        hangs.set()
        goes_on.wait()

    air.open()
    air.link._do(partial(done.append, "in order"))
    air.link.close()
    assert done == ["in order"]
    second = air.open()
    thread = air.link._sender._thread
    air.link._do(hang)
    air.link._do(partial(done.append, "late"))
    hangs.wait()
    second.link = None
    second.connection_lost.call(URI, "Too many packets lost")
    air.link.close()
    assert thread.is_alive()
    goes_on.set()
    thread.join()
    assert done == ["in order"]


def test_without_the_parameter_of_absolute_poses_none_is_written(
    air: Air, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Toc, "get_element_by_complete_name", lambda toc, name: None)
    assert CORRECTIONS not in air.open().sent


def test_what_is_said_of_telemetry_is_told_once(air: Air) -> None:
    board = air.open()
    air.link.notices()
    for number in (1, 2):
        air.link._logs.notices.append(f"telemetry {number}")
        for _ in range(2):
            board.receive(data_packet(CONTROL, 500, [1] * len(CONTROL.variables)))
            air.talk()
        assert air.link.notices() == [f"telemetry {number}"]


def test_telemetry_tells_the_state_and_keeps_the_link(air: Air) -> None:
    board = air.open()
    state = next(block for block in ALL_BLOCKS if "supervisor.state" in [one.name for one in block.variables])
    values = [2 if one.name == "supervisor.state" else 1 for one in state.variables]
    board.receive(data_packet(state, 500, values))
    (sample,) = air.talk()
    assert sample.block is state
    assert air.link.supervisor_state == 2
    for _ in range(3):
        air.now_us += 1_999_999
        board.receive(data_packet(CONTROL, 500, [1] * len(CONTROL.variables)))
        assert len(air.talk()) == 1
        air.link.check()
    air.now_us += 2_000_000
    board.receive(bytes((0xF0,)))  # the radio still hears the board
    air.link.check()
    air.now_us += 1
    with pytest.raises(LinkError, match=rf"^{URI}: lost: no telemetry for 2 s, it may have rebooted$"):
        air.link.check()
    air.now_us += 2_000_000
    with pytest.raises(LinkError, match=rf"^{URI}: lost: silent for 2 s$"):
        air.link.check()


def test_echoes_are_a_tenth_of_a_second_apart_and_away_from_poses(air: Air) -> None:
    air.open()
    asked = bytes((ECHO_HEADER | 0x0C,)) + ECHO.pack(1, air.now_us)
    assert air.check(0) == [asked]
    assert [len(air.check(after_us)) for after_us in (99_999, 1, 99_999)] == [0, 1, 0]
    air.link.send(air.now_us, MocapFrame(air.now_us, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), True), HOME)
    air.talk()
    assert [len(air.check(after_us)) for after_us in (2_999, 1, 99_999, 1)] == [0, 1, 0, 1]


HOME = Goal((0.1, 0.2, 1.15), 0.3)


def test_a_pose_leaves_as_the_correction_on_its_arrival(air: Air) -> None:
    board = air.open()
    frame = MocapFrame(air.now_us - 5_000, (0.3, 0.2, 1.1), (1.0, 0.0, 0.0, 0.0), True)
    air.link.send(air.now_us, frame, HOME)
    air.talk()
    assert board.sent[-1] == crtp.encode_ext_pose(*correct(frame, HOME, air.now_us + 1300))
    assert air.link.summary() == "corrections 1 sent, 0 late"
    for update, value in (
        ("link_quality_updated", 98.4),
        ("uplink_rate_updated", 512.0),
        ("uplink_rssi_updated", 40),
    ):
        getattr(board.link_statistics, update).call(value)
    assert air.link.summary() == "corrections 1 sent, 0 late  quality 98 %  512 exchanges/s"
    assert (air.link.quality, air.link.rssi) == (98.4, 40)


def test_the_board_s_parameters_are_those_of_its_table_and_are_asked_by_number(air: Air) -> None:
    board = air.open()
    assert air.link._parameters() == {
        "stabilizer.estimator": TocEntry(3, Scalar.U8, True, False), ABSOLUTE: TocEntry(5, Scalar.F32, True, False),
        "imu_sensors.BMP388": TocEntry(9, Scalar.F32, False, False), "stored.gain": TocEntry(7, Scalar.I16, True, True),
    }  # fmt: skip
    assert air.link._log_table() == TABLE
    air.link.ask(air.now_us, ControlRequest(ControlAction.READ, "stabilizer.estimator"))
    assert air.link.answer(air.now_us) is None
    air.talk()
    assert board.sent[-1] == crtp.encode(crtp.Packet(crtp.PORT_PARAMETERS, 1, b"\3\0"))
    board.receive(crtp.encode(crtp.Packet(crtp.PORT_PARAMETERS, 1, b"\3\0\0\2")))
    air.talk()
    assert air.link.answer(air.now_us) == Answer((("stabilizer.estimator", 2),))


def test_what_cflib_says_of_a_lost_link_is_reported_by_its_first_line_and_not_of_an_older_one(
    air: Air,
) -> None:
    first = air.open()
    air.link.close()
    second = air.open()
    first.connection_lost.call(URI, "older")
    air.link.check()
    second.disconnected_link_error.call(URI, "Couldn't load link driver: pulled out\nTraceback")
    second.connection_lost.call(URI, "too many packets lost")
    with pytest.raises(LinkError, match=rf"^{URI}: lost: pulled out$"):
        air.link.check()
    air.link.close()
    air.open()
    air.link.check()


def test_cflib_itself_sends_nothing_beside_the_link(air: Air) -> None:
    """Its thread of pings, when it met the loss of the link first, ended in a traceback and kept the link's lock."""
    before = set(threading.enumerate())
    air.open()
    assert {thread.name for thread in set(threading.enumerate()) - before} == {"sender"}
    air.boards[-1].link_statistics.radio_link_statistics_callback({"link_quality": 87.0})
    assert air.link.quality == 87.0


@pytest.mark.parametrize(("protocol", "heard", "after_us", "why"), [
    (10, None, 4_000_001, "no answer within 4 s"),
    (10, 0xFF, 4_000_001, "no answer within 4 s"),  # the radio chip's own
    (3, 0xF0, 4_000_001, "wrong protocol: version 3 answers, at least 4 is needed"),
    (4, 0xF0, 4_000_000, ""),
    (4, 0xF0, 4_000_001, "answers stopped while connecting, for 4 s"),
])  # fmt: skip
def test_why_a_board_does_not_connect(
    air: Air, monkeypatch: pytest.MonkeyPatch, protocol: int, heard: int | None, after_us: int, why: str
) -> None:
    monkeypatch.setattr(Cflib, "protocol", protocol)
    monkeypatch.setattr(Cflib, "answers", False)
    monkeypatch.setattr(crazyradio, "POLL_S", 0.0)
    air.link._open()
    if heard is not None:
        air.boards[-1].receive(bytes((heard,)))
    air.now_us += after_us
    assert not air.link._connect()
    assert air.link._why_no_connection(air.now_us, "within 4 s") == why


def test_a_malformed_address_is_refused_before_cflib_is_asked(air: Air) -> None:
    for uri in ("radio://0/80/3M", "radio://0/80/2M/E7E7", "udp://127.0.0.1", "usb://0"):
        with pytest.raises(
            LinkError, match=f"^{uri}: expected radio://0/80/2M/E7E7E7E7E7 or udp://127.0.0.1:19850$"
        ):
            CrazyradioLink(uri, LinkSettings(50.0, 1300, 0)).open(lambda: False)
    assert air.boards == []
