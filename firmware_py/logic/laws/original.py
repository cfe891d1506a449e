"""The control law of the original firmware: integrators on y and z, and no priority among the inputs.

Its gains are `extCtrl.*`, as there. A flap that saturates takes from height and attitude alike. Where the original froze its
integrators without poses and zeroed them in the manual modes, an open loop zeroes them here.
"""

from typing import Annotated

from firmware_py.core.controller import attitude_share, sign
from firmware_py.core.maths import ZERO, clamp, cos, sin, wrap
from firmware_py.core.structs import ATTITUDE, POSITION, RATE, VELOCITY, Control, Estimator, Parameters
from firmware_py.core.subset import Logged, Struct, Tunable, f32, kernel

DT = f32(0.01)


class Gains(Struct):
    """What the built-in law does not have."""

    gain_iy: Annotated[f32, Tunable(-0.4, "rad/m/s", low=-20.0, high=20.0)]
    limit_iy: Annotated[f32, Tunable(0.1, "m s", low=0.0, high=5.0)]


class Memory(Struct):
    """The integrals of the errors."""

    integral_y: Annotated[f32, Logged("m s")]
    integral_z: Annotated[f32, Logged("m s")]


@kernel
def reset_law(memory: Memory) -> None:
    """Forget the errors."""
    memory.integral_y = ZERO
    memory.integral_z = ZERO


@kernel
def mix(parameters: Parameters, control: Control) -> None:
    """Write the flap angles of eq. (input_signals), each limited by itself."""
    for flap in range(4):
        opening = parameters.hover_angle + attitude_share(control, flap) - control.u[3]
        control.flap[flap] = sign(flap) * clamp(opening, parameters.opening_min, parameters.opening_max)


@kernel
def control_law(
    parameters: Parameters, estimator: Estimator, control: Control, own: Gains, memory: Memory
) -> None:
    """Write inputs and flap angles."""
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
    memory.integral_y = clamp(memory.integral_y + DT * ey, -own.limit_iy, own.limit_iy)
    memory.integral_z = clamp(memory.integral_z + DT * ez, -parameters.limit_iz, parameters.limit_iz)
    u1 = (
        parameters.gain_y * ey
        - parameters.gain_vy * vy
        - parameters.gain_roll * estimator.now[ATTITUDE]
        - parameters.gain_p * estimator.now[RATE]
        + own.gain_iy * memory.integral_y
    )
    u2 = (
        parameters.gain_x * ex
        - parameters.gain_vx * vx
        - parameters.gain_pitch * estimator.now[ATTITUDE + 1]
        - parameters.gain_q * estimator.now[RATE + 1]
    )
    u3 = parameters.gain_yaw * wrap(parameters.target[3] - yaw) - parameters.gain_r * estimator.now[RATE + 2]
    u4 = (
        parameters.gain_z * ez
        - parameters.gain_vz * estimator.now[VELOCITY + 2]
        + parameters.gain_iz * memory.integral_z
    )
    control.u[0] = clamp(u1, -parameters.limit_u, parameters.limit_u)
    control.u[1] = clamp(u2, -parameters.limit_u, parameters.limit_u)
    control.u[2] = clamp(u3, -parameters.limit_u3, parameters.limit_u3)
    control.u[3] = clamp(u4, -parameters.limit_u, parameters.hover_angle)
    mix(parameters, control)
