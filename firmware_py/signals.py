"""What an observer outside the board may read: views on the running core and its counters."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_py.core.structs import Control, Estimator
from firmware_py.core.subset import Block
from firmware_py.supervisor import Supervisor

ESTIMATOR, CONTROL = Estimator.dtype, Control.dtype  # how they lie in memory, here and in an image
COUNTERS = ("fused", "refused", "jumps", "too_old", "invalid", "bounded", "resets", "horizon", "pose_age_us")


@dataclass(frozen=True, slots=True)
class Signals:
    """Views that follow the flight core while it runs."""

    estimate: NDArray[np.float32]  # (16,) state brought to now: p [m], v [m/s] in G; roll, pitch, yaw [rad];
    #                                rates [rad/s]; flap deviations from hover [rad]
    counters: NDArray[np.int32]  # (9,) of the estimator, named by COUNTERS
    u: NDArray[np.float32]  # (4,) [rad] compound inputs
    flap: NDArray[np.float32]  # (4,) [rad] commanded flap angles
    count: NDArray[np.int32]  # (4,) timer compare counts
    supervisor: Supervisor

    @classmethod
    def of(cls, estimator: Block[Estimator], control: Block[Control], supervisor: Supervisor) -> "Signals":
        """Return the views on the blocks of a running core."""
        start = dict(ESTIMATOR.fields or {})[COUNTERS[0]][1]
        counters = np.ndarray(len(COUNTERS), np.int32, estimator.memory.data, start)
        fields = control.fields
        return cls(estimator.fields.now, counters, fields.u, fields.flap, fields.count, supervisor)
