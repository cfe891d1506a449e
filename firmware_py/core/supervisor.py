"""The supervisor decides, before every step of the controller, whether the loop may be closed.

Every cause against it sets the flaps to the hover angles. How it ends depends on the cause:

    imu stale       no new counts of the gyro for 20 ms: ends after 100 ms with new ones
    silence         no accepted pose for 500 ms (parameter): the next accepted pose ends it
    out of bounds   the estimator was held at its bounds for 200 ms: ends after 500 ms inside them
    disarmed        by request: ends with the request to arm
    not finite      own logic returned NaN or infinity, the controller or the estimator: ends with a request to recover
    emergency stop  by request: ends only with a reboot. A stop that is not locked ends with a request to recover, too
    low battery     below the limit for 5 s: ends only with a request to recover when the voltage is back above it
    no control      no controller asked for the mode for 50 ms: ends when one does

The supervisor waits before the first pose. The estimator's gate refuses a single outlier
pose, which has no effect here. Times are summed from call to call, so that a clock that wraps does no harm.
"""

from firmware_py.core.poses import LONG_US, waited_us
from firmware_py.core.structs import (
    CAUSE_DISARMED,
    CAUSE_EMERGENCY_STOP,
    CAUSE_IMU_STALE,
    CAUSE_LOW_BATTERY,
    CAUSE_NO_CONTROL,
    CAUSE_NONE,
    CAUSE_OUT_OF_BOUNDS,
    CAUSE_SILENCE,
    GOAL_ABSOLUTE,
    GOAL_STALE,
    MANUAL_ANGLES,
    MANUAL_HOVER,
    MODE_FLY,
    MODE_HOVER,
    MODE_MANUAL,
    REQUEST_ARM,
    REQUEST_DISARM,
    REQUEST_LOCK,
    REQUEST_RECOVER,
    REQUEST_STOP,
    STATE_CALIBRATING,
    STATE_FAILSAFE,
    STATE_FLYING,
    STATE_WAITING,
    Estimator,
    Input,
    Parameters,
    Sampling,
    Supervisor,
)
from firmware_py.core.subset import Integer, elapsed, i32, kernel

BATTERY_LOW_US = 5000000  # original firmware
CONTROL_US = 50000  # without a call the controller has stopped, or another one runs in its place
EPISODE_GAP_US = 50000  # two bounded steps no further apart belong to one episode
EPISODE_LIMIT_US = 200000
BOUNDS_RECOVERY_US = 500000
DOWN_US = 5000000  # a robot disarmed or stopped for so long lies in the net or is held


@kernel
def longer(time_us: Integer, by_us: Integer) -> i32:
    """Return the sum of both times, saturated at `LONG_US`."""
    if time_us + by_us > LONG_US:
        return i32(LONG_US)
    return i32(time_us + by_us)


@kernel
def shorter(time_us: Integer, by_us: Integer) -> i32:
    """Return the remaining time; below 0 it is over."""
    if time_us < by_us:
        return i32(-1)
    return i32(time_us - by_us)


@kernel
def since_last_look(data: Input, supervisor: Supervisor) -> i32:
    """Return the time since the last `supervise`, negative when the instant is before it."""
    if supervisor.begun == 0:
        return i32(0)
    time_us = elapsed(data.now_us, supervisor.now_us)
    if time_us > LONG_US:
        return i32(LONG_US)
    if time_us < -LONG_US:
        return i32(-LONG_US)
    return time_us


@kernel
def pass_time(data: Input, supervisor: Supervisor) -> None:
    """Advance all times to this instant."""
    by_us = since_last_look(data, supervisor)
    if by_us < 0:
        by_us = i32(0)
    supervisor.begun = i32(1)
    supervisor.now_us = data.now_us
    supervisor.silent_us = longer(supervisor.silent_us, by_us)
    supervisor.low_us = longer(supervisor.low_us, by_us)
    supervisor.down_us = longer(supervisor.down_us, by_us)
    supervisor.episode_us = longer(supervisor.episode_us, by_us)
    supervisor.gap_us = shorter(supervisor.gap_us, by_us)
    supervisor.outside_us = shorter(supervisor.outside_us, by_us)


@kernel
def watch_bounds(estimator: Estimator, supervisor: Supervisor) -> None:
    """Detect that the estimator has been held at its bounds for too long."""
    if estimator.bounded == supervisor.bounded:
        return
    supervisor.bounded = estimator.bounded
    if supervisor.gap_us < 0:
        supervisor.episode_us = i32(0)
    supervisor.gap_us = i32(EPISODE_GAP_US)
    if supervisor.episode_us >= EPISODE_LIMIT_US or supervisor.outside_us > 0:
        supervisor.outside_us = i32(BOUNDS_RECOVERY_US)


@kernel
def watch_battery(parameters: Parameters, data: Input, supervisor: Supervisor) -> None:
    """Detect a voltage that has been too low for too long."""
    if data.battery_mv >= parameters.low_battery_mv:
        supervisor.low_us = i32(0)
    elif supervisor.low_us >= BATTERY_LOW_US:
        supervisor.battery_empty = i32(1)


@kernel
def lasting_cause(supervisor: Supervisor) -> i32:
    """Return the cause that neither poses nor arming clear."""
    if supervisor.stopped != 0:
        return i32(CAUSE_EMERGENCY_STOP)
    if supervisor.not_finite != CAUSE_NONE:
        return i32(supervisor.not_finite)
    if supervisor.battery_empty != 0:
        return i32(CAUSE_LOW_BATTERY)
    return i32(CAUSE_NONE)


@kernel
def update_ready(sampling: Sampling, supervisor: Supervisor) -> None:
    """Note the lasting cause, and whether the robot would fly with poses and an IMU."""
    supervisor.lasting = lasting_cause(supervisor)
    supervisor.ready = i32(0)
    if sampling.calibrated != 0 and supervisor.armed != 0 and supervisor.lasting == CAUSE_NONE:
        supervisor.ready = i32(1)


@kernel
def cause_of_failsafe(parameters: Parameters, sampling: Sampling, supervisor: Supervisor) -> i32:
    """Return the cause against closing the loop, `CAUSE_NONE` if the robot only waits."""
    if supervisor.lasting != CAUSE_NONE:
        return i32(supervisor.lasting)
    if supervisor.armed == 0:
        return i32(CAUSE_DISARMED)
    if sampling.calibrated == 0 or supervisor.pose_seen == 0:
        return i32(CAUSE_NONE)
    if sampling.recovering > 0:
        return i32(CAUSE_IMU_STALE)
    if supervisor.silent_us >= parameters.pose_timeout_us:
        return i32(CAUSE_SILENCE)
    if supervisor.outside_us > 0:
        return i32(CAUSE_OUT_OF_BOUNDS)
    return i32(CAUSE_NONE)


@kernel
def state_of(sampling: Sampling, supervisor: Supervisor, cause: Integer) -> i32:
    """Return the state that a cause leads to."""
    if cause != CAUSE_NONE:
        return i32(STATE_FAILSAFE)
    if sampling.calibrated == 0:
        return i32(STATE_CALIBRATING)
    if supervisor.pose_seen == 0:
        return i32(STATE_WAITING)
    return i32(STATE_FLYING)


@kernel
def mode_of(data: Input, supervisor: Supervisor) -> i32:
    """Return the mode for the state, the cause and the requested manual mode."""
    manual = data.manual_mode
    if data.by_words != 0:
        manual = i32(MANUAL_ANGLES)
    if supervisor.cause > CAUSE_OUT_OF_BOUNDS or manual == MANUAL_HOVER:
        return i32(MODE_HOVER)
    if manual == MANUAL_ANGLES:
        if data.connected != 0:
            return i32(MODE_MANUAL)
        return i32(MODE_HOVER)  # no client could take the angles back
    if supervisor.state == STATE_FLYING:
        return i32(MODE_FLY)
    return i32(MODE_HOVER)


@kernel
def watch_rest(data: Input, supervisor: Supervisor) -> None:
    """Note whether a commander leads, and whether the robot is down: it has not flown, or was stopped long enough."""
    if supervisor.state == STATE_FLYING:
        supervisor.flown = i32(1)
    if supervisor.armed != 0 and supervisor.stopped == 0:
        supervisor.down_us = i32(0)
    supervisor.led = i32(0)
    if supervisor.state == STATE_FLYING and data.poses_absolute != 0:
        supervisor.led = i32(1)
    supervisor.aloft = i32(1)
    if data.mode == MODE_HOVER and (supervisor.flown == 0 or supervisor.down_us >= DOWN_US):
        supervisor.aloft = i32(0)


@kernel
def supervise(
    parameters: Parameters, data: Input, estimator: Estimator, sampling: Sampling, supervisor: Supervisor
) -> i32:
    """Decide the controller's mode at this instant; return whether state or cause has changed. Call it every tick."""
    pass_time(data, supervisor)
    watch_bounds(estimator, supervisor)
    watch_battery(parameters, data, supervisor)
    update_ready(sampling, supervisor)
    cause = cause_of_failsafe(parameters, sampling, supervisor)
    state = state_of(sampling, supervisor, cause)
    changed = i32(0)
    if state != supervisor.state or cause != supervisor.cause:
        changed = i32(1)
    supervisor.state = state
    supervisor.cause = cause
    data.mode = mode_of(data, supervisor)
    watch_rest(data, supervisor)
    return changed


@kernel
def note_pose(data: Input, supervisor: Supervisor) -> None:
    """Note an accepted pose."""
    supervisor.pose_seen = i32(1)
    supervisor.silent_us = i32(waited_us(data) - since_last_look(data, supervisor))


@kernel
def recover(parameters: Parameters, data: Input, supervisor: Supervisor) -> i32:
    """Clear what lasts: a stop that is not locked, logic that failed and, at a good voltage, the low battery."""
    supervisor.stopped = supervisor.locked
    supervisor.not_finite = i32(CAUSE_NONE)
    if data.battery_mv >= parameters.low_battery_mv:
        supervisor.battery_empty = i32(0)
        supervisor.low_us = i32(0)
    if supervisor.battery_empty != 0:
        return i32(0)
    return i32(1)


@kernel
def renew_goal(data: Input, supervisor: Supervisor) -> None:
    """Let a robot that was disarmed or stopped stay where it is: its next pose is the goal."""
    if data.goal_kind == GOAL_ABSOLUTE and (supervisor.armed == 0 or supervisor.stopped != 0):
        data.goal_kind = i32(GOAL_STALE)


@kernel
def execute(parameters: Parameters, data: Input, supervisor: Supervisor) -> i32:
    """Execute a request; return whether that was possible."""
    if data.request == REQUEST_ARM or data.request == REQUEST_RECOVER:
        renew_goal(data, supervisor)
    if data.request == REQUEST_RECOVER:
        return recover(parameters, data, supervisor)
    if data.request == REQUEST_ARM and lasting_cause(supervisor) != CAUSE_NONE:
        return i32(0)
    if data.request == REQUEST_STOP:
        supervisor.stopped = i32(1)
    elif data.request == REQUEST_LOCK:
        supervisor.stopped = i32(1)
        supervisor.locked = i32(1)
    elif data.request == REQUEST_ARM:
        supervisor.armed = i32(1)
    elif data.request == REQUEST_DISARM:
        supervisor.armed = i32(0)
    return i32(1)


@kernel
def serve(parameters: Parameters, data: Input, sampling: Sampling, supervisor: Supervisor) -> i32:
    """Serve a request; return whether it was executed."""
    executed = execute(parameters, data, supervisor)
    update_ready(sampling, supervisor)
    return executed


@kernel
def watch_control(data: Input, supervisor: Supervisor) -> i32:
    """Detect that no controller has asked for the mode lately; return whether that is new. `supervise` clears it."""
    if supervisor.cause == CAUSE_NO_CONTROL or since_last_look(data, supervisor) < CONTROL_US:
        return i32(0)
    supervisor.state = i32(STATE_FAILSAFE)
    supervisor.cause = i32(CAUSE_NO_CONTROL)
    return i32(1)


@kernel
def forget_flight(supervisor: Supervisor) -> None:
    """Forget the last flight and its poses."""
    supervisor.pose_seen = i32(0)
    supervisor.flown = i32(0)
