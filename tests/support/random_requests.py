"""What a broken or hostile client may send on both protocols: random bytes, and requests of every kind with random contents.

What a client has a right to is left out, because it ends a flight or moves the robot as it should: emergency stops,
disarming, goals and poses with possible numbers, parameters, and the radio chip's switches.
"""

import math
import struct
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pymavlink.dialects.v20.development as dialect

from firmware_py.wire import WireError, crtp, high_level, setpoints

HEADERS = [port << 4 | channel for port in range(15) for channel in range(4)]
SERVED_HEADERS = [
    port << 4 | channel
    for port, channels in {2: 4, 3: 1, 4: 3, 5: 2, 6: 3, 7: 2, 8: 1, 9: 2, 13: 3, 15: 2}.items()
    for channel in range(channels)
]
COMMANDS_MAX = 16  # first bytes that mean something are below
RIGHTS = {  # stops and disarming: port, channel, data
    *((6, 1, b"\3"), (6, 1, b"\4"), (7, 0, b"\0"), (9, 1, b"\3"), (9, 1, b"\4")),
    *((9, 1, b"\1\0"), (13, 0, b"\1\0")),
}
PARAMETERS = 1000  # more than any board has
POSSIBLE_CORRECTION = 2.1  # [m]
POSSIBLE = 1e5  # metres, seconds and radians that a command may mean
RADIO_CHIP, CHIP_SWITCHES = 0xF3, (0x03, 0x05, 0xFE)  # header of its packets, and their types

FLOATS = (0.0, 1.0, -1.0, 0.5, np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-45, 30.0, 1000.0, 21196.0)
SIZES = {"int8_t": 8, "int16_t": 16, "int32_t": 32, "int64_t": 64}
SIZES |= {f"u{kind}": -bits for kind, bits in SIZES.items()}
COMMANDS = (185, 245, 400, 410, 510, 511, 512, 519, 520)
SERVED = (0, 4, 20, 21, 23, 66, 75, 76, 84, 102, 110, 111, 138)
NAMES = (b"EXT_Z_P", b"DLY_ACTIVATE", b"_HASH_CHECK", b"TLM_STREAM", b"KAL_MAXPOS", b"\xff\xfe\x00", b"")
STEERING = {23, 84, 86, 102, 104, 138, 331}  # parameters, goals and poses
TARGETS = {84: ("x", "y", "z"), 86: ("alt",)}
ORDERS = {176, 185, 246, 400, 420}  # modes, termination, reboot, disarming, failures


def random_packet(rng: np.random.Generator) -> bytes:
    """A CRTP packet: a third random bytes, a third to any port and channel, a third a request of a known kind."""
    while True:
        kind = rng.integers(3)
        data = bytearray(rng.bytes(int(rng.integers(1, 32))))
        if kind == 1:
            data[0] = HEADERS[rng.integers(len(HEADERS))]
        elif kind == 2:
            head = (SERVED_HEADERS[rng.integers(len(SERVED_HEADERS))], rng.integers(COMMANDS_MAX))
            floats = b"".join(struct.pack("<f", value) for value in rng.choice(FLOATS, 8))
            data = bytearray((*map(int, head), *rng.bytes(int(rng.integers(4))), *floats))
            del data[int(rng.integers(1, 32)) :]
        if not _is_right(bytes(data)):
            return bytes(data)


def _is_right(data: bytes) -> bool:
    """Whether a client may expect that the robot obeys a packet."""
    packet = crtp.decode(data)
    port, channel, rest = packet.port, packet.channel, packet.data
    if (port, channel, rest) in RIGHTS:
        return True
    if data[0] & RADIO_CHIP == RADIO_CHIP:
        return rest[:1] != b"" and rest[0] in CHIP_SWITCHES
    if (port, channel) == (crtp.PORT_PARAMETERS, 2):
        return int.from_bytes(rest[:2], "little") < PARAMETERS
    if (port, channel) == (crtp.PORT_LOCALISATION, crtp.CHANNEL_GENERIC):
        return rest[:1] == b"\x09" or _is_possible_pose(rest)
    if port == crtp.PORT_GENERIC_SETPOINT:
        return rest[:1] in (b"\6", b"\7") and _are_possible(lambda: setpoints.decode_place(rest)[0])
    return port == high_level.PORT and _are_possible(lambda: high_level.decode(rest)[1])


def _are_possible(decode: Callable[[], Sequence[float]]) -> bool:
    """Whether data can be read, and all its numbers may be meant."""
    try:
        return all(abs(value) < POSSIBLE for value in decode())
    except WireError:
        return False


def _is_possible_pose(data: bytes) -> bool:
    try:
        return all(abs(value) < POSSIBLE_CORRECTION for value in crtp.decode_ext_pose(data).p_GB)
    except WireError:
        return False


def _number(rng: np.random.Generator, kind: str) -> float:
    """A value of a C type, often at its limits."""
    if kind in ("float", "double"):
        return float(rng.choice(FLOATS)) if rng.random() < 0.7 else float(rng.normal())
    bits = SIZES[kind]
    low, high = (0, (1 << -bits) - 1) if bits < 0 else (-(1 << bits - 1), (1 << bits - 1) - 1)
    if rng.random() < 0.6:
        return int(rng.choice(np.array((0, 1, low, high), dtype=object)))
    return int.from_bytes(rng.bytes(8), "little") % (high - low + 1) + low


def random_message(rng: np.random.Generator) -> Any:
    """A MAVLink message with any contents; most are of kinds that the board serves, and for it."""
    kinds = SERVED if rng.random() < 0.7 else tuple(dialect.mavlink_map)
    cls = dialect.mavlink_map[int(rng.choice(kinds))]
    fields: dict[str, Any] = {}
    for name, kind, length in zip(cls.fieldnames, cls.fieldtypes, _array_lengths(cls), strict=True):
        if kind == "char":
            fields[name] = NAMES[rng.integers(len(NAMES))][: max(1, length)]
        elif length:
            fields[name] = [_number(rng, kind) for _ in range(length)]
        else:
            fields[name] = _number(rng, kind)
    if rng.random() < 0.8:
        fields |= {name: 1 for name in ("target_system", "target_component") if name in fields}
    if cls.id in (75, 76) and rng.random() < 0.9:
        fields["command"] = int(rng.choice(COMMANDS))
    return cls(**fields)


def harmless_message(rng: np.random.Generator) -> Any:
    """A random message that a robot in flight must not obey."""
    while True:
        message = random_message(rng)
        number = message.get_msgId()
        if number in (75, 76) and message.command in ORDERS:
            continue
        # Of a target, only the place: the mask may say that the rest is not meant.
        names = TARGETS.get(number, tuple(vars(message)))
        values = [value for name in names if isinstance(value := getattr(message, name), float)]
        if number not in STEERING or not all(map(math.isfinite, values)):
            return message


def _array_lengths(cls: Any) -> list[int]:
    """In the order of the fields; 0 for a plain one."""
    by_name = dict(zip(cls.ordered_fieldnames, cls.array_lengths, strict=True))
    return [by_name[name] for name in cls.fieldnames]


def spoilt(rng: np.random.Generator, frame: bytes) -> bytes:
    """The frame with bytes changed, cut or added."""
    data = bytearray(frame)
    kind = rng.integers(3)
    if kind == 0:
        data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    elif kind == 1:
        del data[int(rng.integers(len(data))) :]
    else:
        data += rng.bytes(int(rng.integers(1, 40)))
    return bytes(data)
