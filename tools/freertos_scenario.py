"""Prints the trace of a FreeRTOS scenario on our kernel: `python tools/freertos_scenario.py FILE --mode coop|preempt`.

tests/vectors/README.md has the formats of scenario and trace. Exit code 2 for an invalid file or mode.
"""

import argparse
import sys
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

from firmware_py.rtos import TICK_US, Kernel, KernelError, Mutex, Queue, Semaphore, Task, Timer

NOT_HELD = -2  # result of giving a mutex that the task does not hold

Record = Callable[[int, str, str, int, int], None]
Call = tuple[str, Callable[..., Any]]


def _receive(_: Kernel, queue: Queue[int], timeout: int) -> Generator[int, None, int]:
    item = yield from queue.receive(timeout)
    return -1 if item is None else item


def _give(kernel: Kernel, given: Semaphore | Mutex) -> Generator[int, None, int]:
    if isinstance(given, Mutex) and given.holder is not kernel.current:
        kernel.count_call()
        return NOT_HELD
    return (yield from given.give())


# The operands of each operation and its call: n number, p positive number, q id of a queue, l of a semaphore or mutex, t
# name of a task, T index of a timer, w the task's latest planned wake-up, which is not in the scenario.
OPERATIONS: dict[str, Call] = {
    "work": ("n", lambda kernel, us: kernel.work(us)),
    "delay": ("n", lambda kernel, ticks: kernel.delay(ticks)),
    "delay_until": ("pw", lambda kernel, ticks, wake: wake.delay(kernel, ticks)),
    "send": ("qnn", lambda _, queue, item, timeout: queue.send(item, timeout)),
    "recv": ("qn", _receive),
    "take": ("ln", lambda _, taken, timeout: taken.take(timeout)),
    "give": ("l", _give),
    "notify": ("t", lambda _, task: task.notify()),
    "ntake": ("nn", lambda kernel, clear, timeout: kernel.notify_take(bool(clear), timeout)),
    "yield": ("", lambda kernel: kernel.task_yield()),
    "suspend": ("t", lambda _, task: task.suspend()),
    "resume": ("t", lambda _, task: task.resume()),
    "prio": ("tn", lambda _, task, priority: task.priority_set(priority)),
    "suspend_all": ("", lambda kernel: kernel.suspend_all() or ()),
    "resume_all": ("", lambda kernel: kernel.resume_all()),
    "tmr_start": ("Tn", lambda _, timer, timeout: timer.start(timeout)),
    "tmr_stop": ("Tn", lambda _, timer, timeout: timer.stop(timeout)),
    "tmr_reset": ("Tn", lambda _, timer, timeout: timer.reset(timeout)),
    "tmr_period": ("Tpn", lambda _, timer, period, timeout: timer.change_period(period, timeout)),
}
INTERRUPTS: dict[str, Call] = {
    "isr_send": ("qn", lambda queue, item: queue.send_from_isr(item)),
    "isr_give": ("l", lambda given: given.give_from_isr()),
    "isr_notify": ("t", lambda task: task.notify_from_isr() and 0),
}


@dataclass(slots=True)
class PlannedWake:
    """The tick of a task's last planned wake-up."""

    tick: int = 0

    def delay(self, kernel: Kernel, ticks: int) -> Generator[int, None, bool]:
        """Wait until `ticks` after the last planned wake-up; return whether it had to wait."""
        early = kernel.tick_count < self.tick  # FreeRTOS takes this for an overflow and does not wait
        self.tick += ticks
        waits = not early and self.tick > kernel.tick_count
        yield from kernel.delay_until(0 if early else self.tick)
        return waits


class ScenarioError(Exception):
    """A scenario that cannot be run; the text has line and reason."""


@dataclass(slots=True)
class Operation:
    """A call in a scenario; its operands are words until a run replaces them by numbers and objects."""

    line: int
    name: str
    operands: list[Any]


Interrupt = tuple[int, Operation]  # time [us] and the operation called then


@dataclass(slots=True)
class Scenario:
    """A parsed file."""

    ticks: int = 0
    queues: dict[int, int] = field(default_factory=dict)  # id to length
    mutexes: list[int] = field(default_factory=list)
    semaphores: dict[int, tuple[int, int]] = field(default_factory=dict)  # id to maximum and initial count
    timers: list[tuple[str, int, bool, Operation]] = field(default_factory=list)
    interrupts: list[Interrupt] = field(default_factory=list)
    # Name, priority, once, ...
    tasks: list[tuple[str, int, bool, list[Operation]]] = field(default_factory=list)


def parse(text: str) -> Scenario:
    """Read a scenario; raise ScenarioError."""
    scenario = Scenario()
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].split()
        try:
            _parse_line(scenario, number, words)
        except (ValueError, IndexError):
            raise ScenarioError(f"line {number}: cannot read {line.strip()!r}") from None
    if scenario.ticks <= 0:
        raise ScenarioError("no line `run TICKS` with at least one tick")
    for name, _, _, operations in scenario.tasks:
        if not operations:
            raise ScenarioError(f"task {name} has no operations")
    return scenario


def _parse_line(scenario: Scenario, line: int, words: list[str]) -> None:
    """Add one line to the scenario."""
    match words:
        case ["run", ticks]:
            scenario.ticks = int(ticks)
        case ["queue", number, length]:
            scenario.queues[int(number)] = int(length)
        case ["mutex", number]:
            scenario.mutexes.append(int(number))
        case ["sem", number, maximum, initial]:
            scenario.semaphores[int(number)] = int(maximum), int(initial)
        case ["timer", name, period, autoreload, called, *operands]:
            operation = Operation(line, called, list(operands))
            scenario.timers.append((name, int(period), bool(int(autoreload)), operation))
        case ["at", instant_us, raised, *operands]:
            scenario.interrupts.append((int(instant_us), Operation(line, raised, list(operands))))
        case ["task" | "once" as kind, name, priority]:
            scenario.tasks.append((name, int(priority), kind == "once", []))
        case [name, *operands]:
            scenario.tasks[-1][3].append(Operation(line, name, list(operands)))


class ScenarioRun:
    """One scenario on one kernel; `record` gets the runner's events and, when `traced`, the kernel's."""

    def __init__(self, scenario: Scenario, preemption: bool, record: Record, traced: bool = True) -> None:
        self.scenario = scenario
        self.record = record
        self.kernel = kernel = Kernel(preemption, record if traced else None)
        queues: dict[int, Any] = {}
        locks: dict[int, Any] = {}
        for number, length in scenario.queues.items():
            queues[number] = kernel.create_queue(length, f"queue {number}")
        for number, (maximum, initial) in scenario.semaphores.items():
            locks[number] = kernel.create_counting_semaphore(maximum, initial, f"semaphore {number}")
        for number in scenario.mutexes:
            locks[number] = kernel.create_mutex(f"mutex {number}")
        for number, made in (queues | locks).items():
            made.number = number
        timers = [
            kernel.create_timer(name, period, autoreload, self._timer_callback(operation))
            for name, period, autoreload, operation in scenario.timers
        ]
        self.tasks: dict[str, Task] = {}
        for name, priority, once, operations in scenario.tasks:
            self.tasks[name] = kernel.create_task(name, priority, self._scripted_task, name, operations, once)
        kinds = {"q": queues, "l": locks, "t": self.tasks, "T": dict(enumerate(timers))}
        called = [operation for *_, operations in scenario.tasks for operation in operations]
        for operation in (*called, *(operation for *_, operation in scenario.timers)):
            _resolve(operation, OPERATIONS, kinds)
        for _, raised in scenario.interrupts:
            _resolve(raised, INTERRUPTS, kinds)

    def run(self) -> None:
        """Run up to the end time, exclusive."""
        kernel = self.kernel
        end_us = self.scenario.ticks * TICK_US
        kernel.start()
        interrupts = sorted(self.scenario.interrupts, key=itemgetter(0))
        for instant_us, raised in groupby(interrupts, itemgetter(0)):
            if instant_us >= end_us:
                break
            kernel.run(instant_us - 1)
            kernel.advance(instant_us)
            for _, operation in raised:
                result = INTERRUPTS[operation.name][1](*operation.operands)
                woken = int(kernel.task_woken)
                self.record(kernel.now_us, "ISR", operation.name, int(result or 0), woken)
            kernel.run(instant_us)
        kernel.run(end_us - 1)
        self.record(end_us, "END", "-", 0, 0)

    def _scripted_task(
        self, name: str, operations: list[Operation], once: bool
    ) -> Generator[int, None, None]:
        wake = PlannedWake(self.kernel.tick_count)
        while True:
            for place, operation in enumerate(operations):
                self.record(self.kernel.now_us, "CALL", name, place, 0)
                result = yield from self._perform(operation, wake)
                self.record(self.kernel.now_us, "RET", name, place, result)
            while once:
                yield from self.tasks[name].suspend()

    def _timer_callback(self, operation: Operation) -> Callable[[Timer], Generator[int, None, None]]:
        def callback(timer: Timer) -> Generator[int, None, None]:
            self.record(self.kernel.now_us, "TMR_CB", timer.name, 0, 0)
            result = yield from self._perform(operation, PlannedWake())
            self.record(self.kernel.now_us, "TMR_RET", timer.name, 0, result)

        return callback

    def _perform(self, operation: Operation, wake: PlannedWake) -> Generator[int, None, int]:
        signature, call = OPERATIONS[operation.name]
        planned = [wake] if signature.endswith("w") else []
        result = yield from call(self.kernel, *operation.operands, *planned)
        return int(result or 0)


def _resolve(operation: Operation, known: dict[str, Call], kinds: dict[str, Any]) -> None:
    """Replace the words of an operation by numbers and by the objects of each kind; raise ScenarioError."""
    name, operands, start = operation.name, operation.operands, f"line {operation.line}: "
    if name not in known:
        raise ScenarioError(f"{start}{name!r} is none of {', '.join(known)}")
    signature = known[name][0].removesuffix("w")
    if len(operands) != len(signature):
        raise ScenarioError(f"{start}{name} takes {len(signature)} operands, not {len(operands)}")
    for place, kind in enumerate(signature):
        word = operands[place]
        try:
            value: Any = word if kind == "t" else int(word)
        except ValueError:
            raise ScenarioError(f"{start}{word!r} is not a number") from None
        if kind == "p" and value < 1:
            raise ScenarioError(f"{start}{name} {word}: it must be at least 1")
        if kind in kinds and value not in kinds[kind]:
            raise ScenarioError(f"{start}{name} {word}: there is no such object for it")
        operands[place] = kinds[kind][value] if kind in kinds else value


def trace(text: str, preemption: bool, write: Callable[[str], Any]) -> None:
    """Run the scenario `text` and call `write` with every line of its trace."""
    ScenarioRun(
        parse(text), preemption, lambda us, event, who, a, b: write(f"{us},{event},{who},{a},{b}\n")
    ).run()


def main() -> int:
    parser = argparse.ArgumentParser(description="Prints the trace of a FreeRTOS scenario on our kernel.")
    parser.add_argument("file", type=Path)
    parser.add_argument("--mode", choices=["coop", "preempt"], default="preempt")
    arguments = parser.parse_args()
    try:
        trace(arguments.file.read_text(), arguments.mode == "preempt", sys.stdout.write)
    except (OSError, UnicodeDecodeError, ScenarioError, KernelError) as error:
        print(f"{arguments.file}: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
