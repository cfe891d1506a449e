"""The laboratory's loop in C: the flight tasks, and the beats of the IMU between two other events of the hardware.

`run` of the scheduler goes through them: a run has a leg up to each beat. Where Python flies, or on a clock that waits, the
time line has the beats like all other events.
"""

from collections.abc import Callable
from pathlib import Path

from firmware_py import compiling, rtos, tasks
from firmware_py.core import structs, subset
from firmware_py.core.structs import Estimator, Input, Sampling
from firmware_py.core.subset import Block, I32s, Struct, call, i64
from firmware_py.rtos import Kernel
from firmware_py.rtos.memory import KernelMemory
from firmware_py.rtos.queues import send_from_isr
from firmware_py.rtos.scheduler import begin as begin_run
from firmware_py.rtos.scheduler import next_task as take_next
from firmware_py.rtos.scheduler import resume as resume_run
from firmware_py.tasks import FlightPath, fly
from hil import events
from hil.devices.board_firmware import BoardFirmware
from hil.events import Beat

SOURCES = tuple(Path(module.__file__ or "") for module in (subset, structs, tasks, events))
compiled = compiling.compiler(Path(rtos.__path__[0]), *SOURCES)


class BeatingBoard(Struct):
    """The board under the beat."""

    booted_us: i64  # the time line's instant at which the processor's clock began
    sample: i64  # to `call`: takes a sample, and returns whether the IMU raises its interrupt


@compiled
def leg_end(beat: Beat, board: BeatingBoard, end_us: int) -> int:
    """Return how far a run goes before the next beat, by the processor's clock."""
    before_us = beat.next_us - board.booted_us - 1
    return before_us if before_us < end_us else end_us


@compiled
def take_beat(k: KernelMemory, path: FlightPath, beat: Beat, board: BeatingBoard) -> int:
    """Let the next beat happen: take a sample, and interrupt the processor; return an error below 0."""
    k.now_us = beat.next_us - board.booted_us
    beat.now_us = beat.next_us
    beat.next_us += beat.period_us
    beat.planned += 1
    beat.order = beat.planned
    has_data = call(board.sample)
    if has_data > 0 and k.interrupts_off == 0:
        return send_from_isr(k, path.imu_ready)
    return 0


@compiled
def go_on(  # noqa: PLR0913 - what the tasks use is wired once
    k: KernelMemory, path: FlightPath, data: Input, imu: I32s, sampling: Sampling, estimator: Estimator,
    beat: Beat, board: BeatingBoard, first: int,
) -> int:  # fmt: skip
    """Go on from a task on to the end of the run, beat by beat, or until a task of Python is to take a step; return it."""
    task = fly(k, path, data, imu, sampling, estimator, first)
    while task == 0 and k.until_us < k.end_us:
        answer = take_beat(k, path, beat, board)
        if answer < 0:
            return answer
        end_us = k.end_us
        leg_us = leg_end(beat, board, end_us)
        task = begin_run(k, k.now_us, leg_us)
        k.end_us = end_us
        task = fly(k, path, data, imu, sampling, estimator, task)
    return task


@compiled
def begin(  # noqa: PLR0913 - what the tasks use is wired once
    k: KernelMemory, path: FlightPath, data: Input, imu: I32s, sampling: Sampling, estimator: Estimator,
    beat: Beat, board: BeatingBoard, now_us: int, until_us: int,
) -> int:  # fmt: skip
    """Do what the scheduler's `begin` does, after a beat that is due."""
    if beat.next_us - board.booted_us <= now_us:
        answer = take_beat(k, path, beat, board)
        if answer < 0:
            return answer
    leg_us = leg_end(beat, board, until_us)
    task = begin_run(k, now_us, leg_us)
    if until_us > k.end_us:
        k.end_us = until_us
    return go_on(k, path, data, imu, sampling, estimator, beat, board, task)


@compiled
def resume(  # noqa: PLR0913 - what the tasks use is wired once
    k: KernelMemory, path: FlightPath, data: Input, imu: I32s, sampling: Sampling, estimator: Estimator,
    beat: Beat, board: BeatingBoard, yielded_us: int,
) -> int:  # fmt: skip
    """Do what the scheduler's `resume` does."""
    task = resume_run(k, yielded_us)
    return go_on(k, path, data, imu, sampling, estimator, beat, board, task)


@compiled
def next_task(  # noqa: PLR0913 - what the tasks use is wired once
    k: KernelMemory, path: FlightPath, data: Input, imu: I32s, sampling: Sampling, estimator: Estimator,
    beat: Beat, board: BeatingBoard,
) -> int:  # fmt: skip
    """Do what the scheduler's `next_task` does."""
    task = take_next(k)
    return go_on(k, path, data, imu, sampling, estimator, beat, board, task)


def let_beat(firmware: BoardFirmware, beat: Block[Beat], booted_us: int, sample: Callable[[], bool]) -> bool:
    """Let the runs of a booted processor take the beats by themselves; return whether they do."""
    if firmware.flight_path is None:
        return False
    board = BeatingBoard.allocate()
    board.fields.booted_us = booted_us
    board.connect(sample=sample)
    kernel = firmware.kernel
    assert isinstance(kernel, Kernel)
    return kernel.run_by((begin, resume, next_task), *firmware.flight_path, beat, board)
