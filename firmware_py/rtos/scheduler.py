"""The processor: which task runs, for how long, and when the next thing happens.

Time is integer microseconds and comes from outside: `run(now_us)` brings the processor to that instant. Code between
two kernel calls takes no time and is atomic; work takes time and can be preempted by ticks and interrupts. Hardware
goes first at equal time: raise the interrupts of an instant, then `run` it. Ticks at which nothing can happen cost
nothing, the tick count jumps over them (with a trace every tick is visited, because the trace shows it).

Ready tasks of one priority form a ring, as in FreeRTOS: a list whose last element ran last, with None as a marker that
is skipped. New tasks go in front of the last element, which makes the order equal to FreeRTOS's in every corner.
"""

from bisect import bisect_right
from collections.abc import Callable, Generator, Iterable
from typing import Any, Final

from firmware_py.rtos.control_block import DELAYED, DELETED, READY, SUSPENDED, ControlBlock
from firmware_py.rtos.errors import KernelError, StuckTaskError, TaskError

SWITCH: Final = (0,)  # what a call returns for `yield from` when the processor may go to another task
GO_ON: Final[tuple[int, ...]] = ()  # ... and when the caller just continues

# A timeout that never ends, FreeRTOS's portMAX_DELAY; any other timeout is a number of ticks.
FOREVER: Final = -1

TICK_US: Final = 1000
MAX_PRIORITIES: Final = 7  # the Crazyflie's six, 0 to 5, and one above them for simulated interrupts
# Calls of the kernel, or switches, at one instant after which the running task counts as stuck. The most that a task
# of the firmware needs is 25.
STUCK_CALLS: Final = 10_000
_FOR_EVER_US: Final = 1 << 50

# Whose code runs at the moment: the creator of the tasks before the start, a task, or an interrupt between two runs.
BEFORE_START: Final = 0
IN_TASK: Final = 1
IN_INTERRUPT: Final = 2

# Instant [us], event, who, and two numbers that depend on the event; as in tests/vectors/README.md, without CALL and RET.
Trace = Callable[[int, str, str, int, int], None]


class Scheduler:
    """The part of the kernel that decides who runs; `Kernel` adds what tasks call.

    `run`, `advance` and `next_wake_us` are for the harness, everything else for this package.
    """

    def __init__(self, preemption: bool = True, trace: Trace | None = None) -> None:
        self.preemption = preemption
        self.trace = trace
        self.now_us = 0
        self.next_wake_us: int | None = None
        self.tick_count = 0  # up to date while tasks run
        self.rings: list[list[Any]] = [[None] for _ in range(MAX_PRIORITIES)]  # of tasks and the marker None
        # Before the scheduler starts, the caller.
        self.current = ControlBlock("main", 0, _nothing(), self.rings[0], 0)
        self.task_woken = False  # whether the latest call from an interrupt woke a task above the running one
        self._idle = self.current
        self._idle_slept = False
        self._started = False
        self.context = BEFORE_START
        self._ready_bits = 0  # bit n is set when ring n holds a task
        self._wake_ticks: list[int] = []  # ascending, parallel to _delayed
        self._delayed: list[ControlBlock] = []
        self._pending_ready: list[ControlBlock] = []  # woken by interrupts while the scheduler is suspended
        self.suspended = 0  # how many calls of suspend_all wait for their resume_all
        self.interrupts_off = False
        self._switch_pending = False
        self._interrupted = False
        self._next_tick_us = TICK_US
        self._work_end_us = 0  # of the running task, when it has work left
        self._calls = 0  # of the kernel at this instant
        self._until_us = 0  # how far `run` goes

    def run(self, now_us: int, until_us: int = 0) -> None:
        """Do all that is due up to and including `now_us`, until every task waits or works.

        Then it goes on by itself up to and including `until_us`, where that is later. Hardware that a task starts may
        `stop_before` an instant meanwhile: then the run ends there.
        """
        if not self._started:
            raise KernelError("run before start")
        if now_us < self.now_us:
            raise KernelError(f"time runs backwards: from {self.now_us} us to {now_us} us")
        self._until_us = until_us if until_us > now_us else now_us
        wake_us = self.next_wake_us
        if self._interrupted and (wake_us is None or wake_us > now_us):
            wake_us = now_us
        while wake_us is not None and wake_us <= self._until_us:
            self.now_us = wake_us
            self._interrupted = False
            if wake_us >= self._next_tick_us:
                self._pass_ticks()
            self._dispatch()
            wake_us = self.next_wake_us
            if wake_us is not None and wake_us <= self.now_us:
                raise StuckTaskError(
                    self._delayed[0].name,
                    self.now_us,
                    f"waits for {wake_us / TICK_US:.3f} ms, which has passed",
                )
        if self._until_us > self.now_us:
            self.now_us = self._until_us

    def stop_before(self, now_us: int) -> None:
        """End the present run just before an instant at which hardware acts first."""
        if now_us <= self._until_us:
            self._until_us = now_us - 1

    def set_trace(self, trace: Trace | None) -> None:
        """Begin or end tracing, between two runs; the tasks are not affected."""
        self.trace = trace

    def advance(self, now_us: int) -> None:
        """Set the clock before the interrupts of `now_us` are raised, so that they are recorded at the right time.

        Without it their traces and the tasks' response times are too early. Nothing may be due before `now_us`.
        """
        if now_us < self.now_us or (self.next_wake_us is not None and now_us > self.next_wake_us):
            raise KernelError(f"advance({now_us}): outside {self.now_us}..{self.next_wake_us}")
        self.now_us = now_us

    def block(self, waiters: list[ControlBlock] | None, wake_tick: int) -> None:
        """Take the running task off the ready ring until it is woken or, unless negative, `wake_tick` comes.

        The caller has checked that it may wait.
        """
        if self.context == IN_INTERRUPT:
            raise self.misplaced("waiting")
        task = self.current
        if waiters is not None:
            if waiters:
                priority = task.event_priority
                place = next(
                    (i for i, other in enumerate(waiters) if other.event_priority < priority), len(waiters)
                )
                waiters.insert(place, task)
            else:
                waiters.append(task)
            task.waiting_in = waiters
        self._leave_ring(task)
        if wake_tick < 0:
            task.place = SUSPENDED
        else:
            task.place = DELAYED
            place = bisect_right(self._wake_ticks, wake_tick)
            self._wake_ticks.insert(place, wake_tick)
            self._delayed.insert(place, task)
        task.activations += 1
        response_us = self.now_us - task.released_us
        if response_us > task.worst_response_us:
            task.worst_response_us = response_us
        if response_us > task.deadline_us:
            task.deadline_misses += 1

    def deadline(self, timeout: int) -> int:
        """Return the tick at which a wait of `timeout` ticks from now ends, or FOREVER."""
        return FOREVER if timeout < 0 else self.tick_count + timeout

    def wait_in(self, waiters: list[ControlBlock], deadline: int, call: str, number: int) -> bool:
        """Block the running task among `waiters` of an object; False when the `deadline` of its `call` has come."""
        if 0 <= deadline <= self.tick_count:
            self.failed(call + "_FAIL", number)
            return False
        if self.trace is not None:
            self.record(call + "_BLOCK", number)
        self.block(waiters, deadline)
        return True

    def check_may_wait(self) -> None:
        """Raise KernelError if the running task would wait while no other may run."""
        if self.suspended:
            raise KernelError(f"task {self.current.name} must not wait while the scheduler is suspended")

    def wake(self, task: ControlBlock) -> bool:
        """Make a waiting task ready, later if the scheduler is suspended; True when it outranks the running one."""
        if self.suspended:
            self._pending_ready.append(task)
            task.waiting_in = self._pending_ready
        else:
            task.waiting_in = None
            self.unblock(task)
        return task.priority > self.current.priority

    def unblock(self, task: ControlBlock) -> None:
        """Take the task off whatever list holds it and put it behind the others of its ready ring.

        It may be ready already: a notification can reach a task whose wait timed out and that has not run since.
        """
        place = task.place
        if place != SUSPENDED:
            self.unlink(task)
        if place != READY:  # otherwise its activation has begun
            task.released_us = self.now_us
            task.fresh = True
        if self.trace is not None:
            self.trace(self.now_us, "READY", task.name, task.priority, 0)
        task.place = READY
        task.ring.insert(-1, task)
        self._ready_bits |= task.ready_bit

    def make_ready(self, task: ControlBlock) -> None:
        """Put a task that is in no list behind the others of the ring of its priority."""
        if self.trace is not None:
            self.trace(self.now_us, "READY", task.name, task.priority, 0)
        task.place = READY
        task.ring.insert(-1, task)
        self._ready_bits |= task.ready_bit

    def change_priority(self, task: ControlBlock, priority: int) -> None:
        """Set the effective priority of the task, which goes behind the others there when it is ready."""
        ready = task.place == READY
        if ready:
            self.unlink(task)
        task.priority = priority
        task.ring = self.rings[priority]
        task.ready_bit = 1 << priority
        if ready:
            self.make_ready(task)

    def unlink(self, task: ControlBlock) -> None:
        """Remove the task from the ring or the delayed list."""
        if task.place == READY:
            self._leave_ring(task)
        elif task.place == DELAYED:
            place = self._delayed.index(task)
            del self._delayed[place], self._wake_ticks[place]

    def _leave_ring(self, task: ControlBlock) -> None:
        ring = task.ring
        if ring[-1] is task:
            ring.pop()
        else:
            ring.remove(task)
        if len(ring) == 1:
            self._ready_bits ^= task.ready_bit

    def wake_first(self, waiters: list[ControlBlock]) -> Iterable[int]:
        """Wake the first waiter; return the plain call's result."""
        if self.wake(waiters.pop(0)) and self.preemption:
            self._switch_pending = True
            return SWITCH
        return GO_ON

    def switch_if(self, outranked: bool) -> Iterable[int]:
        """Return what a plain call returns after it made another task ready that may outrank the running one."""
        if outranked and self.preemption:
            self._switch_pending = True
            return SWITCH
        return GO_ON

    def misplaced(self, call: str) -> KernelError:
        """Return the error for a call for interrupts that came from a task, or vice versa."""
        if self.context == IN_TASK:
            return KernelError(f"{call} is for interrupts, and was called by task {self.current.name}")
        return KernelError(f"{call} is for tasks, and was called from an interrupt")

    def interrupted(self, task_woken: bool) -> None:
        """End every call from an interrupt."""
        self._interrupted = True
        self.task_woken = task_woken
        if task_woken:
            self._switch_pending = True

    def leave_tasks(self) -> None:
        """Allow interrupts and no calls of tasks from here on."""
        self.context = IN_INTERRUPT
        self._calls = STUCK_CALLS

    def record(self, event: str, a: int = 0, b: int = 0) -> None:
        """Trace what the running task does; only with a trace."""
        assert self.trace is not None
        self.trace(self.now_us, event, self.current.name, a, b)

    def failed(self, event: str, a: int) -> None:
        """Trace and count a call that failed."""
        if self.trace is not None:
            self.record(event, a)
        self.count_call()

    def count_call(self) -> None:
        """Count a call that returns at once, because a task might make it for ever while no time passes.

        Of two calls that can only follow each other, like giving and taking, the one that takes is counted. Interrupts
        have no calls of this kind: there the first one is one too many.
        """
        self._calls += 1
        if self._calls > STUCK_CALLS:
            if self.context == IN_INTERRUPT:
                raise self.misplaced("this call of the kernel")
            what = f"{STUCK_CALLS} calls of the kernel at one instant"
            raise StuckTaskError(self.current.name, self.now_us, what)

    def _pass_ticks(self) -> None:
        """Take the tick that is due now, if one is; jump over those before at which nothing could happen."""
        tick = self.now_us // TICK_US
        self._next_tick_us = tick * TICK_US + TICK_US
        if self.suspended:
            if self.trace is not None:
                self.record("TICK", self.tick_count + 1)
        elif self.now_us == tick * TICK_US:
            self._tick(tick)
        else:
            self.tick_count = tick

    def _tick(self, tick: int) -> None:
        if self.trace is not None:
            self.record("TICK", tick)
        self.tick_count = tick
        current = self.current
        switch = len(current.ring) > 2  # the time slice is over
        wake_ticks = self._wake_ticks
        while wake_ticks and wake_ticks[0] <= tick:
            del wake_ticks[0]
            task = self._delayed.pop(0)
            task.place = SUSPENDED  # in no list, for a moment
            if task.waiting_in is not None:
                task.waiting_in.remove(task)
                task.waiting_in = None
            self.unblock(task)
            if task.priority >= current.priority:
                switch = True
        if switch and self.preemption:
            self._switch_pending = True

    def _dispatch(self) -> None:
        """Run tasks from this instant on until the running one has work to do during which something may happen."""
        task = self.current
        switch = self._switch_pending and not self.suspended
        self._calls = 0
        self.context = IN_TASK
        if task.work_left_us:  # every interrupt ends the sleep of the idle task
            task.work_left_us = 0 if task is self._idle else self._work_end_us - self.now_us
        result: Any = 0
        since_us, steps = self.now_us, 0
        try:
            while True:
                if switch:
                    task = self._switch()
                if task.work_left_us:
                    break
                steps += 1
                if steps > STUCK_CALLS:
                    if self.now_us == since_us:
                        raise StuckTaskError(task.name, since_us, f"{STUCK_CALLS} switches at one instant")
                    since_us, steps = self.now_us, 0
                try:
                    result = task.step(None)
                except StopIteration:
                    result = self._end(task)
                if result:
                    task.work_left_us = result
                    task.work_us += result
                    switch = self._switch_pending and not self.suspended
                elif self.suspended:
                    self._switch_pending = True
                    switch = False
                else:
                    switch = True
        except TaskError:
            raise
        except Exception as error:
            what = f"{type(error).__name__}: {error}"
            if not isinstance(result, int):
                what = f"yielded a {type(result).__name__}; kernel calls need `yield from`"
            raise TaskError(task.name, self.now_us, what) from error
        finally:
            self.leave_tasks()
        self._set_next_wake(task)

    def _switch(self) -> ControlBlock:
        """Make the next task of the highest ready ring the running one and return it."""
        self._switch_pending = False
        ring = self.rings[self._ready_bits.bit_length() - 1]
        task: ControlBlock
        if len(ring) == 2:
            if ring[1] is None:
                ring.reverse()
            task = ring[1]
            if task is self._idle and self.preemption:  # no task to yield to: sleeps at once
                task.work_left_us = _FOR_EVER_US
                self._idle_slept = True
        else:
            ring.append(ring.pop(0))
            if ring[-1] is None:
                ring.append(ring.pop(0))
            task = ring[-1]
        self.current = task
        if self.trace is not None:
            self.record("IN", task.priority)
        if task.fresh:
            task.fresh = False
            if self.now_us > task.released_us:
                latency_us = self.now_us - task.released_us
                task.latencies[latency_us] = task.latencies.get(latency_us, 0) + 1
        return task

    def _set_next_wake(self, task: ControlBlock) -> None:
        """Work out when the running task's work ends or a tick may let another one run."""
        wake_us: int | None = None
        if self.trace is not None or (len(task.ring) > 2 and self.preemption):
            wake_us = self._next_tick_us
        elif self._wake_ticks and not self.suspended:
            wake_us = self._wake_ticks[0] * TICK_US
        if task is not self._idle:
            self._work_end_us = work_end_us = self.now_us + task.work_left_us
            if wake_us is None or work_end_us < wake_us:
                wake_us = work_end_us
        self.next_wake_us = wake_us

    def _end(self, task: ControlBlock) -> int:
        """Delete the running task, whose function returned; give up the processor for it."""
        if self.suspended:
            raise TaskError(task.name, self.now_us, "ended while the scheduler was suspended") from None
        self.unlink(task)
        task.place = DELETED
        return 0

    def _idle_task(self) -> Generator[int, None, None]:
        """Let others of priority 0 run, then sleep until the next interrupt, like the Crazyflie's idle hook."""
        while True:
            if not self.preemption or len(self.rings[0]) > 2:
                self._idle_slept = False
                yield 0
                if self._idle_slept:
                    continue
            yield _FOR_EVER_US


def _nothing() -> Generator[int, None, None]:
    yield from ()
