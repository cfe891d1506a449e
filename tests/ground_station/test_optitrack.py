"""A NatNet client's sockets on a simulated clock: which packets count, and which are another program's."""

import errno
import socket
from collections.abc import Iterator

import pytest

from ground_station.config import CaptureConfig
from ground_station.errors import MocapError
from ground_station.sources.natnet import MULTICAST_GROUP
from ground_station.sources.optitrack import OptitrackSource
from support import natnet_packets as packets
from support.motive_bench import MotiveBench, StationClock, seen

V = (4, 1)
PING, MODELS, ECHO, DISCONNECT = 0, 4, 12, 9


class Server:
    """A server's command port; what it was asked, and frames of other ports of its computer."""

    def __init__(self, clock: StationClock) -> None:
        self.clock = clock
        self.sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
        for each in self.sockets:
            each.bind(("127.0.0.1", 0))
            each.setblocking(False)
        self.port = self.sockets[0].getsockname()[1]
        self.asked: list[int] = []
        self.client = ("", 0)
        self.number = 0
        clock.turns = self.answer

    def answer(self) -> None:
        try:
            while True:
                data, self.client = self.sockets[0].recvfrom(4096)
                self.asked.append(data[0])
                if data[0] == PING:
                    self.sockets[0].sendto(packets.server_info(V), self.client)
                elif data[0] == MODELS:
                    self.sockets[0].sendto(packets.model_definition({"floaty": 7}, V), self.client)
        except BlockingIOError:
            pass

    def frame(self, port: int, x: float) -> None:
        self.number += 1
        ticks = (self.clock.now_us * 10,) * 3
        data = packets.frame(self.number, V, ticks, pose=((x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        self.sockets[port].sendto(data, self.client)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> StationClock:
    return StationClock(monkeypatch)


@pytest.fixture
def server(clock: StationClock) -> Iterator[Server]:
    server = Server(clock)
    yield server
    for each in server.sockets:
        each.close()


def source_of(port: int, **options: object) -> OptitrackSource:
    capture = CaptureConfig(host="127.0.0.1", port=port, body="floaty", axes="z-up")
    return OptitrackSource(capture.model_copy(update=options))


def heard(source: OptitrackSource) -> float | None:
    frame = source.receive(0.0)
    return None if frame is None else frame.p_WB[0]


def test_frames_are_taken_from_the_first_port_until_it_is_silent_for_a_second_and_always_from_that_of_commands(
    server: Server, clock: StationClock
) -> None:
    source = source_of(server.port)
    source.open()
    taken = []
    for port, x, wait_us in (
        (1, 1.0, 0), (2, 2.0, 0), (1, 3.0, 0), (2, 4.0, 999_999), (2, 5.0, 1), (2, 6.0, 2), (1, 7.0, 0), (0, 8.0, 0),
        (2, 9.0, 0), (0, 10.0, 500_000), (2, 11.0, 500_001), (2, 12.0, 500_002),
    ):  # fmt: skip
        clock.now_us += wait_us
        server.frame(port, x)
        taken.append(heard(source))
    assert taken == [1.0, None, 3.0, None, None, 6.0, None, 8.0, None, 10.0, None, 12.0]
    ignored = [line for line in source.notices() if "ignored" in line]
    other = server.sockets[2].getsockname()[1]
    assert ignored == [f"motion capture: packets of 127.0.0.1:{other} are ignored: not the server's"]
    source.close()


def test_frames_of_another_computer_are_not_the_server_s(server: Server) -> None:
    source = source_of(server.port)
    source.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.2", server.port))
        server.sockets.append(other)
        server.frame(3, 9.0)
    server.frame(0, 1.0)
    assert [heard(source), heard(source)] == [1.0, None]
    (line,) = [line for line in source.notices() if "ignored" in line]
    assert f"packets of 127.0.0.2:{server.port} are" in line
    source.close()


def test_answers_count_only_from_the_port_of_commands(server: Server) -> None:
    source = source_of(server.port)
    source.open()
    for packet in (packets.server_info((3, 1)), packets.model_definition({"wand": 7}, V), b"", b"\7"):
        server.sockets[1].sendto(packet, server.client)
    server.frame(0, 1.0)
    assert [heard(source) for _ in range(6)].count(1.0) == 1
    assert not [line for line in source.notices() if "no body" in line]
    source.close()


def test_packets_of_others_do_not_keep_the_source_from_returning(server: Server) -> None:
    source = source_of(server.port)
    source.open()
    for _ in range(5):
        server.sockets[1].sendto(packets.server_info(V), server.client)
    server.frame(0, 1.0)
    assert [heard(source) for _ in range(3)] == [None, None, 1.0]  # two packets are read at a time
    source.close()


def test_a_source_leaves_its_server_and_begins_anew(server: Server, clock: StationClock) -> None:
    source = source_of(server.port)
    for _ in range(2):
        source.open()
        server.frame(1, 1.0)
        server.frame(2, 2.0)
        assert [heard(source), heard(source)] == [1.0, None]
        opened, ignored = source.notices()
        assert opened == "mocap Motive at 127.0.0.1, NatNet 4.1, unicast, z-up"
        assert "are ignored" in ignored
        server.answer()
        server.asked.clear()
        for _ in range(2):
            source.close()
        server.answer()
        assert server.asked == [DISCONNECT]
        assert source._sockets == []


def test_a_server_that_streams_no_more_is_called_again(server: Server, clock: StationClock) -> None:
    source = source_of(server.port)
    source.open()
    server.frame(0, 1.0)
    assert heard(source) == 1.0
    server.asked.clear()
    assert source.receive(0.4) is None
    assert PING not in server.asked
    for _ in range(20):
        assert source.receive(0.1) is None
    assert 3 <= server.asked.count(PING) <= 5
    source.close()


def test_a_server_that_is_not_there_or_not_so_is_one_line(
    server: Server, clock: StationClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(source: OptitrackSource) -> str:
        with pytest.raises(MocapError) as caught:
            source.open()
        assert source._sockets == []
        return str(caught.value)

    assert (
        refused(source_of(server.port, multicast=True)) == "Motive at 127.0.0.1 does not stream by multicast"
    )
    begin_us, clock.turns = clock.now_us, lambda: None
    assert refused(source_of(server.port)) == f"127.0.0.1:{server.port}: no NatNet server answers"
    assert clock.now_us - begin_us == pytest.approx(3_000_000, abs=60_000)

    def unknown(host: str) -> str:
        raise OSError(errno.ENOENT, "Name or service not known")

    monkeypatch.setattr(socket, "gethostbyname", unknown)
    assert refused(source_of(server.port, host="nowhere")) == "nowhere: Name or service not known"


@pytest.mark.parametrize("multicast", [False, True], ids=["unicast", "multicast"])
def test_packets_from_another_port_of_the_server_s_computer_change_nothing(
    clock: StationClock, multicast: bool
) -> None:
    """Another program on that computer sends frames, bodies and server descriptions to every open port."""
    lab = MotiveBench(multicast=multicast)
    clock.turns = lab.turn
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        source = source_of(lab.motive.port, axes="y-up")
        source.open()
        assert f", {'multicast' if multicast else 'unicast'}, " in source.notices()[0]
        assert [own.getsockname()[0] for own in source._sockets] == ["127.0.0.1", MULTICAST_GROUP][
            : 1 + multicast
        ]
        assert source.receive(1.0) is not None
        other.bind(("127.0.0.1", 0))
        other.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1"))
        for number in range(10):
            for own in source._sockets:
                for packet in (
                    packets.frame(10**6 + number, V, (number, number, number), 1, pose=((9.0, 9.0, 9.0), (0, 0, 0, 1))),
                    packets.model_definition({"floaty": 2}, V),
                    packets.server_info((3, 1)),
                ):  # fmt: skip
                    other.sendto(packet, own.getsockname())
            frame = source.receive(1.0)
            assert frame is not None
            assert (frame.p_WB, frame.valid) == (pytest.approx(seen(lab.number).p_WB, abs=1e-6), True)
        source.close()
        (line,) = [line for line in source.notices() if "ignored" in line]
        name = "{}:{}".format(*other.getsockname())
        assert line == f"motion capture: packets of {name} are ignored: not the server's"
    lab.motive.close()
