"""Semaphores, binary and counting, and mutexes with priority inheritance.

They are queues, as in FreeRTOS, a mutex to the trace only: take is Q_RECV, give is Q_SEND.
"""

from collections.abc import Generator, Iterable
from typing import ClassVar

from firmware_py.rtos.control_block import ControlBlock
from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.queue import Queue
from firmware_py.rtos.scheduler import FOREVER, IN_TASK, Scheduler


class Semaphore(Queue[bool]):
    """A count from 0 to `length`, the number of tokens in the queue that it is; as a queue counts what it `dropped`.

    Made by `Kernel.create_binary_semaphore` or `create_counting_semaphore`. Calls return what those of the queue do.
    """

    kind: ClassVar[str] = "semaphore"

    def __init__(self, kernel: Scheduler, maximum: int, initial: int, name: str) -> None:
        super().__init__(kernel, maximum, name)
        if not 0 <= initial <= maximum:
            raise KernelError(f"semaphore {name}: initial count {initial} is outside 0..{maximum}")
        self._items.extend([True] * initial)

    def take(self, timeout: int = FOREVER) -> Generator[int, None, bool | None]:
        """Lower the count by one, waiting up to `timeout` ticks until it is above zero; None when it never was."""
        return self.receive(timeout)

    def give(self) -> Generator[int, None, bool]:
        """Raise the count by one and wake the first taker; False when the count is at its maximum."""
        return self.send(True, 0)

    def give_nowait(self) -> Iterable[int]:
        """Do the same as `Queue.send_nowait`; a taker that waits runs at the latest at `Kernel.yield_if_pending`."""
        return self.send_nowait(True)

    def give_from_isr(self) -> bool:
        """Like `give`, from an interrupt."""
        return self.send_from_isr(True)


class Mutex:
    """A lock whose holder inherits the priority of the most urgent task that waits for it.

    Made by `Kernel.create_mutex`; free at first. Only the holder may give it, and it may not take it twice.
    """

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
