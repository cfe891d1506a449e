"""The age of a pose at the estimator tick that takes it."""

from firmware_py.core.sampling import until_estimate_us
from firmware_py.core.structs import Input, Sampling
from firmware_py.core.subset import i32, kernel

LONG_US = 1000000000  # times saturate here, above every limit


@kernel
def waited_us(data: Input) -> i32:
    """Return how long the pose has waited, 0 when the clock was set back meanwhile."""
    if data.pose_waited_us < 0:
        return i32(0)
    if data.pose_waited_us > LONG_US:
        return i32(LONG_US)
    return i32(data.pose_waited_us)


@kernel
def age_at_tick(data: Input, sampling: Sampling) -> None:
    """Replace the age at arrival by the age at the estimator's next tick; an unknown age stays unknown."""
    if data.pose_age_us < 0:
        return
    if data.pose_age_us > LONG_US:
        data.pose_age_us = i32(LONG_US)
    data.pose_age_us = i32(data.pose_age_us + waited_us(data) + until_estimate_us(sampling))
