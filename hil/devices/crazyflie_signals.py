"""The signals of an image without our app: the stock firmware's own estimate, motors and supervisor.

They are log variables, read from the chip's memory. The estimate is in W; missing values are empty.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan, radians

import numpy as np

from firmware_py.signals import Signals
from firmware_py.wire.supervisor import LOCKED, Cause, State
from firmware_py.wire.telemetry import LEGACY_DEGREES
from hil.crazyflie.log_table import ImageVariable

FLYING, TUMBLED, CRASHED = 1 << 4, 1 << 5, 1 << 7  # of `supervisor.info`, beside LOCKED
DEGREE = radians(1.0)
# Name and factor to SI of the estimate's twelve numbers.
ESTIMATE = (
    *((f"stateEstimate.{name}", 1.0) for name in ("x", "y", "z", "vx", "vy", "vz")),
    *((f"stateEstimate.{name}", 1.0 / scale) for name, scale in zip(("roll", "pitch", "yaw"), LEGACY_DEGREES, strict=True)),
    *((f"gyro.{name}", DEGREE) for name in "xyz"),
)  # fmt: skip
MOTORS = tuple(f"motor.m{number}" for number in (1, 2, 3, 4))
NO_FLOATS, NO_COUNTS = np.empty(0, np.float32), np.empty(0, np.int32)


@dataclass(frozen=True, slots=True)
class StockSupervisor:
    """`bits` are those of `supervisor.info`."""

    bits: int

    @property
    def state(self) -> State:
        """Our name for its state: failsafe once it stops all motors."""
        if self.bits & (LOCKED | TUMBLED | CRASHED):
            return State.FAILSAFE
        return State.FLYING if self.bits & FLYING else State.WAITING

    @property
    def cause(self) -> Cause:
        return Cause.EMERGENCY_STOP if self.bits & LOCKED else Cause.NONE


def stock_signals(table: Mapping[str, ImageVariable]) -> Signals:
    """Return the current values; NaN for a variable that the image lacks."""

    def read(name: str, missing: float) -> float:
        return table[name].read() if name in table else missing

    estimate = np.array([factor * read(name, nan) for name, factor in ESTIMATE], np.float32)
    motors = np.array([read(name, 0.0) for name in MOTORS], np.int32)
    supervisor = StockSupervisor(int(read("supervisor.info", 0.0)))
    return Signals(estimate, NO_COUNTS, NO_FLOATS, NO_FLOATS, motors, supervisor)
