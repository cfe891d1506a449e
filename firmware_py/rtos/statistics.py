"""Timing of the tasks: run time, response time, start latency, deadlines.

An activation of a task lasts from the instant at which it becomes ready after a wait to its next wait for anything. Its
response time is that duration, its start latency the part before it first runs. The kernel keeps the counts in the tasks.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.kernel import Kernel
from firmware_py.rtos.memory import LATENCY_BOUNDS_US, LATENCY_CLASSES, MAX_PRIORITIES, NEVER_US
from firmware_py.rtos.task import Task

__all__ = ["LATENCY_BOUNDS_US", "ProcessorLoad", "Statistics", "TaskReport"]


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
            kernel.memory.response_limit_us[task.index] = deadlines_us.get(task.name, NEVER_US)

    def reports(self) -> list[TaskReport]:
        """Return the tasks in the order of their creation, between two runs."""
        return [self._report(task) for task in self._tasks]

    def _report(self, task: Task) -> TaskReport:
        memory, index = self._kernel.memory, task.index
        ready = 0 <= memory.place[index] < MAX_PRIORITIES
        lasting_us = self._kernel.now_us - int(memory.released_us[index]) if ready else 0
        activations, deadline_us = int(memory.activations[index]), int(memory.response_limit_us[index])
        late = [int(memory.late[index, interval]) for interval in range(LATENCY_CLASSES)]
        late[0] += activations + (ready and not memory.fresh[index]) - sum(late)
        return TaskReport(
            name=task.name,
            priority=int(memory.base_priority[index]),
            run_time_us=self._kernel.run_time_us(task),
            activations=activations,
            worst_response_us=max(int(memory.worst_response_us[index]), lasting_us),
            worst_latency_us=int(memory.worst_latency_us[index]),
            latency_histogram=tuple(late),
            deadline_us=None if deadline_us == NEVER_US else deadline_us,
            deadline_misses=int(memory.limit_misses[index]) + (lasting_us > deadline_us),
        )
