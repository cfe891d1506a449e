"""A board on `udp://127.0.0.1:PORT`: one datagram is one CRTP packet, for quick use without a radio.

The newest client is the session: packets of the board go to it until it is silent for `SESSION_TIMEOUT_US`; clients
that it displaced are ignored as long as they go on talking. Who looks for boards sends an empty packet and is answered
without becoming the session. What happens between here and the board is the matter of a `VirtualRadio`, which repeats
what the air loses: cflib does not repeat over UDP.
"""

import socket
from collections.abc import Callable
from contextlib import suppress

from hil.clock import Readers
from hil.devices.nrf51 import NULL, NULL_MASK
from hil.errors import LabError
from hil.servers.dongle_server import HOST

SESSION_TIMEOUT_US = 5_000_000
MAX_PACKET = 31

Address = tuple[str, int]


class UdpServer:
    """One board's port (0: any, kept afterwards). `received` gets the packets of the session."""

    def __init__(self, port: int, readers: Readers, received: Callable[[int, bytes], None]) -> None:
        self.port = port
        self._readers = readers
        self._received = received
        self._socket: socket.socket | None = None
        self.open()

    def open(self) -> None:
        """Listen (the board has power), without a session; `LabError` when somebody else has the port."""
        if self._socket is not None:
            return
        self._session: Address | None = None
        self._heard_us: dict[Address, int] = {}  # when each client spoke last
        opened = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        opened.setblocking(False)
        try:
            opened.bind((HOST, self.port))
        except OSError as error:
            opened.close()
            raise LabError(f"udp port {self.port}: {error.strerror or error}") from None
        self._socket = opened
        self.port = opened.getsockname()[1]
        self._readers[opened] = self._read

    def close(self) -> None:
        """Close the port (power off): clients are refused, which they notice."""
        if self._socket is not None:
            del self._readers[self._socket]
            self._socket.close()
            self._socket = None

    def end_session(self) -> None:
        """Displace the client, in favour of one on another link."""
        self._session = None

    def has_session(self, now_us: int) -> bool:
        """Whether a client talks to the board."""
        if self._socket is None or self._session is None:
            return False
        if now_us - self._heard_us[self._session] > SESSION_TIMEOUT_US:
            self._session = None
        return self._session is not None

    def send(self, data: bytes) -> None:
        """Send a packet of the board to the session, if there is one."""
        if self._socket is not None and self._session is not None:
            with suppress(OSError):  # its buffer is full or it is gone: UDP loses packets then
                self._socket.sendto(data, self._session)

    def _read(self, now_us: int) -> None:
        """Take one datagram."""
        assert self._socket is not None
        try:
            data, client = self._socket.recvfrom(2048)
        except OSError:  # the report of an earlier packet that a client did not want
            return
        if not 1 <= len(data) <= MAX_PACKET:
            return
        if data[0] & NULL_MASK == NULL and len(data) == 1:
            self._socket.sendto(data, client)
            return
        if not self._admit(now_us, client):
            return
        self._received(now_us, data)

    def _admit(self, now_us: int, client: Address) -> bool:
        """Make a new client the session; refuse one that was displaced."""
        last_us = self._heard_us.get(client)
        displaced = client != self._session and last_us is not None and now_us - last_us < SESSION_TIMEOUT_US
        if client != self._session and not displaced:
            self._session = client
            self._heard_us = {
                other: t_us for other, t_us in self._heard_us.items() if now_us - t_us < SESSION_TIMEOUT_US
            }
        self._heard_us[client] = now_us
        return not displaced
