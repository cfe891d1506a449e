"""The telemetry of a flight: the log variables of each log block, as one table for all links.

Names and types are the Crazyflie's log variables and log types. On the wire the attitude is in the Crazyflie's degrees; a
`Sample` has SI units and Floaty's signs only, converted here.

`controller.u1` to `.u4` are the means of two ticks, which are one row's period. Over CRTP each block is sampled and sent
separately. Identification compares inputs and their effects, which are therefore in
one block, as half floats: their steps, 2^-11 of the value, are below the noise of the gyro and of the flaps.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import degrees

from firmware_py.wire import WireError
from firmware_py.wire.scalars import Scalar

PERIOD_MS = 20  # of the original ground station's log blocks
SLOW_PERIOD_MS = 500
TIMESTAMP_MASK = 0xFFFFFF  # of a sample: the bits in a log data packet

Number = int | float  # the value of a log variable: an integer where its type on the wire is one

# The Crazyflie's log variables of roll, pitch and yaw per radian: its legacy pitch is positive with the nose up.
LEGACY_DEGREES = (degrees(1), -degrees(1), degrees(1))


@dataclass(frozen=True, slots=True)
class Variable:
    """One log variable: `group.name`, its type on the wire and the unit of its samples (empty for a pure number)."""

    name: str
    type: Scalar
    unit: str
    scale: float | None = None  # of the value on the wire to that of a sample; None: they are equal


@dataclass(frozen=True, slots=True, eq=False)
class TelemetryBlock:
    """Variables that are sent in one packet; at most 26 bytes. There is one object per block: the tables below."""

    id: int
    period_ms: int
    variables: tuple[Variable, ...]
    layout: struct.Struct = field(init=False, repr=False)
    is_scaled: bool = field(init=False, repr=False)  # whether any of them has a scale

    def __post_init__(self) -> None:
        layout = struct.Struct("<" + "".join(variable.type.format for variable in self.variables))
        object.__setattr__(self, "layout", layout)
        object.__setattr__(self, "is_scaled", any(item.scale is not None for item in self.variables))

    def unpack(self, packed: bytes) -> tuple[Number, ...]:
        """Return the values of a sample; `WireError` for a wrong length."""
        if len(packed) != self.layout.size:
            raise WireError(
                f"log block {self.id}: {len(packed)} bytes of values instead of {self.layout.size}"
            )
        return self.si_of(self.layout.unpack(packed))

    def si_of(self, values: Sequence[Number]) -> tuple[Number, ...]:
        """Return the values of a sample from those of the log variables."""
        if not self.is_scaled:
            return tuple(values)
        return tuple(
            value if variable.scale is None else value / variable.scale
            for variable, value in zip(self.variables, values, strict=True)
        )


@dataclass(slots=True)
class Sample:
    """The values of one block at one instant of the board's clock."""

    block: TelemetryBlock
    timestamp_ms: int  # in the bits of TIMESTAMP_MASK
    values: tuple[Number, ...]  # in the order of block.variables


def _variables(group: str, names: str, type: Scalar, unit: str) -> tuple[Variable, ...]:
    return tuple(Variable(f"{group}.{name}", type, unit) for name in names.split())


# Position and yaw are those of the goal frame: the board knows only its error.
MOTION = TelemetryBlock(
    0,
    PERIOD_MS,
    _variables("stateEstimate", "x y z", Scalar.F32, "m")
    + _variables("stateEstimate", "vx vy vz", Scalar.F32, "m/s"),
)
ATTITUDE = TelemetryBlock(
    1,
    PERIOD_MS,
    tuple(
        Variable(f"stateEstimate.{name}", Scalar.F32, "rad", scale)
        for name, scale in zip(("roll", "pitch", "yaw"), LEGACY_DEGREES, strict=True)
    )
    + _variables("locSrv", "age", Scalar.U16, "0.1 ms")  # of the last pose when it arrived
    + _variables("locSrv", "poses rejected", Scalar.U16, ""),  # received, refused; modulo 65536
)
FLAPS = TelemetryBlock(
    2,
    PERIOD_MS,
    _variables("stateEstimate", "flap_1 flap_2 flap_3 flap_4", Scalar.F32, "rad")
    + _variables("motor", "m1 m2 m3 m4", Scalar.U16, "counts"),
)
CONTROL = TelemetryBlock(
    3,
    PERIOD_MS,
    _variables("supervisor", "state", Scalar.U8, "")
    + _variables("stateEstimate", "roll_rate pitch_rate yaw_rate", Scalar.F16, "rad/s")
    + _variables("controller", "u1 u2 u3 u4", Scalar.F16, "rad")
    + _variables("excite", "u1 u2 u3 u4", Scalar.F16, "rad"),
)
BLOCKS = (MOTION, ATTITUDE, FLAPS, CONTROL)
# Separate, because a Crazyflie has no load variable. MAVLink: SYS_STATUS.
BATTERY = TelemetryBlock(4, SLOW_PERIOD_MS, _variables("pm", "vbat", Scalar.F32, "V"))
LOAD = TelemetryBlock(5, SLOW_PERIOD_MS, _variables("system", "load", Scalar.F32, "%"))  # of the processor
SLOW_BLOCKS = (BATTERY, LOAD)
ALL_BLOCKS = (*BLOCKS, *SLOW_BLOCKS)
# Of a Crazyflie with its own firmware; MOTION and BATTERY it has as well. Roll, pitch and yaw are in its degrees.
CRAZYFLIE_STATE = TelemetryBlock(
    6,
    PERIOD_MS,
    tuple(variable for variable in ATTITUDE.variables if variable.scale is not None)
    + _variables("motor", "m1 m2 m3 m4", Scalar.U16, "")
    + _variables("supervisor", "info", Scalar.U16, ""),
)
CRAZYFLIE_BLOCKS = (MOTION, CRAZYFLIE_STATE, BATTERY)


def state_in(samples: Sequence[Sample]) -> int | None:
    """Return the supervisor's state, None where no sample has it."""
    return next((int(sample.values[0]) for sample in samples if sample.block is CONTROL), None)
