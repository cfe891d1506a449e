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
from typing import Annotated, Any, NamedTuple

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
    RESTART = 9
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

    @classmethod
    def of(cls, kind: type[Any]) -> "PacketLayout":
        """Return the layout of a class whose fields have their codes as annotations."""
        return cls(
            kind.__name__, tuple((name, one.__metadata__[0]) for name, one in kind.__annotations__.items())
        )

    @property
    def struct(self) -> struct.Struct:
        """The `struct` that packs it."""
        return struct.Struct("<" + "".join(code for _, code in self.fields))


I8 = Annotated[int, "b"]
I16 = Annotated[int, "h"]
U8 = Annotated[int, "B"]
U16 = Annotated[int, "H"]
U32 = Annotated[int, "I"]
Flag = Annotated[bool, "?"]
Name = Annotated[str, f"{NAME_SIZE}s"]  # how a hash begins


class About(NamedTuple):
    """The board on the port."""

    version: U8  # VERSION
    state: U8  # of the supervisor: firmware_py.wire.supervisor.State
    size: U16  # [B] of the memory
    done: U16  # requests of this session that were executed
    clock_mhz: U16  # of the processor, whose cycles are counted
    core: Name  # of the core's sources
    profile: Name  # of the parameters in the app


class Called(NamedTuple):
    """The result of a call."""

    answer: I8  # 0 of calls without an answer
    cycles: U32  # that the call took, with the interrupts in it; no other task runs meanwhile
    digest: U32  # CRC-32 of the whole memory afterwards, as zlib.crc32


class Health(NamedTuple):
    """The state of a board."""

    gyro_x: I16  # [counts] now, of the board's own gyro
    gyro_y: I16
    gyro_z: I16
    calibrated: Flag  # the gyro's zero is known
    battery_mv: U16
    heap_free: U32  # [B] of RAM
    m1: U16  # timer counts of the servos
    m2: U16
    m3: U16
    m4: U16

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """The timer counts of the servos."""
        return self.m1, self.m2, self.m3, self.m4


class Loop(NamedTuple):
    """The board's report in the loop."""

    used: U16  # number of the next sample, when the controller ran
    waiting: U8  # samples in the buffer then
    state: U8  # of the supervisor
    cause: U8
    fresh: Flag  # the controller has just run; otherwise the flight is held
    held: U16
    late: U16
    lost: U16
    doubled: U16
    m1: U16  # timer counts that the controller puts out
    m2: U16
    m3: U16
    m4: U16
    fused: U16  # poses
    refused: U16
    age: U16  # [0.1 ms] of the last one

    @property
    def received(self) -> int:
        """Number of the next sample for the board, modulo 65536."""
        return (self.used + self.waiting) & 0xFFFF

    @property
    def counts(self) -> tuple[int, int, int, int]:
        """The timer counts of the servos."""
        return self.m1, self.m2, self.m3, self.m4


HEAD = PacketLayout("Head", (("kind", "B"), ("session", "B"), ("number", "H")))
PLACE = PacketLayout("Place", (("offset", "H"),))
PLACE_SIZE = PacketLayout("PlaceSize", (("offset", "H"), ("size", "B")))
CALL = PacketLayout("Call", (("call", "B"),))
WHY = PacketLayout("Why", (("reason", "B"),))
MODE = PacketLayout("Mode", (("mode", "B"),))
SAMPLES = PacketLayout("Samples", (
    ("number", "H"),  # of the first sample
    ("width", "B"),  # [B] of a difference: NARROW or WIDE
    ("x", "h"), ("y", "h"), ("z", "h"),  # [counts] of the gyro, sensor frame
))  # fmt: skip
ABOUT, CALLED, HEALTH, LOOP = map(PacketLayout.of, (About, Called, Health, Loop))
LAYOUTS = (HEAD, ABOUT, PLACE, PLACE_SIZE, CALL, CALLED, WHY, HEALTH, MODE, SAMPLES, LOOP)

_HEAD, _ABOUT, _PLACE, _PLACE_SIZE, _CALL, _CALLED, _WHY, _HEALTH, _MODE, _SAMPLES, _LOOP = (
    layout.struct for layout in LAYOUTS
)
_ANSWERS: dict[int, struct.Struct] = {
    Message.HELLO: _ABOUT, Message.CALL: _CALLED, Message.HEALTH: _HEALTH, Message.REFUSED: _WHY,
}  # fmt: skip
_NARROW, _WIDE = struct.Struct("<I"), struct.Struct("<hhh")
WRITE_MAX = MAX_DATA - _HEAD.size - _PLACE.size  # bytes in a packet
READ_MAX = MAX_DATA - _HEAD.size
# Samples in a packet.
_BEHIND_FIRST = {width: (MAX_DATA - _SAMPLES.size) // width for width in (NARROW, WIDE)}
SAMPLES_MAX = 1 + _BEHIND_FIRST[NARROW]  # in a packet, when the rate changes little


@dataclass(frozen=True, slots=True)
class CoreAnswer:
    """An answer; `body` is what follows its head."""

    kind: int
    session: int
    number: int
    body: bytes

    def check(self, kind: Message, request: bytes) -> None:
        """Raise `WireError` when it does not answer such a request: it has another kind or is too short."""
        if self.kind not in (kind, Message.REFUSED):
            raise WireError(f"an answer of kind {self.kind} to a request of kind {kind}")
        if self.kind in _ANSWERS:
            _unpack(_ANSWERS[self.kind], self.body)
        elif kind == Message.READ and len(self.body) < (size := _PLACE_SIZE.unpack(request)[1]):
            raise _short(self.body, size)

    def about(self) -> About:
        """Read the answer to HELLO."""
        *numbers, core, profile = _unpack(_ABOUT, self.body)
        return About._make((*numbers, core.decode("ascii", "replace"), profile.decode("ascii", "replace")))

    def called(self) -> Called:
        """Read the answer to CALL."""
        return Called(*_unpack(_CALLED, self.body))

    def health(self) -> Health:
        """Read the answer to HEALTH."""
        return Health(*_unpack(_HEALTH, self.body))

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


def decode_loop(data: bytes) -> Loop:
    """Read the board's report; `WireError` when it is too short."""
    return Loop(*_unpack(_LOOP, data))


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
        raise _short(body, layout.size)
    return layout.unpack_from(body)


def _short(body: bytes, least: int) -> WireError:
    return WireError(f"{len(body)} bytes behind the head: at least {least} are expected")
