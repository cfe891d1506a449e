"""The run that steps the tasks' generators.

Time is integer microseconds and comes from outside: `run(now_us)` brings the processor to that instant. Raise the
interrupts of an instant first, then `run` it.
"""

from collections.abc import Callable
from typing import Any

from firmware_py.rtos.errors import KernelError, TaskError
from firmware_py.rtos.memory import NEVER_US, NO_LIST
from firmware_py.rtos.tables import Tables, Trace
from firmware_py.rtos.task import Task


class Processor(Tables):
    """What steps the tasks and answers their calls; `Kernel` adds what tasks call.

    `run`, `advance` and `next_wake_us` are for the harness, everything else for this package.
    """

    def __init__(self, preemption: bool, trace: Trace | None) -> None:
        super().__init__(preemption, trace)
        self.tasks: list[Task] = []
        self._steps: list[Callable[[], int]] = [int]  # of the tasks' generators, by index
        self._started = False

    @property
    def next_wake_us(self) -> int | None:
        """The next instant at which anything happens without a new interrupt, None when nothing ever will."""
        wake_us: int = self._wake[0]
        return None if wake_us == NEVER_US else wake_us

    @property
    def interrupts_off(self) -> bool:
        """Whether a task has blocked interrupts."""
        return bool(self._interrupts_off[0])

    @property
    def current(self) -> Task:
        """The task that has the processor, after the start."""
        return self.tasks[self._current[0] - 1]

    def run(self, now_us: int, until_us: int = 0) -> None:
        """Do all that is due up to and including `now_us`, until every task waits or works.

        Then it goes on by itself up to and including `until_us`, where that is later. Hardware that a task starts may
        `stop_before` an instant meanwhile: then the run ends there.
        """
        if not self._started:
            raise KernelError("run before start")
        if now_us < self._now[0]:
            raise KernelError(f"time runs backwards: from {self._now[0]} us to {now_us} us")
        steps, resume = self._steps, self.calls.resume
        yielded: Any = 0
        try:
            task = self.calls.begin(now_us, until_us)
            while task > 0:
                try:
                    yielded = steps[task]()
                except StopIteration:
                    yielded = self._end()
                task = resume(yielded)
            if task < 0:
                raise self.error(task)
        except TaskError:
            self.calls.leave_tasks()
            raise
        except Exception as error:
            self.calls.leave_tasks()
            what = f"{type(error).__name__}: {error}"
            if not isinstance(yielded, int):
                what = f"yielded a {type(yielded).__name__}; kernel calls need `yield from`"
            raise TaskError(self.running, self.now_us, what) from error

    def stop_before(self, now_us: int) -> None:
        """End the present run just before an instant at which hardware acts first."""
        if now_us <= self._run_end[0]:
            self._run_end[0] = now_us - 1
        if now_us <= self._until[0]:
            self._until[0] = now_us - 1

    def advance(self, now_us: int) -> None:
        """Set the clock before the interrupts of `now_us` are raised, so that they are recorded at the right time.

        Without it their traces and the tasks' response times are too early. Nothing may be due before `now_us`.
        """
        if not self._now[0] <= now_us <= self._wake[0]:
            raise KernelError(f"advance({now_us}): outside {self._now[0]}..{self.next_wake_us}")
        self._now[0] = now_us

    def block(self, waiters: int | None, wake_tick: int) -> None:
        """Let the running task wait in a list, if there is one, until it is woken or, unless negative, `wake_tick` comes."""
        self.done(self.calls.block(NO_LIST if waiters is None else waiters, wake_tick))

    def _end(self) -> int:
        """Delete the running task, whose function has returned; give up the processor for it."""
        self.done(self.calls.end_task())
        return 0
