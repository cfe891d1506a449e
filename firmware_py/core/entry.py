"""The calls by which the firmware enters the core; every argument is the memory of one struct."""

from firmware_py.core import controller, predictor, servo
from firmware_py.core.structs import Control, Estimator, Input, Parameters
from firmware_py.core.subset import Memory, i32, kernel

_reset = predictor.reset
_pose_into_history = predictor.pose_into_history
_estimate = predictor.estimate
_control_flaps = controller.control_flaps
_drive_servos = servo.drive_servos


@kernel
def reset(parameters: Memory[Parameters], estimator: Memory[Estimator]) -> None:
    """Start the estimator."""
    _reset(parameters[0], estimator[0])


@kernel
def file_pose(parameters: Memory[Parameters], data: Memory[Input], estimator: Memory[Estimator]) -> i32:
    """File the pose in the input under the instant at which it was true."""
    return _pose_into_history(parameters[0], data[0], estimator[0])


@kernel
def estimate(
    parameters: Memory[Parameters],
    data: Memory[Input],
    estimator: Memory[Estimator],
    control: Memory[Control],
) -> None:
    """Run one tick of the estimator."""
    _estimate(parameters[0], data[0], estimator[0], control[0])


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
