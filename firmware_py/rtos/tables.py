"""The kernel's memory as Python sees it: its calls, their answers and errors, and the trace."""

from collections.abc import Callable, Iterable
from functools import partial
from types import SimpleNamespace
from typing import Final

from firmware_py.compiling import Functions, Memory, bound_together
from firmware_py.rtos import calls, mutexes, queues, ready, scheduler
from firmware_py.rtos.errors import KernelError, StuckTaskError, TaskError
from firmware_py.rtos.memory import (
    DELAYED,
    DONE,
    ENDED_SUSPENDED,
    EVENTS,
    FOR_INTERRUPTS,
    IN_INTERRUPT,
    ISR,
    ITEMS,
    LATE,
    MAY_NOT_WAIT,
    NOT_SUSPENDED,
    OBJECTS,
    STUCK,
    STUCK_CALLS,
    STUCK_SWITCHES,
    TICK_US,
    TRACE_FULL,
    WAITS_IN_INTERRUPT,
    KernelMemory,
)

GIVE_UP: Final = (0,)  # what a call returns for `yield from` when the processor may go to another task
GO_ON: Final[tuple[int, ...]] = ()  # ... and when the caller just continues

# Instant [us], event, who, and two numbers that depend on the event; as in tests/vectors/README.md, without CALL and RET.
Trace = Callable[[int, str, str, int, int], None]

_CALLS: tuple[Callable[..., int | None], ...] = (
    scheduler.boot, scheduler.add_task, scheduler.start, scheduler.begin, scheduler.resume,
    scheduler.end_task, ready.leave_tasks, ready.counted, ready.block, queues.add_object, queues.send,
    queues.send_from_isr, queues.receive, queues.reset, queues.wait_for_item, mutexes.take_mutex, mutexes.give_mutex,
    mutexes.give_mutex_from_isr, calls.notify, calls.notify_from_isr, calls.await_notification, calls.take_notification,
    calls.work, calls.pending, calls.delay, calls.delay_until, calls.suspend_task, calls.resume_task, calls.set_priority,
    calls.suspend_all, calls.resume_all,
)  # fmt: skip


class Tables:
    """The memory of a kernel and the calls on it.

    `names` are those of the tasks and `numbers` those of the objects in the trace, both by their index.
    """

    def __init__(self, preemption: bool, trace: Trace | None) -> None:
        self.tables = block = KernelMemory.allocate()
        self.memory = block.fields
        bound = bound_together(_CALLS, block)
        self._untraced = {call.__name__: one for call, one in zip(_CALLS, bound, strict=True)}
        self.calls = SimpleNamespace(**self._untraced)
        self.names = ["main"]
        self.numbers: list[int] = []
        self._now, self._run_end, self._until, self._wake = (
            block.cell(name) for name in ("now_us", "end_us", "until_us", "next_wake_us")
        )
        self._interrupts_off = block.cell("interrupts_off")
        self._tick, self._suspended, self._current = (
            block.cell(name) for name in ("tick_count", "suspended", "current")
        )
        self.calls.boot(preemption)
        self.trace: Trace | None = None
        self.set_trace(trace)

    @property
    def now_us(self) -> int:
        """The present instant."""
        return self._now[0]

    @property
    def tick_count(self) -> int:
        """The ticks so far, up to date while tasks run."""
        return self._tick[0]

    @property
    def suspended(self) -> int:
        """How many calls of `suspend_all` wait for their `resume_all`."""
        return self._suspended[0]

    @property
    def running(self) -> str:
        """The name of the task that has the processor."""
        return self.names[self._current[0]]

    @property
    def task_woken(self) -> bool:
        """Whether the latest call from an interrupt woke a task above the running one."""
        return bool(self.memory.task_woken)

    def add_object(self, what: str, length: int, count: int) -> int:
        """Return the index of a new object."""
        if len(self.numbers) >= OBJECTS:
            raise KernelError(f"{what}: there are {OBJECTS} queues and semaphores, which is the most")
        self.numbers.append(0)
        return int(self.calls.add_object(length, count))

    def set_trace(self, trace: Trace | None) -> None:
        """Begin or end tracing, between two runs; the tasks are not affected."""
        self.trace = trace
        self.memory.tracing = int(trace is not None)
        made = (
            self._untraced
            if trace is None
            else {name: self._traced(one) for name, one in self._untraced.items()}
        )
        vars(self.calls).update(made)

    def run_by(self, functions: Functions, *memory: Memory) -> bool:
        """Replace calls by kernels of the same names that take the steps of some tasks themselves; return whether they do.

        They do not where Python flies: it steps the generators of all tasks.
        """
        made = bound_together(functions, self.tables, *memory)
        if any(isinstance(one, partial) for one in made):
            return False
        self._untraced |= {one.__name__: call for one, call in zip(functions, made, strict=True)}
        self._kept = memory
        self.set_trace(self.trace)
        return True

    def count_call(self) -> None:
        """Count a call that returns at once."""
        self.done(self.calls.counted(DONE))

    def done(self, answer: int, call: str = "this call of the kernel") -> int:
        """Return the answer of a call unless it is an error."""
        if answer < 0:
            raise self.error(answer, call)
        return answer

    def outcome(self, answer: int, call: str = "this call of the kernel") -> Iterable[int]:
        """Return what a plain call returns."""
        if answer < 0:
            raise self.error(answer, call)
        return GIVE_UP if answer > DONE else GO_ON

    def error(self, answer: int, call: str = "this call of the kernel") -> KernelError:
        """Return the error for an answer below 0."""
        task, now_us = self.running, self.now_us
        if answer == STUCK and self.memory.context != IN_INTERRUPT:
            return StuckTaskError(task, now_us, f"{STUCK_CALLS} calls of the kernel at one instant")
        if answer == STUCK_SWITCHES:
            return StuckTaskError(task, now_us, f"{STUCK_CALLS} switches at one instant")
        if answer == LATE:
            late = self.names[self.memory.next[ITEMS + DELAYED]]
            what = f"waits for {self._wake[0] / TICK_US:.3f} ms, which has passed"
            return StuckTaskError(late, now_us, what)
        if answer == ENDED_SUSPENDED:
            return TaskError(task, now_us, "ended while the scheduler was suspended")
        if answer == MAY_NOT_WAIT:
            return KernelError(f"task {task} must not wait while the scheduler is suspended")
        if answer == NOT_SUSPENDED:
            return KernelError("resume_all without suspend_all")
        if answer == FOR_INTERRUPTS:
            return KernelError(f"{call} is for interrupts, and was called by task {task}")
        call = "waiting" if answer == WAITS_IN_INTERRUPT else call
        return KernelError(f"{call} is for tasks, and was called from an interrupt")

    def record(self, event: str, a: int = 0, b: int = 0) -> None:
        """Trace what the running task does."""
        if self.trace is not None:
            self.trace(self.now_us, event, self.running, a, b)

    def _traced(self, call: Callable[..., int]) -> Callable[..., int]:
        def traced(*arguments: int) -> int:
            answer = call(*arguments)
            self._read_trace()
            while answer == TRACE_FULL:
                answer = self._untraced["resume"](-1)
                self._read_trace()
            return answer

        return traced

    def _read_trace(self) -> None:
        memory = self.memory
        rows, memory.rows = memory.rows, 0
        assert self.trace is not None
        for row in range(rows):
            now_us, event, task, a, b = (memory.trace[row, column] for column in range(5))
            name = EVENTS[event]
            number = self.numbers[a] if name.startswith("Q_") else a
            self.trace(now_us, name, "isr" if task == ISR else self.names[task], number, b)


class Entry:
    """What has an index in the tables of a kernel: a task or an object."""

    def __init__(self, kernel: Tables, index: int, name: str) -> None:
        self.kernel = kernel
        self.index = index
        self.name = name


class Cell:
    """The number of an entry in a table."""

    def __init__(self, table: str) -> None:
        self._table = table

    def __get__(self, entry: Entry, kind: type[Entry] | None = None) -> int:
        return int(getattr(entry.kernel.memory, self._table)[entry.index])

    def __set__(self, entry: Entry, number: int) -> None:
        getattr(entry.kernel.memory, self._table)[entry.index] = number
