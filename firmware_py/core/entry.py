"""The firmware's calls into the core; every argument is the memory of one struct."""

from firmware_py.core import controller, goal, poses, predictor, sampling, servo, supervisor
from firmware_py.core.structs import (
    POSE_ON_TIME,
    Control,
    Estimator,
    Input,
    Parameters,
    Report,
    Sampling,
    Supervisor,
)
from firmware_py.core.subset import Memory, i32, kernel

_reset = predictor.reset
_file_pose = predictor.pose_into_history
_estimate = predictor.estimate
_control_flaps = controller.control_flaps
_drive_servos = servo.drive_servos
_age_at_tick = poses.age_at_tick
_admits = goal.admits
_follow = goal.follow
_see_from_goal = goal.see_from_goal
_report_state = goal.report_state
_begin_step = sampling.begin_step
_take_sample = sampling.take_sample
_clear_samples = sampling.clear_samples
_forget_zero = sampling.forget_zero
_supervise = supervisor.supervise
_see_pose = supervisor.see_pose
_serve = supervisor.serve
_watch_control = supervisor.watch_control
_begin_flight = supervisor.begin_flight


@kernel
def reset(parameters: Memory[Parameters], estimator: Memory[Estimator]) -> None:
    """Start the estimator."""
    _reset(parameters[0], estimator[0])


@kernel
def begin_step(data: Memory[Input], sampling: Memory[Sampling]) -> i32:
    """Begin a step of 1 ms; return whether the controller runs in it."""
    return _begin_step(data[0], sampling[0])


@kernel
def take_sample(data: Memory[Input], sampling: Memory[Sampling]) -> i32:
    """Take a gyro sample; return whether it completes the search for the gyro's zero."""
    return _take_sample(data[0], sampling[0])


@kernel
def file_pose(
    parameters: Memory[Parameters],
    data: Memory[Input],
    estimator: Memory[Estimator],
    sampling: Memory[Sampling],
    supervisor: Memory[Supervisor],
) -> i32:
    """Turn the input's pose into the goal frame and file it under the instant when it was measured."""
    seen = _see_from_goal(data[0], estimator[0])
    if seen != POSE_ON_TIME:
        return seen
    _age_at_tick(data[0], sampling[0])
    answer = _file_pose(parameters[0], data[0], estimator[0])
    if answer == POSE_ON_TIME:
        _see_pose(data[0], supervisor[0])
    return answer


@kernel
def estimate(
    parameters: Memory[Parameters],
    data: Memory[Input],
    estimator: Memory[Estimator],
    control: Memory[Control],
    sampling: Memory[Sampling],
    report: Memory[Report],
) -> None:
    """Run one tick of the estimator."""
    _estimate(parameters[0], data[0], estimator[0], control[0])
    _clear_samples(data[0], sampling[0])
    _report_state(data[0], estimator[0], control[0], report[0])


@kernel
def supervise(
    parameters: Memory[Parameters],
    data: Memory[Input],
    estimator: Memory[Estimator],
    sampling: Memory[Sampling],
    supervisor: Memory[Supervisor],
) -> i32:
    """Decide the controller's mode; return whether state or cause has changed."""
    return _supervise(parameters[0], data[0], estimator[0], sampling[0], supervisor[0])


@kernel
def control(
    parameters: Memory[Parameters],
    data: Memory[Input],
    estimator: Memory[Estimator],
    control: Memory[Control],
) -> None:
    """Run one tick of the controller, down to the timer counts."""
    _control_flaps(parameters[0], data[0], estimator[0], control[0])
    _drive_servos(parameters[0], control[0])


@kernel
def request(
    parameters: Memory[Parameters],
    data: Memory[Input],
    sampling: Memory[Sampling],
    supervisor: Memory[Supervisor],
) -> i32:
    """Serve a request; return whether it was executed."""
    return _serve(parameters[0], data[0], sampling[0], supervisor[0])


@kernel
def admits(parameters: Memory[Parameters], data: Memory[Input]) -> i32:
    """Return whether the set-point is in the box, or at most as far outside as the goal."""
    return _admits(parameters[0], data[0])


@kernel
def follow(parameters: Memory[Parameters], data: Memory[Input]) -> i32:
    """Make the commander's set-point the goal; return the result, `SETPOINT_...`."""
    return _follow(parameters[0], data[0])


@kernel
def watch_control(data: Memory[Input], supervisor: Memory[Supervisor]) -> i32:
    """Detect that no controller has asked for the mode lately; return whether that is new. `supervise` clears it."""
    return _watch_control(data[0], supervisor[0])


@kernel
def begin_afresh(data: Memory[Input], sampling: Memory[Sampling], supervisor: Memory[Supervisor]) -> None:
    """Search for the gyro's zero again and forget the last flight."""
    _forget_zero(data[0], sampling[0])
    _begin_flight(supervisor[0])
