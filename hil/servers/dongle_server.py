"""The USB side of the virtual dongles: a localhost socket on which `dongle_plugin` sends its transfers.

Each connection is a separate dongle. Nothing here blocks: the board server calls the port and the connections when their
sockets are readable. Frames: see `dongle_plugin`.
"""

from collections.abc import Callable, Sequence

from hil.board.clock import Readers
from hil.board.dongle import VirtualDongle
from hil.errors import LabError
from hil.servers.dongle_plugin import CONTROL, HEAD_SIZE, PAUSES, PORTS, READ, WRITE, frame
from hil.servers.tcp_port import Receive, TcpClient, TcpPort, TcpProtocol

HOST = "127.0.0.1"
AHEAD = (
    8  # cflib gives up a transfer after a time-out and sends the next: with 1, it reconnects seconds later
)
PROTOCOL = TcpProtocol(
    "radio", CONTROL + WRITE + PAUSES, 4096, send_buffer=8192
)  # a client awaits one answer at a time


class DongleServer:
    """Listens on a port (0: any) of the loopback interface and plugs a new dongle in for every connection.

    `others` are the ports of such servers in other processes, which a client also connects to. `stood_still_us` returns how
    long simulated time stood still so far.
    """

    def __init__(
        self,
        port: int,
        readers: Readers,
        new_dongle: Callable[[], VirtualDongle],
        say: Callable[[str], None],
        others: Sequence[int] = (),
        stood_still_us: Callable[[int], int] = lambda now_us: 0,
    ) -> None:
        self._others = b"".join(other.to_bytes(2) for other in others)
        self._new_dongle, self._stood_still_us = new_dongle, stood_still_us
        try:
            self._port = TcpPort((HOST, port), readers, PROTOCOL, self._plug_in, say)
        except OSError as error:
            raise LabError(f"radio port {port}: {error.strerror or error}") from None
        self.port = self._port.port

    def _plug_in(self, client: TcpClient) -> Receive:
        client.offer(frame(PORTS, 0, self._others))
        return _UsbCable(client, self._new_dongle(), self._stood_still_us).receive

    def close(self) -> None:
        """Unplug all dongles and stop listening."""
        self._port.close()


class _UsbCable:
    """One connection and its dongle, which has at most `AHEAD` transfers in progress: a client that is ahead waits."""

    def __init__(
        self, client: TcpClient, dongle: VirtualDongle, stood_still_us: Callable[[int], int]
    ) -> None:
        self._client, self._stood_still_us = client, stood_still_us
        self._dongle = dongle
        self._received = b""
        self._awaited = 0  # answers of the dongle

    def receive(self, now_us: int, data: bytes) -> None:
        """Take bytes of the client."""
        self._received += data
        if self._awaited >= AHEAD:
            self._client.pause()
        else:
            self._work(now_us)

    def _work(self, now_us: int) -> None:
        """Execute the frames that are complete, up to one that is answered."""
        while self._awaited < AHEAD and len(self._received) >= HEAD_SIZE:
            size = HEAD_SIZE + self._received[2]
            if len(self._received) < size:
                break
            request, self._received = self._received[:size], self._received[size:]
            self._execute(now_us, request)

    def _execute(self, now_us: int, request: bytes) -> None:
        kind, sequence, data = request[:1], request[1], request[HEAD_SIZE:]
        if kind == CONTROL and len(data) >= 3:
            self._dongle.control(data[0], data[1] | data[2] << 8, data[3:])
        elif kind == PAUSES:
            self._client.send(now_us, frame(READ, sequence, self._stood_still_us(now_us).to_bytes(8)))
        elif kind == WRITE and data:
            self._awaited += self._dongle.acknowledges
            self._dongle.transmit(now_us, data, lambda t_us, answer: self._answer(t_us, sequence, answer))

    def _answer(self, now_us: int, sequence: int, answer: bytes) -> None:
        self._awaited -= 1
        self._client.send(now_us, frame(READ, sequence, answer))
        self._client.listen(self.receive)
        self._work(now_us)
