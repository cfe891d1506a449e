"""A TCP port whose clients may do anything: flood, never read, stay silent, speak HTTP, be too many."""

import resource
import socket
import struct
from collections.abc import Callable, Iterator

import pytest

from hil.board.clock import Paced
from hil.servers.tcp_port import CLIENTS_MAX, REPORT_US, Receive, TcpClient, TcpPort, TcpProtocol

PATIENCE_S = 20.0
ANSWER = b"a" * 1000


class Bench:
    """A port on which a message is an M; each is answered."""

    def __init__(self) -> None:
        self.said: list[str] = []
        self.received = bytearray()
        self.clock = Paced()
        self.port = TcpPort(
            ("127.0.0.1", 0), self.clock.readers, TcpProtocol("test", b"M", 4096), self.join, self.said.append
        )
        self.clients: list[socket.socket] = []
        self.now_us = 0

    def join(self, client: TcpClient) -> Receive:
        def receive(now_us: int, data: bytes) -> None:
            self.received.extend(data)
            for _ in range(data.count(b"M")):
                client.send(now_us, ANSWER)

        return receive

    def connect(self) -> socket.socket:
        client = socket.create_connection(("127.0.0.1", self.port.port), PATIENCE_S)
        self.clients.append(client)
        self.serve()
        return client

    def serve(self) -> None:
        """Serve the next input."""
        self.clock.wait_until(self.clock.now_us() + round(PATIENCE_S * 1e6))
        assert self.clock._readable
        self.clock.serve(self.now_us)

    def serve_until(self, done: Callable[[], object]) -> None:
        while not done():
            self.serve()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    bench.clock.start(0)
    yield bench
    bench.port.close()
    assert bench.clock.readers == {}
    for client in bench.clients:
        client.close()


def is_closed(client: socket.socket) -> bool:
    """Whether the server has closed the connection; a reset is one, too."""
    try:
        while client.recv(65536):
            pass
    except ConnectionResetError:
        pass
    return True


@pytest.mark.parametrize(
    "begin", [b"POST / HTTP/1.1\r\n\r\nM", b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01M", b"\0M"]
)
def test_a_client_of_another_protocol_is_closed_and_not_heard(bench: Bench, begin: bytes) -> None:
    client, listener = bench.connect(), bench.connect()
    client.sendall(begin)
    bench.serve()
    assert is_closed(client)
    assert bench.received == b""
    name = "{}:{}".format(*client.getsockname())
    assert bench.said == [
        f"test port {bench.port.port}: {name} was closed: not of this protocol: {begin[:16]!r}"
    ]
    for one in [*bench.port.clients]:
        one.offer(b"to all that listen")
    assert listener.recv(100) == b"to all that listen"


def test_any_byte_may_follow_the_first(bench: Bench) -> None:
    client = bench.connect()
    client.sendall(b"M")
    bench.serve()
    client.sendall(b"GET / HTTP/1.1\r\n")
    bench.serve()
    assert bench.received == b"MGET / HTTP/1.1\r\n"


def test_a_client_that_writes_and_never_reads_is_closed_in_one_line(bench: Bench) -> None:
    deaf, other = bench.connect(), bench.connect()
    deaf.setblocking(False)
    while len(bench.port.clients) == 2:
        try:
            deaf.send(b"M" * 1000)
        except BlockingIOError:
            pass
        except OSError:
            break
        bench.serve()
    assert len(bench.said) == 1
    assert bench.said[0].endswith(" was closed: it does not read its answers")
    other.sendall(b"M")
    bench.serve()
    assert other.recv(2000) == ANSWER


def test_one_client_more_replaces_the_one_silent_for_longest(bench: Bench) -> None:
    clients = [bench.connect() for _ in range(CLIENTS_MAX)]
    clients[0].sendall(b"M")
    bench.serve()
    assert clients[0].recv(2000) == ANSWER
    newest = bench.connect()
    assert is_closed(clients[1])
    for client in (clients[0], clients[2], newest):
        client.sendall(b"M")
        bench.serve()
        assert client.recv(2000) == ANSWER
    assert len(bench.said) == 1
    assert f"was closed: silent for longest of more than {CLIENTS_MAX} clients" in bench.said[0]


def test_a_thousand_clients_are_reported_in_one_line_a_second(bench: Bench) -> None:
    for number in range(100):
        bench.now_us = number * REPORT_US // 40
        bench.connect().close()
        bench.serve_until(lambda: not bench.port.clients)
        bench.connect().sendall(b"HTTP")
        bench.serve_until(lambda: not bench.port.clients)
    assert len(bench.said) == 3
    assert all(line.endswith("(39 such lines before)") for line in bench.said[1:])


def test_a_client_without_a_free_descriptor_is_refused_and_the_next_one_is_served(bench: Bench) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with socket.socket() as refused:
        refused.connect(("127.0.0.1", bench.port.port))
        with socket.socket() as lowest:
            free = lowest.fileno()
        try:
            resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
            bench.serve()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        assert is_closed(refused)
    assert bench.said == [f"test port {bench.port.port}: a client was refused: Too many open files"]
    client = bench.connect()
    client.sendall(b"M")
    bench.serve()
    assert client.recv(2000) == ANSWER


def reset(client: socket.socket) -> None:
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()


def test_a_client_that_resets_its_connection_is_forgotten_whoever_notices(bench: Bench) -> None:
    read, written = bench.connect(), bench.connect()
    first, second = bench.port.clients
    reset(read)
    bench.serve()
    assert [*bench.port.clients] == [second]
    reset(written)
    assert [second.offer(b"x"), second.offer(b"x")] == [0, 0]
    assert [*bench.port.clients] == [] == bench.said
    second.listen(lambda now_us, data: None)
    first.send(0, b"x")
    assert [*bench.port.readers] == [bench.port._listener]


def test_where_nothing_has_arrived_nothing_is_read_and_nobody_closed(bench: Bench) -> None:
    bench.connect()
    (client,) = bench.port.clients
    for reader in [*bench.port.readers.values()]:
        reader(0)
    assert ([*bench.port.clients], bench.said) == ([client], [])
    client.pause()
    client.listen(lambda now_us, data: bench.received.extend(data))
    bench.clients[0].sendall(b"M")
    bench.serve()
    assert bench.received == b"M"
