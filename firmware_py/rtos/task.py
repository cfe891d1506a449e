"""A task and what can be done to it: notify, suspend, resume, change its priority.

A task's function returns a generator. It gives up the processor by yielding 0 and consumes n microseconds of it by
yielding n; tasks never do this themselves but through `yield from` a kernel call.
"""

from collections.abc import Generator, Iterable

from firmware_py.rtos.control_block import SUSPENDED, ControlBlock
from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.scheduler import GO_ON, IN_TASK, MAX_PRIORITIES, SWITCH, Scheduler


class Task(ControlBlock):
    """One task; made by `Kernel.create_task`."""

    def __init__(
        self, kernel: Scheduler, name: str, priority: int, body: Generator[int, None, object]
    ) -> None:
        if not isinstance(body, Generator):
            raise KernelError(f"task {name}: its function returned {type(body).__name__}, not a generator")
        _check_priority(name, priority)
        super().__init__(name, priority, body, kernel.rings[priority], kernel.now_us)
        self.kernel = kernel

    def notify(self) -> Generator[int, None, bool]:
        """Add one to this task's notification value and wake it if it waits for that; always True."""
        kernel = self.kernel
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "NOTIFY", self.name, 0, 2)
        kernel.count_call()
        self.notification += 1
        if self.notify_waiting:
            self.notify_waiting = False
            kernel.unblock(self)
            if self.priority > kernel.current.priority and kernel.preemption:
                yield 0
        return True

    def notify_from_isr(self) -> None:
        """Like `notify`, from an interrupt."""
        kernel = self.kernel
        if kernel.context == IN_TASK:
            raise kernel.misplaced(f"task {self.name}: notify_from_isr")
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "NOTIFY_ISR", self.name, 0, 0)
        self.notification += 1
        woken = False
        if self.notify_waiting:
            self.notify_waiting = False
            woken = kernel.wake(self)
        kernel.interrupted(woken)

    def suspend(self) -> Iterable[int]:
        """Stop this task until `resume`, whatever it is doing or waiting for."""
        kernel = self.kernel
        if self is kernel.current:
            kernel.check_may_wait()
        kernel.count_call()
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "SUSPEND", self.name, 0, 0)
        kernel.unlink(self)
        if self.waiting_in is not None:
            self.waiting_in.remove(self)
            self.waiting_in = None
        self.place = SUSPENDED
        self.notify_waiting = False
        return SWITCH if self is kernel.current else GO_ON

    def resume(self) -> Iterable[int]:
        """Resume a suspended task; a task that waits, and is not suspended, keeps waiting.

        As in V10.4.1 a task that waits for a notification without timeout counts as suspended.
        """
        kernel = self.kernel
        kernel.count_call()
        if self.place != SUSPENDED or self.waiting_in is not None:
            return GO_ON
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "RESUME", self.name, 0, 0)
        kernel.unblock(self)
        return kernel.switch_if(self.priority >= kernel.current.priority)

    def priority_set(self, priority: int) -> Iterable[int]:
        """Change the base priority; an inherited priority stays until the mutex is given."""
        _check_priority(self.name, priority)
        kernel = self.kernel
        kernel.count_call()
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "PRIO_SET", self.name, priority, 0)
        old = self.base_priority
        if priority == old:
            return GO_ON
        own = self is kernel.current
        outranked = priority < old if own else priority > old and priority >= kernel.current.priority
        self.base_priority = priority
        self.event_priority = priority
        kernel.change_priority(self, priority if self.priority == old else self.priority)
        return kernel.switch_if(outranked)


def _check_priority(name: str, priority: int) -> None:
    if not 0 <= priority < MAX_PRIORITIES:
        raise KernelError(f"task {name}: priority {priority} is outside 0..{MAX_PRIORITIES - 1}")
