"""A TCP port for clients that may do anything: none of them blocks the server or uses up its descriptors.

A page in any browser of this computer can send HTTP, with anything in its body, to every port. So a client is closed whose
first byte does not begin a message of the protocol; one that sends nothing first may listen. Beyond `CLIENTS_MAX` a new
client replaces the one silent for longest. Each of these is reported in a line, at most one of a kind in `REPORT_US`.
"""

import os
import socket
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from hil.board.clock import Readers

CLIENTS_MAX = 32
REPORT_US = 1_000_000
FIRST_SHOWN = 16  # bytes of a refused client

Receive = Callable[[int, bytes], object]  # (now_us, data)


@dataclass(frozen=True, slots=True)
class TcpProtocol:
    """What clients of a port send."""

    name: str  # of the port, for the user
    begins: bytes  # the first bytes that a message may have
    read_size: int
    send_buffer: int | None = None  # bytes for a client that does not read, None: the system's choice


class TcpPort:
    """Listens on `host:port` (0: any). `join` returns what takes a new client's bytes; `say` gets lines for the user.

    Raises `OSError`.
    """

    def __init__(
        self,
        address: tuple[str, int],
        readers: Readers,
        protocol: TcpProtocol,
        join: Callable[["TcpClient"], Receive],
        say: Callable[[str], None],
    ) -> None:
        self.clients: dict[TcpClient, None] = {}  # the latest sender is last
        self.readers, self.protocol = readers, protocol
        self._join, self._say = join, say
        self._listener = socket.create_server(address)
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        self._spare = os.open(
            os.devnull, os.O_RDONLY
        )  # closed to refuse a client when no other descriptor is left
        self._reported: dict[str, tuple[int, int]] = {}  # by kind: when last, and how many since
        readers[self._listener] = self._accept

    def report(self, now_us: int, client: str, kind: str, detail: str = "") -> None:
        """Tell the user about a client; of many such lines only some."""
        last_us, unsaid = self._reported.get(kind, (now_us - REPORT_US, 0))
        if now_us < last_us + REPORT_US:
            self._reported[kind] = last_us, unsaid + 1
            return
        self._reported[kind] = now_us, 0
        more = f" ({unsaid} such lines before)" if unsaid else ""
        self._say(f"{self.protocol.name} port {self.port}: {client} {kind}{detail}{more}")

    def _accept(self, now_us: int) -> None:
        try:
            connection, address = self._listener.accept()
        except (BlockingIOError, ConnectionError):  # it has left already
            return
        except OSError as error:
            self._refuse()
            self.report(now_us, "a client", f"was refused: {error.strerror}")
            return
        if len(self.clients) >= CLIENTS_MAX:
            silent = next(iter(self.clients))
            silent.close()
            self.report(
                now_us, silent.name, f"was closed: silent for longest of more than {CLIENTS_MAX} clients"
            )
        client = TcpClient(self, connection, "{}:{}".format(*address))
        self.clients[client] = None
        client.listen(self._join(client))

    def _refuse(self) -> None:
        """Close the next client without a free descriptor: otherwise it stays readable, and time is spent on it."""
        with suppress(OSError):
            os.close(self._spare)
            self._listener.accept()[0].close()
        with suppress(OSError):
            self._spare = os.open(os.devnull, os.O_RDONLY)

    def close(self) -> None:
        """Stop listening; the clients notice. Closing again has no effect."""
        if self.readers.pop(self._listener, None) is None:
            return
        for client in [*self.clients]:
            client.close()
        self._listener.close()
        with suppress(OSError):
            os.close(self._spare)


class TcpClient:
    """One connection."""

    def __init__(self, port: TcpPort, connection: socket.socket, name: str) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if port.protocol.send_buffer is not None:
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, port.protocol.send_buffer)
        self.name = name
        self._port, self._socket = port, connection
        self._begun = False

    def offer(self, data: bytes) -> int:
        """Send as many bytes as the client has room for; return their number."""
        if self not in self._port.clients:
            return 0
        try:
            return self._socket.send(data)
        except BlockingIOError:
            return 0
        except OSError:
            self.close()
            return 0

    def send(self, now_us: int, data: bytes) -> None:
        """Send bytes, none of which may be lost: a client whose buffers are full does not read, and is closed."""
        if self.offer(data) < len(data) and self in self._port.clients:
            self.close()
            self._port.report(now_us, self.name, "was closed: it does not read its answers")

    def listen(self, receive: Receive) -> None:
        """Let `receive` take what arrives from now on."""
        if self in self._port.clients:
            self._port.readers[self._socket] = partial(self._read, receive)

    def pause(self) -> None:
        """Read no more before `listen`; the client's writes wait meanwhile."""
        self._port.readers.pop(self._socket, None)

    def _read(self, receive: Receive, now_us: int) -> None:
        """Pass on what has arrived."""
        try:
            data = self._socket.recv(self._port.protocol.read_size)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.close()
            return
        if not self._begun and data[0] not in self._port.protocol.begins:
            self.close()
            self._port.report(
                now_us, self.name, "was closed: not of this protocol", f": {data[:FIRST_SHOWN]!r}"
            )
            return
        self._begun = True
        self._port.clients[self] = self._port.clients.pop(self)
        receive(now_us, data)

    def close(self) -> None:
        """Disconnect it; closing again has no effect."""
        if self in self._port.clients:
            del self._port.clients[self]
            self.pause()
            self._socket.close()
