"""The calls of tasks, and the creation of everything: tasks, queues, semaphores, mutexes, timers.

Waiting and working calls are used with `yield from`. Times are ticks of 1 ms, except for `work`, which is microseconds.
"""

from collections.abc import Callable, Generator, Iterable
from typing import Any, TypeVarTuple

from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.queue import Queue, T
from firmware_py.rtos.scheduler import GO_ON, MAX_PRIORITIES, SWITCH, TICK_US, Scheduler, Trace
from firmware_py.rtos.semaphore import Mutex, Semaphore
from firmware_py.rtos.task import Task
from firmware_py.rtos.timer import SERVICE_PRIORITY, Callback, Timer, TimerService

Arguments = TypeVarTuple("Arguments")


class Kernel(Scheduler):
    """One processor with its tasks. Create tasks and objects, `start`, then `run` from instant to instant.

    `next_wake_us` is the next instant at which anything happens without a new interrupt, None when nothing ever will.
    """

    def __init__(self, preemption: bool = True, trace: Trace | None = None) -> None:
        super().__init__(preemption, trace)
        self.tasks: list[Task] = []
        self.queues: list[Queue[Any]] = []
        self._timers = TimerService(self)
        self._first: Task | None = None  # the task that `start` runs first
        self._idle_place = 0  # of the idle task among `tasks`

    def create_task(
        self,
        name: str,
        priority: int,
        function: Callable[[*Arguments], Generator[int, None, object]],
        *args: *Arguments,
    ) -> Task:
        """Make a ready task that runs the generator `function(*args)`; higher numbers are more urgent."""
        task = Task(self, name, priority, function(*args))
        self.tasks.append(task)
        self.make_ready(task)
        if self._started:
            self.switch_if(priority > self.current.priority)
        elif self._first is None or priority >= self._first.priority:
            self._first = task
        return task

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

    def _occupied(self, taken_us: Callable[[], int]) -> Generator[int, None, None]:
        wake_tick = self.tick_count
        while True:
            wake_tick += 1
            yield from self.delay_until(wake_tick)
            yield from self.work(taken_us())

    def start(self) -> None:
        """Create the idle and the timer service task; the tasks begin at the first `run`."""
        if self._started:
            raise KernelError("the scheduler was started already")
        self._idle_place = len(self.tasks)
        self._idle = self.create_task("IDLE", 0, self._idle_task)
        self.create_task("Tmr Svc", SERVICE_PRIORITY, self._timers.run)
        assert self._first is not None
        self._started = True
        self.leave_tasks()
        self.current = self._first
        self.next_wake_us = self.now_us
        self.current.fresh = False
        if self.trace is not None:
            self.record("IN", self.current.priority)

    def run_time_us(self, task: Task) -> int:
        """Return the task's processor time so far, between two runs; for the idle task, what all others left."""
        return self.run_times_us()[self.tasks.index(task)]

    def run_times_us(self) -> list[int]:
        """Return the run time of every task, in the order of their creation."""
        current, current_left_us = self.current, self._work_end_us - self.now_us
        times_us = [
            task.work_us - (current_left_us if task is current else task.work_left_us) for task in self.tasks
        ]
        times_us[self._idle_place] = 0
        times_us[self._idle_place] = self.now_us - sum(times_us)
        return times_us

    def work(self, duration_us: int) -> Iterable[int]:
        """Take processor time; others may run in between."""
        if duration_us <= 0:
            self.count_call()
            return GO_ON
        end_us = self.now_us + duration_us
        if end_us >= self._next_tick_us or end_us > self._until_us or self._switch_pending:
            return (duration_us,)
        # Nothing can happen before the work is done: the clock moves, and the task goes on.
        self.current.work_us += duration_us
        self.now_us = end_us
        self._calls = 0
        return GO_ON

    def task_yield(self) -> Iterable[int]:
        """Let the next task of the same priority run."""
        return SWITCH

    def yield_if_pending(self) -> Iterable[int]:
        """Let a task of higher priority run that a plain call woke; use it after callbacks, which cannot yield."""
        return SWITCH if self._switch_pending and not self.suspended else GO_ON

    def delay(self, ticks: int) -> Iterable[int]:
        """Wait until the tick count has risen by `ticks`; 0 is `task_yield`."""
        if ticks > 0:
            if self.suspended:
                self.check_may_wait()
            if self.trace is not None:
                self.record("DELAY", ticks)
            self.block(None, self.tick_count + ticks)
        return SWITCH

    def delay_until(self, wake_tick: int) -> Iterable[int]:
        """Wait until the tick count is `wake_tick`; when that is past it is `task_yield`."""
        if self.suspended:
            self.check_may_wait()
        if wake_tick > self.tick_count:
            if self.trace is not None:
                self.record("DELAY_UNTIL", wake_tick)
            self.block(None, wake_tick)
        return SWITCH

    def notify_take(self, clear: bool, timeout: int) -> Generator[int, None, int]:
        """Wait up to `timeout` ticks for the running task's notification value to be above zero and return it.

        Then set it to zero (`clear`) or lower it by one. 0 means that no notification came.
        """
        task = self.current
        if task.notification or timeout == 0:
            self.count_call()
        else:
            self.check_may_wait()
            task.notify_waiting = True
            self.block(None, self.deadline(timeout))
            if self.trace is not None:
                self.record("NTAKE_BLOCK")
            yield 0
        if self.trace is not None:
            self.record("NTAKE")
        task.notify_waiting = False
        value = task.notification
        if value:
            task.notification = 0 if clear else value - 1
        return value

    def enter_critical(self) -> None:
        """Block task switches and interrupts until `exit_critical`.

        Hardware checks `interrupts_off`. Ticks are caught up afterwards, where a real processor loses all but one.
        """
        self.suspend_all()
        self.interrupts_off = True

    def exit_critical(self) -> Iterable[int]:
        """End `enter_critical`, which must not be nested; pending events happen now."""
        self.interrupts_off = False
        return self.resume_all()

    def suspend_all(self) -> None:
        """Block task switches and defer ticks until as many calls of `resume_all`."""
        self.count_call()
        self.suspended += 1

    def resume_all(self) -> Iterable[int]:
        """End the innermost `suspend_all`; after the outermost, pending events happen now."""
        if self.suspended == 0:
            raise KernelError("resume_all without suspend_all")
        self.suspended -= 1
        if self.suspended:
            return GO_ON
        while self._pending_ready:
            task = self._pending_ready.pop(0)
            task.waiting_in = None
            self.unblock(task)
            self._switch_pending |= task.priority >= self.current.priority
        while (self.tick_count + 1) * TICK_US < self._next_tick_us:
            self._tick(self.tick_count + 1)
        self._switch_pending &= self.preemption
        return SWITCH if self._switch_pending else GO_ON
