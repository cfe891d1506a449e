"""The tasks of the flight path, each reading like its specification. Ticks are 1 ms.

The IMU interrupt wakes SENSORS, which reads it and lets STABILIZER run on the next tick edge; STABILIZER lets the
estimator run, closes the loop in every tenth tick and leaves servo counts in the timers. The estimator works one tick
before the controller, so that a pose reaches the flaps in 1 to 11 ms.
"""

from collections.abc import Callable, Generator

from firmware_py.board import Board
from firmware_py.config import CpuConfig
from firmware_py.core.structs import POSE_ON_TIME
from firmware_py.core.subset import i32
from firmware_py.core_runner import CoreBlocks, CoreCosts
from firmware_py.drivers.imu import GyroZero
from firmware_py.measurements import ACCELEROMETER, GYRO, POSE, Measurement, PoseMeasurement
from firmware_py.rtos import TICK_US, Kernel, Queue, Semaphore
from firmware_py.supervisor import Supervisor

Task = Generator[int, None, None]

TICKS_PER_STEP = 10  # 100 Hz
CONTROL_PHASE = 0  # the controller runs in ticks 0, 10, 20 …
POWER_PERIOD = 100  # original firmware
ESTIMATOR_PHASE = 9  # and the estimator in the ticks before
DATA_TIMEOUT = 1  # tick edges without a sample after which the stabilizer runs without the IMU


def sensors_task(
    kernel: Kernel,
    cost: CpuConfig,
    board: Board,
    imu_ready: Semaphore,
    measurements: Queue[Measurement],
    data_ready: Semaphore,
    zero: GyroZero,
    zero_found: Callable[[], None],
) -> Task:
    """Read the IMU whenever it has data."""
    cost_us = cost.sensors_us
    while True:
        yield from imu_ready.take()
        yield from kernel.work(cost_us)
        counts = board.read_imu()
        if zero.bias is None and zero.add(counts):
            zero_found()
            yield from kernel.yield_if_pending()
        yield from measurements.send_nowait((GYRO, counts))
        yield from measurements.send_nowait((ACCELEROMETER, counts))
        yield from data_ready.give_nowait()


def stabilizer_task(
    kernel: Kernel,
    cost: CpuConfig,
    board: Board,
    data_ready: Semaphore,
    estimator_run: Semaphore,
    supervisor: Supervisor,
    core: CoreBlocks,
    costs: CoreCosts,
) -> Task:
    """Run at 1 kHz on the tick edge after each IMU sample; control at 100 Hz."""
    control_tick = next_step(kernel.tick_count, CONTROL_PHASE)
    while True:
        if (yield from data_ready.take(DATA_TIMEOUT)):
            yield from kernel.delay_until(kernel.tick_count + 1)
        core.watchdog_fed_us = kernel.now_us
        yield from kernel.work(cost.stabilizer_us)
        yield from estimator_run.give_nowait()
        if kernel.tick_count >= control_tick:
            control_tick = next_step(kernel.tick_count, CONTROL_PHASE)
            yield from kernel.work(costs.control_us())
            if core.guard is not None:
                supervisor.logic.see(int(core.guard.controller_faults), int(core.guard.estimator_faults))
            core.data.fields.mode = i32(supervisor.mode(kernel.now_us))
            yield from kernel.yield_if_pending()
            core.run.control()
            board.write_compare(core.control.fields.count.tolist())


def estimator_task(
    kernel: Kernel,
    cost: CpuConfig,
    estimator_run: Semaphore,
    measurements: Queue[Measurement],
    supervisor: Supervisor,
    core: CoreBlocks,
    costs: CoreCosts,
) -> Task:
    """Take measurements at 1 kHz, estimate at 100 Hz."""
    data = core.data.fields
    samples = x = y = z = 0
    step_tick = next_step(kernel.tick_count, ESTIMATOR_PHASE)
    while True:
        yield from estimator_run.take()
        yield from kernel.work(cost.kalman_us)
        while (measurement := measurements.receive_nowait()) is not None:
            if measurement[0] == GYRO:
                counts = measurement[1]
                samples += 1
                x += counts[0]
                y += counts[1]
                z += counts[2]
            elif measurement[0] == POSE:
                hand_pose_to_core(kernel, measurement[1], supervisor, core)
        if kernel.tick_count >= step_tick:
            step_tick = next_step(kernel.tick_count, ESTIMATOR_PHASE)
            data.gyro_sum[:] = x, y, z
            data.gyro_samples = i32(samples)
            samples = x = y = z = 0
            yield from kernel.work(costs.estimate_us())
            core.run.estimate()


def power_task(kernel: Kernel, board: Board, supervisor: Supervisor) -> Task:
    """Measure the supply voltage at 10 Hz."""
    wake_tick = kernel.tick_count
    while True:
        supervisor.see_battery(kernel.now_us, board.read_battery_mv())
        wake_tick += POWER_PERIOD
        yield from kernel.delay_until(wake_tick)


def next_step(tick: int, phase: int) -> int:
    """Return the first tick of a phase after `tick`: a step that is late does not move the next one."""
    return tick + 1 + (phase - tick - 1) % TICKS_PER_STEP


def hand_pose_to_core(
    kernel: Kernel, measurement: PoseMeasurement, supervisor: Supervisor, core: CoreBlocks
) -> None:
    """Hand a pose to the core with the age that it will have at the estimator's next step."""
    data = core.data.fields
    message = measurement.message
    data.pose_position[:] = message.p_GB
    data.pose_quaternion[:] = message.q_GB
    if message.age_us is None:
        data.pose_age_us = i32(-1)
    else:
        ticks_to_step = (ESTIMATOR_PHASE - kernel.tick_count) % TICKS_PER_STEP
        waited_us = kernel.now_us - measurement.t_us
        data.pose_age_us = i32(waited_us + message.age_us + ticks_to_step * TICK_US)
    if core.run.file_pose() == POSE_ON_TIME:
        supervisor.last_pose_us = measurement.t_us
