"""The telemetry of a flight: which variables travel in which log block, as one table for both ends.

Names, types and numbers are the Crazyflie's log variables and log types, units are Floaty's (angles in rad).
Each block is one CRTP log data packet. The four blocks of one period carry the same time stamp, so that the
receiver can join them into one row.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum

from firmware_py.wire import WireError
from firmware_py.wire.crtp import MAX_LOG_VALUES, decode_log_data, encode_log_data

PERIOD_MS = 20  # of the original ground station's log blocks


class LogType(IntEnum):
    """The Crazyflie's numbers for the types of log variables (the ones in use)."""

    U8 = 1
    U16 = 2
    F32 = 7


_FORMAT = {LogType.U8: "B", LogType.U16: "H", LogType.F32: "f"}
_MODULUS = {LogType.U8: 1 << 8, LogType.U16: 1 << 16}


@dataclass(frozen=True, slots=True)
class Variable:
    """One log variable: `group.name`, its type on the wire and its unit (empty for a pure number)."""

    name: str
    type: LogType
    unit: str


@dataclass(frozen=True, slots=True)
class Block:
    """Variables that travel together in one packet; at most 26 bytes."""

    id: int
    variables: tuple[Variable, ...]
    layout: struct.Struct = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        layout = struct.Struct("<" + "".join(_FORMAT[variable.type] for variable in self.variables))
        if layout.size > MAX_LOG_VALUES:
            raise WireError(f"log block {self.id}: {layout.size} bytes, at most {MAX_LOG_VALUES} fit")
        object.__setattr__(self, "layout", layout)


@dataclass(frozen=True, slots=True)
class Sample:
    """The values of one block at one instant of the board's clock."""

    block: Block
    timestamp_ms: int  # modulo 2^24
    values: tuple[float, ...]  # in the order of block.variables


def _variables(group: str, names: str, type: LogType, unit: str) -> tuple[Variable, ...]:
    return tuple(Variable(f"{group}.{name}", type, unit) for name in names.split())


# Position and yaw are those of the goal frame: what the board knows is its error.
BLOCKS = (
    Block(
        1,
        _variables("stateEstimate", "x y z", LogType.F32, "m")
        + _variables("stateEstimate", "vx vy vz", LogType.F32, "m/s"),
    ),
    Block(
        2,
        _variables("stateEstimate", "roll pitch yaw", LogType.F32, "rad")
        + _variables("stateEstimate", "roll_rate pitch_rate yaw_rate", LogType.F32, "rad/s"),
    ),
    Block(
        3,
        _variables("stateEstimate", "flap_1 flap_2 flap_3 flap_4", LogType.F32, "rad")
        + _variables("motor", "m1 m2 m3 m4", LogType.U16, "counts"),
    ),
    Block(
        4,
        _variables("controller", "u1 u2 u3 u4", LogType.F32, "rad")
        + _variables("supervisor", "state", LogType.U8, "")
        + _variables("locSrv", "age", LogType.U16, "0.1 ms")  # of the last pose when it arrived
        + _variables("locSrv", "poses rejected", LogType.U16, ""),  # received, refused; modulo 65536
    ),
)

_BLOCK_OF_ID = {block.id: block for block in BLOCKS}


def encode_sample(block: Block, timestamp_ms: int, values: Sequence[float]) -> bytes:
    """The complete packet with `values` in the order of `block.variables`; integers wrap at their width."""
    if len(values) != len(block.variables):
        raise WireError(f"log block {block.id}: {len(values)} values for {len(block.variables)} variables")
    try:
        packed = block.layout.pack(*values)
    except struct.error:
        packed = block.layout.pack(*map(_cast, block.variables, values))
    return encode_log_data(block.id, timestamp_ms, packed)


def decode_sample(data: bytes) -> Sample:
    """The sample in the data of a log data packet; `WireError` for an unknown block or a wrong length."""
    block_id, timestamp_ms, packed = decode_log_data(data)
    block = _BLOCK_OF_ID.get(block_id)
    if block is None:
        raise WireError(f"log block {block_id}: not among {sorted(_BLOCK_OF_ID)}")
    if len(packed) != block.layout.size:
        raise WireError(f"log block {block_id}: {len(packed)} bytes of values instead of {block.layout.size}")
    return Sample(block, timestamp_ms, block.layout.unpack(packed))


def _cast(variable: Variable, value: float) -> float:
    """What a C cast makes of an integer that does not fit."""
    modulus = _MODULUS.get(variable.type)
    return value if modulus is None else int(value) % modulus
