"""A board on UDP hears one client at a time; the time is the test's own."""

import select
import socket
from collections.abc import Iterator

import pytest

from hil.servers.udp_server import PROBE_PERIOD_US, SESSION_TIMEOUT_US, UdpServer

PATIENCE_S = 10.0


class Board:
    """The port, what came in and what was reported."""

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self.said: list[str] = []
        self.readers: dict[object, object] = {}
        self.server = UdpServer(0, self.readers, lambda _, data: self.received.append(data), self.said.append)  # type: ignore[arg-type]

    def read(self, now_us: int) -> None:
        """Take what has arrived, at an instant."""
        ((source, reader),) = self.readers.items()
        assert select.select([source], [], [], PATIENCE_S)[0]
        reader(now_us)  # type: ignore[operator]


@pytest.fixture
def board() -> Iterator[Board]:
    board = Board()
    yield board
    board.server.close()


@pytest.fixture
def clients(board: Board) -> Iterator[list[socket.socket]]:
    clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
    for client in clients:
        client.connect(("127.0.0.1", board.server.port))
        client.settimeout(PATIENCE_S)
    yield clients
    for client in clients:
        client.close()


def test_a_stranger_is_ignored_counted_and_reported_once(board: Board, clients: list[socket.socket]) -> None:
    first, second, third = clients
    first.send(b"\xf0a")
    board.read(0)
    for n in range(5):
        for stranger in (second, third):
            stranger.send(b"\xf0b")
            board.read(n)
    assert board.received == [b"\xf0a"]
    assert board.server.ignored == 10
    assert len(board.said) == 1
    assert "is ignored while" in board.said[0]
    board.server.send(b"answer")
    probes = [first.recv(64), first.recv(64)]  # one look whether it is still there
    assert probes == [b"\xf3", b"\xf3"]
    assert first.recv(64) == b"answer"
    for now_us in (PROBE_PERIOD_US - 1, PROBE_PERIOD_US):
        second.send(b"\xf0b")
        board.read(now_us)
        board.server.send(b"answer")
        probes = [] if now_us < PROBE_PERIOD_US else [b"\xf3"] * 2
        assert [first.recv(64) for _ in range(len(probes) + 1)] == [*probes, b"answer"]


def test_a_board_that_is_switched_off_and_on_has_forgotten_its_session(
    board: Board, clients: list[socket.socket]
) -> None:
    port = board.server.port
    for now_us in (0, 10):
        first, second, _ = clients
        for number, client in enumerate((first, second)):
            client.send(b"\xf0a")
            board.read(now_us + number)
        assert (board.server.ignored, board.server.port) == (1, port)
        board.server.close()
        assert (board.server.has_session(now_us), board.readers) == (False, {})
        board.server.send(b"nobody is there")
        board.server.open()
    told = [line.partition(": ")[2] for line in board.said]
    ignored = [f"127.0.0.1:{second.getsockname()[1]} is ignored while 127.0.0.1:{first.getsockname()[1]} talks to the board",
        "1 packets of others were ignored"]  # fmt: skip
    assert told == ignored * 2


def test_a_client_that_is_silent_for_long_loses_the_board(board: Board, clients: list[socket.socket]) -> None:
    first, second, _ = clients
    first.send(b"\xf0a")
    board.read(0)
    second.send(b"\xf0b")
    board.read(SESSION_TIMEOUT_US)  # not silent for longer than that
    assert board.received == [b"\xf0a"]
    assert [board.server.has_session(SESSION_TIMEOUT_US + late) for late in (0, 1)] == [True, False]
    second.send(b"\xf0c")
    board.read(SESSION_TIMEOUT_US + 1)
    assert board.received == [b"\xf0a", b"\xf0c"]
    assert board.said[-1].endswith("1 packets of others were ignored")
    assert board.server.has_session(2 * SESSION_TIMEOUT_US)
    board.server.end_session()
    assert (len(board.said), board.server.ignored) == (2, 0), "none of the second session"


def test_a_client_that_is_gone_makes_room_at_once(board: Board, clients: list[socket.socket]) -> None:
    first, second, _ = clients
    first.send(b"\xf0a")
    board.read(0)
    first.close()
    second.send(b"\xf0b")  # cflib sends its first packet over UDP once
    board.read(1)
    assert board.received == [b"\xf0a", b"\xf0b"]
    assert board.said == []
    second.close()
    board.server.send(b"answer")
    board.read(2)
    assert not board.server.has_session(2)
    assert not select.select([*board.readers], [], [], 0)[0], "its report is read only once"


@pytest.mark.parametrize("null", [b"\xff", b"\xf3"])
def test_a_prober_is_answered_and_changes_nothing(
    board: Board, clients: list[socket.socket], null: bytes
) -> None:
    first, prober, _ = clients
    first.send(b"\xf0a")
    board.read(0)
    prober.send(null)
    board.read(1)
    assert prober.recv(64) == null
    assert (board.received, board.server.ignored, board.said) == ([b"\xf0a"], 0, [])
    first.send(null + b"\x01")  # more than a header is a packet
    board.read(2)
    assert board.received[1:] == [null + b"\x01"]


@pytest.mark.parametrize(
    ("size", "is_packet"), [(0, False), (1, True), (31, True), (32, False), (2048, False), (60_000, False)]
)
def test_a_datagram_longer_than_a_packet_or_empty_is_none(
    board: Board, clients: list[socket.socket], size: int, is_packet: bool
) -> None:
    clients[0].send(bytes([0x30] * size))
    board.read(7)
    assert board.received == [bytes([0x30] * size)] * is_packet
    assert board.server.has_session(7) == is_packet
    clients[0].send(b"\x30next")
    board.read(8)
    assert board.received[-1] == b"\x30next"
