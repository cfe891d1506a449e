"""A task and what can be done to it: notify, suspend, resume, change its priority.

A task's function returns a generator. It gives up the processor by yielding 0 and consumes n microseconds of it by
yielding n; tasks never do this themselves but through `yield from` a kernel call.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from typing import TYPE_CHECKING, Any

from firmware_py.rtos.errors import KernelError

if TYPE_CHECKING:
    from firmware_py.rtos.scheduler import Scheduler

SWITCH = (0,)  # what a call returns for `yield from` when the processor may go to another task
GO_ON: tuple[int, ...] = ()  # ... and when the caller just continues

# Which list holds the task. A wait without timeout is a suspension, as in FreeRTOS.
READY, DELAYED, SUSPENDED, DELETED = range(4)

FOREVER = -1  # a timeout that never ends, FreeRTOS's portMAX_DELAY; any other timeout is a number of ticks


NO_DEADLINE_US = 1 << 62


class Task:
    """One task; made by `Kernel.create_task`. Its fields, but for the name and the priorities, belong to the kernel."""

    __slots__ = (
        "_notification",
        "_notify_waiting",
        "activations",
        "base_priority",
        "deadline_misses",
        "deadline_us",
        "event_priority",
        "fresh",
        "kernel",
        "latencies",
        "mutexes_held",
        "name",
        "place",
        "priority",
        "ready_bit",
        "released_us",
        "ring",
        "step",
        "waiting_in",
        "work_left_us",
        "work_us",
        "worst_response_us",
    )

    def __init__(self, kernel: Scheduler, name: str, priority: int, body: Generator[int, None, Any]) -> None:
        if not isinstance(body, Generator):
            raise KernelError(f"task {name}: its function returned {type(body).__name__}, not a generator")
        if priority < 0:
            raise KernelError(f"task {name}: priority {priority} is negative")
        self.kernel = kernel
        self.name = name
        self.step = body.send
        self.set_priority(priority)
        self.base_priority = priority
        self.event_priority = priority  # orders the waiters; a change does not move a task that waits already
        self.mutexes_held = 0
        self.place = SUSPENDED
        self.waiting_in: list[Task] | None = None  # the waiters' list of a queue, or the pending-ready list
        self.work_left_us = 0  # what is left of the current `work`
        self.work_us = 0  # all work so far, with what is left of the current one
        # How it keeps up. An activation lasts from the instant at which the task becomes ready after a wait to its next
        # wait; its response time is that duration, its start latency the part before it first runs.
        self.released_us = kernel.now_us
        self.fresh = True  # released, and has not run since
        self.activations = 0
        self.worst_response_us = 0
        self.deadline_us = NO_DEADLINE_US
        self.deadline_misses = 0
        self.latencies: dict[
            int, int
        ] = {}  # number of activations by start latency, without those that ran at once
        self._notification = 0
        self._notify_waiting = False

    def notify(self) -> Generator[int, None, bool]:
        """Adds one to this task's notification value and wakes it if it waits for that; always True."""
        kernel = self.kernel
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "NOTIFY", self.name, 0, 2)
        kernel.spin()
        self._notification += 1
        if self._notify_waiting:
            self._notify_waiting = False
            kernel.unblock(self)
            if self.priority > kernel.current.priority and kernel.preemption:
                yield 0
        return True

    def notify_from_isr(self) -> None:
        """Like `notify`, from an interrupt."""
        kernel = self.kernel
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "NOTIFY_ISR", self.name, 0, 0)
        self._notification += 1
        woken = False
        if self._notify_waiting:
            self._notify_waiting = False
            woken = kernel.wake(self)
        kernel.interrupted(woken)

    def take_notification(self, clear: bool, timeout: int) -> Generator[int, None, int]:
        """See `Kernel.notify_take`; `self` is the running task."""
        kernel = self.kernel
        if self._notification == 0 and timeout != 0:
            self._notify_waiting = True
            kernel.block(None, FOREVER if timeout < 0 else kernel.tick_count + timeout)
            if kernel.trace is not None:
                kernel.trace(kernel.now_us, "NTAKE_BLOCK", self.name, 0, 0)
            yield 0
        elif self._notification == 0:
            kernel.spin()
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "NTAKE", self.name, 0, 0)
        value = self._notification
        if value:
            self._notification = 0 if clear else value - 1
        self._notify_waiting = False
        return value

    def suspend(self) -> Iterable[int]:
        """Stops this task until `resume`, whatever it is doing or waiting for."""
        kernel = self.kernel
        if self is kernel.current:
            kernel.check_may_wait()
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "SUSPEND", self.name, 0, 0)
        kernel.unlink(self)
        if self.waiting_in is not None:
            self.waiting_in.remove(self)
            self.waiting_in = None
        self.place = SUSPENDED
        self._notify_waiting = False
        return SWITCH if self is kernel.current else GO_ON

    def resume(self) -> Iterable[int]:
        """Lets a suspended task go on; a task that waits, and is not suspended, keeps waiting.

        As in V10.4.1 a task that waits for a notification without timeout counts as suspended.
        """
        kernel = self.kernel
        if self.place != SUSPENDED or self.waiting_in is not None:
            return GO_ON
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "RESUME", self.name, 0, 0)
        kernel.unblock(self)
        return kernel.switch_if(self.priority >= kernel.current.priority)

    def priority_set(self, priority: int) -> Iterable[int]:
        """Changes the base priority; an inherited priority stays until the mutex is given."""
        kernel = self.kernel
        if priority < 0:
            raise KernelError(f"task {self.name}: priority {priority} is negative")
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "PRIO_SET", self.name, priority, 0)
        old = self.base_priority
        if priority == old:
            return GO_ON
        own = self is kernel.current
        outranked = priority < old if own else priority > old and priority >= kernel.current.priority
        self.base_priority = priority
        self.event_priority = priority
        self.change_priority(priority if self.priority == old else self.priority)
        return kernel.switch_if(outranked)

    def change_priority(self, priority: int) -> None:
        """Moves the task to `priority`, behind the others there when it is ready."""
        ready = self.place == READY
        if ready:
            self.kernel.unlink(self)
        self.set_priority(priority)
        if ready:
            self.kernel.make_ready(self)

    def set_priority(self, priority: int) -> None:
        """Sets the effective priority, the one after inheritance, of a task that is in no ready ring."""
        self.priority = priority
        self.ring = self.kernel.ring(priority)
        self.ready_bit = 1 << priority
