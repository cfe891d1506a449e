"""The guard after the user's own logic: it passes finite numbers only, and counts NaN and infinity.

The default core has no such logic and no guard.
"""

from firmware_py.core import controller
from firmware_py.core.controller import FLAP_LIMIT, release, sign
from firmware_py.core.maths import ZERO, clamp, finite
from firmware_py.core.structs import (
    CAUSE_CONTROLLER_NOT_FINITE,
    CAUSE_ESTIMATOR_NOT_FINITE,
    MODE_FLY,
    STATES,
    Control,
    Estimator,
    Input,
    Parameters,
    Supervisor,
)
from firmware_py.core.subset import Struct, i32, kernel

_allocate = controller.allocate


class Guard(Struct):
    """How often own logic has returned NaN or infinity."""

    controller_faults: i32  # ticks
    estimator_faults: i32


@kernel
def closed(data: Input) -> bool:
    """Return whether the loop is closed."""
    return bool(data.mode == MODE_FLY)


@kernel
def allocate(parameters: Parameters, control: Control) -> None:
    """Write flap angles as the built-in law does, height last; an input u4 that is not finite is kept, to be detected."""
    u4 = control.u[3]
    _allocate(parameters, control)
    if not finite(u4):
        control.u[3] = u4


@kernel
def guard_control(parameters: Parameters, control: Control, guard: Guard) -> None:
    """Limit the law's flap angles; when an angle or an input is not finite, set the flaps to hover."""
    sound = True
    for i in range(4):
        if not finite(control.flap[i]) or not finite(control.u[i]):
            sound = False
    if not sound:
        guard.controller_faults = i32(guard.controller_faults + 1)
        release(control)
        for flap in range(4):
            control.flap[flap] = sign(flap) * parameters.hover_angle
    for flap in range(4):
        control.flap[flap] = clamp(control.flap[flap], -FLAP_LIMIT, FLAP_LIMIT)
        control.command[flap] = control.flap[flap] - sign(flap) * parameters.hover_angle


@kernel
def guard_estimate(estimator: Estimator, guard: Guard) -> None:
    """Replace an estimate that is not finite by zeros before the controller reads it."""
    sound = True
    for i in range(STATES):
        if not finite(estimator.now[i]):
            sound = False
            estimator.now[i] = ZERO
    if not sound:
        guard.estimator_faults = i32(guard.estimator_faults + 1)


@kernel
def note_faults(supervisor: Supervisor, guard: Guard) -> None:
    """Note which of the user's modules has returned NaN or infinity since the last call."""
    if guard.estimator_faults > supervisor.estimator_faults:
        supervisor.not_finite = i32(CAUSE_ESTIMATOR_NOT_FINITE)
    elif guard.controller_faults > supervisor.controller_faults:
        supervisor.not_finite = i32(CAUSE_CONTROLLER_NOT_FINITE)
    supervisor.controller_faults = guard.controller_faults
    supervisor.estimator_faults = guard.estimator_faults
