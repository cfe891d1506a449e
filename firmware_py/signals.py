"""What an observer outside the board may read: views on the running core and its counters."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from firmware_py.core.structs import Control, Estimator, Input
from firmware_py.wire.supervisor import Cause, State

ESTIMATOR, CONTROL, INPUT = (
    Estimator.dtype,
    Control.dtype,
    Input.dtype,
)  # how they lie in memory, here and in an image
REFUSED = ("refused", "too_old", "invalid")  # counters of poses not fused; their sum is `Report.rejected`
COUNTERS = ("fused", "refused", "jumps", "too_old", "invalid", "bounded", "resets", "horizon", "pose_age_us")


class SupervisorState(Protocol):
    """The supervisor's output."""

    @property
    def state(self) -> State:
        """The present state."""

    @property
    def cause(self) -> Cause:
        """Why it is in its failsafe."""


@dataclass(frozen=True, slots=True)
class Signals:
    """Views that follow the flight core while it runs."""

    estimate: NDArray[np.float32]  # (16,) present state: p [m], v [m/s] in G; roll, pitch, yaw [rad];
    #                                rates [rad/s]; flap deviations from hover [rad]
    counters: NDArray[np.int32]  # (9,) of the estimator, named by COUNTERS
    u: NDArray[np.float32]  # (4,) [rad] compound inputs
    flap: NDArray[np.float32]  # (4,) [rad] commanded flap angles
    count: NDArray[np.int32]  # (4,) timer compare counts
    supervisor: SupervisorState

    @classmethod
    def of(cls, estimator: NDArray[Any], control: NDArray[Any], supervisor: SupervisorState) -> "Signals":
        """Return the views on the structs of a running core, one of each."""
        start = dict(ESTIMATOR.fields or {})[COUNTERS[0]][1]
        counters = np.ndarray(len(COUNTERS), np.int32, estimator.view(np.uint8).data, start)
        u, flap, count = (control[name][0] for name in ("u", "flap", "count"))
        return cls(estimator["now"][0], counters, u, flap, count, supervisor)
