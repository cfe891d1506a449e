"""Microseconds per task activation of our kernel and of simpy, in the flight's pattern of waking.

Every millisecond an interrupt gives a semaphore to a task of priority 4, which sends a sample to a queue and gives a
semaphore to a task of priority 5, which waits for the next tick and gives a semaphore to a task of priority 2, which
drains the queue: four activations. simpy has no priorities, so its version only wakes the same tasks as often.
"""

from collections.abc import Callable, Generator
from timeit import repeat
from typing import Any

import simpy

from firmware_py.rtos import TICK_US, Kernel, Queue

ACTIVATIONS_PER_TICK = 4
IMU_PHASE_US = 300


def kernel_run(ticks: int) -> int:
    """Run the pattern for `ticks` milliseconds of simulated time; return the number of samples that arrived."""
    kernel = Kernel()
    imu_ready = kernel.create_binary_semaphore("imu_ready")
    sample_ready = kernel.create_binary_semaphore("sample_ready")
    run_estimator = kernel.create_binary_semaphore("run_estimator")
    samples: Queue[int] = kernel.create_queue(20, "samples")
    arrived = 0

    def sensors() -> Generator[int, None, None]:
        while True:
            yield from imu_ready.take()
            yield from samples.send(1, 0)
            yield from sample_ready.give()

    def stabilizer() -> Generator[int, None, None]:
        while True:
            yield from sample_ready.take()
            yield from kernel.delay_until(kernel.tick_count + 1)
            yield from run_estimator.give()

    def estimator() -> Generator[int, None, None]:
        nonlocal arrived
        while True:
            yield from run_estimator.take()
            while (sample := samples.receive_nowait()) is not None:
                arrived += sample

    kernel.create_task("STABILIZER", 5, stabilizer)
    kernel.create_task("SENSORS", 4, sensors)
    kernel.create_task("ESTIMATOR", 2, estimator)
    kernel.start()
    kernel.run(0)
    imu_us = IMU_PHASE_US
    while imu_us < ticks * TICK_US:  # the harness's loop, with the IMU as the only hardware
        wake_us = kernel.next_wake_us
        now_us = imu_us if wake_us is None or imu_us < wake_us else wake_us
        if now_us == imu_us:
            imu_ready.give_from_isr()
            imu_us += TICK_US
        kernel.run(now_us)
    return arrived


def simpy_run(ticks: int) -> int:
    """Run the same pattern with simpy's stores and timeouts."""
    environment = simpy.Environment()
    imu_ready = simpy.Store(environment)
    sample_ready = simpy.Store(environment)
    run_estimator = simpy.Store(environment)
    samples = simpy.Store(environment, capacity=20)
    arrived = 0

    def imu() -> Generator[Any, Any, None]:
        yield environment.timeout(IMU_PHASE_US)
        while True:
            yield imu_ready.put(1)
            yield environment.timeout(TICK_US)

    def sensors() -> Generator[Any, Any, None]:
        while True:
            yield imu_ready.get()
            yield samples.put(1)
            yield sample_ready.put(1)

    def stabilizer() -> Generator[Any, Any, None]:
        while True:
            yield sample_ready.get()
            yield environment.timeout(TICK_US - environment.now % TICK_US)
            yield run_estimator.put(1)

    def estimator() -> Generator[Any, Any, None]:
        nonlocal arrived
        while True:
            yield run_estimator.get()
            while samples.items:
                arrived += yield samples.get()

    for process in (imu, sensors, stabilizer, estimator):
        environment.process(process())
    environment.run(until=ticks * TICK_US)
    return arrived


def us_per_activation(run: Callable[[int], int], ticks: int = 20_000) -> float:
    """Return the best of three runs [us]."""
    return min(repeat(lambda: run(ticks), number=1, repeat=3)) * 1e6 / (ticks * ACTIVATIONS_PER_TICK)
