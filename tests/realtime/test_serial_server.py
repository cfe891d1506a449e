"""The ends of a served serial line: bytes pass both ways, nobody who comes, leaves or sleeps holds the server up."""

import os
import select
import socket
import time

import pytest
import serial

from hil.errors import LabError
from hil.servers.serial_server import Address, parse_addresses
from support.serving import free_port

PATIENCE_S = 5.0


class OpenEnd:
    """An open end and the bytes that came in."""

    def __init__(self, address):
        self.readers, self.received = {}, bytearray()
        self.end = address.open(self.readers, lambda now_us, data: self.received.extend(data))

    def serve_until(self, done):
        """Answer readable sockets until `done()`."""
        deadline = time.monotonic() + PATIENCE_S
        while not done():
            assert time.monotonic() < deadline, f"nothing more after {bytes(self.received)!r}"
            for reader in select.select(list(self.readers), (), (), 0.01)[0]:
                self.readers[reader](0)

    def close(self):
        self.end.close()
        assert self.readers == {}


class PtyClient:
    def __init__(self, bench):
        self._serial = serial.Serial(bench.end.master, 57600, timeout=PATIENCE_S)
        self.write, self.exactly, self.close = self._serial.write, self._serial.read, self._serial.close


class TcpClient:
    def __init__(self, bench):
        host, port = bench.end.master.split(":")[1:]
        self._socket = socket.create_connection((host, int(port)), PATIENCE_S)
        self.write, self.close = self._socket.sendall, self._socket.close
        bench.serve_until(lambda: bench.end._client is not None)

    def exactly(self, size):
        return self._socket.recv(size, socket.MSG_WAITALL)


class UdpClient:
    def __init__(self, bench):
        host, port = bench.end.master.split(":")[1:]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind((host, int(port)))
        self.close = self._socket.close

        def heard():
            bench.end.send(b"?")
            return select.select([self._socket], (), (), 0.01)[0]

        bench.serve_until(heard)
        self._vehicle = self._socket.recvfrom(100)[1]

    def write(self, data):
        self._socket.sendto(data, self._vehicle)

    def exactly(self, size):
        while (data := self._socket.recv(size)) == b"?":
            pass
        return data


@pytest.fixture(
    params=[("pty", PtyClient), ("udp", UdpClient), ("tcp", TcpClient)], ids=lambda param: param[0]
)
def pair(request):
    """An end, and a class whose objects are clients of it."""
    kind, client = request.param
    bench = OpenEnd(Address(kind, port=free_port() if kind == "udp" else 0))
    yield bench, client
    bench.close()


def test_every_byte_passes_unchanged_both_ways(pair):
    bench, connect = pair
    client = connect(bench)
    everything = bytes(range(256))
    client.write(everything)
    bench.serve_until(lambda: len(bench.received) == 256)
    assert bench.received == everything
    bench.end.send(everything)
    assert client.exactly(256) == everything
    client.close()


def test_clients_come_and_go(pair):
    bench, connect = pair
    bench.end.send(b"nobody there")
    for number in range(3):
        client = connect(bench)
        client.write(b"%d" % number)
        bench.serve_until(lambda number=number: bench.received.endswith(b"%d" % number))
        bench.end.send(b"welcome")
        assert client.exactly(7) == b"welcome"
        client.close()
        bench.end.send(b"nobody there")
    assert bench.received == b"012"


def test_a_client_that_does_not_read_holds_nobody_up(pair):
    bench, connect = pair
    client = connect(bench)
    start = time.monotonic()
    for _ in range(20_000):
        bench.end.send(bytes(280))
    assert time.monotonic() - start < PATIENCE_S
    client.write(b"still here")
    bench.serve_until(lambda: bench.received == b"still here")
    client.close()


def test_a_second_tcp_client_waits_for_the_first_to_leave():
    bench = OpenEnd(Address("tcp"))
    where = bench.end._listener.getsockname()
    with socket.create_connection(where) as first, socket.create_connection(where) as second:
        first.sendall(b"1")
        second.sendall(b"2")
        bench.serve_until(lambda: bench.received == b"1")
        bench.end.send(b"for the first")
        assert first.recv(100) == b"for the first"
        first.close()
        bench.serve_until(lambda: bench.received == b"12")
        bench.end.send(b"for the second")
        assert second.recv(100) == b"for the second"
    bench.close()


def test_the_link_to_a_pty_is_made_and_removed(tmp_path):
    path = tmp_path / "floaty"
    bench = OpenEnd(Address("pty", path=path))
    assert bench.end.master == str(path)
    with serial.Serial(str(path), 921_600) as client:
        client.write(b"through the link")
        bench.serve_until(lambda: bench.received == b"through the link")
    bench.close()
    assert not os.path.lexists(path)


def test_the_link_of_a_killed_server_is_replaced_but_nothing_else(tmp_path):
    stale, file, other = tmp_path / "stale", tmp_path / "file", tmp_path / "other"
    stale.symlink_to("/dev/pts/99999")
    OpenEnd(Address("pty", path=stale)).close()
    file.write_text("mine")
    other.symlink_to(file)
    for path in (file, other, tmp_path / "no" / "folder"):
        with pytest.raises(LabError, match=f"mavlink pty {path}: "):
            Address("pty", path=path).open({}, lambda now_us, data: None)
    assert file.read_text() == "mine"
    assert other.is_symlink()


def test_a_port_in_use_is_named():
    bench = OpenEnd(Address("tcp"))
    port = bench.end._listener.getsockname()[1]
    with pytest.raises(LabError, match=f"mavlink tcp 127.0.0.1:{port}: Address already in use"):
        Address("tcp", port=port).open({}, lambda now_us, data: None)
    bench.close()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("pty", [("pty", 0, None), ("pty", 0, None)]),
        ("pty:/tmp/a:b", [("pty", 0, "/tmp/a:b"), ("pty", 0, "/tmp/a:b-2")]),
        ("udp", [("udp", 14550, None), ("udp", 14551, None)]),
        ("udp:1234", [("udp", 1234, None), ("udp", 1235, None)]),
        ("udp:10.0.0.7:1234", [("udp", 1234, None), ("udp", 1235, None)]),
        ("tcp", [("tcp", 5760, None), ("tcp", 5761, None)]),
        ("tcp:0", [("tcp", 0, None), ("tcp", 0, None)]),
        ("tcp:localhost:", [("tcp", 5760, None), ("tcp", 5761, None)]),
    ],
)
def test_addresses_count_up(text, expected):
    addresses = parse_addresses(text, 2)
    found = [(end.kind, end.port, None if end.path is None else str(end.path)) for end in addresses]
    assert found == expected
    host = {"udp:10.0.0.7:1234": "10.0.0.7", "tcp:localhost:": "localhost"}.get(text, "127.0.0.1")
    assert [end.host for end in addresses] == [host, host]


@pytest.mark.parametrize(
    "text", ["", "usb", "udp:x", "udp:0", "udp:127.0.0.1:x", "tcp:-1", "tcp:65535", "udp:²"]
)
def test_other_addresses_are_refused_in_one_line(text):
    with pytest.raises(LabError, match=r"^--mavlink ") as caught:
        parse_addresses(text, 2)
    assert "\n" not in str(caught.value)
