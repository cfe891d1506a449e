"""OptiTrack: the sockets of a NatNet client. Frames arrive at the command socket or, by multicast, at another one.

Both sockets are bound to the interface that leads to the server, the latter to the group. Answers count only from the
server's command port. Motive does not announce the port that frames come from: the first port that sends some is kept for as
long as it streams, unless the command port sends them.
"""

import socket
import sys
from contextlib import suppress

from ground_station.clock import clock_us, readable
from ground_station.config import CaptureConfig
from ground_station.errors import MocapError
from ground_station.mocap import MocapFrame
from ground_station.sources.alignment import Alignment
from ground_station.sources.natnet import COMMAND_PORT, MessageId, packet
from ground_station.sources.natnet_stream import NatnetStream

CONNECT_TIMEOUT_US = 3_000_000
PACKET_MAX = 65_536
FRAMES_END_US = 1_000_000  # without frames of the port that sent them
IP_MULTICAST_ALL = 49  # Linux: 0 keeps groups away that other programs have joined


class OptitrackSource:
    """Follows one body of a Motive."""

    def __init__(self, capture: CaptureConfig) -> None:
        self._host = capture.host
        self._port = capture.port or COMMAND_PORT
        self._body = capture.body
        self._multicast = capture.multicast
        self._alignment = Alignment(capture)
        self._stream = NatnetStream(self._body, self._alignment)
        self._sockets: list[socket.socket] = []
        self._waiting: list[socket.socket] = []  # sockets that have packets
        self._address = self._interface = ""  # of the server, and ours towards it
        self._frames_from, self._frame_us = 0, 0  # the port of the latest frame, and its arrival
        self._warned = False  # about a foreign packet

    def open(self) -> None:
        """Find the server and the body; raises `MocapError` within 4 s."""
        self._stream = NatnetStream(self._body, self._alignment)
        try:
            self._address = socket.gethostbyname(self._host)
            self._interface = self._interface_to_server()
            self._frames_from, self._frame_us, self._warned = 0, 0, False
            self._add_socket(self._interface, 0)
            self._connect()
        except OSError as error:
            self.close()
            raise MocapError(f"{self._host}: {error.strerror or error}") from None
        except MocapError:
            self.close()
            raise

    def _connect(self) -> None:
        stream = self._stream
        deadline_us = clock_us() + CONNECT_TIMEOUT_US
        while stream.models is None:
            self.receive(0.05)
            if clock_us() > deadline_us:
                raise MocapError(f"{self._host}:{self._port}: {stream.missing()}")
        server = stream.server
        assert server is not None
        if self._multicast and not server.multicast:
            raise MocapError(f"{server.name} at {self._host} does not stream by multicast")
        if server.multicast:
            self._join(server.group, server.data_port)
        version = f"NatNet {stream.version[0]}.{stream.version[1]}"
        transport = "multicast" if server.multicast else "unicast"
        stream.notices.append(
            f"mocap {server.name} at {self._host}, {version}, {transport}, {self._alignment.axes}"
        )

    def receive(self, timeout_s: float) -> MocapFrame | None:
        deadline_us = clock_us() + round(timeout_s * 1e6)
        while True:
            data = self._next_packet(0)
            self._send(clock_us(), packets_wait=data is not None)
            if data is None:
                data = self._next_packet(deadline_us)
            if data is None:
                return None
            frame = self._stream.on_packet(data, clock_us())
            if frame is not None:
                return frame

    def notices(self) -> list[str]:
        notices = self._stream.notices.copy()
        self._stream.notices.clear()
        return notices

    def summary(self) -> str:
        counters = self._stream.counters
        return f"mocap {counters.lost} lost, {counters.dropped} dropped, {counters.malformed} malformed"

    def close(self) -> None:
        for index, each in enumerate(self._sockets):
            if index == 0 and self._address:
                with suppress(OSError):
                    each.sendto(packet(MessageId.DISCONNECT, b"\0"), (self._address, self._port))
            each.close()
        self._sockets, self._waiting = [], []

    def _send(self, now_us: int, packets_wait: bool) -> None:
        self._stream.call(now_us, packets_wait)
        outgoing, self._stream.outgoing = self._stream.outgoing, []
        for data in outgoing:
            with suppress(OSError):  # no network: no packet will arrive, and that is reported
                self._sockets[0].sendto(data, (self._address, self._port))

    def _next_packet(self, deadline_us: int) -> bytes | None:
        """Return the next packet of the server, None when none comes in time."""
        while True:
            left_us = deadline_us - clock_us()
            self._waiting = self._waiting or readable(self._sockets, max(0, left_us) * 1e-6)
            if not self._waiting:
                return None
            with suppress(OSError):
                data, sender = self._waiting.pop().recvfrom(PACKET_MAX)
                if self._is_of_server(data, *sender):
                    return data
                self._warn(sender)
            if left_us <= 0:  # others may send more than can be read
                return None

    def _warn(self, sender: tuple[str, int]) -> None:
        if not self._warned:
            self._warned = True
            self._stream.notices.append(
                "motion capture: packets of {}:{} are ignored: not the server's".format(*sender)
            )

    def _is_of_server(self, data: bytes, address: str, port: int) -> bool:
        if address != self._address:
            return False
        if int.from_bytes(data[:2], "little") != MessageId.FRAME:
            return port == self._port
        now_us = clock_us()
        if port in (self._port, self._frames_from) or now_us - self._frame_us > FRAMES_END_US:
            self._frames_from, self._frame_us = port, now_us
        return port == self._frames_from

    def _add_socket(self, address: str, port: int) -> socket.socket:
        added = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._sockets.append(added)
        added.setblocking(False)
        if port:
            # Other programs on this computer may listen on the same port.
            added.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        added.bind((address, port))
        return added

    def _join(self, group: str, port: int) -> None:
        """Receive the group's packets on the interface that leads to the server."""
        added = self._add_socket(self._interface if sys.platform == "win32" else group, port)
        if sys.platform == "linux":
            added.setsockopt(socket.IPPROTO_IP, IP_MULTICAST_ALL, 0)
        membership = socket.inet_aton(group) + socket.inet_aton(self._interface)
        added.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)

    def _interface_to_server(self) -> str:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((self._address, self._port))
            return str(probe.getsockname()[0])
