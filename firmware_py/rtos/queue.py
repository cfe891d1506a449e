"""Bounded queues: tasks send and receive with a timeout, interrupts send at once or not at all.

A full queue drops the newest item once its timeout is over and counts it in `dropped`. Items are any object but None,
which means "nothing came". Waiting tasks are served by priority, first come first served among equals. The kernel counts
the items; the object holds them.
"""

from collections import deque
from collections.abc import Generator, Iterable
from typing import ClassVar, Generic, TypeVar

from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.memory import AGAIN, DONE, FAILED, FOREVER, SWITCH, WAITS
from firmware_py.rtos.tables import Cell, Entry, Tables

T = TypeVar("T")


class Waited(Entry):
    """What tasks wait for: a count from 0 to `length`."""

    kind: ClassVar[str]
    dropped = Cell("dropped")  # items that found the queue full
    high_water = Cell("high_water")  # the most items that ever waited

    def __init__(self, kernel: Tables, length: int, count: int, name: str) -> None:
        if length < 1:
            raise KernelError(f"{self.kind} {name}: length {length}, it must be at least 1")
        super().__init__(kernel, kernel.add_object(f"{self.kind} {name}", length, count), name)
        self.length = length

    @property
    def number(self) -> int:
        """How the trace calls it."""
        return self.kernel.numbers[self.index]

    @number.setter
    def number(self, number: int) -> None:
        self.kernel.numbers[self.index] = number

    def __len__(self) -> int:
        return int(self.kernel.memory.count[self.index])


class Queue(Waited, Generic[T]):
    """A queue of at most `length` items; made by `Kernel.create_queue`."""

    kind = "queue"

    def __init__(self, kernel: Tables, length: int, name: str) -> None:
        super().__init__(kernel, length, 0, name)
        self._items: deque[T] = deque()

    def send(self, item: T, timeout: int = FOREVER) -> Generator[int, None, bool]:
        """Append `item`, waiting up to `timeout` ticks for space; False when it was dropped."""
        kernel = self.kernel
        self._check(item)
        while (answer := kernel.calls.send(self.index, timeout)) == WAITS:
            timeout = AGAIN
            yield 0
        if answer <= FAILED:
            return bool(kernel.done(answer))
        self._items.append(item)
        if answer == SWITCH:
            yield 0
        return True

    def send_nowait(self, item: T) -> Iterable[int]:
        """Append `item`, or drop and count it when there is no space.

        `yield from` it lets a receiver of higher priority run at once; the plain call lets it run at the caller's next
        `yield from` that blocks, yields or works.
        """
        self._check(item)
        answer = self.kernel.calls.send(self.index, 0)
        if answer > FAILED:
            self._items.append(item)
        return self.kernel.outcome(answer, f"queue {self.name}: sending without waiting")

    def receive(self, timeout: int = FOREVER) -> Generator[int, None, T | None]:
        """Take the oldest item, waiting up to `timeout` ticks for one; None when none came."""
        kernel = self.kernel
        while (answer := kernel.calls.receive(self.index, timeout)) == WAITS:
            timeout = AGAIN
            yield 0
        if answer <= FAILED:
            kernel.done(answer)
            return None
        item = self._items.popleft()
        if answer == SWITCH:
            yield 0
        return item

    def receive_nowait(self) -> T | None:
        """Take the oldest item, None when there is none; a plain call.

        A sender of higher priority that waited for the space runs at the caller's next `yield from` that blocks,
        yields or works, not here: use `receive(0)` where that matters.
        """
        answer = self.kernel.calls.receive(self.index, 0)
        if answer <= FAILED:
            self.kernel.done(answer)
            return None
        return self._items.popleft()

    def reset(self) -> Iterable[int]:
        """Empty the queue; one sender that waited for space goes on, as with xQueueReset.

        `yield from queue.reset()` lets it run at once if its priority is higher; the plain call, at the caller's next
        `yield from` that blocks, yields or works.
        """
        after = self.kernel.outcome(self.kernel.calls.reset(self.index), f"queue {self.name}: reset")
        self._items.clear()
        return after

    def wait_for_item(self, wake_tick: int) -> None:
        """Block the running task until an item comes or, unless negative, `wake_tick`; for the timer service."""
        self.kernel.done(self.kernel.calls.wait_for_item(self.index, wake_tick))

    def send_from_isr(self, item: T) -> bool:
        """Append `item` from an interrupt; False when the queue was full and it was dropped."""
        self._check(item)
        answer = self.kernel.calls.send_from_isr(self.index)
        if answer == DONE:
            self._items.append(item)
            return True
        return bool(self.kernel.done(answer, f"queue {self.name}: sending from an interrupt"))

    def _check(self, item: T) -> None:
        if item is None:
            raise KernelError(f'queue {self.name}: None cannot be sent, it stands for "nothing came"')
