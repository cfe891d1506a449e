"""Poses that repeat while the robot turns: their source is frozen.

A measured pose has noise in its last bits, so it never repeats. The pose of a simulator without noise repeats as long as
the robot rests. So a repetition alone is no fault. It is one when the gyro has measured a turn before the exposure.
"""

from firmware_py.core.maths import ZERO
from firmware_py.core.model import DT
from firmware_py.core.structs import HORIZON_LIMIT, TICK_US, Input, Parameters, Sampling
from firmware_py.core.subset import f32, i32, kernel

# [rad] 1 deg. A turn by 0.5 deg changes the coarsest pose, a packed one. A hovering robot turns by 1 deg in 0.1 s.
TURN = f32(0.0175)
# A turn is forgotten with a time constant of 16 ticks: a wrong zero of 5 deg/s adds up to 0.8 deg.
KEPT = f32(0.9375)


@kernel
def compare(data: Input, sampling: Sampling) -> None:
    """Remember the pose, and forget the turn if any bit differs from the last one."""
    same = True
    for i in range(3):
        if data.pose_position[i] != sampling.last_position[i]:
            same = False
        sampling.last_position[i] = data.pose_position[i]
    for i in range(4):
        if data.pose_quaternion[i] != sampling.last_quaternion[i]:
            same = False
        sampling.last_quaternion[i] = data.pose_quaternion[i]
    if not same:
        sampling.turned_ticks = i32(0)
        for axis in range(3):
            sampling.turn[axis] = ZERO


@kernel
def frozen(data: Input, sampling: Sampling) -> bool:
    """Return whether the pose was exposed after a turn that it does not show."""
    if sampling.turned_ticks == 0:
        return False
    if data.pose_age_us < 0:  # unknown: as old as a pose may be
        return bool(sampling.turned_ticks > HORIZON_LIMIT)
    return bool(data.pose_age_us <= sampling.turned_ticks * TICK_US)


@kernel
def add_turn(parameters: Parameters, data: Input, sampling: Sampling) -> None:
    """Add the turn of the tick that ends; count the ticks since it exceeded `TURN`."""
    if sampling.turned_ticks > 0:
        if sampling.turned_ticks <= HORIZON_LIMIT:
            sampling.turned_ticks = i32(sampling.turned_ticks + 1)
        return
    square = ZERO
    for axis in range(3):
        turn = KEPT * sampling.turn[axis]
        if data.gyro_samples > 0:
            mean = f32(data.gyro_sum[axis]) / f32(data.gyro_samples) - data.gyro_bias[axis]
            turn = turn + mean * parameters.gyro_scale * DT
        sampling.turn[axis] = turn
        square = square + turn * turn
    if square > TURN * TURN:
        sampling.turned_ticks = i32(1)
