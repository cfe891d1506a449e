"""Timing of the tasks: run time, response time, start latency, deadlines.

An activation of a task lasts from the instant at which it becomes ready after a wait to its next wait for anything. Its
response time is that duration, its start latency the part before it first runs. The kernel keeps the counts in the tasks.
"""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

from firmware_py.rtos.control_block import NO_DEADLINE_US, READY
from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.kernel import Kernel
from firmware_py.rtos.task import Task

LATENCY_BOUNDS_US = (1, 10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)  # of the histogram's classes


class ProcessorLoad:
    """The share of the processor's time that tasks use: 0 to 1, between the last two calls that are `least_us` apart."""

    def __init__(self, kernel: Kernel, least_us: int = 1) -> None:
        self._kernel = kernel
        self._least_us = least_us
        self._us = self._work_us = 0  # instant and processor time of the last reading
        self._share = 0.0

    def __call__(self) -> float:
        """Return the share."""
        passed_us = self._kernel.now_us - self._us
        if passed_us >= self._least_us:
            busy = (task for task in self._kernel.tasks if task.name != "IDLE")
            work_us = sum(self._kernel.run_time_us(task) for task in busy)
            self._share = (work_us - self._work_us) / passed_us
            self._us, self._work_us = self._kernel.now_us, work_us
        return self._share


@dataclass(frozen=True, slots=True)
class TaskReport:
    """One task so far. An activation that still lasts counts for the worst response and for the deadline."""

    name: str
    priority: int
    run_time_us: int
    activations: int  # those that have ended
    worst_response_us: int
    worst_latency_us: int
    # (12,) activations by start latency, class i is below LATENCY_BOUNDS_US[i].
    latency_histogram: tuple[int, ...]
    deadline_us: int | None  # of the response time
    deadline_misses: int


class Statistics:
    """Reports on all tasks that exist when it is made."""

    def __init__(self, kernel: Kernel, deadlines_us: Mapping[str, int]) -> None:
        """`deadlines_us` holds the deadlines by name of the task [us]; raises KernelError for an unknown name."""
        names = [task.name for task in kernel.tasks]
        for name in deadlines_us:
            if name not in names:
                raise KernelError(f"deadline of {name!r}: no such task, there are {', '.join(names)}")
        self._kernel = kernel
        self._tasks = list(kernel.tasks)
        for task in self._tasks:
            task.deadline_us = deadlines_us.get(task.name, NO_DEADLINE_US)

    def reports(self) -> list[TaskReport]:
        """Return the tasks in the order of their creation, between two runs."""
        return [self._report(task) for task in self._tasks]

    def _report(self, task: Task) -> TaskReport:
        lasting_us = self._kernel.now_us - task.released_us if task.place == READY else 0
        delayed = [0] * (len(LATENCY_BOUNDS_US) + 1)
        for latency_us, count in task.latencies.items():
            delayed[bisect_right(LATENCY_BOUNDS_US, latency_us)] += count
        started = task.activations + (task.place == READY and not task.fresh)
        delayed[0] += started - sum(delayed)
        return TaskReport(
            name=task.name,
            priority=task.base_priority,
            run_time_us=self._kernel.run_time_us(task),
            activations=task.activations,
            worst_response_us=max(task.worst_response_us, lasting_us),
            worst_latency_us=max(task.latencies, default=0),
            latency_histogram=tuple(delayed),
            deadline_us=None if task.deadline_us == NO_DEADLINE_US else task.deadline_us,
            deadline_misses=task.deadline_misses + (lasting_us > task.deadline_us),
        )
