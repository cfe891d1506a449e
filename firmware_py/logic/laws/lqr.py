"""A linear quadratic regulator: full feedback of the filter's 16 states, the flaps' angles included.

The gains' defaults are the optimum for the model of profiles/floaty.toml, as `python tools/lqr_gains.py` computes it with
the weights that stand there. The model falls apart into roll with y, pitch with x, yaw, and height, each with its share of
the flaps, so that 16 numbers are the whole matrix. Its errors are limited and its flaps allocated as in the built-in law.
"""

from typing import Annotated

from firmware_py.core.guard import allocate
from firmware_py.core.maths import clamp, cos, sin, wrap
from firmware_py.core.structs import ATTITUDE, FLAP, POSITION, RATE, VELOCITY, Control, Estimator, Parameters
from firmware_py.core.subset import Struct, Tunable, f32, kernel

QUARTER = f32(0.25)


class Gains(Struct):
    """The regulator's matrix; `gain_u1` .. `gain_u4` are on what the flaps have reached of the inputs."""

    gain_y: Annotated[f32, Tunable(-1.90553, "rad/m", low=-20.0, high=20.0)]
    gain_vy: Annotated[f32, Tunable(-0.945983, "rad s/m", low=-20.0, high=20.0)]
    gain_roll: Annotated[f32, Tunable(1.30842, "", low=-20.0, high=20.0)]
    gain_p: Annotated[f32, Tunable(0.0306313, "s", low=-20.0, high=20.0)]
    gain_u1: Annotated[f32, Tunable(0.472199, "", low=-20.0, high=20.0)]
    gain_x: Annotated[f32, Tunable(-1.89981, "rad/m", low=-20.0, high=20.0)]
    gain_vx: Annotated[f32, Tunable(-1.01173, "rad s/m", low=-20.0, high=20.0)]
    gain_pitch: Annotated[f32, Tunable(0.384216, "", low=-20.0, high=20.0)]
    gain_q: Annotated[f32, Tunable(-0.00775635, "s", low=-20.0, high=20.0)]
    gain_u2: Annotated[f32, Tunable(0.495649, "", low=-20.0, high=20.0)]
    gain_yaw: Annotated[f32, Tunable(0.955955, "", low=-20.0, high=20.0)]
    gain_r: Annotated[f32, Tunable(0.097035, "s", low=-20.0, high=20.0)]
    gain_u3: Annotated[f32, Tunable(0.440334, "", low=-20.0, high=20.0)]
    gain_z: Annotated[f32, Tunable(3.29188, "rad/m", low=-20.0, high=20.0)]
    gain_vz: Annotated[f32, Tunable(1.14703, "rad s/m", low=-20.0, high=20.0)]
    gain_u4: Annotated[f32, Tunable(0.124361, "", low=-20.0, high=20.0)]


@kernel
def control_law(parameters: Parameters, estimator: Estimator, control: Control, own: Gains) -> None:
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
    f1 = estimator.now[FLAP]
    f2 = estimator.now[FLAP + 1]
    f3 = estimator.now[FLAP + 2]
    f4 = estimator.now[FLAP + 3]
    u1 = (
        own.gain_y * ey
        - own.gain_vy * vy
        - own.gain_roll * estimator.now[ATTITUDE]
        - own.gain_p * estimator.now[RATE]
        - own.gain_u1 * QUARTER * ((f1 + f2) - (f3 + f4))
    )
    u2 = (
        own.gain_x * ex
        - own.gain_vx * vx
        - own.gain_pitch * estimator.now[ATTITUDE + 1]
        - own.gain_q * estimator.now[RATE + 1]
        - own.gain_u2 * QUARTER * ((f1 - f2) - (f3 - f4))
    )
    u3 = (
        own.gain_yaw * wrap(parameters.target[3] - yaw)
        - own.gain_r * estimator.now[RATE + 2]
        + own.gain_u3 * QUARTER * ((f1 + f2) + (f3 + f4))
    )
    u4 = (
        own.gain_z * ez
        - own.gain_vz * estimator.now[VELOCITY + 2]
        - own.gain_u4 * QUARTER * ((f2 - f1) + (f4 - f3))
    )
    control.u[0] = clamp(u1, -parameters.limit_u, parameters.limit_u)
    control.u[1] = clamp(u2, -parameters.limit_u, parameters.limit_u)
    control.u[2] = clamp(u3, -parameters.limit_u3, parameters.limit_u3)
    control.u[3] = clamp(u4, -parameters.limit_u, parameters.limit_u)
    allocate(parameters, control)
