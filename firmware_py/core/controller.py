"""The controller and its allocation: proportional with an integrator on z, height last when flaps saturate.

Errors are taken in the heading frame. Sign conventions are the paper's: u1 > 0 rolls left side up (+roll), u2 acts on
pitch with the sign of the profile's pitch constant, u3 > 0 turns left, u4 > 0 lifts.
"""

from firmware_py.core.excitation import excite
from firmware_py.core.maths import HALF, ZERO, clamp, cos, sin, wrap
from firmware_py.core.servo import WORD_CENTRE, WORDS_PER_RADIAN
from firmware_py.core.structs import (
    ATTITUDE,
    MODE_FLY,
    MODE_MANUAL,
    POSITION,
    RATE,
    VELOCITY,
    Control,
    Estimator,
    Input,
    Parameters,
)
from firmware_py.core.subset import Integer, f32, i32, kernel

DT = f32(0.01)
FLAP_LIMIT = f32(1.5707963)  # [rad] for flap angles from outside


@kernel
def feedback(parameters: Parameters, estimator: Estimator, control: Control) -> None:
    """Write the compound inputs u from the estimated state and the set-point."""
    yaw = estimator.now[ATTITUDE + 2]
    sine = sin(yaw)
    cosine = cos(yaw)
    ex_G = parameters.target[0] - estimator.now[POSITION]
    ey_G = parameters.target[1] - estimator.now[POSITION + 1]
    ez = parameters.target[2] - estimator.now[POSITION + 2]
    vx_G = estimator.now[VELOCITY]
    vy_G = estimator.now[VELOCITY + 1]
    ex = clamp(cosine * ex_G + sine * ey_G, -parameters.limit_xy, parameters.limit_xy)
    ey = clamp(cosine * ey_G - sine * ex_G, -parameters.limit_xy, parameters.limit_xy)
    vx = cosine * vx_G + sine * vy_G
    vy = cosine * vy_G - sine * vx_G
    control.integral_z = clamp(control.integral_z + DT * ez, -parameters.limit_iz, parameters.limit_iz)
    control.u[0] = (
        parameters.gain_y * ey
        - parameters.gain_vy * vy
        - parameters.gain_roll * estimator.now[ATTITUDE]
        - parameters.gain_p * estimator.now[RATE]
    )
    control.u[1] = (
        parameters.gain_x * ex
        - parameters.gain_vx * vx
        - parameters.gain_pitch * estimator.now[ATTITUDE + 1]
        - parameters.gain_q * estimator.now[RATE + 1]
    )
    control.u[2] = (
        parameters.gain_yaw * wrap(parameters.target[3] - yaw) - parameters.gain_r * estimator.now[RATE + 2]
    )
    control.u[3] = (
        parameters.gain_z * ez
        - parameters.gain_vz * estimator.now[VELOCITY + 2]
        + parameters.gain_iz * control.integral_z
    )
    control.u[0] = clamp(control.u[0], -parameters.limit_u, parameters.limit_u)
    control.u[1] = clamp(control.u[1], -parameters.limit_u, parameters.limit_u)
    control.u[2] = clamp(control.u[2], -parameters.limit_u3, parameters.limit_u3)
    control.u[3] = clamp(control.u[3], -parameters.limit_u, parameters.limit_u)


@kernel
def sign(flap: Integer) -> f32:
    """Return the sign of a flap's angle: eq. (input_signals) turns flaps 1 and 3 in the opposite direction to 2 and 4."""
    if flap % 2 == 0:
        return f32(1.0)
    return f32(-1.0)


@kernel
def attitude_share(control: Control, flap: Integer) -> f32:
    """Return how far u1, u2 and u3 open a flap [rad]: the first three columns of eq. (input_signals) times its sign."""
    u1 = control.u[0]
    u2 = control.u[1]
    u3 = control.u[2]
    if flap == 0:
        return f32(u1 + u2 - u3)
    if flap == 1:
        return f32(u2 + u3 - u1)
    if flap == 2:
        return f32(-u1 - u2 - u3)
    return f32(u1 - u2 + u3)


@kernel
def allocate(parameters: Parameters, control: Control) -> None:
    """Write the flap angles of eq. (input_signals); attitude first, height gives way, then each flap is limited."""
    least = attitude_share(control, 0)
    most = least
    for flap in range(1, 4):
        share = attitude_share(control, flap)
        if share < least:
            least = share
        if share > most:
            most = share
    low = parameters.hover_angle + most - parameters.opening_max
    high = parameters.hover_angle + least - parameters.opening_min
    if low > high:
        control.u[3] = HALF * (low + high)
    else:
        control.u[3] = clamp(control.u[3], low, high)
    for flap in range(4):
        opening = parameters.hover_angle + attitude_share(control, flap) - control.u[3]
        control.flap[flap] = sign(flap) * clamp(opening, parameters.opening_min, parameters.opening_max)


@kernel
def release(control: Control) -> None:
    """Open the loop: clear compound inputs, integral and excitation."""
    control.integral_z = ZERO
    control.excite_tick = i32(0)
    for i in range(4):
        control.u[i] = ZERO
        control.excitation[i] = ZERO


@kernel
def average_inputs(control: Control) -> None:
    """Write the mean of the inputs of this tick and of the one before, for telemetry."""
    for i in range(4):
        control.u_mean[i] = HALF * (control.u_last[i] + control.u[i])
        control.u_last[i] = control.u[i]


@kernel
def manual_angle(parameters: Parameters, data: Input, flap: Integer) -> f32:
    """Return the flap angle from outside [rad]; for a servo word, an angle that the truncating mapping turns into it."""
    if data.by_words == 0:
        return f32(data.manual[flap])
    untrimmed = f32(data.words[flap]) + HALF - WORD_CENTRE - parameters.trim[flap]
    return f32(parameters.direction[flap] * untrimmed / WORDS_PER_RADIAN)


@kernel
def control_flaps(parameters: Parameters, data: Input, estimator: Estimator, control: Control) -> None:
    """Write the commanded flap angles for the mode: closed loop, hover angles, or angles from outside."""
    if data.mode == MODE_FLY:
        feedback(parameters, estimator, control)
        excite(parameters, control)
        allocate(parameters, control)
    else:
        release(control)
        for flap in range(4):
            control.flap[flap] = sign(flap) * parameters.hover_angle
            if data.mode == MODE_MANUAL:
                control.flap[flap] = clamp(manual_angle(parameters, data, flap), -FLAP_LIMIT, FLAP_LIMIT)
    for flap in range(4):
        control.command[flap] = control.flap[flap] - sign(flap) * parameters.hover_angle
