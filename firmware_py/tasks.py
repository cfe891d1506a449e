"""The tasks of the flight path, each reading like its specification. Ticks are 1 ms.

The IMU interrupt wakes SENSORS, which reads it and lets STABILIZER run on the next tick edge; STABILIZER lets the
estimator run, closes the loop in every tenth tick and writes servo counts to the timers. The estimator works one tick
before the controller, so that a pose reaches the flaps in 1 to 11 ms.
"""

from collections.abc import Callable, Generator

from firmware_py.board import Board
from firmware_py.config import CpuConfig
from firmware_py.core.structs import POSE_ON_TIME
from firmware_py.core.subset import i32
from firmware_py.core_runner import CoreBlocks, CoreCosts
from firmware_py.crazyflie.planner import PathPoint
from firmware_py.pilot import Arrived, Pilot, put_goal
from firmware_py.rtos import Kernel, Queue, Semaphore
from firmware_py.supervisor import CoreSupervisor, wrapped
from firmware_py.wire.crtp import Correction

Task = Generator[int, None, None]

POWER_PERIOD = 100  # original firmware
DATA_TIMEOUT = 1  # tick edges without a sample after which the stabilizer runs without the IMU


def sensors_task(
    kernel: Kernel,
    cost: CpuConfig,
    board: Board,
    imu_ready: Semaphore,
    data_ready: Semaphore,
    core: CoreBlocks,
    zero_found: Callable[[], None],
) -> Task:
    """Read the IMU whenever it has data."""
    cost_us, gyro = cost.sensors_us, core.data.fields.gyro.data
    while True:
        yield from imu_ready.take()
        yield from kernel.work(cost_us)
        gyro[0], gyro[1], gyro[2] = board.read_imu()[:3]
        if core.run.call("take_sample"):
            zero_found()
            yield from kernel.yield_if_pending()
        yield from data_ready.give_nowait()


def stabilizer_task(  # noqa: PLR0913 - what a task uses is wired once
    kernel: Kernel,
    cost: CpuConfig,
    board: Board,
    data_ready: Semaphore,
    estimator_run: Semaphore,
    supervisor: CoreSupervisor,
    core: CoreBlocks,
    costs: CoreCosts,
    pilot: Pilot,
) -> Task:
    """Run at 1 kHz on the tick edge after each IMU sample; control at 100 Hz."""
    cost_us, tick = cost.stabilizer_us, core.data.cell("tick")
    while True:
        if (yield from data_ready.take(DATA_TIMEOUT)):
            yield from kernel.delay_until(kernel.tick_count + 1)
        core.watchdog_fed_us = kernel.now_us
        if cost_us:
            yield from kernel.work(cost_us)
        tick[0] = kernel.tick_count
        control_runs = core.run.call("begin_step")
        yield from estimator_run.give_nowait()
        if control_runs:
            yield from kernel.work(costs.control_us())
            pilot.step(kernel.now_us)
            supervisor.update(kernel.now_us)
            yield from kernel.yield_if_pending()
            core.run.call("control")
            board.write_compare(core.control.fields.count.tolist())


def estimator_task(  # noqa: PLR0913 - what a task uses is wired once
    kernel: Kernel,
    cost: CpuConfig,
    estimator_run: Semaphore,
    measurements: Queue[Arrived],
    core: CoreBlocks,
    costs: CoreCosts,
    pose_refused: Callable[[int, Correction], None],
    pose_gated: Callable[[], None],
) -> Task:
    """Take poses at 1 kHz, estimate at 100 Hz."""
    cost_us, estimate_due = cost.kalman_us, core.sampling.cell("estimate_due")
    gated = core.estimator.cell("refused")
    while True:
        yield from estimator_run.take()
        if cost_us:
            yield from kernel.work(cost_us)
        while (arrived := measurements.receive_nowait()) is not None:
            if (answer := hand_pose_to_core(kernel, core, *arrived)) != POSE_ON_TIME:
                pose_refused(answer, arrived[1])
                yield from kernel.yield_if_pending()
        if estimate_due[0]:
            yield from kernel.work(costs.estimate_us())
            before = gated[0]
            core.run.call("estimate")
            if gated[0] != before:
                pose_gated()
                yield from kernel.yield_if_pending()


def power_task(kernel: Kernel, board: Board, core: CoreBlocks) -> Task:
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
