"""The tasks of the flight path, each reading like its specification. Ticks are 1 ms.

The IMU interrupt wakes SENSORS, which reads it and lets STABILIZER run on the next tick edge; STABILIZER lets the
estimator run, closes the loop in every tenth tick and writes servo counts to the timers. The estimator works one tick
before the controller, so that a pose reaches the flaps in 1 to 11 ms.

The three tasks fly as C, in one loop with the scheduler and the IMU's beat, from one other event of hardware to the next.
A run has a leg up to each beat. Where Python flies everything, the tasks are generators.
"""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from firmware_py import rtos
from firmware_py.board import Board
from firmware_py.compiling import compiler
from firmware_py.config import CpuConfig
from firmware_py.core import structs, subset
from firmware_py.core.structs import POSE_ON_TIME, Estimator, Input, Sampling
from firmware_py.core.subset import Block, I32s, Struct, call, i32, i64, step
from firmware_py.core_runner import CoreBlocks, costs_of
from firmware_py.crazyflie.planner import PathPoint
from firmware_py.pilot import Arrived, Pilot, put_goal
from firmware_py.rtos import FOREVER, Kernel, KernelError, Queue
from firmware_py.rtos.awaited import Steps, delay_until, give, take, work, yield_if_pending
from firmware_py.rtos.memory import FRAMES, NEVER_US, Beat, KernelMemory
from firmware_py.rtos.queues import send_from_isr
from firmware_py.rtos.scheduler import begin as begin_run
from firmware_py.rtos.scheduler import resume as resume_run
from firmware_py.supervisor import CoreSupervisor, wrapped
from firmware_py.wire.crtp import Correction

compiled = compiler(Path(rtos.__path__[0]), Path(structs.__file__), Path(subset.__file__))
MEASUREMENT_QUEUE: Final = 20  # original firmware
POWER_PERIOD: Final = 100  # likewise
DATA_TIMEOUT: Final = 1  # tick edges without a sample after which the stabilizer runs without the IMU


class FlightPath(Struct):
    """What the three tasks share: objects and tasks of the scheduler, processor times, and functions to `call`."""

    imu_ready: i64
    data_ready: i64
    estimator_run: i64
    measurements: i64
    sensors: i64
    stabilizer: i64
    kalman: i64
    sensors_us: i64
    stabilizer_us: i64
    kalman_us: i64
    fed_us: i64  # when the watchdog was fed
    booted_us: i64  # when the processor's clock began, by that of the beat
    # Entry points of the core, and their processor times.
    take_sample: i64
    begin_step: i64
    control: i64
    control_us: i64
    estimate: i64
    estimate_us: i64
    sample: i64  # at a beat: takes a sample, and returns whether the IMU interrupts the processor
    # What Python does for the tasks.
    zero_found: i64
    decide: i64
    write_compare: i64
    take_pose: i64
    pose_gated: i64


@compiled
def sensors(k: KernelMemory, path: FlightPath, data: Input, imu: I32s) -> Steps:
    """Read the IMU whenever it has data."""
    while True:
        yield from take(k, path.imu_ready, FOREVER)
        yield from work(k, path.sensors_us)
        data.gyro[0], data.gyro[1], data.gyro[2] = imu[0], imu[1], imu[2]
        found = call(path.take_sample)
        if found > 0:
            call(path.zero_found)
            yield from yield_if_pending(k)
        yield from give(k, path.data_ready, 0)


@compiled
def stabilizer(k: KernelMemory, path: FlightPath, data: Input) -> Steps:
    """Run at 1 kHz on the tick edge after each IMU sample; control at 100 Hz."""
    while True:
        came = yield from take(k, path.data_ready, DATA_TIMEOUT)
        if came > 0:
            yield from delay_until(k, k.tick_count + 1)
        path.fed_us = k.now_us
        if path.stabilizer_us > 0:
            yield from work(k, path.stabilizer_us)
        data.tick = i32(k.tick_count)
        control_runs = call(path.begin_step)
        yield from give(k, path.estimator_run, 0)
        if control_runs > 0:
            cost_us = call(path.control_us)
            yield from work(k, cost_us)
            call(path.decide)
            yield from yield_if_pending(k)
            call(path.control)
            call(path.write_compare)


@compiled
def kalman(k: KernelMemory, path: FlightPath, sampling: Sampling, estimator: Estimator) -> Steps:
    """Take poses at 1 kHz, estimate at 100 Hz."""
    while True:
        yield from take(k, path.estimator_run, FOREVER)
        if path.kalman_us > 0:
            yield from work(k, path.kalman_us)
        while k.count[path.measurements] > 0:
            call(path.take_pose)
            yield from yield_if_pending(k)
        if sampling.estimate_due > 0:
            cost_us = call(path.estimate_us)
            yield from work(k, cost_us)
            before = estimator.refused
            call(path.estimate)
            if estimator.refused != before:
                call(path.pose_gated)
                yield from yield_if_pending(k)


@compiled
def step_tasks(
    k: KernelMemory, path: FlightPath, data: Input, imu: I32s, sampling: Sampling, estimator: Estimator, first: int
) -> int:  # fmt: skip
    """Take the steps of the three tasks, from a task on, until another one is to take a step; return it."""
    task = first
    while task > 0:
        yielded_us = 0
        if task == path.sensors:
            yielded_us = step(sensors(k, path, data, imu))
        elif task == path.stabilizer:
            yielded_us = step(stabilizer(k, path, data))
        elif task == path.kalman:
            yielded_us = step(kalman(k, path, sampling, estimator))
        else:
            return task
        if yielded_us < 0:
            return yielded_us
        task = resume_run(k, yielded_us)
    return task


@compiled
def take_beat(k: KernelMemory, path: FlightPath, beat: Beat) -> int:
    """Let the next beat happen: take a sample, and interrupt the processor; return an error below 0."""
    k.now_us = beat.next_us - path.booted_us
    beat.now_us = beat.next_us
    beat.next_us += beat.period_us
    beat.planned += 1
    beat.order = beat.planned
    has_data = call(path.sample)
    if has_data > 0 and k.interrupts_off == 0:
        return send_from_isr(k, path.imu_ready)
    return 0


@compiled
def begin_leg(k: KernelMemory, path: FlightPath, beat: Beat, now_us: int, end_us: int) -> int:
    """Do what the scheduler's `begin` does, up to the next beat."""
    before_us = beat.next_us - path.booted_us - 1
    task = begin_run(k, now_us, before_us if before_us < end_us else end_us)
    if end_us > k.end_us:
        k.end_us = end_us
    return task


@compiled
def fly(  # noqa: PLR0913 - what the tasks use is wired once
    k: KernelMemory, path: FlightPath, data: Input, imu: I32s, sampling: Sampling, estimator: Estimator,
    beat: Beat, first: int,
) -> int:  # fmt: skip
    """Go on from a task on to the end of the run, beat by beat, or until a task of Python is to take a step; return it."""
    task = step_tasks(k, path, data, imu, sampling, estimator, first)
    while task == 0 and k.until_us < k.end_us:
        answer = take_beat(k, path, beat)
        if answer < 0:
            return answer
        task = begin_leg(k, path, beat, k.now_us, k.end_us)
        task = step_tasks(k, path, data, imu, sampling, estimator, task)
    return task


@compiled
def begin(  # noqa: PLR0913 - what the tasks use is wired once
    k: KernelMemory, path: FlightPath, data: Input, imu: I32s, sampling: Sampling, estimator: Estimator,
    beat: Beat, now_us: int, until_us: int,
) -> int:  # fmt: skip
    """Do what the scheduler's `begin` does, after a beat that is due."""
    if beat.next_us - path.booted_us <= now_us:
        answer = take_beat(k, path, beat)
        if answer < 0:
            return answer
    task = begin_leg(k, path, beat, now_us, until_us)
    return fly(k, path, data, imu, sampling, estimator, beat, task)


@compiled
def resume(  # noqa: PLR0913 - what the tasks use is wired once
    k: KernelMemory, path: FlightPath, data: Input, imu: I32s, sampling: Sampling, estimator: Estimator,
    beat: Beat, yielded_us: int,
) -> int:  # fmt: skip
    """Do what the scheduler's `resume` does."""
    task = resume_run(k, yielded_us)
    return fly(k, path, data, imu, sampling, estimator, beat, task)


@dataclass(frozen=True, slots=True)
class Findings:
    """What the tasks report."""

    zero_found: Callable[[], None]
    pose_refused: Callable[[int, Correction], None]  # (POSE_..., pose)
    pose_gated: Callable[[], None]


class FlightTasks:
    """The tasks of the flight path in a scheduler; `imu_ready` is the IMU's, `measurements` are the poses' to arrive."""

    def __init__(
        self,
        kernel: Kernel,
        cpu: CpuConfig,
        board: Board,
        core: CoreBlocks,
        supervisor: CoreSupervisor,
        pilot: Pilot,
        findings: Findings,
    ) -> None:
        self.imu_ready = kernel.create_binary_semaphore("imuReady")
        data_ready = kernel.create_binary_semaphore("dataReady")
        estimator_run = kernel.create_binary_semaphore("runTaskSemaphore")
        self.measurements: Queue[Arrived] = kernel.create_queue(MEASUREMENT_QUEUE, "measurements")
        self._kernel, self._board, self._core = kernel, board, core
        self._supervisor, self._pilot, self._findings = supervisor, pilot, findings
        self._path = FlightPath.allocate()
        path, costs = self._path.fields, costs_of(core.run, cpu)
        path.imu_ready, path.data_ready = self.imu_ready.index, data_ready.index
        path.estimator_run, path.measurements = estimator_run.index, self.measurements.index
        path.sensors_us, path.stabilizer_us, path.kalman_us = cpu.sensors_us, cpu.stabilizer_us, cpu.kalman_us
        entries = {name: core.entry(name) for name in ("take_sample", "begin_step", "control", "estimate")}
        self._path.connect(
            **entries,
            control_us=costs.control_us,
            estimate_us=costs.estimate_us,
            zero_found=findings.zero_found,
            decide=self._decide,
            write_compare=self._write_compare,
            take_pose=self._take_pose,
            pose_gated=findings.pose_gated,
        )
        k, data, sampling = kernel.memory, core.data, core.sampling
        estimated = sampling.fields, core.estimator.fields
        path.sensors = kernel.create_task("SENSORS", 4, sensors, k, path, data.fields, board.imu).index
        path.stabilizer = kernel.create_task("STABILIZER", 5, stabilizer, k, path, data.fields).index
        path.kalman = kernel.create_task("KALMAN", 2, kalman, k, path, *estimated).index
        if max(path.sensors, path.stabilizer, path.kalman) >= FRAMES:
            raise KernelError(f"the flight tasks are not among the first {FRAMES} tasks")
        kernel.create_task("PWRMGNT", 0, power_task, kernel, board, core)
        self._memory = self._path, data, board.imu, sampling, core.estimator
        beat = Beat.allocate()
        beat.fields.next_us = NEVER_US
        kernel.run_by((begin, resume), *self._memory, beat)

    def take_beats(self, beat: Block[Beat], booted_us: int, sample: Callable[[], bool]) -> bool:
        """Let runs of the processor take the beats by themselves; return whether they do.

        `booted_us`: when the processor's clock began, by that of the beat. `sample` returns whether the IMU interrupts.
        """
        self._path.fields.booted_us = booted_us
        self._path.connect(sample=sample)
        return self._kernel.run_by((begin, resume), *self._memory, beat)

    @property
    def fed_us(self) -> int:
        """When the watchdog was fed."""
        return self._path.fields.fed_us

    def _decide(self) -> None:
        now_us = self._kernel.now_us
        self._core.sense(self._board.sensors)
        self._pilot.step(now_us)
        self._supervisor.update(now_us)

    def _write_compare(self) -> None:
        self._board.write_compare(self._core.control.fields.count.tolist())

    def _take_pose(self) -> None:
        """Hand the next pose to the core."""
        arrived = self.measurements.receive_nowait()
        assert arrived is not None
        answer = hand_pose_to_core(self._kernel, self._core, *arrived)
        if answer != POSE_ON_TIME:
            self._findings.pose_refused(answer, arrived[1])


def power_task(kernel: Kernel, board: Board, core: CoreBlocks) -> Generator[int, None, None]:
    """Measure the supply voltage at 10 Hz."""
    wake_tick = kernel.tick_count
    while True:
        core.data.fields.battery_mv = i32(board.read_battery_mv())
        wake_tick += POWER_PERIOD
        yield from kernel.delay_until(wake_tick)


def hand_pose_to_core(
    kernel: Kernel,
    core: CoreBlocks,
    arrived_us: int,
    pose: Correction,
    absolute: bool,
    goal: PathPoint | None,
) -> int:
    """Hand a pose to the core; return the result, `POSE_...`."""
    data = core.data.fields
    data.poses_absolute = i32(absolute)
    if goal is not None:
        put_goal(data, goal)
    data.now_us = wrapped(kernel.now_us)
    data.pose_waited_us = i32(kernel.now_us - arrived_us)
    data.pose_position[:] = pose.p_GB
    data.pose_quaternion[:] = pose.q_GB
    data.pose_age_us = i32(-1 if pose.age_us is None else pose.age_us)
    answer = core.run.call("file_pose")
    if goal is not None:
        put_goal(data, None)  # it was that of this pose only: the estimate is reported from the goal
    return answer
