"""How the tasks kept up: run time, response time, start latency, deadlines.

An activation of a task lasts from the instant at which it becomes ready after a wait to its next wait for anything. Its
response time is that duration, its start latency the part before it first runs. Without statistics the kernel pays for
none of this.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass

from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.kernel import Kernel
from firmware_py.rtos.task import READY

LATENCY_BOUNDS_US = (1, 10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000)  # of the histogram's classes


@dataclass(frozen=True, slots=True)
class TaskReport:
    """One task so far. An activation that still lasts counts for the worst response and for the deadline."""

    name: str
    priority: int
    run_time_us: int
    activations: int  # those that are over
    worst_response_us: int
    worst_latency_us: int
    latency_histogram: tuple[
        int, ...
    ]  # (12,) activations by start latency, class i is below LATENCY_BOUNDS_US[i]
    deadline_us: int | None  # of the response time
    deadline_misses: int


class TaskStatistics:
    """What the kernel tells about one task: `released`, `started`, `finished`, over and over."""

    __slots__ = (
        "_released_us",
        "_started",
        "activations",
        "deadline_misses",
        "deadline_us",
        "latency_histogram",
        "worst_latency_us",
        "worst_response_us",
    )

    def __init__(self, deadline_us: int | None, now_us: int) -> None:
        self.deadline_us = deadline_us
        self.activations = 0
        self.worst_response_us = 0
        self.worst_latency_us = 0
        self.deadline_misses = 0
        self.latency_histogram = [0] * (len(LATENCY_BOUNDS_US) + 1)
        self._released_us = now_us
        self._started = False

    def released(self, now_us: int) -> None:
        """The task became ready after a wait."""
        self._released_us = now_us
        self._started = False

    def started(self, now_us: int) -> None:
        """The task got the processor, for the first time in this activation or again."""
        if self._started:
            return
        self._started = True
        latency_us = now_us - self._released_us
        if latency_us > self.worst_latency_us:
            self.worst_latency_us = latency_us
        self.latency_histogram[bisect_right(LATENCY_BOUNDS_US, latency_us)] += 1

    def finished(self, now_us: int) -> None:
        """The task waits again."""
        response_us = now_us - self._released_us
        self.activations += 1
        if response_us > self.worst_response_us:
            self.worst_response_us = response_us
        if self.deadline_us is not None and response_us > self.deadline_us:
            self.deadline_misses += 1

    def lasting_us(self, now_us: int) -> int:
        """How long the current activation has lasted, for a task that is ready or running."""
        return now_us - self._released_us


class Statistics:
    """Watches all tasks that exist; make it after the tasks and before `Kernel.start`."""

    def __init__(self, kernel: Kernel, deadlines_us: Mapping[str, int]) -> None:
        """`deadlines_us` holds the deadlines by name of the task [us]; raises KernelError for an unknown name."""
        names = [task.name for task in kernel.tasks]
        for name in deadlines_us:
            if name not in names:
                raise KernelError(f"deadline of {name!r}: no such task, there are {', '.join(names)}")
        self._kernel = kernel
        self._watched = list(kernel.tasks)
        self._statistics = [TaskStatistics(deadlines_us.get(name), kernel.now_us) for name in names]
        for task, statistics in zip(self._watched, self._statistics, strict=True):
            task.watch = statistics
        kernel.observed = True

    def reports(self) -> list[TaskReport]:
        """The tasks in the order of their creation, between two runs."""
        reports = []
        for task, statistics in zip(self._watched, self._statistics, strict=True):
            lasting_us = statistics.lasting_us(self._kernel.now_us) if task.place == READY else 0
            late = statistics.deadline_us is not None and lasting_us > statistics.deadline_us
            reports.append(
                TaskReport(
                    name=task.name,
                    priority=task.base_priority,
                    run_time_us=self._kernel.run_time_us(task),
                    activations=statistics.activations,
                    worst_response_us=max(statistics.worst_response_us, lasting_us),
                    worst_latency_us=statistics.worst_latency_us,
                    latency_histogram=tuple(statistics.latency_histogram),
                    deadline_us=statistics.deadline_us,
                    deadline_misses=statistics.deadline_misses + late,
                )
            )
        return reports

    def load(self) -> float:
        """The share of processor time that the watched tasks consumed since the start, 0 to 1."""
        busy_us = sum(self._kernel.run_time_us(task) for task in self._watched)
        return busy_us / self._kernel.now_us if self._kernel.now_us else 0.0
