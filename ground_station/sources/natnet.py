"""NatNet, the protocol of OptiTrack's Motive: its packets, versions 3.0 to 4.1, little endian.

A packet is u16 message, u16 length of the rest, payload. Sans I/O; positions and rotations are in Motive's
axes, and a quaternion's order is x y z w on the wire, w x y z here. Skeletons, assets, force plates, devices and
cameras are checked and skipped. `hil.servers.motive` writes these packets. Layouts: OptiTrack's
NatNet SDK, PacketClient.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from firmware_py.geometry import Quaternion, Vector
from ground_station.errors import MocapError
from ground_station.sources.natnet_reader import Reader, Version

COMMAND_PORT = 1510
MULTICAST_GROUP = "239.255.42.99"
VERSIONS: tuple[Version, ...] = ((3, 0), (3, 1), (4, 0), (4, 1))
TRACKED = 1  # bit of a body's parameters
HEADER_SIZE = 4
END_TAG_SIZE = 4  # zeros behind a frame
PRECISION_SIZE = 8  # of the time of a precision time protocol

# Layouts, which the virtual Motive shares.
SERVER_INFO = struct.Struct("<256s4B4BQHB4B")  # name, app, NatNet, clock, data port, multicast, group
OLD_SERVER_INFO = struct.Struct("<256s4B4B")
BODY = struct.Struct("<I3f4ffH")  # id, position, rotation x y z w, error, parameters
LABELLED = struct.Struct("<I3ffHf")  # id, position, size, parameters, residual
SUFFIX = struct.Struct("<8xd3Q")  # no timecode, timestamp; exposure, arrival and departure
_HEADER = struct.Struct("<HH")
_ECHO = struct.Struct("<QQ")


class MessageId(IntEnum):
    """The type of a packet; clients send CONNECT, REQUEST, REQUEST_MODELDEF, KEEPALIVE, DISCONNECT and ECHO_REQUEST."""

    CONNECT = 0
    SERVER_INFO = 1
    REQUEST = 2
    RESPONSE = 3
    REQUEST_MODELDEF = 4
    MODELDEF = 5
    FRAME = 7
    MESSAGE = 8
    DISCONNECT = 9
    KEEPALIVE = 10
    ECHO_REQUEST = 12  # u64 chosen by the client
    ECHO_RESPONSE = 13  # the same u64, u64 the server's clock [ticks]
    UNRECOGNIZED = 100


@dataclass(frozen=True, slots=True)
class ServerInfo:
    """The answer to CONNECT."""

    name: str
    app_version: tuple[int, int, int, int]
    natnet_version: tuple[int, int, int, int]
    clock_hz: int  # ticks per second of all time stamps; 0, like the rest, before 3.0
    data_port: int
    multicast: bool
    group: str  # of multicast, dotted


@dataclass(frozen=True, slots=True)
class MarkerDescription:
    """A marker of a rigid body."""

    p: Vector  # [m] in the body's frame
    label: int
    name: str  # empty before 4.0


@dataclass(frozen=True, slots=True)
class BodyDescription:
    """A rigid body of the server; the frames carry its id only."""

    name: str
    id: int
    parent: int
    offset: Vector  # [m] from the parent
    markers: tuple[MarkerDescription, ...]


@dataclass(frozen=True, slots=True)
class ModelDefinition:
    """The answer to REQUEST_MODELDEF."""

    bodies: tuple[BodyDescription, ...]


@dataclass(frozen=True, slots=True)
class BodyPose:
    """A rigid body in a frame."""

    id: int
    p: Vector  # [m] in Motive's axes
    q: Quaternion  # w x y z
    error: float  # mean distance of the markers [m]
    valid: bool  # tracked in this frame


@dataclass(frozen=True, slots=True)
class LabelledMarker:
    """A marker that the server has identified."""

    id: int  # model << 16 | marker
    p: Vector  # [m] in Motive's axes
    size: float  # [m]
    parameters: int
    residual: float  # [m]


@dataclass(frozen=True, slots=True)
class Frame:
    """One exposure of the cameras; ticks are on the server's clock."""

    number: int
    bodies: tuple[BodyPose, ...]
    unlabelled: tuple[Vector, ...]  # [m]
    labelled: tuple[LabelledMarker, ...]
    timestamp_s: float  # since the server started
    mid_exposure: int  # [ticks]
    received: int  # [ticks] by the server from the cameras
    transmitted: int  # [ticks]
    parameters: int  # 1 recording, 2 the models have changed


@dataclass(frozen=True, slots=True)
class Echo:
    """The answer to ECHO_REQUEST."""

    asked: int  # the u64 from the client
    server: int  # [ticks]


@dataclass(frozen=True, slots=True)
class Other:
    """A packet without useful content."""

    message: int


@dataclass(frozen=True, slots=True)
class Response:
    """The answer to REQUEST: a number, 0 for done, or a text."""

    code: int | None
    text: str


Message = ServerInfo | ModelDefinition | Frame | Echo | Response | Other


def packet(message: MessageId, payload: bytes = b"") -> bytes:
    return message.to_bytes(2, "little") + len(payload).to_bytes(2, "little") + payload


def decode(data: bytes, version: Version) -> Message:
    """Return the content of a packet, in the layout of `version`; `MocapError` for a malformed one."""
    if version not in VERSIONS:
        raise MocapError(f"NatNet {version[0]}.{version[1]}: only 3.0, 3.1, 4.0 and 4.1 can be read")
    reader = Reader(data, version)
    message, size = reader.unpack(_HEADER)
    if size != len(data) - HEADER_SIZE:
        raise MocapError(f"NatNet packet of {len(data)} bytes says that it has {size + HEADER_SIZE}")
    if message == MessageId.FRAME:
        return _frame(reader)
    if message == MessageId.SERVER_INFO:
        return _server_info(reader)
    if message == MessageId.MODELDEF:
        return _model_definition(reader)
    if message == MessageId.ECHO_RESPONSE:
        return Echo(*reader.unpack(_ECHO))
    if message == MessageId.RESPONSE:
        return _response(reader)
    return Other(message)


def _response(reader: Reader) -> Response:
    if reader.left == 4:
        return Response(reader.u32(), "")
    return Response(None, reader.read_bytes(reader.left).partition(b"\0")[0].decode("utf-8", "replace"))


def _server_info(reader: Reader) -> ServerInfo:
    if reader.left < SERVER_INFO.size:  # 2.x and older end with the versions
        raw, a, b, c, d, e, f, g, h = reader.unpack(OLD_SERVER_INFO)
        if e < VERSIONS[0][0]:
            return ServerInfo(_name(raw), (a, b, c, d), (e, f, g, h), 0, 0, False, "")
        raise MocapError(f"NatNet {e}.{f} server {_name(raw)!r}: its answer lacks clock and data port")
    raw, a, b, c, d, e, f, g, h, clock_hz, port, multicast, *address = reader.unpack(SERVER_INFO)
    name = _name(raw)
    if clock_hz == 0 or port == 0:
        raise MocapError(f"NatNet server {name!r}: clock {clock_hz} Hz, data port {port}: neither may be 0")
    group = ".".join(map(str, address))
    return ServerInfo(name, (a, b, c, d), (e, f, g, h), clock_hz, port, bool(multicast), group)


def _name(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("utf-8", "replace")


def _frame(reader: Reader) -> Frame:
    number = reader.u32()
    for _ in range(reader.section(5)):  # marker sets
        reader.text()
        reader.read_bytes(12 * reader.count(12))
    unlabelled = tuple(reader.vector() for _ in range(reader.section(12)))
    bodies = tuple(_body(reader) for _ in range(reader.section(BODY.size)))
    for _ in range(reader.section(8)):  # skeletons
        reader.u32()
        reader.read_bytes(BODY.size * reader.count(BODY.size))
    if reader.version >= (4, 1):
        for _ in range(reader.section(12)):  # assets
            reader.u32()
            reader.read_bytes(BODY.size * reader.count(BODY.size))
            reader.read_bytes(LABELLED.size * reader.count(LABELLED.size))
    labelled = tuple(_labelled(reader) for _ in range(reader.section(LABELLED.size)))
    for _ in range(2):  # force plates, devices
        for _ in range(reader.section(8)):
            reader.u32()
            for _ in range(reader.count(4)):  # channels
                reader.read_bytes(4 * reader.count(4))
    timestamp_s, exposed, received, sent = reader.unpack(SUFFIX)
    if reader.version >= (4, 1) or (reader.version == (4, 0) and reader.left >= PRECISION_SIZE + 2):
        reader.read_bytes(PRECISION_SIZE)  # public readers disagree whether 4.0 has it
    parameters = int.from_bytes(reader.read_bytes(2), "little")
    if reader.left not in (0, END_TAG_SIZE):
        raise MocapError(f"NatNet frame {number}: {reader.left} bytes too many")
    return Frame(number, bodies, unlabelled, labelled, timestamp_s, exposed, received, sent, parameters)


def _body(reader: Reader) -> BodyPose:
    number, x, y, z, qx, qy, qz, qw, error, parameters = reader.unpack(BODY)
    return BodyPose(number, (x, y, z), (qw, qx, qy, qz), error, bool(parameters & TRACKED))


def _labelled(reader: Reader) -> LabelledMarker:
    number, x, y, z, *rest = reader.unpack(LABELLED)
    return LabelledMarker(number, (x, y, z), *rest)


def _model_definition(reader: Reader) -> ModelDefinition:
    bodies = []
    for _ in range(reader.count(4)):
        kind = reader.u32()
        if reader.version >= (4, 1):
            reader.u32()  # bytes
        if kind == 1:
            bodies.append(_description(reader))
            continue
        if kind not in PASSED_OVER:
            raise MocapError(f"NatNet model definition: {kind} is not a kind of model")
        for part in PASSED_OVER[kind]:
            reader.read_bytes(part) if isinstance(part, int) else part(reader)
    return ModelDefinition(tuple(bodies))


def _description(reader: Reader) -> BodyDescription:
    name, number, parent, offset = reader.text(), reader.u32(), reader.u32(), reader.vector()
    count = reader.count(16)
    places = [reader.vector() for _ in range(count)]
    labels = [reader.u32() for _ in range(count)]
    names = [reader.text() if reader.version >= (4, 0) else "" for _ in range(count)]
    markers = map(MarkerDescription, places, labels, names)
    return BodyDescription(name, number, parent, offset, tuple(markers))


def _descriptions(reader: Reader) -> None:
    for _ in range(reader.count(25)):
        _description(reader)


def _asset_markers(reader: Reader) -> None:
    for _ in range(reader.count(23)):
        reader.text()
        reader.read_bytes(22)  # id, position, size, parameters


# The useless parts of descriptions, by kind; a number is that many bytes.
PASSED_OVER: dict[int, tuple[Callable[[Reader], object] | int, ...]] = {
    0: (Reader.text, Reader.texts),  # marker set
    2: (Reader.text, Reader.u32, _descriptions),  # skeleton
    # Force plate: size, origin, calibration, corners, types
    3: (Reader.u32, Reader.text, 4 * (2 + 3 + 144 + 12) + 8, Reader.texts),
    4: (Reader.u32, Reader.text, Reader.text, 8, Reader.texts),  # device
    5: (Reader.text, 28),  # camera
    6: (Reader.text, 8, _descriptions, _asset_markers),  # asset
}
