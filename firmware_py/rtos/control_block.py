"""The control block of a task: the scheduler's data about it."""

from collections.abc import Generator
from typing import Any, Final

# Which list holds the task. A wait without timeout is a suspension, as in FreeRTOS.
READY: Final = 0
DELAYED: Final = 1
SUSPENDED: Final = 2
DELETED: Final = 3

NO_DEADLINE_US: Final = 1 << 62


class ControlBlock:
    """One task. Its fields, but for the name and the priorities, belong to the kernel."""

    def __init__(
        self, name: str, priority: int, body: Generator[int, None, object], ring: list[Any], now_us: int
    ) -> None:
        self.name = name
        self.step = body.send
        self.priority = priority  # the effective one, after inheritance
        self.ring = ring  # of all ready tasks of that priority
        self.ready_bit = 1 << priority
        self.base_priority = priority
        # Orders the waiters; a change does not move a task that is waiting already.
        self.event_priority = priority
        self.mutexes_held = 0
        self.place = SUSPENDED
        self.waiting_in: list[ControlBlock] | None = None  # waiters of a queue, or the pending-ready list
        self.notification = 0
        self.notify_waiting = False  # it waits for a notification, or has not run since that wait ended
        self.work_left_us = 0  # rest of the current `work`
        self.work_us = 0  # all work so far, the rest of the current one included
        # Timing. An activation lasts from the instant at which the task becomes ready after a wait to its next
        # wait; its response time is that duration, its start latency the part before it first runs.
        self.released_us = now_us
        self.fresh = True  # released, and has not run since
        self.activations = 0
        self.worst_response_us = 0
        self.deadline_us = NO_DEADLINE_US
        self.deadline_misses = 0
        # Number of activations by start latency [us], without those that ran at once.
        self.latencies: dict[int, int] = {}
