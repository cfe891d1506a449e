"""The telemetry of a flight: which variables travel in which log block, as one table for both ends.

Names, types and numbers are the Crazyflie's log variables and log types. On the wire the attitude is in the Crazyflie's
degrees; a `Sample` has SI units and Floaty's signs only, converted here.
Each block is one CRTP log data packet. The four blocks of one period carry the same time stamp, so that the
receiver can join them into one row.

The board sends them while its parameter `telemetry.stream` is 1. Their numbers lie above those that clients give to
blocks of their own.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import degrees

from firmware_py.wire import WireError
from firmware_py.wire.crtp import MAX_LOG_VALUES, decode_log_data, encode_log_data
from firmware_py.wire.parameters import SetByName, encode_set_by_name
from firmware_py.wire.scalars import Scalar

PERIOD_MS = 20  # of the original ground station's log blocks
SLOW_PERIOD_MS = 500
TIMESTAMP_MASK = 0xFFFFFF  # of a sample: what a log data packet has room for


Number = int | float  # the value of a log variable: an integer where its type on the wire is one

STREAM = "telemetry.stream"  # uint8 parameter: 1 switches the stream on
FIRST_ID = 0xF1

# What the Crazyflie's log variables of roll, pitch and yaw show per radian: its legacy pitch is positive with the nose up.
LEGACY_DEGREES = (degrees(1), -degrees(1), degrees(1))


def encode_stream_request(on: bool) -> bytes:
    """The complete packet that switches the stream on or off."""
    return encode_set_by_name(SetByName(STREAM, Scalar.U8, int(on)))


@dataclass(frozen=True, slots=True)
class Variable:
    """One log variable: `group.name`, its type on the wire and the unit of its samples (empty for a pure number)."""

    name: str
    type: Scalar
    unit: str
    scale: float | None = None  # of the value on the wire to that of a sample; None: they are equal


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Variables that travel together in one packet; at most 26 bytes. There is one object per block: the tables below."""

    id: int
    variables: tuple[Variable, ...]
    layout: struct.Struct = field(init=False, repr=False)
    is_scaled: bool = field(init=False, repr=False)  # whether any of them has a scale

    def __post_init__(self) -> None:
        layout = struct.Struct("<" + "".join(variable.type.format for variable in self.variables))
        if layout.size > MAX_LOG_VALUES:
            raise WireError(f"log block {self.id}: {layout.size} bytes, at most {MAX_LOG_VALUES} fit")
        object.__setattr__(self, "layout", layout)
        object.__setattr__(self, "is_scaled", any(item.scale is not None for item in self.variables))

    def pack(self, values: Sequence[Number]) -> bytes:
        """The bytes of the log variables' values; integers wrap at their width."""
        if len(values) != len(self.variables):
            raise WireError(f"log block {self.id}: {len(values)} values for {len(self.variables)} variables")
        try:
            return self.layout.pack(*values)
        except struct.error:
            pairs = zip(self.variables, values, strict=True)
            return self.layout.pack(*(variable.type.cast(value) for variable, value in pairs))

    def unpack(self, packed: bytes) -> tuple[Number, ...]:
        """The values of a sample; `WireError` for a wrong length."""
        if len(packed) != self.layout.size:
            raise WireError(
                f"log block {self.id}: {len(packed)} bytes of values instead of {self.layout.size}"
            )
        return self.si_of(self.layout.unpack(packed))

    def si_of(self, values: Sequence[Number]) -> tuple[Number, ...]:
        """The values of a sample from those of the log variables."""
        if not self.is_scaled:
            return tuple(values)
        return tuple(
            value if variable.scale is None else value / variable.scale
            for variable, value in zip(self.variables, values, strict=True)
        )


@dataclass(slots=True)
class Sample:
    """The values of one block at one instant of the board's clock."""

    block: Block
    timestamp_ms: int  # in the bits of TIMESTAMP_MASK
    values: tuple[Number, ...]  # in the order of block.variables


def _variables(group: str, names: str, type: Scalar, unit: str) -> tuple[Variable, ...]:
    return tuple(Variable(f"{group}.{name}", type, unit) for name in names.split())


# Position and yaw are those of the goal frame: what the board knows is its error.
BLOCKS = (
    Block(
        FIRST_ID,
        _variables("stateEstimate", "x y z", Scalar.F32, "m")
        + _variables("stateEstimate", "vx vy vz", Scalar.F32, "m/s"),
    ),
    Block(
        FIRST_ID + 1,
        tuple(
            Variable(f"stateEstimate.{name}", Scalar.F32, "rad", scale)
            for name, scale in zip(("roll", "pitch", "yaw"), LEGACY_DEGREES, strict=True)
        )
        + _variables("stateEstimate", "roll_rate pitch_rate yaw_rate", Scalar.F32, "rad/s"),
    ),
    Block(
        FIRST_ID + 2,
        _variables("stateEstimate", "flap_1 flap_2 flap_3 flap_4", Scalar.F32, "rad")
        + _variables("motor", "m1 m2 m3 m4", Scalar.U16, "counts"),
    ),
    Block(
        FIRST_ID + 3,
        _variables("controller", "u1 u2 u3 u4", Scalar.F32, "rad")
        + _variables("supervisor", "state", Scalar.U8, "")
        + _variables("locSrv", "age", Scalar.U16, "0.1 ms")  # of the last pose when it arrived
        + _variables("locSrv", "poses rejected", Scalar.U16, ""),  # received, refused; modulo 65536
    ),
)

# Only while something is excited: other flights do not spend air time on it.
EXCITATION = Block(FIRST_ID + 4, _variables("excite", "u1 u2 u3 u4", Scalar.F32, "rad"))
ALL_BLOCKS = (*BLOCKS, EXCITATION)
# Not part of the stream: stations of real boards request them one by one, because a Crazyflie has no load variable. MAVLink:
# SYS_STATUS.
BATTERY = Block(FIRST_ID + 5, _variables("pm", "vbat", Scalar.F32, "V"))
LOAD = Block(FIRST_ID + 6, _variables("system", "load", Scalar.F32, "%"))  # of the processor
SLOW_BLOCKS = (BATTERY, LOAD)

_BLOCK_OF_ID = {block.id: block for block in ALL_BLOCKS}


def encode_block(block: Block, timestamp_ms: int, values: Sequence[Number]) -> bytes:
    """The complete packet with the values of a block's log variables; integers wrap at their width."""
    return encode_log_data(block.id, timestamp_ms, block.pack(values))


def decode_sample(data: bytes) -> Sample:
    """The sample in the data of a log data packet; `WireError` for an unknown block or a wrong length."""
    block_id, timestamp_ms, packed = decode_log_data(data)
    block = _BLOCK_OF_ID.get(block_id)
    if block is None:
        raise WireError(f"log block {block_id}: not among {sorted(_BLOCK_OF_ID)}")
    return Sample(block, timestamp_ms, block.unpack(packed))
