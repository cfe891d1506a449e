"""What is a packet on a board's UDP port, to the byte; addresses of serial lines, to the last port."""

import socket
from collections.abc import Iterator

import pytest

from hil.clock import Readers
from hil.errors import LabError
from hil.servers.serial_server import parse_addresses
from hil.servers.udp_server import SESSION_TIMEOUT_US, UdpServer

Received = list[tuple[int, bytes]]


class Bench:
    """A server and clients; whatever they send has arrived when `read` is called."""

    def __init__(self) -> None:
        self.readers: Readers = {}
        self.received: Received = []
        self.server = UdpServer(
            0, self.readers, lambda now_us, data: self.received.append((now_us, data)), [].append
        )
        self.clients = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        for client in self.clients:
            client.settimeout(30.0)
            client.connect(("127.0.0.1", self.server.port))

    def send(self, client: int, data: bytes, now_us: int = 0) -> None:
        self.clients[client].send(data)
        (read,) = self.readers.values()
        read(now_us)

    def close(self) -> None:
        self.server.close()
        for client in self.clients:
            client.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()


@pytest.mark.parametrize(
    ("size", "is_packet"), [(0, False), (1, True), (31, True), (32, False), (60_000, False)]
)
def test_a_datagram_longer_than_a_packet_or_empty_is_none(bench: Bench, size: int, is_packet: bool) -> None:
    bench.send(0, bytes([0x30] * size), 7)
    assert bench.received == ([(7, bytes([0x30] * size))] if is_packet else [])
    assert bench.server.has_session(7) == is_packet
    bench.send(0, b"\x30next", 8)
    assert bench.received[-1] == (8, b"\x30next")


def test_a_session_ends_after_a_second_of_silence_and_not_before(bench: Bench) -> None:
    bench.send(0, b"\x30a")
    assert bench.server.has_session(SESSION_TIMEOUT_US)
    assert not bench.server.has_session(SESSION_TIMEOUT_US + 1)
    assert not bench.server.has_session(0)


@pytest.mark.parametrize(
    ("text", "count", "ports"),
    [
        ("tcp:65535", 1, [65535]),
        ("tcp:65534", 2, [65534, 65535]),
        ("tcp:0", 2, [0, 0]),
        ("udp", 2, [14550, 14551]),
    ],
)
def test_ports_of_boards_count_up_to_the_last_and_any_port_is_any(
    text: str, count: int, ports: list[int]
) -> None:
    assert [address.port for address in parse_addresses(text, count)] == ports


@pytest.mark.parametrize(("text", "count"), [("tcp:65536", 1), ("tcp:65535", 2), ("udp:0", 1)])
def test_a_port_that_there_is_not_for_every_board_is_one_line(text: str, count: int) -> None:
    with pytest.raises(LabError, match=f"is not possible for {count} boards"):
        parse_addresses(text, count)
