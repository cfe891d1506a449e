"""The Kalman filter: 16 states, scalar updates, full covariance; each pose is fused at the instant when it was measured.

The filter runs `horizon` ticks behind the present. `predictor.py` advances it and predicts its state to the present.
"""

from firmware_py.core.maths import ONE, PI, TWO, ZERO, asin, atan2, clamp, cos, finite, sin, wrap
from firmware_py.core.model import advance_covariance, advance_state
from firmware_py.core.structs import (
    ATTITUDE,
    FLAP,
    HISTORY,
    POSITION,
    RATE,
    STATES,
    VELOCITY,
    Estimator,
    Parameters,
)
from firmware_py.core.subset import F32s, Integer, f32, i32, kernel, sqrt

START_POSITION = f32(0.09)  # variances at start, from the original firmware
START_VELOCITY = f32(0.25)
START_ATTITUDE = f32(0.01)
START_RATE = f32(0.01)
START_FLAP = f32(0.0001)
VARIANCE_MIN = f32(1e-9)
VARIANCE_MAX = f32(100.0)
FLAP_BOUND = f32(1.6)  # [rad] deviation from hover
JUMP_VARIANCE = f32(4.0)  # factor on the variance of a pose that the state jumped to


@kernel
def start_variance(state: Integer) -> f32:
    """Return a state's initial variance."""
    if state < VELOCITY:
        return START_POSITION
    if state < ATTITUDE:
        return START_VELOCITY
    if state < RATE:
        return START_ATTITUDE
    if state < FLAP:
        return START_RATE
    return START_FLAP


@kernel
def open_covariance(estimator: Estimator) -> None:
    """Reset the covariance but not the state."""
    for i in range(STATES):
        for j in range(STATES):
            estimator.P[i, j] = ZERO
        estimator.P[i, i] = start_variance(i)


@kernel
def process_variance(parameters: Parameters, state: Integer) -> f32:
    """Return the variance that one tick adds to a state."""
    if state < VELOCITY:
        return parameters.process_position
    if state < ATTITUDE:
        return parameters.process_velocity
    if state < RATE:
        return parameters.process_attitude
    if state < FLAP:
        return parameters.process_rate
    return parameters.process_flap


@kernel
def predict(parameters: Parameters, estimator: Estimator, row: Integer) -> None:
    """Advance filter state and covariance by one tick under the command in that row; `keep_sane` wraps the yaw."""
    sine = sin(estimator.x[ATTITUDE + 2])
    cosine = cos(estimator.x[ATTITUDE + 2])
    advance_state(
        parameters, sine, cosine, estimator.x, estimator.command, row, estimator.work_1, estimator.work_2
    )
    advance_covariance(
        parameters,
        sine,
        cosine,
        estimator.P,
        estimator.work_P,
        estimator.work_1,
        estimator.work_2,
        estimator.work_3,
    )
    for i in range(STATES):
        estimator.P[i, i] = estimator.P[i, i] + process_variance(parameters, i)


@kernel
def update(estimator: Estimator, state: Integer, innovation: f32, variance: f32) -> None:
    """Fuse one directly measured state (measurement model: a unit row)."""
    scale = ONE / (estimator.P[state, state] + variance)
    for i in range(STATES):
        estimator.work_1[i] = estimator.P[state, i]
    for i in range(STATES):
        gain = estimator.work_1[i] * scale
        estimator.x[i] = estimator.x[i] + gain * innovation
        for j in range(i + 1):
            value = estimator.P[i, j] - gain * estimator.work_1[j]
            estimator.P[i, j] = value
            estimator.P[j, i] = value


@kernel
def update_gyro(parameters: Parameters, estimator: Estimator, row: Integer) -> None:
    """Fuse the body rates in that row of the history; through the covariance they correct the attitude."""
    for axis in range(3):
        innovation = estimator.gyro[row, axis] - estimator.x[RATE + axis]
        update(estimator, RATE + axis, innovation, parameters.measured_rate)


@kernel
def attitude_of(q: F32s, attitude: F32s, offset: Integer) -> None:
    """Write roll, pitch, yaw [rad] of a quaternion (w x y z, any length but zero) into attitude[offset:]."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    scale = TWO / (w * w + x * x + y * y + z * z)
    attitude[offset] = atan2(scale * (w * x + y * z), ONE - scale * (x * x + y * y))
    attitude[offset + 1] = asin(scale * (w * y - z * x))
    attitude[offset + 2] = atan2(scale * (w * z + x * y), ONE - scale * (y * y + z * z))


@kernel
def pose_at_tick(estimator: Estimator, row: Integer, pose: F32s) -> None:
    """Write the pose of that row, extrapolated to the tick with the estimated velocities."""
    lag = estimator.pose_lag[row]
    for axis in range(3):
        pose[axis] = estimator.pose[row, axis] + lag * estimator.x[VELOCITY + axis]
        pose[3 + axis] = wrap(estimator.pose[row, 3 + axis] + lag * estimator.x[RATE + axis])


@kernel
def surprising(parameters: Parameters, estimator: Estimator, pose: F32s) -> bool:
    """Return whether the gate refuses a pose: any axis beyond both its standard deviations and its floor."""
    square = parameters.gate_sigma * parameters.gate_sigma
    for axis in range(3):
        e = pose[axis] - estimator.x[POSITION + axis]
        variance = estimator.P[POSITION + axis, POSITION + axis] + parameters.measured_position
        if e * e > square * variance and abs(e) > parameters.gate_position:
            return True
        e = wrap(pose[3 + axis] - estimator.x[ATTITUDE + axis])
        variance = estimator.P[ATTITUDE + axis, ATTITUDE + axis] + parameters.measured_attitude
        if e * e > square * variance and abs(e) > parameters.gate_attitude:
            return True
    return False


@kernel
def confirms_suspect(parameters: Parameters, estimator: Estimator, pose: F32s) -> bool:
    """Return whether a refused pose agrees with the previous refused one: then the goal jumped, not the camera."""
    if estimator.suspect_waiting == 0 or estimator.filtered_tick - estimator.suspect_tick > 4:
        return False
    for axis in range(3):
        if abs(pose[axis] - estimator.suspect[axis]) > parameters.gate_position:
            return False
        if abs(wrap(pose[3 + axis] - estimator.suspect[3 + axis])) > parameters.gate_attitude:
            return False
    return True


@kernel
def jump(parameters: Parameters, estimator: Estimator, pose: F32s) -> None:
    """Set position and attitude to those of a pose and turn the velocity into the new goal frame."""
    turn = wrap(pose[5] - estimator.x[ATTITUDE + 2])
    sine = sin(turn)
    cosine = cos(turn)
    vx = estimator.x[VELOCITY]
    vy = estimator.x[VELOCITY + 1]
    estimator.x[VELOCITY] = cosine * vx - sine * vy
    estimator.x[VELOCITY + 1] = sine * vx + cosine * vy
    for axis in range(3):
        estimator.x[POSITION + axis] = pose[axis]
        estimator.x[ATTITUDE + axis] = pose[3 + axis]
        for i in range(STATES):
            estimator.P[POSITION + axis, i] = ZERO
            estimator.P[i, POSITION + axis] = ZERO
            estimator.P[ATTITUDE + axis, i] = ZERO
            estimator.P[i, ATTITUDE + axis] = ZERO
    for axis in range(3):
        estimator.P[POSITION + axis, POSITION + axis] = JUMP_VARIANCE * parameters.measured_position
        estimator.P[ATTITUDE + axis, ATTITUDE + axis] = JUMP_VARIANCE * parameters.measured_attitude


@kernel
def update_pose(parameters: Parameters, estimator: Estimator, row: Integer) -> None:
    """Fuse the pose in that row of the history, unless the gate refuses it."""
    pose = estimator.work_2
    pose_at_tick(estimator, row, pose)
    if estimator.started == 0:
        estimator.started = i32(1)
        jump(parameters, estimator, pose)
        estimator.fused = i32(estimator.fused + 1)
        return
    if surprising(parameters, estimator, pose):
        if confirms_suspect(parameters, estimator, pose):
            jump(parameters, estimator, pose)
            estimator.jumps = i32(estimator.jumps + 1)
            estimator.suspect_waiting = i32(0)
            return
        estimator.refused = i32(estimator.refused + 1)
        for i in range(6):
            estimator.suspect[i] = pose[i]
        estimator.suspect_tick = estimator.filtered_tick
        estimator.suspect_waiting = i32(1)
        return
    estimator.suspect_waiting = i32(0)
    for axis in range(3):
        innovation = pose[axis] - estimator.x[POSITION + axis]
        update(estimator, POSITION + axis, innovation, parameters.measured_position)
        innovation = wrap(pose[3 + axis] - estimator.x[ATTITUDE + axis])
        update(estimator, ATTITUDE + axis, innovation, parameters.measured_attitude)
    estimator.fused = i32(estimator.fused + 1)


@kernel
def bound(estimator: Estimator, state: Integer, limit: f32) -> None:
    """Limit one state to its bound."""
    value = clamp(estimator.x[state], -limit, limit)
    if value != estimator.x[state]:
        estimator.x[state] = value
        estimator.bounded = i32(estimator.bounded + 1)


@kernel
def keep_sane(parameters: Parameters, estimator: Estimator) -> None:
    """Bound state and covariance; a state that is NaN or infinite restarts from the next pose."""
    broken = False
    for i in range(STATES):
        if not finite(estimator.x[i]):
            broken = True
            estimator.x[i] = ZERO
    for i in range(STATES):
        if not finite(estimator.P[i, i]):
            broken = True
    if broken:
        open_covariance(estimator)
        estimator.started = i32(0)
        estimator.resets = i32(estimator.resets + 1)
    for axis in range(3):
        bound(estimator, POSITION + axis, parameters.bound_position)
        bound(estimator, VELOCITY + axis, parameters.bound_velocity)
        bound(estimator, RATE + axis, parameters.bound_rate)
    bound(estimator, ATTITUDE, parameters.bound_tilt)
    bound(estimator, ATTITUDE + 1, parameters.bound_tilt)
    estimator.x[ATTITUDE + 2] = clamp(wrap(estimator.x[ATTITUDE + 2]), -PI, PI)
    for i in range(4):
        bound(estimator, FLAP + i, FLAP_BOUND)
    for i in range(STATES):
        estimator.P[i, i] = clamp(estimator.P[i, i], VARIANCE_MIN, VARIANCE_MAX)
    for i in range(STATES):
        for j in range(i):
            limit = sqrt(estimator.P[i, i] * estimator.P[j, j])
            value = clamp(estimator.P[i, j], -limit, limit)
            estimator.P[i, j] = value
            estimator.P[j, i] = value


@kernel
def filter_tick(parameters: Parameters, estimator: Estimator) -> None:
    """Advance the filter by one tick: predict, fuse the gyro and the pose measured at that instant, if there is one."""
    predict(parameters, estimator, estimator.filtered_tick % HISTORY)
    estimator.filtered_tick = i32(estimator.filtered_tick + 1)
    row = estimator.filtered_tick % HISTORY
    update_gyro(parameters, estimator, row)
    if estimator.pose_waiting[row] != 0:
        estimator.pose_waiting[row] = i32(0)
        update_pose(parameters, estimator, row)
    keep_sane(parameters, estimator)
