"""A board on UDP hears one client at a time; the time is the test's own."""

import select
import socket
from collections.abc import Iterator

import pytest

from hil.servers.udp_server import SESSION_TIMEOUT_US, UdpServer

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


def test_a_client_that_is_silent_for_long_loses_the_board(board: Board, clients: list[socket.socket]) -> None:
    first, second, _ = clients
    first.send(b"\xf0a")
    board.read(0)
    second.send(b"\xf0b")
    board.read(SESSION_TIMEOUT_US)  # not silent for longer than that
    assert board.received == [b"\xf0a"]
    second.send(b"\xf0c")
    board.read(SESSION_TIMEOUT_US + 1)
    assert board.received == [b"\xf0a", b"\xf0c"]
    assert board.said[-1].endswith("1 packets of others were ignored")


def test_a_client_that_is_gone_makes_room_at_once(board: Board, clients: list[socket.socket]) -> None:
    first, second, _ = clients
    first.send(b"\xf0a")
    board.read(0)
    first.close()
    second.send(b"\xf0b")  # cflib sends its first packet over UDP once
    board.read(1)
    assert board.received == [b"\xf0a", b"\xf0b"]
    assert board.said == []


def test_a_prober_is_answered_and_changes_nothing(board: Board, clients: list[socket.socket]) -> None:
    first, prober, _ = clients
    first.send(b"\xf0a")
    board.read(0)
    prober.send(b"\xff")
    board.read(1)
    assert prober.recv(64) == b"\xff"
    assert (board.received, board.server.ignored, board.said) == ([b"\xf0a"], 0, [])


@pytest.mark.parametrize("size", [0, 32, 2048, 9000])
def test_datagrams_that_are_no_packet_are_dropped(
    board: Board, clients: list[socket.socket], size: int
) -> None:
    clients[0].send(b"\xf0" * size)
    board.read(0)
    assert board.received == []
