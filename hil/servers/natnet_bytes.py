"""Motive's network messages as bytes: packs the values that `ground_station.sources.natnet` unpacks.

Pure functions; sockets: `hil.servers.motive`. Layouts: those of `ground_station.sources.natnet`.
"""

import struct
from collections.abc import Sequence

from ground_station.sources.natnet import (
    BODY,
    LABELLED,
    SERVER_INFO,
    SUFFIX,
    TRACKED,
    BodyDescription,
    BodyPose,
    Frame,
    LabelledMarker,
    MessageId,
    ModelDefinition,
    ServerInfo,
    packet,
)
from ground_station.sources.natnet_reader import Version

_COUNT = struct.Struct("<I")
_DESCRIBED = struct.Struct("<II3fI")  # id, parent, offset, markers
_VECTOR = struct.Struct("<3f")
_NO_PRECISION_TIME = bytes(8)
_END = struct.Struct("<HI")  # parameters, end tag
_RIGID_BODY = 1  # kind of a description


def encode_server_info(info: ServerInfo) -> bytes:
    """Return the answer to CONNECT, the same in all versions."""
    group = (int(part) for part in info.group.split("."))
    rest = (*info.app_version, *info.natnet_version, info.clock_hz, info.data_port, info.multicast, *group)
    return packet(MessageId.SERVER_INFO, SERVER_INFO.pack(info.name.encode(), *rest))


def encode_models(models: ModelDefinition, version: Version) -> bytes:
    """Return the answer to REQUEST_MODELDEF."""
    rest = [_COUNT.pack(len(models.bodies))]
    for body in models.bodies:
        described = _described(body, version)
        rest.append(_COUNT.pack(_RIGID_BODY))
        if version >= (4, 1):
            rest.append(_COUNT.pack(len(described)))
        rest.append(described)
    return packet(MessageId.MODELDEF, b"".join(rest))


def encode_frame(frame: Frame, version: Version) -> bytes:
    nothing = _section((), version)
    assets = nothing if version >= (4, 1) else b""
    parts = (
        _COUNT.pack(frame.number),
        nothing,  # marker sets
        _section([_VECTOR.pack(*p) for p in frame.unlabelled], version),
        _section([_body(body) for body in frame.bodies], version),
        nothing,  # skeletons
        assets,
        _section([_labelled(marker) for marker in frame.labelled], version),
        nothing,  # force plates
        nothing,  # devices
        SUFFIX.pack(frame.timestamp_s, frame.mid_exposure, frame.received, frame.transmitted),
        _NO_PRECISION_TIME if version >= (4, 0) else b"",
        _END.pack(frame.parameters, 0),
    )
    return packet(MessageId.FRAME, b"".join(parts))


def _described(body: BodyDescription, version: Version) -> bytes:
    head = _DESCRIBED.pack(body.id, body.parent, *body.offset, len(body.markers))
    places = b"".join(_VECTOR.pack(*marker.p) for marker in body.markers)
    labels = b"".join(_COUNT.pack(marker.label) for marker in body.markers)
    names = b"".join(_text(marker.name) for marker in body.markers) if version >= (4, 0) else b""
    return _text(body.name) + head + places + labels + names


def _section(items: Sequence[bytes], version: Version) -> bytes:
    """Return a list in a frame; from 4.1 on its size in bytes follows the count."""
    data = b"".join(items)
    size = _COUNT.pack(len(data)) if version >= (4, 1) else b""
    return _COUNT.pack(len(items)) + size + data


def _text(text: str) -> bytes:
    return text.encode() + b"\0"


def _body(body: BodyPose) -> bytes:
    w, x, y, z = body.q
    return BODY.pack(body.id, *body.p, x, y, z, w, body.error, TRACKED if body.valid else 0)


def _labelled(marker: LabelledMarker) -> bytes:
    return LABELLED.pack(marker.id, *marker.p, marker.size, marker.parameters, marker.residual)
