"""A virtual Motive: a NatNet server that streams the virtual cameras' view to programs of this computer.

It answers connect, model definitions, echo, keep-alive and the bitstream request on its command port, and sends every
frame either to the multicast group or to each client: to the data port of its computer and, after a keep-alive, also to
the client's sending port, because clients listen on one or the other. Clients also join the group on different
interfaces, so frames go out on the loopback interface and on the default route's, never beyond this computer. Nothing
here blocks: the board server calls it. Malformed requests are counted. Its clock starts with it, like another computer's.
"""

import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

from firmware_py.geometry import Quaternion, Vector
from ground_station.clock import clock_us
from ground_station.config import CaptureConfig
from ground_station.mocap import MocapFrame
from ground_station.sources.natnet import (
    COMMAND_PORT,
    HEADER_SIZE,
    MULTICAST_GROUP,
    BodyDescription,
    BodyPose,
    Frame,
    LabelledMarker,
    MarkerDescription,
    MessageId,
    ModelDefinition,
    ServerInfo,
    packet,
)
from ground_station.sources.natnet_reader import Version
from ground_station.unused import Reason
from hil.board.clock import Readers
from hil.board.markers import DIAMETER, NO_POINTS, Sighting
from hil.errors import LabError
from hil.servers.dongle_server import HOST
from hil.servers.natnet_bytes import encode_frame, encode_models, encode_server_info
from hil.world.scene import Points

MAX_CLIENTS = 16  # one more replaces the client silent for longest
MAX_COMMAND = 256  # bytes of a request that are read

_RELEASES: dict[Version, tuple[int, int, int, int]] = {
    (3, 1): (2, 2, 0, 0),
    (4, 1): (3, 1, 0, 0),
}  # of Motive
_TICKS_PER_US = 10  # the performance counter of its computer
_NO_PARENT = 0xFFFF_FFFF  # -1 as the unsigned number that clients read
_PASSIVE = 0  # label of a passive marker
_OCCLUDED, _RECONSTRUCTED, _FILLED, _OF_MODEL = 1, 2, 4, 8  # bits of a labelled marker
_SEEN, _UNSEEN = _RECONSTRUCTED | _OF_MODEL, _OCCLUDED | _FILLED | _OF_MODEL
_HEADER = struct.Struct("<HH")  # kind, length
_ECHO = struct.Struct("<QQ")
_ECHO_REQUEST_SIZE = 8
_ACCEPTED, _REFUSED = (
    packet(MessageId.RESPONSE, code.to_bytes(4, "little", signed=True)) for code in (0, -1)
)

Address = tuple[str, int]
Up = Literal["y", "z"]
_TURNS: dict[Up, Callable[[float, float, float], Vector]] = {  # from W to the axes with this one up
    "y": lambda x, y, z: (x, z, -y),
    "z": lambda x, y, z: (x, y, z),
}


@dataclass(frozen=True, slots=True)
class Streaming:
    """The settings of Motive's streaming pane."""

    port: int  # of commands, 0: any; frames go to the next one, which is announced to clients
    version: Version
    multicast: bool  # to the group, else to each client
    up: Up = "y"  # the axis; z: those of the world


def streaming_of(config: CaptureConfig) -> Streaming:
    """Return the stream that a station with these settings expects."""
    port = COMMAND_PORT if config.port is None else config.port
    major, minor = map(int, config.natnet.split("."))
    return Streaming(port, (major, minor), config.multicast, "z" if config.axes == "z-up" else "y")


@dataclass(frozen=True, slots=True)
class _Client:
    """A connected client."""

    version: Version
    keeps_alive: bool  # then it takes frames on its sending port; others would read them as answers


def in_axes(up: Up, p_WB: Vector, q_WB: Quaternion) -> tuple[Vector, Quaternion]:
    """Return a pose as Motive streams it, in its axes for both world and body."""
    w, a, b, c = q_WB
    turn = _TURNS[up]
    return turn(*p_WB), (w, *turn(a, b, c))


def _send(sender: socket.socket, data: bytes, to: Address) -> None:
    with suppress(OSError):  # a full buffer or no listener: UDP loses packets then
        sender.sendto(data, to)


def _interfaces(port: int) -> set[str]:
    """Return the addresses of the interfaces on which clients of this computer join the group."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker,
        suppress(OSError),
    ):  # no route: loopback alone
        asker.connect((MULTICAST_GROUP, port))  # sends nothing
        routed: str = asker.getsockname()[0]
        return {HOST, routed}
    return {HOST}


def _group_sender(interface: str) -> socket.socket:
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sender.setblocking(False)
    sender.bind((interface, 0))
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(interface))
    sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)  # for this computer alone
    return sender


def name_of(number: int) -> str:
    """Return the name of body 1, 2, ...."""
    return "floaty" if number == 1 else f"floaty{number}"


class VirtualMotive:
    """Tracks `count` bodies, each with the same `markers`, (N, 3) [m] in B; `period_us` is that of the cameras."""

    def __init__(
        self,
        settings: Streaming,
        count: int,
        readers: Readers,
        markers: Points = NO_POINTS,
        period_us: int = 10_000,
    ) -> None:
        self.malformed = 0
        self._version = settings.version
        self._multicast = settings.multicast
        self._up = settings.up
        described = tuple(
            MarkerDescription(place, _PASSIVE, f"Marker{number}")
            for number, place in enumerate(self._all_turned(markers), 1)
        )
        self._models = ModelDefinition(
            tuple(
                BodyDescription(name_of(number), number, _NO_PARENT, (0.0, 0.0, 0.0), described)
                for number in range(1, count + 1)
            )
        )
        self._readers = readers
        self._clients: dict[Address, _Client] = {}  # the latest sender is last
        self._missing = {
            number: BodyPose(number, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 0.0, valid=False)
            for number in range(1, count + 1)
        }
        self._awaited = set(self._missing)
        self._number = 0
        # Of the frame being assembled.
        self._tolerance_us = period_us // 2
        self._exposure_us = 0
        self._seen: dict[int, BodyPose] = {}
        self._exposed = self._received = 0  # ticks
        self._labelled: list[LabelledMarker] = []
        self._unlabelled: list[Vector] = []
        self._start_us = clock_us()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((HOST, settings.port))
        except OSError as error:
            self._socket.close()
            raise LabError(
                f"natnet port {settings.port}: {error.strerror or error}; --set capture.port=0 takes a free one, "
                "--no-motive none"
            ) from None
        self.port: int = self._socket.getsockname()[1]
        self.data_port = self.port + 1
        self._groups = [_group_sender(interface) for interface in _interfaces(self.data_port)]
        readers[self._socket] = self._read

    def close(self) -> None:
        del self._readers[self._socket]
        for each in (self._socket, *self._groups):
            each.close()

    def stream_frame(
        self,
        body: int,
        frame: MocapFrame,
        now_us: int,
        sighting: Sighting | None = None,
        began_us: int = 0,
    ) -> None:
        """Take a body's frame of another clock, whose time is `now_us`, and which began at `began_us` of all bodies' clock.

        The last body completes a frame; so does one of a later exposure. A body that comes after that is not tracked.
        """
        sent, later_us = self._ticks(), began_us + frame.t_us - self._exposure_us
        if later_us < -self._tolerance_us:
            return
        if later_us > self._tolerance_us:
            if self._seen:
                self._stream(sent)
            self._exposure_us += later_us
        arrival_us = now_us if frame.received_us is None else frame.received_us
        self._exposed, self._received = (
            max(0, sent - (now_us - t_us) * _TICKS_PER_US)  # not before the start
            for t_us in (frame.t_us, arrival_us)
        )
        p, q = in_axes(self._up, frame.p_WB, frame.q_WB)
        error = 0.0 if sighting is None else sighting.error
        tracked = frame.valid or frame.unused[0] is Reason.FROZEN  # clients find out by themselves
        self._seen[body] = BodyPose(body, p, q, error, tracked)
        if sighting is not None:
            self._unlabelled += self._all_turned(sighting.unlabelled)
            self._labelled += self._labels(body, sighting) if tracked else ()
        if self._awaited <= self._seen.keys():
            self._stream(sent)

    def lose(self, body: int) -> None:
        """Report a body as not tracked from now on, without waiting for it."""
        self._awaited.discard(body)

    def _stream(self, sent: int) -> None:
        """Send the assembled frame and begin the next."""
        self._number += 1
        whole = Frame(
            self._number,
            tuple((self._missing | self._seen).values()),
            tuple(self._unlabelled),
            tuple(self._labelled),
            self._exposed * 1e-6 / _TICKS_PER_US,
            self._exposed,
            self._received,
            sent,
            parameters=0,
        )
        self._seen, self._labelled, self._unlabelled = {}, [], []
        if self._multicast:
            data = encode_frame(whole, self._version)
            for group in self._groups:
                _send(group, data, (MULTICAST_GROUP, self.data_port))
            return
        targets = self._targets()
        encoded = {version: encode_frame(whole, version) for version in set(targets.values())}
        for target, version in targets.items():
            _send(self._socket, encoded[version], target)

    def _ticks(self) -> int:
        """Return the time of Motive's clock."""
        return (clock_us() - self._start_us) * _TICKS_PER_US

    def _targets(self) -> dict[Address, Version]:
        """Return the unicast addresses for frames, with their versions."""
        ports = {(host, self.data_port): client.version for (host, _), client in self._clients.items()}
        return ports | {at: client.version for at, client in self._clients.items() if client.keeps_alive}

    def _read(self, now_us: int) -> None:
        """Take one datagram and answer it."""
        try:
            data, client = self._socket.recvfrom(2048)
        except OSError:  # reports an earlier packet that a client refused
            return
        kind, size = _HEADER.unpack_from(data) if len(data) >= HEADER_SIZE else (None, 0)
        payload = data[HEADER_SIZE:]
        if kind == MessageId.CONNECT:  # clients differ in the rest of the request
            self._admit(client, _Client(self._version, keeps_alive=False))
            _send(self._socket, self._info(), client)
        elif kind == MessageId.KEEPALIVE:
            if client in self._clients:
                self._admit(client, _Client(self._version_of(client), keeps_alive=True))
        elif kind == MessageId.REQUEST_MODELDEF:
            _send(self._socket, encode_models(self._models, self._version_of(client)), client)
        elif kind == MessageId.DISCONNECT:
            self._clients.pop(client, None)
        elif kind == MessageId.ECHO_REQUEST and len(payload) == _ECHO_REQUEST_SIZE:
            asked = int.from_bytes(payload, "little")
            _send(self._socket, packet(MessageId.ECHO_RESPONSE, _ECHO.pack(asked, self._ticks())), client)
        elif kind == MessageId.REQUEST and size <= len(payload) <= MAX_COMMAND:
            _send(self._socket, self._obey(payload.partition(b"\0")[0], client), client)
        else:
            self.malformed += 1

    def _info(self) -> bytes:
        major, minor = self._version
        return encode_server_info(
            ServerInfo(
                "Motive",
                _RELEASES[self._version],
                (major, minor, 0, 0),
                _TICKS_PER_US * 1_000_000,
                self.data_port,
                self._multicast,
                MULTICAST_GROUP if self._multicast else "0.0.0.0",
            )
        )

    def _admit(self, address: Address, client: _Client) -> None:
        """Register a client."""
        self._clients.pop(address, None)
        self._clients[address] = client
        if len(self._clients) > MAX_CLIENTS:
            del self._clients[next(iter(self._clients))]

    def _version_of(self, client: Address) -> Version:
        """Return the protocol version used for a client."""
        return self._clients[client].version if client in self._clients else self._version

    def _obey(self, command: bytes, client: Address) -> bytes:
        """Return the answer to a command; only the version command is supported."""
        name, comma, wanted = command.partition(b",")
        if name != b"Bitstream":
            return packet(MessageId.UNRECOGNIZED)
        if not comma:
            major, minor = self._version_of(client)
            return packet(MessageId.RESPONSE, b"Bitstream,%d.%d.0\0" % (major, minor))
        for version in _RELEASES:
            same = wanted.split(b".")[:2] == [b"%d" % number for number in version]
            if same and client in self._clients and not self._multicast:
                self._admit(client, _Client(version, self._clients[client].keeps_alive))
                return _ACCEPTED
        return _REFUSED

    def _all_turned(self, points: Points) -> list[Vector]:
        """Return points (N, 3) of W or B in Motive's axes."""
        turn = _TURNS[self._up]
        return [turn(x, y, z) for x, y, z in points.tolist()]

    def _labels(self, body: int, sighting: Sighting) -> list[LabelledMarker]:
        """Return all markers of a tracked body; unseen ones are at their places on the body."""
        points, seen = self._all_turned(sighting.points), sighting.seen.tolist()
        rows = zip(points, seen, sighting.residuals.tolist(), strict=True)
        return [
            LabelledMarker(body << 16 | number, p, DIAMETER, _SEEN if seen else _UNSEEN, residual)
            for number, (p, seen, residual) in enumerate(rows, 1)
        ]
