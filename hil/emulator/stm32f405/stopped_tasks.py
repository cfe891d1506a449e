"""Finds tasks that ran regularly and stopped, although nothing outside the image keeps them from running.

A task is regular when it ran between all of the last `LOOKS` looks. It has stopped when it has not run for `PERIODS` of
its mean periods and no time-out ends its wait: for a mutex, a semaphore or a notification, suspended, deleted, or delayed
beyond any flight. A task that waits for an item of a queue is idle: its senders may have nothing to send.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from hil.emulator.stm32f405.chip import CYCLES_PER_US, Chip
from hil.emulator.stm32f405.freertos import FreeRtos

LOOKS = 10
PERIODS = 10
SETTLED_US = (
    3_200_000  # after a reset: tasks that end with the start, as the firmware's self-test, have ended
)


@dataclass(frozen=True, slots=True)
class StoppedTask:
    """A task by its control block, how long it has been silent, its period before, and what it waits for."""

    block: int
    silent_us: int
    period_us: int
    reason: str


class TaskWatch:
    """The tasks of one chip; `look` is called periodically."""

    def __init__(self, chip: Chip, kernel: FreeRtos) -> None:
        self._chip, self._kernel = chip, kernel
        self.restart()

    def restart(self) -> None:
        """Forget everything: the chip was reset."""
        self._from_us = self._chip.now_us + SETTLED_US
        self._history: dict[
            int, deque[tuple[int, int]]
        ] = {}  # of each task: instants, and how often it had run
        self._reported: set[int] = set()

    def newly_stopped(self) -> Iterator[StoppedTask]:
        """Yield the tasks that have stopped since the last look, each once; note which ones have run."""
        state, now_us = self._chip.state, self._chip.now_us
        for index, task in enumerate(state.task[0 : state.task_count]):
            history = self._history.setdefault(task.block, deque(maxlen=LOOKS + 1))
            ran_us = now_us if index == state.running else task.ran // CYCLES_PER_US
            if not history or task.times != history[-1][1]:
                history.append((now_us, task.times))
                self._reported.discard(task.block)
            elif index != state.running and len(history) <= LOOKS:
                history.clear()  # it missed a look before it was regular
            if len(history) <= LOOKS or task.block in self._reported or ran_us < self._from_us:
                continue
            (begin_us, first), (end_us, last) = history[0], history[-1]
            period_us = (end_us - begin_us) // (last - first)
            if now_us - ran_us < PERIODS * period_us:
                continue
            wait = self._kernel.endless_wait(task.block)
            if wait is not None and not wait.for_messages:
                self._reported.add(task.block)
                yield StoppedTask(task.block, now_us - ran_us, period_us, wait.reason)
