"""Modules of a user's own: laws and estimators that tests fly, and the folder of a project around them."""

from pathlib import Path

from hil.config import LabConfig, load_config

HEAD = '''"""A law of the tests."""

from typing import Annotated

from firmware_py.core.controller import feedback
from firmware_py.core.guard import allocate
from firmware_py.core.maths import ZERO, clamp, sin
from firmware_py.core.structs import POSITION, Control, Estimator, Input, Parameters
from firmware_py.core.subset import F32s, Logged, Sensed, Struct, Tunable, f32, i32, kernel, sqrt

'''
AS_BUILT_IN = (
    HEAD
    + """
@kernel
def control_law(parameters: Parameters, estimator: Estimator, control: Control) -> None:
    feedback(parameters, estimator, control)
    allocate(parameters, control)
"""
)
LAW = (
    HEAD
    + '''
DT = f32(0.01)


class Gains(Struct):
    """What may be tuned."""

    gain_iy: Annotated[f32, Tunable(-0.4, "rad/m/s", low=-2.0, high=2.0)]
    twelve_chars: Annotated[f32, Tunable(0.1, "m s", low=0.0, high=1.0)]
    after: Annotated[i32, Tunable(1000000, "10 ms", low=0, high=1000000)]


class Memory(Struct):
    """What is remembered."""

    integral: Annotated[f32, Logged("m s")]
    errors: Annotated[F32s, 3, Logged("m")]
    ticks: Annotated[i32, Logged("")]
    hidden: f32


@kernel
def reset_law(memory: Memory) -> None:
    """Forget."""
    memory.integral = ZERO
    memory.ticks = i32(0)


@kernel
def control_law(parameters: Parameters, estimator: Estimator, control: Control, own: Gains, memory: Memory) -> None:
    """The core's law with an integrator on y; after some ticks it divides nothing by nothing."""
    feedback(parameters, estimator, control)
    for axis in range(3):
        memory.errors[axis] = parameters.target[axis] - estimator.now[POSITION + axis]
    memory.integral = clamp(memory.integral + DT * memory.errors[1], -own.twelve_chars, own.twelve_chars)
    control.u[0] = control.u[0] + own.gain_iy * memory.integral
    memory.ticks = i32(memory.ticks + 1)
    if memory.ticks > own.after:
        control.u[3] = memory.hidden / memory.hidden
    allocate(parameters, control)
'''
)
ESTIMATOR = '''"""The core's estimator by another way; after some ticks it divides nothing by nothing."""

from typing import Annotated

from firmware_py.core import predictor
from firmware_py.core.structs import Control, Estimator, Input, Parameters
from firmware_py.core.subset import Struct, Tunable, f32, i32, kernel

_reset = predictor.reset
_file_pose = predictor.pose_into_history
_estimate = predictor.estimate


class Noise(Struct):
    until: Annotated[i32, Tunable(1000000, "10 ms", low=0, high=1000000)]


class Memory(Struct):
    ticks: i32
    nothing: f32


@kernel
def reset(parameters: Parameters, estimator: Estimator, memory: Memory) -> None:
    memory.ticks = i32(0)
    _reset(parameters, estimator)


@kernel
def file_pose(parameters: Parameters, data: Input, estimator: Estimator) -> i32:
    return _file_pose(parameters, data, estimator)


@kernel
def estimate(
    parameters: Parameters, data: Input, estimator: Estimator, control: Control, own: Noise, memory: Memory
) -> None:
    _estimate(parameters, data, estimator, control)
    memory.ticks = i32(memory.ticks + 1)
    if memory.ticks > own.until:
        estimator.now[4] = memory.nothing / memory.nothing
'''


def make_project(folder: Path, law: str = LAW, estimator: str = "", values: str = "") -> Path:
    """Write a project into a folder; returns its profile's path."""
    lines = ['base = "floaty"', "[logic]"]
    for key, text in (("controller", law), ("estimator", estimator)):
        if text:
            (folder / f"{key}.py").write_text(text, encoding="utf-8")
            lines.append(f'{key} = "{key}.py"')
    profile = folder / "profile.toml"
    profile.write_text("\n".join((*lines, values, "")), encoding="utf-8")
    return profile


def own_config(folder: Path, law: str = LAW, estimator: str = "", values: str = "") -> LabConfig:
    """Write a project and return its configuration."""
    return load_config(str(make_project(folder, law, estimator, values)))
