"""Semaphores, binary and counting, and mutexes with priority inheritance.

To the trace they are queues, as they are in FreeRTOS: take is Q_RECV, give is Q_SEND.
"""

from collections.abc import Generator, Iterable

from firmware_py.rtos.control_block import ControlBlock
from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.scheduler import FOREVER, GO_ON, IN_INTERRUPT, IN_TASK, Scheduler


class Semaphore:
    """A count between 0 and `maximum`; made by `Kernel.create_binary_semaphore` or `create_counting_semaphore`."""

    __slots__ = ("_kernel", "_takers", "count", "maximum", "name", "number", "overruns")

    def __init__(self, kernel: Scheduler, maximum: int, initial: int, name: str) -> None:
        if maximum < 1:
            raise KernelError(f"semaphore {name}: maximum {maximum}, it must be at least 1")
        if not 0 <= initial <= maximum:
            raise KernelError(f"semaphore {name}: initial count {initial} is outside 0..{maximum}")
        self._kernel = kernel
        self._takers: list[ControlBlock] = []
        self.count = initial
        self.maximum = maximum
        self.overruns = 0  # gives that found the count at its maximum: the taker did not keep up
        self.name = name
        self.number = 0  # how the trace calls it

    def take(self, timeout: int = FOREVER) -> Generator[int, None, bool]:
        """Lower the count by one, waiting up to `timeout` ticks until it is above zero; False when it never was."""
        kernel = self._kernel
        if timeout and kernel.suspended:
            kernel.check_may_wait()
        if self.count:
            kernel.count_call()
        else:
            deadline = timeout if timeout < 0 else kernel.tick_count + timeout
            while self.count == 0:
                if not kernel.wait_in(self._takers, deadline, "Q_RECV", self.number):
                    return False
                yield 0
        if kernel.trace is not None:
            kernel.record("Q_RECV", self.number, self.count)
        self.count -= 1
        return True

    def give(self) -> Generator[int, None, bool]:
        """Raise the count by one and wake the first taker; False when the count is at its maximum."""
        kernel = self._kernel
        if self.count >= self.maximum:
            self.overruns += 1
            kernel.failed("Q_SEND_FAIL", self.number)
            return False
        if kernel.trace is not None:
            kernel.record("Q_SEND", self.number, self.count)
        self.count += 1
        if self._takers and kernel.wake(self._takers.pop(0)) and kernel.preemption:
            yield 0
        return True

    def give_nowait(self) -> Iterable[int]:
        """Raise the count by one and wake the first taker, unless the count is at its maximum.

        `yield from` it lets a taker of higher priority run at once; after the plain call it runs at the caller's next
        `yield from` that blocks, yields or works, at the latest at `Kernel.yield_if_pending`.
        """
        kernel = self._kernel
        if kernel.context == IN_INTERRUPT:
            raise kernel.misplaced(f"semaphore {self.name}: give_nowait")
        if self.count >= self.maximum:
            self.overruns += 1
            kernel.failed("Q_SEND_FAIL", self.number)
            return GO_ON
        if kernel.trace is not None:
            kernel.record("Q_SEND", self.number, self.count)
        self.count += 1
        return kernel.wake_first(self._takers) if self._takers else GO_ON

    def give_from_isr(self) -> bool:
        """Like `give`, from an interrupt."""
        kernel = self._kernel
        if kernel.context == IN_TASK:
            raise kernel.misplaced(f"semaphore {self.name}: give_from_isr")
        if self.count >= self.maximum:
            self.overruns += 1
            if kernel.trace is not None:
                kernel.trace(kernel.now_us, "Q_SEND_ISR_FAIL", "isr", self.number, 0)
            kernel.interrupted(False)
            return False
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "Q_SEND_ISR", "isr", self.number, self.count)
        self.count += 1
        kernel.interrupted(bool(self._takers) and kernel.wake(self._takers.pop(0)))
        return True


class Mutex:
    """A lock whose holder inherits the priority of the most urgent task that waits for it.

    Made by `Kernel.create_mutex`; free at first. Only the holder may give it, and it may not take it twice.
    """

    __slots__ = ("_kernel", "_takers", "holder", "name", "number")

    def __init__(self, kernel: Scheduler, name: str) -> None:
        self._kernel = kernel
        self._takers: list[ControlBlock] = []
        self.holder: ControlBlock | None = None
        self.name = name
        self.number = 0  # how the trace calls it
        if kernel.trace is not None:  # FreeRTOS makes a mutex by giving it once
            kernel.record("Q_SEND", self.number)

    def take(self, timeout: int = FOREVER) -> Generator[int, None, bool]:
        """Become the holder, waiting up to `timeout` ticks while another task is; False when time ran out."""
        kernel = self._kernel
        if timeout and kernel.suspended:
            kernel.check_may_wait()
        kernel.count_call()
        task = kernel.current
        deadline = kernel.deadline(timeout)
        lent = False
        while (holder := self.holder) is not None:
            if 0 <= deadline <= kernel.tick_count:
                if lent:
                    self._lower_after_timeout(holder)
                kernel.failed("Q_RECV_FAIL", self.number)
                return False
            if kernel.trace is not None:
                kernel.record("Q_RECV_BLOCK", self.number)
            lent = self._lend_priority(holder, task)
            kernel.block(self._takers, deadline)
            yield 0
        if kernel.trace is not None:
            kernel.record("Q_RECV", self.number, 1)
        self.holder = task
        task.mutexes_held += 1
        return True

    def give(self) -> Generator[int, None, bool]:
        """Set the mutex free and, with the last one held, return to the task's own priority.

        False when it was free already.
        """
        kernel = self._kernel
        task = kernel.current
        if self.holder is None:
            kernel.failed("Q_SEND_FAIL", self.number)
            return False
        if self.holder is not task:
            raise KernelError(f"mutex {self.name}: given by {task.name}, held by {self.holder.name}")
        if kernel.trace is not None:
            kernel.record("Q_SEND", self.number)
        self.holder = None
        task.mutexes_held -= 1
        lowered = task.priority != task.base_priority and task.mutexes_held == 0
        if lowered:
            self._disinherit(task, task.base_priority)
        if self._takers:
            lowered = kernel.wake(self._takers.pop(0))
        if lowered and kernel.preemption:
            yield 0
        return True

    def give_from_isr(self) -> bool:
        """Return False for a free mutex; raise `KernelError` for a held one, because only its holder may give it."""
        kernel = self._kernel
        if kernel.context == IN_TASK:
            raise kernel.misplaced(f"mutex {self.name}: give_from_isr")
        if self.holder is not None:
            raise KernelError(f"mutex {self.name}: given from an interrupt, held by {self.holder.name}")
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "Q_SEND_ISR_FAIL", "isr", self.number, 0)
        kernel.interrupted(False)
        return False

    def _lend_priority(self, holder: ControlBlock, waiter: ControlBlock) -> bool:
        """Raise the holder to the waiter's priority; True when it owes its priority to a waiter like this one."""
        if holder.priority >= waiter.priority:
            return holder.base_priority < waiter.priority
        kernel = self._kernel
        holder.event_priority = waiter.priority
        kernel.change_priority(holder, waiter.priority)
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "INHERIT", holder.name, waiter.priority, 0)
        return True

    def _lower_after_timeout(self, holder: ControlBlock) -> None:
        """Take back a timed-out waiter's priority; a holder of several mutexes keeps it until it gives them."""
        priority = holder.base_priority
        if self._takers and self._takers[0].event_priority > priority:
            priority = self._takers[0].event_priority
        if holder.priority == priority or holder.mutexes_held != 1:
            return
        if holder is self._kernel.current:
            raise KernelError(f"mutex {self.name}: {holder.name} waited for it and holds it")
        self._disinherit(holder, priority)

    def _disinherit(self, holder: ControlBlock, priority: int) -> None:
        kernel = self._kernel
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "DISINHERIT", holder.name, priority, 0)
        holder.event_priority = priority
        kernel.change_priority(holder, priority)
