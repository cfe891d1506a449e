"""Clients of the ends of a served board's line, one per kind of end; every end with a client passes messages both ways.

Nothing here looks at the clock: the loopback interface needs none, and who waits for what never comes gives up.
"""

import select
import socket
from collections.abc import Callable
from typing import Any, Protocol

import serial

from hil.board.clock import Readers
from hil.servers.serial_server import Address
from hil.servers.udp_server import UdpServer

PATIENCE_S = 20.0


class OpenEnd:
    """An open end and the bytes that came in."""

    def __init__(
        self, opened: Callable[[Readers, Callable[[int, bytes], object], Callable[[str], None]], Any]
    ) -> None:
        self.readers: Readers = {}
        self.received = bytearray()
        self.said: list[str] = []
        self.end = opened(self.readers, lambda now_us, data: self.received.extend(data), self.said.append)

    def serve_until(self, done: Callable[[], Any]) -> None:
        """Answer readable sockets until `done()`."""
        while not done():
            ready = select.select(list(self.readers), (), (), PATIENCE_S)[0]
            assert ready, f"nothing more after {bytes(self.received)!r}"
            for reader in ready:
                self.readers[reader](0)

    def close(self) -> None:
        self.end.close()
        assert self.readers == {}


class LineClient(Protocol):
    """A program at the end."""

    def write(self, data: bytes) -> object: ...

    def exactly(self, size: int) -> bytes: ...

    def close(self) -> None: ...


class PtyClient:
    def __init__(self, open_end: OpenEnd) -> None:
        self._serial = serial.Serial(open_end.end.master, 57600, timeout=PATIENCE_S)
        self.write, self.exactly, self.close = self._serial.write, self._serial.read, self._serial.close


class TcpClient:
    def __init__(self, open_end: OpenEnd) -> None:
        host, port = open_end.end.master.split(":")[1:]
        before = set(open_end.readers)
        self._socket = socket.create_connection((host, int(port)), PATIENCE_S)
        self.write, self.close = self._socket.sendall, self._socket.close
        open_end.serve_until(lambda: open_end.readers.keys() - before)
        received = len(open_end.received)
        self.write(b"\xfd")  # a frame of MAVLink begins; the tests send what they want
        open_end.serve_until(lambda: len(open_end.received) > received)
        del open_end.received[received:]

    def exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size and (more := self._socket.recv(size - len(data))):
            data += more
        return data


class _Datagrams:
    """Joins datagrams; `CALL` is what an end says that talks first."""

    CALL = b"?"
    peer: Any

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(PATIENCE_S)
        self.close = self._socket.close

    def write(self, data: bytes) -> None:
        self._socket.sendto(data, self.peer)

    def exactly(self, size: int) -> bytes:
        data = b""
        while len(data) < size:
            datagram = self._socket.recv(size)
            data += datagram if datagram != self.CALL else b""
        return data


class UdpClient(_Datagrams):
    """A ground station that listens where the end sends to."""

    def __init__(self, open_end: OpenEnd) -> None:
        super().__init__()
        host, port = open_end.end.master.split(":")[1:]
        self._socket.bind((host, int(port)))
        # The first call may be told that nobody listened.
        while not select.select([self._socket], (), (), 0.01)[0]:
            open_end.end.send(self.CALL)
        self.peer = self._socket.recvfrom(100)[1]


class CrtpUdpClient(_Datagrams):
    """A program with a Crazyflie's UDP link, which talks first."""

    def __init__(self, open_end: OpenEnd) -> None:
        super().__init__()
        self.peer = ("127.0.0.1", open_end.end.port)
        before = len(open_end.received)
        self.write(b"hello")
        open_end.serve_until(lambda: len(open_end.received) == before + 5)
        del open_end.received[before:]


ENDS: dict[str, tuple[Callable[[Any], OpenEnd], Callable[[OpenEnd], LineClient]]] = {
    "pty": (lambda path: OpenEnd(Address("pty", path=path).open), PtyClient),
    "udp": (lambda port: OpenEnd(Address("udp", port=port).open), UdpClient),
    "tcp": (lambda port: OpenEnd(Address("tcp", port=port).open), TcpClient),
    "crtp": (
        lambda port: OpenEnd(lambda readers, received, say: UdpServer(port, readers, received, say)),
        CrtpUdpClient,
    ),
}
