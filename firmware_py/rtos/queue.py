"""Bounded queues: tasks send and receive with a timeout, interrupts send at once or not at all.

A full queue drops the newest item once its timeout is over and counts it in `dropped`. Items are any object but None,
which means "nothing came". Waiting tasks are served by priority, first come first served among equals.
"""

from collections import deque
from collections.abc import Generator, Iterable
from typing import ClassVar, Generic, TypeVar

from firmware_py.rtos.control_block import ControlBlock
from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.scheduler import FOREVER, GO_ON, IN_INTERRUPT, IN_TASK, Scheduler

T = TypeVar("T")


class Queue(Generic[T]):
    """A queue of at most `length` items; made by `Kernel.create_queue`."""

    kind: ClassVar[str] = "queue"

    def __init__(self, kernel: Scheduler, length: int, name: str) -> None:
        if length < 1:
            raise KernelError(f"{self.kind} {name}: length {length}, it must be at least 1")
        self._kernel = kernel
        self._items: deque[T] = deque()
        self._receivers: list[ControlBlock] = []
        self._senders: list[ControlBlock] = []
        self.length = length
        self.name = name
        self.number = 0  # how the trace calls this queue
        self.dropped = 0  # items that found the queue full
        self.high_water = 0  # the most items that ever waited

    def __len__(self) -> int:
        return len(self._items)

    def send(self, item: T, timeout: int = FOREVER) -> Generator[int, None, bool]:
        """Append `item`, waiting up to `timeout` ticks for space; False when it was dropped."""
        kernel = self._kernel
        items = self._items
        if item is None:
            raise self._null_item()
        if timeout and kernel.suspended:
            kernel.check_may_wait()
        if len(items) >= self.length:
            deadline = kernel.deadline(timeout)
            while len(items) >= self.length:
                if not kernel.wait_in(self._senders, deadline, "Q_SEND", self.number):
                    self.dropped += 1
                    return False
                yield 0
        if kernel.trace is not None:
            kernel.record("Q_SEND", self.number, len(items))
        items.append(item)
        if len(items) > self.high_water:
            self.high_water = len(items)
        if self._receivers and kernel.wake(self._receivers.pop(0)) and kernel.preemption:
            yield 0
        return True

    def send_nowait(self, item: T) -> Iterable[int]:
        """Append `item`, or drop and count it when there is no space.

        `yield from` it lets a receiver of higher priority run at once; the plain call lets it run at the caller's next
        `yield from` that blocks, yields or works.
        """
        kernel = self._kernel
        items = self._items
        if item is None:
            raise self._null_item()
        if kernel.context == IN_INTERRUPT:
            raise kernel.misplaced(f"{self.kind} {self.name}: sending without waiting")
        if len(items) >= self.length:
            self.dropped += 1
            kernel.failed("Q_SEND_FAIL", self.number)
            return GO_ON
        if kernel.trace is not None:
            kernel.record("Q_SEND", self.number, len(items))
        items.append(item)
        if len(items) > self.high_water:
            self.high_water = len(items)
        return kernel.wake_first(self._receivers) if self._receivers else GO_ON

    def receive(self, timeout: int = FOREVER) -> Generator[int, None, T | None]:
        """Take the oldest item, waiting up to `timeout` ticks for one; None when none came."""
        kernel = self._kernel
        items = self._items
        if timeout and kernel.suspended:
            kernel.check_may_wait()
        if items:
            kernel.count_call()
        else:
            # Written out, not called, because this is the hot loop.
            deadline = timeout if timeout < 0 else kernel.tick_count + timeout
            while not items:
                if not kernel.wait_in(self._receivers, deadline, "Q_RECV", self.number):
                    return None
                yield 0
        if kernel.trace is not None:
            kernel.record("Q_RECV", self.number, len(items))
        item = items.popleft()
        if self._senders and kernel.wake(self._senders.pop(0)) and kernel.preemption:
            yield 0
        return item

    def receive_nowait(self) -> T | None:
        """Take the oldest item, None when there is none; a plain call.

        A sender of higher priority that waited for the space runs at the caller's next `yield from` that blocks,
        yields or works, not here: use `receive(0)` where that matters.
        """
        kernel = self._kernel
        items = self._items
        if not items:
            kernel.failed("Q_RECV_FAIL", self.number)
            return None
        kernel.count_call()
        if kernel.trace is not None:
            kernel.record("Q_RECV", self.number, len(items))
        item = items.popleft()
        if self._senders:
            kernel.wake_first(self._senders)
        return item

    def reset(self) -> Iterable[int]:
        """Empty the queue; one sender that waited for space goes on, as with xQueueReset.

        `yield from queue.reset()` lets it run at once if its priority is higher; the plain call, at the caller's next
        `yield from` that blocks, yields or works.
        """
        kernel = self._kernel
        if kernel.context == IN_INTERRUPT:
            raise kernel.misplaced(f"queue {self.name}: reset")
        kernel.count_call()
        self._items.clear()
        return kernel.wake_first(self._senders) if self._senders else GO_ON

    def wait_for_item(self, wake_tick: int) -> None:
        """Block the running task until an item comes or, unless negative, `wake_tick`; for the timer service."""
        self._kernel.check_may_wait()
        self._kernel.block(self._receivers, wake_tick)

    def send_from_isr(self, item: T) -> bool:
        """Append `item` from an interrupt; False when the queue was full and it was dropped."""
        if item is None:
            raise self._null_item()
        kernel = self._kernel
        if kernel.context == IN_TASK:
            raise kernel.misplaced(f"{self.kind} {self.name}: sending from an interrupt")
        items = self._items
        if len(items) >= self.length:
            if kernel.trace is not None:
                kernel.trace(kernel.now_us, "Q_SEND_ISR_FAIL", "isr", self.number, 0)
            self.dropped += 1
            kernel.interrupted(False)
            return False
        if kernel.trace is not None:
            kernel.trace(kernel.now_us, "Q_SEND_ISR", "isr", self.number, len(items))
        items.append(item)
        if len(items) > self.high_water:
            self.high_water = len(items)
        kernel.interrupted(bool(self._receivers) and kernel.wake(self._receivers.pop(0)))
        return True

    def _null_item(self) -> KernelError:
        return KernelError(f'queue {self.name}: None cannot be sent, it stands for "nothing came"')
