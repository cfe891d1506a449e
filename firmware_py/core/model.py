"""The linear model of the robot at hover and its discretisation, shared by the filter and the predictor.

The model is the paper's Table of dynamics constants; the couplings to the horizontal velocities, which the Table omits,
follow from the plate model's identities (see the profile). Small angles: Euler rates are body rates. Horizontal
accelerations are formed in the heading frame and turned into G by the yaw of the estimate.
"""

from firmware_py.core.maths import HALF
from firmware_py.core.structs import ATTITUDE, FLAP, POSITION, RATE, STATES, VELOCITY, Parameters
from firmware_py.core.subset import F32s, Integer, f32, kernel

DT = f32(0.01)
DT_2 = f32(0.5e-4)  # dt^2 / 2
DT_3 = f32(1.66666667e-7)  # dt^3 / 6
QUARTER = f32(0.25)


@kernel
def derivative(parameters: Parameters, sine: f32, cosine: f32, x: F32s, dx: F32s) -> None:
    """Write A x into dx; sine and cosine are of the yaw at which the model is taken."""
    vx = cosine * x[VELOCITY] + sine * x[VELOCITY + 1]
    vy = cosine * x[VELOCITY + 1] - sine * x[VELOCITY]
    roll = x[ATTITUDE]
    pitch = x[ATTITUDE + 1]
    f1 = x[FLAP]
    f2 = x[FLAP + 1]
    f3 = x[FLAP + 2]
    f4 = x[FLAP + 3]
    # eq. (input_signals) inverted: its columns are orthogonal and of length 2
    u1 = QUARTER * ((f1 + f2) - (f3 + f4))
    u2 = QUARTER * ((f1 - f2) - (f3 - f4))
    u3 = -QUARTER * ((f1 + f2) + (f3 + f4))
    u4 = QUARTER * ((f2 - f1) + (f4 - f3))
    ax = parameters.x_vx * vx + parameters.x_pitch * pitch + parameters.x_u2 * u2
    ay = parameters.y_vy * vy + parameters.y_roll * roll + parameters.y_u1 * u1
    for i in range(3):
        dx[POSITION + i] = x[VELOCITY + i]
        dx[ATTITUDE + i] = x[RATE + i]
    dx[VELOCITY] = cosine * ax - sine * ay
    dx[VELOCITY + 1] = sine * ax + cosine * ay
    dx[VELOCITY + 2] = parameters.z_vz * x[VELOCITY + 2] + parameters.z_u4 * u4
    dx[RATE] = (
        parameters.roll_rate * x[RATE]
        + parameters.roll_roll * roll
        + parameters.roll_vy * vy
        + parameters.roll_u1 * u1
    )
    dx[RATE + 1] = (
        parameters.pitch_rate * x[RATE + 1]
        + parameters.pitch_pitch * pitch
        + parameters.pitch_vx * vx
        + parameters.pitch_u2 * u2
    )
    dx[RATE + 2] = parameters.yaw_rate * x[RATE + 2] + parameters.yaw_u3 * u3
    for i in range(4):
        dx[FLAP + i] = -parameters.flap_rate * x[FLAP + i]


@kernel
def add_series(parameters: Parameters, sine: f32, cosine: f32, x: F32s, first: F32s, other: F32s) -> None:
    """Add dt f + dt^2/2 A f + dt^3/6 A^2 f to x, where f is given in `first`; both work arrays are overwritten."""
    for i in range(STATES):
        x[i] = x[i] + DT * first[i]
    derivative(parameters, sine, cosine, first, other)
    for i in range(STATES):
        x[i] = x[i] + DT_2 * other[i]
    derivative(parameters, sine, cosine, other, first)
    for i in range(STATES):
        x[i] = x[i] + DT_3 * first[i]


@kernel
def advance_state(
    parameters: Parameters,
    sine: f32,
    cosine: f32,
    x: F32s,
    command: F32s,
    row: Integer,
    first: F32s,
    other: F32s,
) -> None:
    """Advance a state vector by one tick under the flap command in that row of the history."""
    derivative(parameters, sine, cosine, x, first)
    for i in range(4):
        first[FLAP + i] = first[FLAP + i] + parameters.flap_rate * command[row, i]
    add_series(parameters, sine, cosine, x, first, other)


@kernel
def advance_covariance(
    parameters: Parameters, sine: f32, cosine: f32, P: F32s, M: F32s, x: F32s, first: F32s, other: F32s
) -> None:
    """Replace P by Phi P Phi^T, symmetrised; M, x, first and other are work space."""
    for column in range(STATES):
        for i in range(STATES):
            x[i] = P[i, column]
        derivative(parameters, sine, cosine, x, first)
        add_series(parameters, sine, cosine, x, first, other)
        for i in range(STATES):
            M[column, i] = x[i]  # M = (Phi P)^T
    for column in range(STATES):
        for i in range(STATES):
            x[i] = M[i, column]
        derivative(parameters, sine, cosine, x, first)
        add_series(parameters, sine, cosine, x, first, other)
        for i in range(STATES):
            P[i, column] = x[i]
    for i in range(STATES):
        for j in range(i):
            mean = HALF * (P[i, j] + P[j, i])
            P[i, j] = mean
            P[j, i] = mean
