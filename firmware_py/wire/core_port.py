"""The CRTP port on which a real board executes the flight core call by call; `floaty_wire.h` of the app is made from this.

The board keeps separate memory for it, apart from that in flight: the structs of the core, and of own logic, one after
the other in the order of `CoreBlocks.named`. A packet is one request of the host or one answer of the board, little-endian.
Each begins with HEAD: the kind, the session, and the request's number in it. An answer has the head of its request.

        HELLO   ->                       a session begins, memory is zero; a repeated request is only answered
                <- ABOUT                 the board's data
    WRITE   -> PLACE, bytes          into the memory
            <-
    CALL    -> CALL                  execute an entry point
            <- CALLED
    READ    -> PLACE_SIZE            of the memory
            <- bytes
    LOOP    -> MODE                  hardware in the loop: a mode from the next millisecond on
            <-
        HEALTH  ->
                <- HEALTH                the board's state; in flight as well
    (any)   <- REFUSED               with a reason

A board executes the requests of a session in the order of their numbers, from 0 on, and each once. A number above the next
one is not answered: an earlier one was lost. A repeated request is answered again but not executed again, READ
with the present memory; of calls only the last one. So the host may send many at once and repeats those without an
answer; it continues after a call when everything up to it has been answered.

Hardware in the loop has its own channel, without sessions. The board flies as always, but each millisecond with the
host's next gyro sample. A packet begins with SAMPLES, which has the first sample; after it come the differences of
each further one to its predecessor, in `width` bytes: 6, x y z as int16, modulo 65536, or 4, a word with ten bits each, x in
the lowest ones, where all differences of the packet fit. The board takes the first sample when `HIL_WAITING` wait. If
the next one is missing, its flight stops for up to `HIL_HOLD` steps (held), as it would without the interrupt of
its own gyro; then it goes on with the last sample (late). After a gap in the numbers nothing is taken (lost) until the
host repeats the missing samples; samples that arrive again are dropped (doubled). After each controller step, and every ten
held steps, it sends LOOP to the host, in which `used` plus `waiting` is the number that it expects. A second without
samples ends the mode. With every change of the mode the gyro's zero is determined again and the estimator restarted.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise, takewhile
from typing import Any

from firmware_py.wire import WireError
from firmware_py.wire.crtp import MAX_DATA

PORT_CORE = 10
CHANNEL_CALLS = 0
CHANNEL_LOOP = 1
VERSION = 3  # of this protocol
NAME_SIZE = 8  # characters of a hash
HIL_WAITING = 8  # samples of 1 ms
HIL_HOLD = 250  # steps of 1 ms
NARROW, WIDE = 4, 6  # bytes of a difference between two samples
NARROW_BITS = 10  # of an axis


class Message(IntEnum):
    """The kind of a request and of its answer."""

    HELLO = 0
    WRITE = 1
    CALL = 2
    READ = 3
    REFUSED = 4
    LOOP = 5
    HEALTH = 6


class Refusal(IntEnum):
    """Why a board refuses a request."""

    NO_SESSION = 1  # it has rebooted, or another host has begun one
    FLYING = 2  # or may be in the air
    OUTSIDE = 3  # of the memory, or no such call
    LOOP = 4  # hardware in the loop flies


class Call(IntEnum):
    """The entry points; `firmware_py.core.entry`."""

    RESET = 0
    FILE_POSE = 1
    ESTIMATE = 2
    CONTROL = 3
    BEGIN_STEP = 4
    TAKE_SAMPLE = 5
    SUPERVISE = 6
    REQUEST = 7
    WATCH_CONTROL = 8
    BEGIN_AFRESH = 9
    ADMITS = 10
    FOLLOW = 11


class Hil(IntEnum):
    """Hardware in the loop."""

    OFF = 0  # the board's own gyro, servos move
    STILL = 1  # the host's samples, servos stay at hover
    MOVING = 2  # the host's samples, servos move as well


@dataclass(frozen=True, slots=True)
class PacketLayout:
    """A piece of a packet: its fields in their order, each with its code of `struct`."""

    name: str
    fields: tuple[tuple[str, str], ...]

    @property
    def struct(self) -> struct.Struct:
        """The `struct` that packs it."""
        return struct.Struct("<" + "".join(code for _, code in self.fields))


HEAD = PacketLayout("Head", (("kind", "B"), ("session", "B"), ("number", "H")))
ABOUT = PacketLayout("About", (
    ("version", "B"),  # VERSION
    ("state", "B"),  # of the supervisor: firmware_py.wire.supervisor.State
    ("size", "H"),  # [B] of the memory
    ("done", "H"),  # requests of this session that were executed
    ("clock_mhz", "H"),  # of the processor, whose cycles are counted
    ("core", f"{NAME_SIZE}s"),  # how the hash of the core's sources begins
    ("profile", f"{NAME_SIZE}s"),  # and that of the parameters in the app
))  # fmt: skip
PLACE = PacketLayout("Place", (("offset", "H"),))
PLACE_SIZE = PacketLayout("PlaceSize", (("offset", "H"), ("size", "B")))
CALL = PacketLayout("Call", (("call", "B"),))
CALLED = PacketLayout("Called", (
    ("answer", "b"),  # 0 of calls without an answer
    ("cycles", "I"),  # that the call took, with the interrupts in it; no other task runs meanwhile
    ("digest", "I"),  # CRC-32 of the whole memory afterwards, as zlib.crc32
))  # fmt: skip
WHY = PacketLayout("Why", (("reason", "B"),))
HEALTH = PacketLayout("Health", (
    ("gyro_x", "h"), ("gyro_y", "h"), ("gyro_z", "h"),  # [counts] now, of the board's own gyro
    ("calibrated", "B"),  # 1: the gyro's zero is known
    ("battery_mv", "H"),
    ("heap_free", "I"),  # [B] of RAM
    ("m1", "H"), ("m2", "H"), ("m3", "H"), ("m4", "H"),  # timer counts of the servos
))  # fmt: skip
MODE = PacketLayout("Mode", (("mode", "B"),))
SAMPLES = PacketLayout("Samples", (
    ("number", "H"),  # of the first sample
    ("width", "B"),  # [B] of a difference: NARROW or WIDE
    ("x", "h"), ("y", "h"), ("z", "h"),  # [counts] of the gyro, sensor frame
))  # fmt: skip
LOOP = PacketLayout("Loop", (
    ("used", "H"),  # number of the next sample, when the controller ran
    ("waiting", "B"),  # samples in the buffer then
    ("state", "B"),  # of the supervisor
    ("cause", "B"),
    ("fresh", "B"),  # 1: the controller has just run; 0: the flight is held
    ("held", "H"), ("late", "H"), ("lost", "H"), ("doubled", "H"),
    ("m1", "H"), ("m2", "H"), ("m3", "H"), ("m4", "H"),  # timer counts that the controller puts out
    ("fused", "H"), ("refused", "H"),  # poses
    ("age", "H"),  # [0.1 ms] of the last one
))  # fmt: skip
LAYOUTS = (HEAD, ABOUT, PLACE, PLACE_SIZE, CALL, CALLED, WHY, HEALTH, MODE, SAMPLES, LOOP)

_HEAD, _ABOUT, _PLACE, _PLACE_SIZE, _CALL, _CALLED, _WHY, _HEALTH, _MODE, _SAMPLES, _LOOP = (
    layout.struct for layout in LAYOUTS
)
_NARROW, _WIDE = struct.Struct("<I"), struct.Struct("<hhh")
WRITE_MAX = MAX_DATA - _HEAD.size - _PLACE.size  # bytes in a packet
READ_MAX = MAX_DATA - _HEAD.size
_BEHIND_FIRST = {
    width: (MAX_DATA - _SAMPLES.size) // width for width in (NARROW, WIDE)
}  # samples in a packet
SAMPLES_MAX = 1 + _BEHIND_FIRST[NARROW]  # in a packet, when the rate changes little


@dataclass(frozen=True, slots=True)
class About:
    """The board on the port."""

    version: int
    state: int
    size: int
    done: int
    clock_mhz: int
    core: str
    profile: str


@dataclass(frozen=True, slots=True)
class Called:
    """The result of a call."""

    answer: int
    cycles: int
    digest: int


@dataclass(frozen=True, slots=True)
class Health:
    """The state of a board."""

    gyro: tuple[int, ...]  # [counts] sensor frame
    calibrated: bool
    battery_mv: int
    heap_free: int  # [B]
    counts: tuple[int, int, int, int]  # of the servos


@dataclass(frozen=True, slots=True)
class CoreAnswer:
    """An answer; `body` is what follows its head."""

    kind: int
    session: int
    number: int
    body: bytes

    def about(self) -> About:
        """Read the answer to HELLO."""
        version, state, size, done, clock_mhz, *names = _unpack(_ABOUT, self.body)
        core, profile = (name.decode("ascii", "replace") for name in names)
        return About(version, state, size, done, clock_mhz, core, profile)

    def called(self) -> Called:
        """Read the answer to CALL."""
        return Called(*_unpack(_CALLED, self.body))

    def health(self) -> "Health":
        """Read the answer to HEALTH."""
        *gyro, calibrated, battery_mv, heap_free, m1, m2, m3, m4 = _unpack(_HEALTH, self.body)
        return Health(tuple(gyro), bool(calibrated), battery_mv, heap_free, (m1, m2, m3, m4))

    def refusal(self) -> int:
        """Read the reason of a refusal."""
        return int(_unpack(_WHY, self.body)[0])


def hello() -> tuple[Message, bytes]:
    """Begin a session."""
    return Message.HELLO, b""


def write(offset: int, data: bytes) -> tuple[Message, bytes]:
    """Write up to `WRITE_MAX` bytes."""
    return Message.WRITE, _PLACE.pack(offset) + data


def call(entry: Call) -> tuple[Message, bytes]:
    """Execute an entry point."""
    return Message.CALL, _CALL.pack(entry)


def read(offset: int, size: int) -> tuple[Message, bytes]:
    """Read up to `READ_MAX` bytes."""
    return Message.READ, _PLACE_SIZE.pack(offset, size)


def health() -> tuple[Message, bytes]:
    return Message.HEALTH, b""


def loop(mode: Hil) -> tuple[Message, bytes]:
    """Switch hardware in the loop."""
    return Message.LOOP, _MODE.pack(mode)


@dataclass(frozen=True, slots=True)
class Looped:
    """The board's report in the loop."""

    used: int
    waiting: int
    state: int
    cause: int
    fresh: bool
    held: int
    late: int
    lost: int
    doubled: int
    counts: tuple[int, int, int, int]
    fused: int
    refused: int
    age_us: int

    @property
    def received(self) -> int:
        """Number of the next sample for the board, modulo 65536."""
        return (self.used + self.waiting) & 0xFFFF


def encode_samples(number: int, samples: Sequence[Sequence[int]]) -> tuple[bytes, int]:
    """Return the data of a packet with the first of these gyro samples, and how many of them it holds.

    `samples`: (n, 3) [counts], n > 0; the first one has this number. All fit where the rate changes little.
    """
    differences = [
        [(b - a + 0x8000 & 0xFFFF) - 0x8000 for a, b in zip(one, other, strict=True)]
        for one, other in pairwise(samples[:SAMPLES_MAX])
    ]
    small = sum(1 for _ in takewhile(_fits, differences))
    width = NARROW if small >= min(len(differences), _BEHIND_FIRST[WIDE]) else WIDE
    behind = differences[: small if width == NARROW else _BEHIND_FIRST[WIDE]]
    pack = _narrow if width == NARROW else _WIDE.pack
    return _SAMPLES.pack(number & 0xFFFF, width, *samples[0]) + b"".join(
        [pack(*step) for step in behind]
    ), 1 + len(behind)


def _fits(step: Sequence[int]) -> bool:
    limit = 1 << NARROW_BITS - 1
    return all(-limit <= axis < limit for axis in step)


def _narrow(x: int, y: int, z: int) -> bytes:
    mask = (1 << NARROW_BITS) - 1
    return _NARROW.pack((x & mask) | (y & mask) << NARROW_BITS | (z & mask) << 2 * NARROW_BITS)


def decode_looped(data: bytes) -> Looped:
    """Read the board's report; `WireError` when it is too short."""
    *head, m1, m2, m3, m4, fused, refused, age = _unpack(_LOOP, data)
    used, waiting, state, cause, fresh, held, late, lost, doubled = head
    return Looped(
        used, waiting, state, cause, bool(fresh), held, late, lost, doubled, (m1, m2, m3, m4), fused,
        refused, 100 * age,
    )  # fmt: skip


def encode_request(kind: Message, body: bytes, session: int, number: int) -> bytes:
    """Return the data of the packet."""
    return _HEAD.pack(kind, session, number & 0xFFFF) + body


def decode_answer(data: bytes) -> CoreAnswer:
    """Read the data of a packet; `WireError` when it has no head."""
    if len(data) < _HEAD.size:
        raise WireError(f"an answer of {len(data)} bytes: at least {_HEAD.size} are expected")
    kind, session, number = _HEAD.unpack_from(data)
    return CoreAnswer(kind, session, number, data[_HEAD.size :])


def _unpack(layout: struct.Struct, body: bytes) -> tuple[Any, ...]:
    if len(body) < layout.size:
        raise WireError(f"{len(body)} bytes behind the head: at least {layout.size} are expected")
    return layout.unpack_from(body)
