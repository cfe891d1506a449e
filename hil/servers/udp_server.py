"""A board on `udp://127.0.0.1:PORT`: one datagram is one CRTP packet, for quick use without a radio.

The first client is the session: the board receives only its packets, until it is silent for `SESSION_TIMEOUT_US` (cflib
pings ten times per second) or its port is closed. Packets of others are counted and reported in one line. A scan for
boards sends an empty packet and is answered without becoming the session.

A `VirtualRadio` carries packets between here and the board and repeats lost ones: cflib does not repeat over UDP.
"""

import socket
import sys
from collections.abc import Callable
from contextlib import suppress

from hil.board.clock import Readers
from hil.emulator.crazyflie.nrf51 import NULL, NULL_MASK
from hil.errors import LabError
from hil.servers.dongle_server import HOST

SESSION_TIMEOUT_US = 1_000_000
PROBE_PERIOD_US = 100_000  # between checks of the session's port, while others send
IP_RECVERR = 11  # Linux: report that a client's port is closed
MAX_PACKET = 31

Address = tuple[str, int]


class UdpServer:
    """One board's port (0: any, then fixed). `received` gets the packets of the session, `say` lines for the user."""

    def __init__(
        self, port: int, readers: Readers, received: Callable[[int, bytes], None], say: Callable[[str], None]
    ) -> None:
        self.port = port
        self.ignored = 0  # packets of others during this session
        self._say = say
        self._readers = readers
        self._received = received
        self._socket: socket.socket | None = None
        self._session: Address | None = None
        self._heard_us = 0  # of the session's last packet
        self._probed_us = -PROBE_PERIOD_US
        self.open()

    def open(self) -> None:
        """Listen (the board has power), without a session. Raises `LabError` when the port is taken."""
        if self._socket is not None:
            return
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setblocking(False)
        if sys.platform == "linux":
            opened.setsockopt(socket.IPPROTO_IP, IP_RECVERR, 1)
        try:
            opened.bind((HOST, self.port))
        except OSError as error:
            opened.close()
            raise LabError(f"udp port {self.port}: {error.strerror or error}") from None
        self._socket = opened
        self.port = opened.getsockname()[1]
        self._readers[opened] = self._read

    def close(self) -> None:
        """Close the port (power off): clients get an error, and the next session is a new one."""
        self.end_session()
        if self._socket is not None:
            del self._readers[self._socket]
            self._socket.close()
            self._socket = None

    def end_session(self) -> None:
        """Drop the client: it is gone, or one on another link is newer."""
        if self.ignored:
            self._say(f"udp port {self.port}: {self.ignored} packets of others were ignored")
        self.ignored = 0
        self._session = None

    def has_session(self, now_us: int) -> bool:
        """Whether a client is connected."""
        if self._socket is None or self._session is None:
            return False
        if now_us - self._heard_us > SESSION_TIMEOUT_US:
            self.end_session()
        return self._session is not None

    def send(self, data: bytes) -> None:
        """Send the board's packet to the session, if there is one."""
        if self._socket is not None and self._session is not None:
            try:
                self._socket.sendto(data, self._session)
            except ConnectionRefusedError:
                self.end_session()
            except OSError:  # its buffer is full: UDP loses packets then
                pass

    def _read(self, now_us: int) -> None:
        assert self._socket is not None
        try:
            data, client = self._socket.recvfrom(2048)
        except OSError as error:
            if isinstance(error, ConnectionRefusedError):  # reports an earlier packet: its client is gone
                self.end_session()
            self._forget_errors()
            return
        if not 1 <= len(data) <= MAX_PACKET:
            return
        if data[0] & NULL_MASK == NULL and len(data) == 1:
            with suppress(OSError):
                self._socket.sendto(data, client)
            return
        if not self._admit(now_us, client):
            return
        self._received(now_us, data)

    def _forget_errors(self) -> None:
        """Empty the queue of reports, with which the port stays readable."""
        with suppress(OSError):
            while self._socket is not None and sys.platform == "linux":
                self._socket.recvmsg(0, 0, socket.MSG_ERRQUEUE)

    def _probe(self, now_us: int) -> None:
        """Drop a session whose port is closed: its program has ended, and cflib sends its first packet only once."""
        if now_us - self._probed_us >= PROBE_PERIOD_US:
            self._probed_us = now_us
            for _ in range(2):  # the second reports the error of the first
                self.send(bytes((NULL,)))

    def _admit(self, now_us: int, client: Address) -> bool:
        """Make a client the session if there is none; refuse any other."""
        if client != self._session and self.has_session(now_us):
            self._probe(now_us)
        if self._session is not None and client != self._session:
            if self.ignored == 0:
                new, old = ("{}:{}".format(*address) for address in (client, self._session))
                self._say(f"udp port {self.port}: {new} is ignored while {old} talks to the board")
            self.ignored += 1
            return False
        self._session, self._heard_us = client, now_us
        return True
