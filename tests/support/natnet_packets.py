"""NatNet packets written field by field from the layouts of OptiTrack's SDK, apart from the laboratory's own encoder."""

import struct

CLOCK_HZ = 10_000_000
VERSIONS = ((3, 0), (3, 1), (4, 0), (4, 1))
POSE = ((1.0, 2.0, 3.0), (0.5, -0.5, 0.5, 0.5))  # p, q x y z w


def packet(message: int, payload: bytes) -> bytes:
    return struct.pack("<HH", message, len(payload)) + payload


def old_server_info(version: tuple[int, int]) -> bytes:
    """The answer of a server before 3.0: nothing after the versions."""
    return packet(1, b"Motive".ljust(256, b"\0") + bytes((1, 10, 3, 0, *version, 0, 0)))


def server_info(
    version: tuple[int, int], multicast: bool = False, port: int = 1511, hz: int = CLOCK_HZ
) -> bytes:
    name = b"Motive".ljust(256, b"\0")
    group = bytes((239, 255, 42, 99))
    versions = bytes((3, 1, 0, 0, *version, 0, 0))
    return packet(1, name + versions + struct.pack("<QHB", hz, port, multicast) + group)


def description(name: str, number: int, version: tuple[int, int]) -> bytes:
    """A body with two markers."""
    markers = struct.pack("<I6f2I", 2, 0.1, 0, 0, 0, 0.1, 0, 0, 0)
    names = b"a\0b\0" if version >= (4, 0) else b""
    return name.encode() + b"\0" + struct.pack("<Ii3f", number, -1, 0, 0, 0) + markers + names


def model_definition(bodies: dict[str, int], version: tuple[int, int]) -> bytes:
    """A marker set, a camera, a force plate, a device, a skeleton, an asset from 4.1, and bodies with these ids."""
    body = description("bone", 9, version)
    plate = (
        struct.pack("<I3s", 1, b"AB\0") + bytes(4 * (2 + 3 + 144 + 12) + 8) + struct.pack("<I2s", 1, b"x\0")
    )
    device = struct.pack("<I4s", 1, b"D\0E\0") + bytes(8) + struct.pack("<I2s", 1, b"x\0")
    skeleton = struct.pack("<2sII", b"S\0", 3, 1) + body
    asset = (
        struct.pack("<2sII", b"A\0", 1, 4)
        + struct.pack("<I", 1)
        + body
        + struct.pack("<I2s", 1, b"m\0")
        + bytes(22)
    )
    parts = [(0, struct.pack("<4sI4s", b"all\0", 2, b"a\0b\0")), (5, b"cam\0" + bytes(28))]
    parts += [(3, plate), (4, device), (2, skeleton)] + ([(6, asset)] if version >= (4, 1) else [])
    parts += [(1, description(name, number, version)) for name, number in bodies.items()]
    payload = struct.pack("<I", len(parts))
    for kind, part in parts:
        size = struct.pack("<I", len(part)) if version >= (4, 1) else b""
        payload += struct.pack("<I", kind) + size + part
    return packet(5, payload)


def frame(
    number: int, version: tuple[int, int], ticks: tuple[int, int, int], number_of_body: int = 7, tracked: bool = True,
    pose: tuple[tuple[float, ...], tuple[float, ...]] = POSE, parameters: int = 0, precision: bool = True,
) -> bytes:  # fmt: skip
    """One body, one of everything else; ticks: exposure, received, transmitted."""
    body = struct.pack("<I3f4ffH", number_of_body, *pose[0], *pose[1], 0.001, tracked)
    bone = struct.pack("<I3f4ffH", 9, *bytes(8), 1)
    marker = struct.pack("<I3ffHf", 0x70001, 1, 2, 3, 0.014, 2, 0.0005)
    channels = struct.pack("<III2f", 1, 1, 2, 0.5, 0.5)
    sections = [(1, b"all\0" + struct.pack("<I3f", 1, 1, 2, 3)), (1, struct.pack("<3f", 4, 5, 6)), (1, body)]
    sections += [(1, struct.pack("<II", 3, 1) + bone)]
    if version >= (4, 1):
        sections += [(1, struct.pack("<II", 4, 1) + bone + struct.pack("<I", 1) + marker)]
    sections += [(1, marker), (1, channels), (1, channels)]
    payload = struct.pack("<I", number)
    for count, section in sections:
        size = struct.pack("<I", len(section)) if version >= (4, 1) else b""
        payload += struct.pack("<I", count) + size + section
    payload += struct.pack("<IId3Q", 0, 0, 12.5, *ticks) + (
        bytes(8) if version >= (4, 0) and precision else b""
    )
    return packet(7, payload + struct.pack("<H", parameters) + bytes(4))


def echo(asked: int, ticks: int) -> bytes:
    return packet(13, struct.pack("<QQ", asked, ticks))
