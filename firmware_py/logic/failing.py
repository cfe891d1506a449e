"""Own logic that returns NaN when a parameter asks for it: a law and an estimator that are the core's otherwise."""

from typing import Annotated

from firmware_py.core import predictor
from firmware_py.core.controller import feedback
from firmware_py.core.guard import allocate
from firmware_py.core.maths import ZERO
from firmware_py.core.structs import Control, Estimator, Input, Parameters
from firmware_py.core.subset import Struct, Tunable, f32, i32, kernel

_reset = predictor.reset
_file_pose = predictor.pose_into_history
_estimate = predictor.estimate


class Law(Struct):
    """Whether the law fails."""

    law_fails: Annotated[f32, Tunable(0.0, "", low=0.0, high=1.0)]


class Filter(Struct):
    """Whether the estimator fails."""

    filter_fails: Annotated[f32, Tunable(0.0, "", low=0.0, high=1.0)]


@kernel
def control_law(parameters: Parameters, estimator: Estimator, control: Control, own: Law) -> None:
    """Run the core's law, or divide zero by zero."""
    feedback(parameters, estimator, control)
    if own.law_fails != ZERO:
        control.u[3] = ZERO / ZERO
    allocate(parameters, control)


@kernel
def reset(parameters: Parameters, estimator: Estimator) -> None:
    """Start the core's estimator."""
    _reset(parameters, estimator)


@kernel
def file_pose(parameters: Parameters, data: Input, estimator: Estimator) -> i32:
    """File a pose as the core does."""
    return _file_pose(parameters, data, estimator)


@kernel
def estimate(
    parameters: Parameters, data: Input, estimator: Estimator, control: Control, own: Filter
) -> None:
    """Run the core's estimator, or divide zero by zero."""
    _estimate(parameters, data, estimator, control)
    if own.filter_fails != ZERO:
        estimator.now[0] = ZERO / ZERO
