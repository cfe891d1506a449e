"""The firmware's calls into the core: the public names. What they are made of has names that begin with `_`."""

from firmware_py.core import controller, goal, poses, predictor, repetition, sampling, servo, supervisor
from firmware_py.core.structs import (
    POSE_FROZEN,
    POSE_INVALID,
    POSE_ON_TIME,
    Control,
    Estimator,
    Input,
    Parameters,
    Report,
    Sampling,
    Supervisor,
)
from firmware_py.core.subset import i32, kernel

reset = predictor.reset
begin_step = sampling.begin_step
take_sample = sampling.take_sample
supervise = supervisor.supervise
request = supervisor.serve
admits = goal.admits
follow = goal.follow
watch_control = supervisor.watch_control

_valid_pose = goal.valid_pose
_see_from_goal = goal.see_from_goal
_age_at_tick = poses.age_at_tick
_compare = repetition.compare
_frozen = repetition.frozen
_add_turn = repetition.add_turn
_file_pose = predictor.pose_into_history
_note_pose = supervisor.note_pose
_estimate = predictor.estimate
_clear_samples = sampling.clear_samples
_report_state = goal.report_state
_control_flaps = controller.control_flaps
_drive_servos = servo.drive_servos
_average_inputs = controller.average_inputs
_forget_zero = sampling.forget_zero
_forget_flight = supervisor.forget_flight


@kernel
def file_pose(
    parameters: Parameters, data: Input, estimator: Estimator, sampling: Sampling, supervisor: Supervisor
) -> i32:
    """Turn the input's pose into the goal frame and file it under the instant when it was measured."""
    if not _valid_pose(data):
        estimator.invalid = i32(estimator.invalid + 1)
        return i32(POSE_INVALID)
    _age_at_tick(data, sampling)
    _compare(data, sampling)
    if _frozen(data, sampling):
        estimator.invalid = i32(estimator.invalid + 1)
        estimator.frozen = i32(estimator.frozen + 1)
        return i32(POSE_FROZEN)
    seen = _see_from_goal(data, estimator)
    if seen != POSE_ON_TIME:
        return seen
    answer = _file_pose(parameters, data, estimator)
    if answer == POSE_ON_TIME:
        _note_pose(data, supervisor)
    return answer


@kernel
def estimate(
    parameters: Parameters,
    data: Input,
    estimator: Estimator,
    control: Control,
    sampling: Sampling,
    report: Report,
) -> None:
    """Run one tick of the estimator."""
    _estimate(parameters, data, estimator, control)
    _add_turn(parameters, data, sampling)
    _clear_samples(data, sampling)
    _report_state(data, estimator, control, report)


@kernel
def control(parameters: Parameters, data: Input, estimator: Estimator, control: Control) -> None:
    """Run one tick of the controller, down to the timer counts and the mean inputs."""
    _control_flaps(parameters, data, estimator, control)
    _drive_servos(parameters, control)
    _average_inputs(control)


@kernel
def restart(data: Input, sampling: Sampling, supervisor: Supervisor) -> None:
    """Search for the gyro's zero again and forget the last flight."""
    _forget_zero(data, sampling)
    _forget_flight(supervisor)
