"""The delay predictor: it fuses poses at their own instant and predicts the delayed state to the present.

A pose carries its age. It is filed under the tick when it was measured and fused when the filter, which runs one horizon
behind, reaches that tick. From the filter's state the linear model steps to the present with the buffered commands;
the buffered gyro samples replace the body rates. When ages are measured, the horizon follows them: at once when
a pose arrives too late, one tick at a time when poses have been younger for a second. With the predictor off, every pose
counts as current and the filter runs without delay.
"""

from firmware_py.core.estimator import attitude_of, filter_tick, keep_sane, open_covariance
from firmware_py.core.maths import ZERO, clamp, cos, finite, sin, wrap
from firmware_py.core.model import advance_state
from firmware_py.core.structs import (
    ATTITUDE,
    HISTORY,
    HORIZON_LIMIT,
    POSE_ON_TIME,
    POSE_TOO_OLD,
    RATE,
    STATES,
    TICK_US,
    Control,
    Estimator,
    Input,
    Parameters,
)
from firmware_py.core.subset import Integer, f32, i32, kernel

QUIET_TICKS = 100  # 1 s of younger poses before the horizon shrinks by a tick
CATCH_UP = 2  # filter ticks per tick at most, so that the time of a tick stays bounded
SECONDS_PER_US = f32(1e-6)
# The sensor sits at -45 deg in the body, as in drivers/imu.py: p = cos45 (gx + gy), q = cos45 (gy - gx).
COS_45 = f32(0.707106781186548)


@kernel
def clamp_horizon(ticks: Integer) -> i32:
    """Return a horizon inside 1..HORIZON_LIMIT."""
    if ticks < 1:
        return i32(1)
    if ticks > HORIZON_LIMIT:
        return i32(HORIZON_LIMIT)
    return i32(ticks)


@kernel
def reset(parameters: Parameters, estimator: Estimator) -> None:
    """Start the estimator: no pose, initial covariance, empty history; the counters are kept."""
    for i in range(STATES):
        estimator.x[i] = ZERO
        estimator.now[i] = ZERO
    for row in range(HISTORY):
        estimator.pose_waiting[row] = i32(0)
        for i in range(3):
            estimator.gyro[row, i] = ZERO
        for i in range(4):
            estimator.command[row, i] = ZERO
    estimator.tick = i32(0)
    estimator.filtered_tick = i32(0)
    estimator.horizon = clamp_horizon(parameters.horizon)
    estimator.quiet_ticks = i32(0)
    estimator.started = i32(0)
    estimator.suspect_waiting = i32(0)
    open_covariance(estimator)


@kernel
def pose_into_history(parameters: Parameters, data: Input, estimator: Estimator) -> i32:
    """File a valid pose under the coming tick minus its age; return POSE_ON_TIME or POSE_TOO_OLD.

    Call it before `estimate` of the tick that `pose_age_us` refers to.
    """
    age_us = data.pose_age_us
    if parameters.predict != 0 and parameters.age_measured == 0:
        age_us = i32(clamp_horizon(parameters.horizon) * TICK_US)
    elif age_us < 0:
        age_us = parameters.default_age_us
    if age_us < 0:
        age_us = i32(0)
    if age_us > (HORIZON_LIMIT + 1) * TICK_US:
        age_us = i32((HORIZON_LIMIT + 1) * TICK_US)
    reported_us = i32(age_us)
    if parameters.predict == 0:
        age_us = i32(0)
    ticks = (age_us + TICK_US // 2) // TICK_US
    if ticks >= estimator.horizon:
        estimator.quiet_ticks = i32(0)
    elif parameters.age_measured != 0 and estimator.quiet_ticks > QUIET_TICKS:
        estimator.quiet_ticks = i32(0)
        estimator.horizon = clamp_horizon(estimator.horizon - 1)
    tick = estimator.tick + 1 - ticks
    if tick <= estimator.filtered_tick:
        estimator.too_old = i32(estimator.too_old + 1)
        if parameters.age_measured != 0 and ticks > estimator.horizon:
            estimator.horizon = clamp_horizon(ticks)
        return i32(POSE_TOO_OLD)
    row = tick % HISTORY
    for axis in range(3):
        estimator.pose[row, axis] = data.pose_position[axis]
    attitude_of(data.pose_quaternion, estimator.work_1, 0)
    for axis in range(3):
        estimator.pose[row, 3 + axis] = estimator.work_1[axis]
    estimator.pose_lag[row] = f32(age_us - ticks * TICK_US) * SECONDS_PER_US
    estimator.pose_waiting[row] = i32(1)
    estimator.pose_age_us = reported_us
    return i32(POSE_ON_TIME)


@kernel
def file_samples(parameters: Parameters, data: Input, estimator: Estimator, control: Control) -> None:
    """File the mean gyro sample of the tick that begins, and the command that held until now."""
    previous = estimator.tick % HISTORY
    for i in range(4):
        estimator.command[previous, i] = control.command[i]
    estimator.tick = i32(estimator.tick + 1)
    row = estimator.tick % HISTORY
    if data.gyro_samples > 0:
        scale = parameters.gyro_scale / f32(data.gyro_samples)
        share = f32(data.gyro_samples)
        gx = scale * (f32(data.gyro_sum[0]) - share * data.gyro_bias[0])
        gy = scale * (f32(data.gyro_sum[1]) - share * data.gyro_bias[1])
        gz = scale * (f32(data.gyro_sum[2]) - share * data.gyro_bias[2])
        limit = parameters.bound_rate
        estimator.gyro[row, 0] = clamp(COS_45 * (gx + gy), -limit, limit)
        estimator.gyro[row, 1] = clamp(COS_45 * (gy - gx), -limit, limit)
        estimator.gyro[row, 2] = clamp(gz, -limit, limit)
    else:  # the sensor is silent: the last rates are the best guess
        for i in range(3):
            estimator.gyro[row, i] = estimator.gyro[previous, i]


@kernel
def follow_age(parameters: Parameters, estimator: Estimator) -> i32:
    """Return the horizon of this tick."""
    if parameters.predict == 0:
        return i32(0)
    if parameters.age_measured == 0:
        return clamp_horizon(parameters.horizon)
    estimator.quiet_ticks = i32(estimator.quiet_ticks + 1)
    return clamp_horizon(estimator.horizon)


@kernel
def predict_now(parameters: Parameters, estimator: Estimator) -> None:
    """Predict the filter's state to the present, in `now`."""
    for i in range(STATES):
        estimator.now[i] = estimator.x[i]
    for step in range(estimator.tick - estimator.filtered_tick):
        row = (estimator.filtered_tick + step) % HISTORY
        following = (estimator.filtered_tick + step + 1) % HISTORY
        yaw = estimator.now[ATTITUDE + 2]
        advance_state(
            parameters,
            sin(yaw),
            cos(yaw),
            estimator.now,
            estimator.command,
            row,
            estimator.work_1,
            estimator.work_2,
        )
        for i in range(3):
            estimator.now[RATE + i] = estimator.gyro[following, i]
        estimator.now[ATTITUDE + 2] = wrap(estimator.now[ATTITUDE + 2])
    for i in range(STATES):
        if not finite(estimator.now[i]):
            estimator.now[i] = estimator.x[i]


@kernel
def estimate(parameters: Parameters, data: Input, estimator: Estimator, control: Control) -> None:
    """Run one tick of the estimator: file the samples, move the delayed filter, predict to now."""
    file_samples(parameters, data, estimator, control)
    estimator.horizon = follow_age(parameters, estimator)
    for _ in range(CATCH_UP):
        if estimator.filtered_tick < estimator.tick - estimator.horizon:
            filter_tick(parameters, estimator)
    keep_sane(parameters, estimator)
    predict_now(parameters, estimator)
