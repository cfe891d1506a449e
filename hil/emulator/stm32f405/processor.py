"""The chip on the laboratory's time line, and the tasks of its image's scheduler.

The machine itself counts run times and switches, whenever the scheduler's pointer to the running task changes.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from hil.emulator.events import EventQueue
from hil.emulator.stm32f405.chip import CYCLES_PER_US, Chip
from hil.emulator.stm32f405.freertos import FreeRtos

NEVER_US = 1 << 62
IDLE = "IDLE"
TICK_US = 1_000
INTERRUPTS = 6  # above the priorities of all tasks


@dataclass(slots=True)
class ChipTask:
    """A task of the image's scheduler. Its deadlines are unknown."""

    name: str
    priority: int
    block: int
    deadline_misses: int = 0


T = TypeVar("T")
Trace = Callable[[int, str, str, int, int], None]


class ChipProcessor:
    """The chip's time in the form of `firmware_py.rtos.Kernel`: microseconds since the firmware's boot."""

    queues: tuple[Any, ...] = ()

    def __init__(
        self, chip: Chip, kernel: FreeRtos | None, act: Callable[[int], None], run: Callable[[int], int]
    ) -> None:
        """`run` runs the chip like `Chip.run`, and `act` gets the reason when it ends early."""
        self.chip = chip
        self.trace: Trace | None = None
        self.ahead_us = 0  # of the chip's time before the boot's
        self._act = act
        self._run_chip = run
        self._names: dict[int, ChipTask] = {}
        self._target_us = 0
        self._limit_us = NEVER_US
        self._own = EventQueue()  # by the chip's time
        self._kernel = kernel
        self._outside: ChipTask | None = None  # the outside load
        self._place = 0  # among the tasks, in the order in which they first ran
        self.find_kernel()

    def find_kernel(self) -> None:
        """Tell the machine where the scheduler's structures are; without symbols they appear while it runs."""
        if self._kernel is not None:
            self.chip.state.kernel = self._kernel.places

    def every(self, period_us: int, do: Callable[[int], object]) -> None:
        """Call something periodically by the chip's time."""
        self._own.every(period_us, self.chip.now_us + period_us, do)

    def later(self, delay_us: int, do: Callable[[int], object]) -> None:
        """Do something once, after a while by the chip's time."""
        self._own.at(self.chip.now_us + delay_us, do)

    def begin(self, us: int) -> None:
        """Set the time from which the clock counts."""
        self.ahead_us += us
        self._target_us -= us

    @property
    def now_us(self) -> int:
        """The current time; the chip itself may have finished a block of code beyond it."""
        return min(self.chip.now_us - self.ahead_us, self._target_us)

    def advance(self, now_us: int) -> None:
        self.run(now_us)

    def run(self, now_us: int, until_us: int = 0) -> None:
        """Run the chip up to a time, and on to a later one, if given; stop earlier at a hardware event."""
        now_us = max(now_us, until_us)
        self._target_us, self._limit_us = now_us, NEVER_US
        own, state = self._own, self.chip.state
        while True:
            until_us = min(now_us, self._limit_us) + self.ahead_us
            due_us = own.next_us
            if due_us is not None and due_us <= until_us:
                until_us = due_us
            if state.now < until_us * CYCLES_PER_US:
                if reason := self._run_chip(until_us * CYCLES_PER_US):
                    self._act(reason)
            elif until_us == due_us:
                own.run(until_us)
            else:
                break
        self._pass_switches_on()

    def stop_before(self, us: int) -> None:
        self._limit_us = min(self._limit_us, us - 1)

    def occupy(self, name: str, taken_us: Callable[[], int]) -> None:
        """Let an outside load take the processor at every tick, before all tasks, for the time it returns."""
        state = self.chip.state
        self._outside, self._place = ChipTask(name, INTERRUPTS, 0), state.task_count

        def take(now_us: int) -> None:
            state.owed += taken_us() * CYCLES_PER_US

        self.every(TICK_US, take)

    # Tasks

    @property
    def tasks(self) -> list[ChipTask]:
        """Return the tasks that have run, in the order of their first run, with the outside load."""
        state = self.chip.state
        return self._with_outside(
            [self._task(task.block) for task in state.task[0 : state.task_count]], self._outside
        )

    @property
    def task_names(self) -> list[str]:
        """Return the names of the tasks that have run, as `state.task` numbers them."""
        state = self.chip.state
        return [self._task(task.block).name for task in state.task[0 : state.task_count]]

    @property
    def current(self) -> ChipTask:
        state = self.chip.state
        return self._task(state.task[state.running].block) if state.task_count else ChipTask("-", 0, 0)

    def run_times_us(self) -> list[int]:
        """Return each task's processor time, including interrupts and the idle task's sleep, across resets."""
        state = self.chip.state
        cycles = [task.cycles for task in state.task[0 : state.task_count]]
        if cycles:
            cycles[state.running] += state.now - state.running_since
        return [own // CYCLES_PER_US for own in self._with_outside(cycles, state.taken)]

    def activations(self) -> list[int]:
        state = self.chip.state
        return self._with_outside([task.times for task in state.task[0 : state.task_count]], 0)

    def _with_outside(self, of_tasks: list[T], of_outside: T | None) -> list[T]:
        """Return the values of each task, with the outside load inserted at its place."""
        if self._outside is None or of_outside is None:
            return of_tasks
        return [*of_tasks[: self._place], of_outside, *of_tasks[self._place :]]

    def longest_busy(self, least_us: int) -> tuple[int, int] | None:
        """Return the highest-priority task that has not waited for so long, and its microseconds; None without one.

        Tasks below it may be waiting for it. The idle task never waits.
        """
        state = self.chip.state
        busy = [
            (self._task(one.block).priority, (state.now - one.busy_since) // CYCLES_PER_US, one.block)
            for one in state.task[0 : state.task_count]
            if one.busy_since and self._task(one.block).name != IDLE
        ]
        _, us, block = max((one for one in busy if one[1] >= least_us), default=(0, 0, 0))
        return (block, us) if block else None

    def set_trace(self, trace: Trace | None) -> None:
        self.trace = trace
        self.chip.state.tracing = trace is not None
        self.chip.state.switch_count = 0

    def _pass_switches_on(self) -> None:
        state = self.chip.state
        if self.trace is None:
            return
        for switch in state.task_switch[0 : state.switch_count]:
            task = self._task(switch.block)
            self.trace(switch.now // CYCLES_PER_US - self.ahead_us, "IN", task.name, task.priority, 0)
        state.switch_count = 0

    def _task(self, block: int) -> ChipTask:
        if block not in self._names:
            assert self._kernel is not None
            view = self._kernel.task(block, "running")
            name = view.name.replace(" ", "_")
            taken = sum(task.name.split("#")[0] == name for task in self._names.values())
            self._names[block] = ChipTask(f"{name}#{taken + 1}" if taken else name, view.priority, block)
        return self._names[block]
