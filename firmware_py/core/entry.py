"""The calls by which the firmware enters the core; every argument is the memory of one struct."""

from firmware_py.core import controller, predictor, servo
from firmware_py.core.subset import Memory, i32, kernel

_reset = predictor.reset
_file_pose = predictor.file_pose
_estimate = predictor.estimate
_control_flaps = controller.control_flaps
_drive_servos = servo.drive_servos


@kernel
def reset(parameters: Memory, estimator: Memory) -> None:
    """Start the estimator."""
    _reset(parameters[0], estimator[0])


@kernel
def file_pose(parameters: Memory, data: Memory, estimator: Memory) -> i32:
    """File the pose in the input under the instant at which it was true."""
    return _file_pose(parameters[0], data[0], estimator[0])


@kernel
def estimate(parameters: Memory, data: Memory, estimator: Memory, control: Memory) -> None:
    """Run one tick of the estimator."""
    _estimate(parameters[0], data[0], estimator[0], control[0])


@kernel
def control(parameters: Memory, data: Memory, estimator: Memory, control: Memory) -> None:
    """Run one tick of the controller, down to the timer counts."""
    _control_flaps(parameters[0], data[0], estimator[0], control[0])
    _drive_servos(parameters[0], control[0])
