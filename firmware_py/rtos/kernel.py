"""The calls of tasks, and the creation of everything: tasks, queues, semaphores, mutexes, timers.

Waiting and working calls are used with `yield from`. Times are ticks of 1 ms, except for `work`, which is microseconds.
"""

from collections.abc import Callable, Generator, Iterable
from typing import Any, TypeVarTuple

from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.memory import DONE, MAX_PRIORITIES
from firmware_py.rtos.processor import Processor
from firmware_py.rtos.queue import Queue, T
from firmware_py.rtos.semaphore import Mutex, Semaphore
from firmware_py.rtos.tables import GIVE_UP, Trace
from firmware_py.rtos.task import Task
from firmware_py.rtos.timer import SERVICE_PRIORITY, Callback, Timer, TimerService

Arguments = TypeVarTuple("Arguments")


class Kernel(Processor):
    """One processor with its tasks. Create tasks and objects, `start`, then `run` from instant to instant."""

    def __init__(self, preemption: bool = True, trace: Trace | None = None) -> None:
        super().__init__(preemption, trace)
        self.queues: list[Queue[Any]] = []
        self._timers = TimerService(self)

    def create_task(
        self,
        name: str,
        priority: int,
        function: Callable[[*Arguments], Generator[int, None, object]],
        *args: *Arguments,
    ) -> Task:
        """Make a ready task that runs the generator `function(*args)`; higher numbers are more urgent."""
        body = function(*args)
        if not isinstance(body, Generator):
            raise KernelError(f"task {name}: its function returned {type(body).__name__}, not a generator")
        return self._add(Task(self, name, priority), priority, body.__next__)

    def occupy(self, name: str, taken_us: Callable[[], int]) -> None:
        """Let something outside take the processor at every tick, before all tasks, for `taken_us()`."""
        self.create_task(name, MAX_PRIORITIES - 1, self._occupied, taken_us)

    def create_queue(self, length: int, name: str) -> Queue[T]:
        """Make an empty queue for at most `length` items."""
        queue: Queue[T] = Queue(self, length, name)
        self.queues.append(queue)
        return queue

    def create_binary_semaphore(self, name: str) -> Semaphore:
        """Make a semaphore of maximum 1 that must be given before it can be taken."""
        return Semaphore(self, 1, 0, name)

    def create_counting_semaphore(self, maximum: int, initial: int, name: str) -> Semaphore:
        """Make a semaphore that counts from `initial` up to `maximum`."""
        return Semaphore(self, maximum, initial, name)

    def create_mutex(self, name: str) -> Mutex:
        """Make a free mutex."""
        return Mutex(self, name)

    def create_timer(self, name: str, period_ticks: int, autoreload: bool, callback: Callback) -> Timer:
        """Make a dormant timer whose `callback(timer)` runs in the timer service task."""
        return Timer(self._timers, name, period_ticks, autoreload, callback)

    def start(self) -> None:
        """Create the idle and the timer service task; the tasks begin at the first `run`."""
        if self._started:
            raise KernelError("the scheduler was started already")
        self.memory.idle = self._add(Task(self, "IDLE", 0), 0, int).index
        self.create_task("Tmr Svc", SERVICE_PRIORITY, self._timers.run)
        self._started = True
        self.calls.start()

    def run_time_us(self, task: Task) -> int:
        """Return the task's processor time so far, between two runs; for the idle task, what all others left."""
        return self.run_times_us()[self.tasks.index(task)]

    def run_times_us(self) -> list[int]:
        """Return the run time of every task, in the order of their creation."""
        memory, ends = self.memory, len(self.tasks) + 1
        left_us = memory.work_left_us[:ends].tolist()
        left_us[memory.current] = memory.work_end_us - self.now_us
        pairs = zip(memory.work_us[:ends].tolist(), left_us, strict=True)
        times_us = [work - left for work, left in pairs]
        times_us[memory.idle] = 0
        times_us[memory.idle] = self.now_us - sum(times_us)
        return times_us[1:]  # task 0 is none

    def work(self, duration_us: int) -> Iterable[int]:
        """Take processor time; others may run in between."""
        return self.outcome(self.calls.work(duration_us))

    def task_yield(self) -> Iterable[int]:
        """Let the next task of the same priority run."""
        return GIVE_UP

    def yield_if_pending(self) -> Iterable[int]:
        """Let a task of higher priority run that a plain call woke; use it after callbacks, which cannot yield."""
        return self.outcome(self.calls.pending())

    def delay(self, ticks: int) -> Iterable[int]:
        """Wait until the tick count has risen by `ticks`; 0 is `task_yield`."""
        return self.outcome(self.calls.delay(ticks))

    def delay_until(self, wake_tick: int) -> Iterable[int]:
        """Wait until the tick count is `wake_tick`; when that is past it is `task_yield`."""
        return self.outcome(self.calls.delay_until(wake_tick))

    def notify_take(self, clear: bool, timeout: int) -> Generator[int, None, int]:
        """Wait up to `timeout` ticks for the running task's notification value to be above zero and return it.

        Then set it to zero (`clear`) or lower it by one. 0 means that no notification came.
        """
        if self.done(self.calls.await_notification(timeout)) != DONE:
            yield 0
        return int(self.calls.take_notification(clear))

    def enter_critical(self) -> None:
        """Block task switches and interrupts until `exit_critical`.

        Hardware checks `interrupts_off`. Ticks are caught up afterwards, where a real processor loses all but one.
        """
        self.suspend_all()
        self._interrupts_off[0] = 1

    def exit_critical(self) -> Iterable[int]:
        """End `enter_critical`, which must not be nested; pending events happen now."""
        self._interrupts_off[0] = 0
        return self.resume_all()

    def suspend_all(self) -> None:
        """Block task switches and defer ticks until as many calls of `resume_all`."""
        self.done(self.calls.suspend_all())

    def resume_all(self) -> Iterable[int]:
        """End the innermost `suspend_all`; after the outermost, pending events happen now."""
        return self.outcome(self.calls.resume_all())

    def _add(self, task: Task, priority: int, step: Callable[[], int]) -> Task:
        """Make a task ready; the kernel itself takes the steps of the idle task."""
        self.tasks.append(task)
        self._steps.append(step)
        self.calls.add_task(priority)
        return task

    def _occupied(self, taken_us: Callable[[], int]) -> Generator[int, None, None]:
        wake_tick = self.tick_count
        while True:
            wake_tick += 1
            yield from self.delay_until(wake_tick)
            yield from self.work(taken_us())
