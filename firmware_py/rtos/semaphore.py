"""Semaphores, binary and counting, and mutexes with priority inheritance.

They are queues, as in FreeRTOS, whose items nobody looks at: take is Q_RECV, give is Q_SEND.
"""

from collections.abc import Generator, Iterable

from firmware_py.rtos.errors import KernelError
from firmware_py.rtos.memory import AGAIN, DONE, FAILED, FOREVER, HELD_BY_OTHER, HELD_BY_WAITER, SWITCH, WAITS
from firmware_py.rtos.processor import Processor
from firmware_py.rtos.queue import Waited
from firmware_py.rtos.task import Task


class Semaphore(Waited):
    """A count from 0 to `length`; it counts in `dropped` what was given at the maximum.

    Made by `Kernel.create_binary_semaphore` or `create_counting_semaphore`. Calls return what those of a queue do.
    """

    kind = "semaphore"

    def __init__(self, kernel: Processor, maximum: int, initial: int, name: str) -> None:
        if maximum > 0 and not 0 <= initial <= maximum:
            raise KernelError(f"semaphore {name}: initial count {initial} is outside 0..{maximum}")
        super().__init__(kernel, maximum, initial, name)

    def take(self, timeout: int = FOREVER) -> Generator[int, None, bool | None]:
        """Lower the count by one, waiting up to `timeout` ticks until it is above zero; None when it never was."""
        kernel = self.kernel
        while (answer := kernel.calls.receive(self.index, timeout)) == WAITS:
            timeout = AGAIN
            yield 0
        if answer == SWITCH:
            yield 0
        return bool(kernel.done(answer)) or None

    def give(self) -> Generator[int, None, bool]:
        """Raise the count by one and wake the first taker; False when the count is at its maximum."""
        answer = self.kernel.calls.send(self.index, 0)
        if answer == SWITCH:
            yield 0
        return self.kernel.done(answer) > FAILED

    def give_nowait(self) -> Iterable[int]:
        """Do the same as `Queue.send_nowait`; a taker that waits runs at the latest at `Kernel.yield_if_pending`."""
        answer = self.kernel.calls.send(self.index, 0)
        return self.kernel.outcome(answer, f"semaphore {self.name}: sending without waiting")

    def give_from_isr(self) -> bool:
        """Like `give`, from an interrupt."""
        answer = self.kernel.calls.send_from_isr(self.index)
        return self.kernel.done(answer, f"semaphore {self.name}: sending from an interrupt") == DONE


class Mutex(Waited):
    """A lock whose holder inherits the priority of the most urgent task that waits for it.

    Made by `Kernel.create_mutex`; free at first. Only the holder may give it, and it may not take it twice.
    """

    kind = "mutex"

    def __init__(self, kernel: Processor, name: str) -> None:
        super().__init__(kernel, 1, 0, name)
        self._tasks = kernel.tasks
        kernel.record("Q_SEND", self.number)  # FreeRTOS makes a mutex by giving it once

    @property
    def holder(self) -> Task | None:
        """The task that has taken it."""
        holder = int(self.kernel.memory.holder[self.index])
        return self._tasks[holder - 1] if holder > 0 else None

    def take(self, timeout: int = FOREVER) -> Generator[int, None, bool]:
        """Become the holder, waiting up to `timeout` ticks while another task is; False when time ran out."""
        kernel = self.kernel
        while (answer := kernel.calls.take_mutex(self.index, timeout)) == WAITS:
            timeout = AGAIN
            yield 0
        return self._done(answer) == DONE

    def give(self) -> Generator[int, None, bool]:
        """Set the mutex free and, with the last one held, return to the task's own priority.

        False when it was free already.
        """
        answer = self.kernel.calls.give_mutex(self.index)
        if answer == SWITCH:
            yield 0
        return self._done(answer, f"given by {self.kernel.running}") > FAILED

    def give_from_isr(self) -> bool:
        """Return False for a free mutex; raise `KernelError` for a held one, because only its holder may give it."""
        return (
            self._done(self.kernel.calls.give_mutex_from_isr(self.index), "given from an interrupt") > FAILED
        )

    def _done(self, answer: int, given: str = "") -> int:
        if answer in (HELD_BY_OTHER, HELD_BY_WAITER):
            assert self.holder is not None
            name = self.holder.name
            what = (
                f"{given}, held by {name}"
                if answer == HELD_BY_OTHER
                else f"{name} waited for it and holds it"
            )
            raise KernelError(f"mutex {self.name}: {what}")
        return self.kernel.done(answer, f"mutex {self.name}: give_from_isr")
