"""What goes into the flight core, recorded from a flight or made up of arbitrary bits, and its replay on any runner.

Run as a script with a library and a seed, this file replays arbitrary bits on that library.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.config import parameters_of
from firmware_py.core.structs import Control, Estimator, Input, Parameters, Report, Sampling, Supervisor
from firmware_py.core.subset import Block
from firmware_py.core_runner import CoreBlocks, NativeRunner, PlainRunner, RunnerFactory
from hil.board.board_firmware import PythonBoard
from hil.config import load_config
from hil.laboratory.experiments.position import HOVER
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Request

CONFIG = load_config()
# Calls with arbitrary bits in what the tasks write, and their shares; sums of samples would overflow.
WILD = {
    "reset": 0.02, "file_pose": 0.24, "estimate": 0.3, "control": 0.22, "begin_step": 0.06, "supervise": 0.06,
    "request": 0.04, "admits": 0.02, "follow": 0.04,
}  # fmt: skip
ONE_NAN = 0x7FC00000
SPECIAL_FLOATS = np.array(
    [0.0, -0.0, 1.0, -1.0, 1e-45, -1e-42, 1.1754942e-38, 3.4028235e38, -3.4028235e38, 1e30, -1e20, 16777216.0,
     np.inf, -np.inf, np.nan, 1000.0, -1000.0, -998.0, 3.1415927], np.float32,
)  # fmt: skip
SPECIAL_INTEGERS = np.array([0, 1, 2, -1, 3, 10, 100_000, 131_072, -(2**31), 2**31 - 1], np.int32)


def float_words(dtype: np.dtype[Any]) -> NDArray[np.bool_]:
    """Return which 32-bit words of a struct are floats."""
    ones = [np.full(dtype[name].itemsize // 4, dtype[name].base == np.float32) for name in dtype.names or ()]
    return np.concatenate(ones)


STRUCTS = (Parameters, Input, Estimator, Control, Sampling, Supervisor, Report)
MEMORY = sum(struct.dtype.itemsize for struct in STRUCTS)  # [B] of the default core
FLOATS = {struct.dtype: float_words(struct.dtype) for struct in STRUCTS}


def one_nan(words: NDArray[np.uint32], floats: NDArray[np.bool_] | bool = True) -> bytes:
    """Return the bytes of words in which every NaN has one pattern."""
    words = words.copy()
    words[floats & np.isnan(words.view(np.float32))] = ONE_NAN
    return words.tobytes()


def block_bits(block: Block) -> bytes:
    """Return a block's bytes with one pattern for NaN."""
    return one_nan(block.memory.view(np.uint32), FLOATS[block.memory.dtype])


def blocks_of(core: CoreBlocks) -> tuple[Block, ...]:
    return tuple(core.named.values())


def fill(block: Block, content: bytes) -> None:
    block.memory.view(np.uint8)[:] = np.frombuffer(content, np.uint8)


@dataclass(frozen=True, slots=True)
class Step:
    """A call of the core with what parameters and input hold then; `floats` disturb the estimator's if not empty."""

    call: str
    parameters: bytes
    data: bytes
    floats: bytes = b""


@dataclass(slots=True)
class Recording:
    """The blocks at the start, the calls, and result and blocks after each."""

    start: list[bytes]
    steps: list[Step] = field(default_factory=list)
    after: list[bytes] = field(default_factory=list)


def run_step(core: CoreBlocks, step: Step) -> bytes:
    """Return the result and the blocks after a call."""
    fill(core.parameters, step.parameters)
    fill(core.data, step.data)
    if step.floats:
        floats = FLOATS[Estimator.dtype]
        words = core.estimator.memory.view(np.uint32)
        words[floats] = np.frombuffer(step.floats, np.uint32)[floats]
    result = core.run.call(step.call)
    return repr(result).encode() + b"".join(map(block_bits, blocks_of(core)))


def replay(recording: Recording, on: Path | RunnerFactory) -> Iterator[bytes]:
    """Yield result and blocks after each recorded call on a compiled library, or on another runner."""
    core = CoreBlocks(
        Parameters.allocate(), partial(NativeRunner, library=on) if isinstance(on, Path) else on
    )
    for block, content in zip(blocks_of(core), recording.start, strict=True):
        fill(block, content)
    for step in recording.steps:
        yield run_step(core, step)


def first_difference(recording: Recording, on: Path | RunnerFactory) -> int | None:
    """Return the first call after which the memory is not what was recorded."""
    pairs = zip(replay(recording, on), recording.after, strict=True)
    return next((index for index, (got, expected) in enumerate(pairs) if got != expected), None)


class RecordingRunner:
    """Runs the core's Python and writes down what goes in and what comes out."""

    def __init__(self, core: CoreBlocks) -> None:
        self._core, self._inner = core, PlainRunner(core)
        self.recording = Recording([block.bytes() for block in blocks_of(core)])

    def call(self, name: str) -> int:
        parameters, data = self._core.parameters.bytes(), self._core.data.bytes()
        result = self._inner.call(name)
        self.recording.steps.append(Step(name, parameters, data))
        blocks = b"".join(map(block_bits, blocks_of(self._core)))
        self.recording.after.append(repr(result).encode() + blocks)
        return result


def record_flight(duration_s: float) -> Recording:
    """Return the core's calls in a hover with pushes and with gaps, outliers and late poses."""
    faults = ["push.y@1=2", "push.roll@1.5=0.2", "mocap.dropout@2:0.4", "push.z@2.6=2"]
    request = Request.of(HOVER, duration_s=duration_s, faults=faults)
    flight = lockstep_flight(request, executor=PythonBoard(RecordingRunner))
    flight.run()
    runner = flight.robot.firmware._core.run
    assert isinstance(runner, RecordingRunner)
    return runner.recording


def wild_words(rng: np.random.Generator, block: Block) -> bytes:
    """Return a block's content with about a third of its words random and a third special."""
    words = block.memory.view(np.uint32).copy()
    floats = FLOATS[block.memory.dtype]
    fate = rng.choice(3, words.size, p=rng.dirichlet((1, 1, 1)))
    special = np.where(
        floats,
        rng.choice(SPECIAL_FLOATS.view(np.uint32), words.size),
        rng.choice(SPECIAL_INTEGERS.view(np.uint32), words.size),
    )
    words = np.where(
        fate == 0, words, np.where(fate == 1, special, rng.integers(0, 2**32, words.size, np.uint32))
    )
    return words.astype(np.uint32).tobytes()


def record_wild(seed: int, count: int) -> Recording:
    """Return calls with arbitrary bits in parameters, input and the estimator's floats, run on Python."""
    rng = np.random.default_rng(seed)
    core = CoreBlocks(parameters_of(CONFIG), PlainRunner)
    parameters, data, estimator = core.parameters, core.data, core.estimator
    data.fields.pose_quaternion[0] = 1.0
    data.fields.gyro_samples = 10
    recording = Recording([block.bytes() for block in blocks_of(core)])
    sane = parameters.bytes(), data.bytes()
    recording.steps.append(Step("reset", *sane))
    for _ in range(count):
        call = rng.choice(list(WILD), p=list(WILD.values()))
        first = wild_words(rng, parameters) if rng.random() < 0.5 else sane[0]
        second = wild_words(rng, data) if rng.random() < 0.7 else sane[1]
        floats = wild_words(rng, estimator) if rng.random() < 0.15 else b""
        recording.steps.append(Step(str(call), first, second, floats))
    recording.after = list(replay(recording, PlainRunner))
    return recording


def record_plausible(seed: int, ticks: int) -> Recording:
    """Return ticks with poses, outliers, ages and rates of a flight, under profiles that are varied now and then."""
    rng = np.random.default_rng(seed)
    core = CoreBlocks(parameters_of(CONFIG), PlainRunner)
    parameters, data = core.parameters, core.data
    parameters.fields.gain_pitch, parameters.fields.gain_q = 0.1, 0.02  # the profile's are zero
    sane = parameters.memory.view(np.uint32).copy()
    floats = FLOATS[Parameters.dtype]
    recording = Recording([block.bytes() for block in blocks_of(core)])
    recording.steps.append(Step("reset", parameters.bytes(), data.bytes()))
    fields = data.fields
    for tick in range(ticks):
        if tick % 125 == 0:
            ages = [5_000] if tick % 2 else [-1, 5_000, 37_777, 41_234, 83_000, 140_000]
            words = np.where(floats, sane.view(np.float32) * rng.lognormal(0, 0.4, sane.size), 0).astype(
                np.float32
            )
            parameters.memory.view(np.uint32)[floats] = words.view(np.uint32)[floats]
            parameters.fields.target[:] = rng.normal(0, 0.3, 4)
            parameters.fields.home[:2] = parameters.fields.target[:2]
            fields.poses_absolute = tick % 250 == 0
            parameters.fields.predict, parameters.fields.age_measured = rng.random(2) < 0.8
            parameters.fields.horizon, parameters.fields.default_age_us = (
                rng.integers(1, 13),
                rng.integers(120_000),
            )
            parameters.fields.excite_kind = rng.integers(3)
            parameters.fields.excite_rms[:] = rng.normal(0.05, 0.05, 4)
        for _ in range(rng.choice(3, p=[0.4, 0.5, 0.1])):
            spread = 1.0 if rng.random() < 0.2 else 0.1
            turn = rng.normal(0, spread, 3)
            fields.pose_position[:] = rng.normal(0, spread, 3)
            fields.pose_quaternion[:] = np.array([1, *(turn / 2)]) / np.sqrt(1 + turn @ turn / 4)
            fields.pose_age_us = rng.choice(ages)
            recording.steps.append(Step("file_pose", parameters.bytes(), data.bytes()))
        fields.gyro_sum[:] = rng.normal(0, 3000, 3)
        fields.gyro_bias[:] = (1.5, -2.25, 0.3)
        fields.gyro_samples = rng.choice([0, 9, 10])
        fields.mode = rng.choice(3, p=[0.1, 0.8, 0.1])
        fields.manual[:] = rng.normal(0, 1, 4)
        fields.tick, fields.now_us = tick, 1000 * tick
        fields.gyro[:] = rng.normal(0, 300, 3)
        fields.battery_mv, fields.manual_mode = rng.integers(3000, 4000), rng.choice(3, p=[0.8, 0.1, 0.1])
        fields.connected, fields.by_words = rng.random(2) < 0.1
        fields.words[:] = rng.integers(65536, size=4)
        fields.poses_absolute, fields.setpoint_kind = rng.random() < 0.5, rng.integers(5)
        fields.goal_kind = rng.integers(4)
        fields.goal[:], fields.setpoint[:] = rng.normal(0, 0.3, (2, 4))
        fields.request = rng.integers(6)
        calls = ["begin_step", "take_sample", "estimate", "supervise", "control"]
        calls += ["admits", "follow"]
        calls += ["request"] if rng.random() < 0.02 else []
        recording.steps += [Step(call, parameters.bytes(), data.bytes()) for call in calls]
    recording.after = list(replay(recording, PlainRunner))
    return recording


if __name__ == "__main__":
    for _ in replay(record_wild(int(sys.argv[2]), 500), Path(sys.argv[1])):
        pass
    print("done")
