"""Laws of every `CoreRunner`: whatever executes the flight core gives the same bits and keeps nothing to itself."""

import numpy as np
import pytest

from firmware_py.config import LogicConfig, parameters_of
from firmware_py.core.structs import POSE_INVALID, POSE_ON_TIME, POSE_TOO_OLD, Input, Parameters
from firmware_py.core_runner import CoreBlocks, RunnerFactory, default_runner
from hil.board.cores.boards import BOARDS, runner_of
from hil.config import load_config
from support.core_streams import Recording, blocks_of, fill, record_wild, run_step

RECORDING = 25  # ticks


@pytest.fixture(scope="module")
def recording() -> Recording:
    return record_wild(7, RECORDING)


@pytest.fixture(scope="module", params=BOARDS)
def runner(request: pytest.FixtureRequest) -> RunnerFactory:
    """What makes a runner of each kind."""
    return runner_of(request.param, LogicConfig())


def core_at_start(recording: Recording, runner: RunnerFactory) -> CoreBlocks:
    core = CoreBlocks(Parameters.allocate(), runner)
    for block, content in zip(blocks_of(core), recording.start, strict=True):
        fill(block, content)
    return core


@pytest.mark.long
def test_arbitrary_calls_give_the_bits_of_python(recording: Recording, runner: RunnerFactory) -> None:
    core = core_at_start(recording, runner)
    for number, (step, after) in enumerate(zip(recording.steps, recording.after, strict=True)):
        assert run_step(core, step) == after, f"call {number}, {step.call}"


@pytest.mark.long
def test_one_runner_continues_what_another_began(recording: Recording, runner: RunnerFactory) -> None:
    """All state lies in the blocks: runners that take turns with Python's compute what one alone does."""
    core = core_at_start(recording, runner)
    runners = (core.run, default_runner(core))
    for number, (step, after) in enumerate(zip(recording.steps, recording.after, strict=True)):
        core.run = runners[number % 3 % 2]
        assert run_step(core, step) == after, f"call {number}, {step.call}"


WRITES = {  # of the input
    "file_pose": {"pose_age_us"}, "estimate": {"gyro_sum", "gyro_samples"}, "supervise": {"mode"},
}  # fmt: skip


def test_no_call_writes_parameters_or_the_tasks_inputs(recording: Recording, runner: RunnerFactory) -> None:
    core = core_at_start(recording, runner)
    for step in recording.steps:
        run_step(core, step)
        assert core.parameters.bytes() == step.parameters, step.call
        before, after = (np.frombuffer(data, Input.dtype)[0] for data in (step.data, core.data.bytes()))
        written = {
            name for name in Input.dtype.names or () if before[name].tobytes() != after[name].tobytes()
        }
        assert written <= WRITES.get(step.call, set()), step.call


@pytest.mark.long
def test_a_pose_is_on_time_too_old_or_none(runner: RunnerFactory) -> None:
    core = CoreBlocks(parameters_of(load_config()), runner)
    core.run.call("reset")
    for _ in range(20):  # until a pose can belong to the past
        core.run.call("estimate")
    data, core.sampling.fields.phase = core.data.fields, 9  # the estimator's tick comes in this step
    data.pose_quaternion[:] = (1, 0, 0, 0)
    found = []
    for x, age_us in ((0.1, 40_000), (0.1, 10_000_000), (float("nan"), 40_000), (0.1, 40_000)):
        data.pose_position[:], data.pose_age_us = (x, 0, 0), age_us
        found.append(core.run.call("file_pose"))
    assert found == [POSE_ON_TIME, POSE_TOO_OLD, POSE_INVALID, POSE_ON_TIME]
