"""The observations and actions of a learned law, defined once for training, laboratory and board.

An observation holds 20 numbers; directions are in the heading frame (z up, x along the estimated yaw):

    0..2    position error, goal minus estimate [m]; x and y limited to `limit_xy`, as in `controller.feedback`
    3..5    velocity [m/s]
    6..8    roll, pitch, yaw error (target minus estimate, wrapped) [rad]
    9..11   body rates p, q, r [rad/s]
    12..15  estimated flap angles as deviations from the hover angles [rad]
    16..19  the previous action, -1..1

An action holds 4 numbers, -1..1: the inputs u1..u4 as shares of `limit_u`, `limit_u`, `limit_u3`, `limit_u`.
"""

from firmware_py.core.maths import ONE, clamp, cos, sin, wrap
from firmware_py.core.structs import ATTITUDE, FLAP, POSITION, RATE, VELOCITY, Control, Estimator, Parameters
from firmware_py.core.subset import F32s, f32, kernel

OBSERVATIONS = 20
ACTIONS = 4
YAW_ERROR = 8
PREVIOUS = 16


@kernel
def observe(parameters: Parameters, estimator: Estimator, previous: F32s, out: F32s) -> None:
    """Write the observation `out` (20,) from the estimate, the set-point and the previous action (4,)."""
    yaw = estimator.now[ATTITUDE + 2]
    sine = sin(yaw)
    cosine = cos(yaw)
    ex_G = parameters.target[0] - estimator.now[POSITION]
    ey_G = parameters.target[1] - estimator.now[POSITION + 1]
    vx_G = estimator.now[VELOCITY]
    vy_G = estimator.now[VELOCITY + 1]
    out[0] = clamp(cosine * ex_G + sine * ey_G, -parameters.limit_xy, parameters.limit_xy)
    out[1] = clamp(cosine * ey_G - sine * ex_G, -parameters.limit_xy, parameters.limit_xy)
    out[2] = parameters.target[2] - estimator.now[POSITION + 2]
    out[3] = cosine * vx_G + sine * vy_G
    out[4] = cosine * vy_G - sine * vx_G
    out[5] = estimator.now[VELOCITY + 2]
    out[6] = estimator.now[ATTITUDE]
    out[7] = estimator.now[ATTITUDE + 1]
    out[YAW_ERROR] = wrap(parameters.target[3] - yaw)
    for i in range(3):
        out[RATE + i] = estimator.now[RATE + i]
    for i in range(4):
        out[FLAP + i] = estimator.now[FLAP + i]
        out[PREVIOUS + i] = previous[i]


@kernel
def limited(x: f32, limit: f32) -> f32:
    """Return x inside +-limit; NaN stays NaN, which the guard detects."""
    if x > limit:
        return limit
    if x < -limit:
        return -limit
    return x


@kernel
def act(parameters: Parameters, action: F32s, control: Control) -> None:
    """Limit the action (4,) in place and write its inputs u1..u4 [rad]; the allocation follows."""
    for i in range(ACTIONS):
        action[i] = limited(action[i], ONE)
    control.u[0] = parameters.limit_u * action[0]
    control.u[1] = parameters.limit_u * action[1]
    control.u[2] = parameters.limit_u3 * action[2]
    control.u[3] = parameters.limit_u * action[3]
