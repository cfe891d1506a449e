"""The open end of a served board's serial line: a pty, a UDP socket that sends first, or a TCP port.

`hil.board.uart` is the line itself (baud rate, buffers, bit errors); this file only passes bytes on. Nothing here
blocks: bytes that a client does not read are lost, as without flow control, and the board does not notice when a client
leaves.
"""

import os
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol

from hil.board.clock import Readers
from hil.errors import LabError
from hil.servers.dongle_server import HOST
from hil.servers.tcp_port import TcpPort, TcpProtocol

Received = Callable[[int, bytes], object]  # (now_us, data)

READ_SIZE = 4096
# More than a client's socket buffers on the loopback interface in one turn of the server: all that a client has sent is
# read, so that another client's frames do not split its own.
WHOLE_SIZE = 1 << 18
MAVLINK_CLIENTS = TcpProtocol("mavlink tcp", b"\xfd\xfe", WHOLE_SIZE)
UDP_PORT = 14550  # where ground stations listen
TCP_PORT = 5760  # where vehicles listen
PTYS = "/dev/pts/"
EXPECTED = "expected pty, pty:PATH, udp, udp:PORT, udp:HOST:PORT, tcp, tcp:PORT or tcp:HOST:PORT"


class Endpoint(Protocol):
    """One open end."""

    master: str  # its name for MAVProxy, after `--master=`

    def send(self, data: bytes) -> None:
        """Pass the board's bytes to the client, if there is one."""

    def close(self) -> None:
        """Release all resources; closing again has no effect."""


@dataclass(frozen=True, slots=True)
class Address:
    """An end that can be opened."""

    kind: str  # pty, udp, tcp
    host: str = HOST
    port: int = 0
    path: Path | None = None  # of a link to the pty

    def open(self, readers: Readers, received: Received, say: Callable[[str], None]) -> Endpoint:
        """Open it; `received` gets the clients' bytes, `say` lines for the user. Raises `LabError` on failure."""
        where = self.path or f"{self.host}:{self.port}"
        try:
            if self.kind == "pty":
                return PtyEnd(self.path, readers, received)
            if self.kind == "udp":
                return UdpEnd(self.host, self.port, readers, received)
            return TcpEnd(self.host, self.port, readers, received, say)
        except OSError as error:
            raise LabError(f"mavlink {self.kind} {where}: {error.strerror or error}") from None


def parse_addresses(text: str, count: int) -> list[Address]:
    """Return one address per board: ports count up, links to ptys get `-2`, `-3`, ..."""
    kind, _, rest = text.partition(":")
    if kind == "pty":
        if not rest:
            return [Address("pty")] * count
        return [Address("pty", path=Path(rest + (f"-{n}" if n > 1 else ""))) for n in range(1, count + 1)]
    if kind not in ("udp", "tcp"):
        raise LabError(f"--mavlink {text}: {EXPECTED}")
    host, _, number = rest.rpartition(":")
    default = UDP_PORT if kind == "udp" else TCP_PORT
    if number and not (number.isascii() and number.isdigit() and len(number) <= 5):
        raise LabError(f"--mavlink {text}: {EXPECTED}")
    port = int(number) if number else default
    if port + count - 1 > 65535 or (kind == "udp" and port == 0):
        raise LabError(f"--mavlink {text}: port {port} is not possible for {count} boards")
    return [Address(kind, host or HOST, port + n if port else 0) for n in range(count)]


class PtyEnd:
    """A pseudo terminal: for a client a serial port, of which it may set the baud rate without effect."""

    def __init__(self, link: Path | None, readers: Readers, received: Received) -> None:
        import termios  # not on every system
        import tty

        self._readers = readers
        self._received = received
        self._link = link
        self._closed = False
        if link is not None and link.is_symlink() and os.readlink(link).startswith(PTYS):
            link.unlink()  # left by a killed server
        self._master, self._slave = os.openpty()  # the slave stays open, so that clients may come and go
        self._forget_unread = partial(termios.tcflush, self._slave, termios.TCIFLUSH)
        device = os.ttyname(self._slave)
        self.master = device if link is None else str(link)
        try:
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            if link is not None:
                link.symlink_to(device)
        except OSError:
            os.close(self._master)
            os.close(self._slave)
            raise
        readers[self._master] = self._read

    def send(self, data: bytes) -> None:
        """Pass bytes on; drop the waiting ones when nobody reads."""
        try:
            written = os.write(self._master, data)
        except BlockingIOError:
            written = 0
        if written < len(data):
            self._forget_unread()

    def _read(self, now_us: int) -> None:
        with suppress(BlockingIOError):
            self._received(now_us, os.read(self._master, READ_SIZE))

    def close(self) -> None:
        """Remove the pty and the link to it."""
        if self._closed:  # another end may use its descriptors and its link by now
            return
        self._closed = True
        if self._link is not None:
            with suppress(OSError):
                self._link.unlink()
        del self._readers[self._master]
        os.close(self._master)
        os.close(self._slave)


class UdpEnd:
    """Sends to a ground station and takes its answers."""

    def __init__(self, host: str, port: int, readers: Readers, received: Received) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.connect((host, port))
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise
        self.master = f"udpin:{host}:{port}"
        self._readers = readers
        self._received = received
        readers[self._socket] = self._read

    def send(self, data: bytes) -> None:
        """Send a datagram; it is lost without a listener."""
        with suppress(OSError):
            self._socket.send(data)

    def _read(self, now_us: int) -> None:
        with suppress(OSError):  # reports a datagram that nobody received
            self._received(now_us, self._socket.recv(READ_SIZE))

    def close(self) -> None:
        self._readers.pop(self._socket, None)
        self._socket.close()


class TcpEnd:
    """Listens for any number of clients: all hear the board, and it hears them all."""

    def __init__(
        self, host: str, port: int, readers: Readers, received: Received, say: Callable[[str], None]
    ) -> None:
        self._port = TcpPort((host, port), readers, MAVLINK_CLIENTS, lambda client: received, say)
        self.master = f"tcp:{host}:{self._port.port}"

    def send(self, data: bytes) -> None:
        """Pass bytes on; a slow client loses those it does not read."""
        for client in [*self._port.clients]:
            client.offer(data)

    def close(self) -> None:
        """Stop listening; the clients notice."""
        self._port.close()
