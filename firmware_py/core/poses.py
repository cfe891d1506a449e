"""A pose on its way to the estimator: how old it will be at the tick that takes it."""

from firmware_py.core.sampling import until_estimate_us
from firmware_py.core.structs import Input, Sampling
from firmware_py.core.subset import i32, kernel

LONG_US = 1000000000  # longer than any limit: times are counted up to here


@kernel
def waited_us(data: Input) -> i32:
    """Return how long the pose has waited; a clock that was set back in between does not make it younger."""
    if data.pose_waited_us < 0:
        return i32(0)
    if data.pose_waited_us > LONG_US:
        return i32(LONG_US)
    return i32(data.pose_waited_us)


@kernel
def age_at_tick(data: Input, sampling: Sampling) -> None:
    """Put the age at the estimator's next tick in place of that at arrival; an unknown one stays unknown."""
    if data.pose_age_us < 0:
        return
    if data.pose_age_us > LONG_US:
        data.pose_age_us = i32(LONG_US)
    data.pose_age_us = i32(data.pose_age_us + waited_us(data) + until_estimate_us(sampling))
