"""A task and what can be done to it: notify, suspend, resume, change its priority.

A task's function returns a generator. It gives up the processor by yielding 0 and consumes n microseconds of it by
yielding n; tasks never do this themselves but through `yield from` a kernel call.
"""

from collections.abc import Generator, Iterable

from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.memory import MAX_PRIORITIES, SWITCH, TASKS
from firmware_py.rtos.tables import Cell, Entry, Tables


class Task(Entry):
    """One task; made by `Kernel.create_task`."""

    priority = Cell("priority")  # the effective one, after inheritance
    notification = Cell("notification")
    deadline_misses = Cell("limit_misses")

    def __init__(self, kernel: Tables, name: str, priority: int) -> None:
        _check_priority(name, priority)
        index = len(kernel.names)
        if index >= TASKS:
            raise KernelError(f"task {name}: there are {TASKS - 1} tasks, which is the most")
        kernel.names.append(name)
        super().__init__(kernel, index, name)

    def notify(self) -> Generator[int, None, bool]:
        """Add one to this task's notification value and wake it if it waits for that; always True."""
        answer = self.kernel.calls.notify(self.index)
        if answer == SWITCH:
            yield 0
        self.kernel.done(answer)
        return True

    def notify_from_isr(self) -> None:
        """Like `notify`, from an interrupt."""
        self.kernel.done(self.kernel.calls.notify_from_isr(self.index), f"task {self.name}: notify_from_isr")

    def suspend(self) -> Iterable[int]:
        """Stop this task until `resume`, whatever it is doing or waiting for."""
        return self.kernel.outcome(self.kernel.calls.suspend_task(self.index))

    def resume(self) -> Iterable[int]:
        """Resume a suspended task; a task that waits, and is not suspended, keeps waiting.

        As in V10.4.1 a task that waits for a notification without timeout counts as suspended.
        """
        return self.kernel.outcome(self.kernel.calls.resume_task(self.index))

    def priority_set(self, priority: int) -> Iterable[int]:
        """Change the base priority; an inherited priority stays until the mutex is given."""
        _check_priority(self.name, priority)
        return self.kernel.outcome(self.kernel.calls.set_priority(self.index, priority))


def _check_priority(name: str, priority: int) -> None:
    if not 0 <= priority < MAX_PRIORITIES:
        raise KernelError(f"task {name}: priority {priority} is outside 0..{MAX_PRIORITIES - 1}")
