"""The log variables of the firmware: names as on the Crazyflie and on the original Floaty, values from the running core."""

from collections.abc import Callable, Sequence

from firmware_py.core.structs import ATTITUDE, FLAP, POSITION, RATE, VELOCITY, Control, Estimator
from firmware_py.wire.telemetry import Block

AGE_UNIT_US = 100  # locSrv.age counts tenths of a millisecond


def telemetry_reader(
    estimator: Estimator, control: Control, supervisor_state: Callable[[], int]
) -> Callable[[Block], Sequence[float]]:
    """Return the function that reads a telemetry block; estimator and control are the core's fields."""

    def motion() -> Sequence[float]:
        return list(estimator.now[POSITION : VELOCITY + 3].tolist())

    def attitude() -> Sequence[float]:
        return list(estimator.now[ATTITUDE : RATE + 3].tolist())

    def flaps() -> Sequence[float]:
        hover = control.flap - control.command
        return [*(estimator.now[FLAP:] + hover).tolist(), *control.count.tolist()]

    def health() -> Sequence[float]:
        refused = int(estimator.refused + estimator.too_old + estimator.invalid)
        received = int(estimator.fused + estimator.jumps) + refused
        age = int(estimator.pose_age_us) // AGE_UNIT_US
        return [*control.u.tolist(), supervisor_state(), age, received & 0xFFFF, refused & 0xFFFF]

    readers = {1: motion, 2: attitude, 3: flaps, 4: health}
    return lambda block: readers[block.id]()
