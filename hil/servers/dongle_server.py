"""The USB side of the virtual dongles: a localhost socket on which `dongle_plugin` sends its transfers.

Each connection is a separate dongle. Nothing here blocks: the board server calls `accept` and the connections when their
sockets are readable. Frames: see `dongle_plugin`.
"""

import socket
from collections.abc import Callable, Sequence
from contextlib import suppress

from hil.clock import Readers
from hil.devices.dongle import VirtualDongle
from hil.errors import LabError
from hil.servers.dongle_plugin import CONTROL, HEAD_SIZE, PORTS, READ, WRITE, frame

HOST = "127.0.0.1"


class DongleServer:
    """Listens on a port (0: any) of the loopback interface and plugs a new dongle in for every connection.

    `others` are the ports of such servers in other processes, which a client also connects to.
    """

    def __init__(
        self, port: int, readers: Readers, new_dongle: Callable[[], VirtualDongle], others: Sequence[int] = ()
    ) -> None:
        self._others = b"".join(other.to_bytes(2) for other in others)
        self._readers = readers
        self._new_dongle = new_dongle
        self._cables: list[_UsbCable] = []
        try:
            self._socket = socket.create_server((HOST, port))
        except OSError as error:
            raise LabError(f"radio port {port}: {error.strerror or error}") from None
        self.port: int = self._socket.getsockname()[1]
        readers[self._socket] = self._accept

    def _accept(self, now_us: int) -> None:
        connection, _ = self._socket.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with suppress(OSError):  # a client that only looks whether it is there
            connection.sendall(frame(PORTS, 0, self._others))
        self._cables = [cable for cable in self._cables if cable.plugged]
        self._cables.append(_UsbCable(connection, self._readers, self._new_dongle()))

    def close(self) -> None:
        """Unplug all dongles and stop listening."""
        for cable in self._cables:
            cable.unplug()
        del self._readers[self._socket]
        self._socket.close()


class _UsbCable:
    """One connection and its dongle."""

    def __init__(self, connection: socket.socket, readers: Readers, dongle: VirtualDongle) -> None:
        self._socket = connection
        self._readers = readers
        self._dongle = dongle
        self._received = b""
        readers[connection] = self._read

    def _read(self, now_us: int) -> None:
        try:
            data = self._socket.recv(4096)
        except OSError:
            data = b""
        if not data:
            self.unplug()
            return
        self._received += data
        while len(self._received) >= HEAD_SIZE and len(self._received) >= HEAD_SIZE + self._received[2]:
            size = HEAD_SIZE + self._received[2]
            self._execute(now_us, self._received[:size])
            self._received = self._received[size:]

    def _execute(self, now_us: int, request: bytes) -> None:
        kind, sequence, data = request[:1], request[1], request[HEAD_SIZE:]
        if kind == CONTROL and len(data) >= 3:
            self._dongle.control(data[0], data[1] | data[2] << 8, data[3:])
        elif kind == WRITE and data:
            self._dongle.transmit(now_us, data, lambda t_us, answer: self._answer(sequence, answer))

    def _answer(self, sequence: int, answer: bytes) -> None:
        if not self.plugged:
            return
        try:
            self._socket.send(frame(READ, sequence, answer))
        except OSError:
            self.unplug()

    @property
    def plugged(self) -> bool:
        """Whether the host still holds the connection."""
        return self._socket in self._readers

    def unplug(self) -> None:
        """Unplug the dongle."""
        self._readers.pop(self._socket, None)
        self._socket.close()
