"""Where the cycles of an image went: call trees of tasks and exceptions, their activations, and masked interrupts.

An activation of a task lasts from its first instruction after a wait to its next wait; its own cycles are those without
interrupts, other tasks and sleep. Times count from the laboratory's start, in microseconds.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from firmware_py.export.elf import FLASH, Symbol
from hil.emulator.stm32f405.chip import CYCLES_PER_US, Chip
from hil.emulator.stm32f405.coverage import runs_of
from hil.emulator.stm32f405.image import Image

START, HANDLERS = (
    32,
    33,
)  # the roots of what runs before all tasks, and of exception 0: TASKS of machine.h, and one more
ROOT = 1 << 16
OUTSIDE = "outside every function"
BIN_PER_OCTAVE = 8
REFILL = 3  # cycles after a jump
CALLERS = 4  # of a function that are named


@dataclass(frozen=True, slots=True)
class Calls:
    """A function called from one place, with its own cycles; `asleep` of them in WFI."""

    name: str
    cycles: int
    asleep: int
    calls: int
    children: tuple["Calls", ...]

    @property
    def total(self) -> int:
        """Its cycles with those of the functions that it called."""
        return self.cycles + sum(child.total for child in self.children)

    def stacks(self, above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], int]]:
        """Yield every stack of names with its own cycles, outermost first."""
        here = (*above, self.name)
        if self.cycles - self.asleep:
            yield here, self.cycles - self.asleep
        if self.asleep:
            yield (*here, "(asleep)"), self.asleep
        for child in self.children:
            yield from child.stacks(here)


@dataclass(frozen=True, slots=True)
class Part:
    """A function's share of an activation, from all places that call it."""

    name: str
    cycles: int
    hottest: str  # its line with the most cycles in the whole flight
    callers: str  # of the most expensive place: `caller (line) < its caller (line)`, and so on


@dataclass(frozen=True, slots=True)
class Longest:
    """The longest activation of a task: its functions, and what the other tasks and exceptions took meanwhile [cycles]."""

    begin_us: float
    us: float
    cycles: int
    parts: tuple[Part, ...]
    others: tuple[tuple[str, int], ...]


@dataclass(frozen=True, slots=True)
class TaskTimes:
    """The activations of a task that have ended: instants [us] and own cycles, (N,) each."""

    name: str
    begin_us: NDArray[np.float64]
    end_us: NDArray[np.float64]
    cycles: NDArray[np.int64]
    longest: Longest


@dataclass(frozen=True, slots=True)
class HandlerTimes:
    """An exception's runs without those that interrupt it [cycles]; percentiles are upper ends of bins of 1/8 octave."""

    name: str
    count: int
    cycles: int
    worst: int
    worst_us: float  # when
    percentiles: tuple[int, int, int]  # 50, 95, 99


@dataclass(frozen=True, slots=True)
class Masked:
    """The longest time with interrupts masked."""

    by: str
    cycles: int
    begin_us: float
    begin: str  # places
    end: str
    context: str


@dataclass(frozen=True, slots=True)
class CpuProfile:
    """A flight's profile; `roots` have all `cycles` since power-on but those that an outside load took."""

    cycles: int
    outside: int
    lost: int  # calls and activations for which there was no room
    roots: tuple[Calls, ...]
    tasks: tuple[TaskTimes, ...]
    handlers: tuple[HandlerTimes, ...]
    masked: tuple[Masked, ...]


def functions_of(image: Image) -> list[Symbol]:
    """Return the functions in flash with a size, one of each address; number n of the machine's is the (n - 1)th."""
    end = image.base + len(image.code)
    found = {one.address: one for one in reversed(image.functions) if one.size and one.address < end}
    return [found[address] for address in sorted(found)]


class Reader:
    """Reads the machine's profile. `tasks` are the names of the scheduler's, and `ahead_us` is the laboratory's start."""

    def __init__(self, image: Image, chip: Chip, tasks: Sequence[str], ahead_us: int) -> None:
        self._image, self._chip, self._tasks, self._ahead_us = image, chip, tasks, ahead_us
        self._functions = functions_of(image)
        self._profile = chip.profiled()
        self._line_cycles = _cycles_of_code(chip)

    def read(self) -> CpuProfile:
        profile, state = self._profile, self._chip.state
        nodes = profile.node[0 : profile.nodes]
        roots = tuple(
            self._calls(nodes, child, self._root_name(nodes[child].function - ROOT))
            for child in _children(nodes, 0)
        )
        return CpuProfile(
            int(state.now), int(state.taken), int(profile.lost),
            tuple(sorted(roots, key=lambda one: -one.total)), tuple(self._task_times(nodes)),
            tuple(self._handler_times()), tuple(self._masked()),
        )  # fmt: skip

    def _us(self, cycles: int) -> float:
        return cycles / CYCLES_PER_US - self._ahead_us

    def _root_name(self, root: int) -> str:
        if root < len(self._tasks):
            return self._tasks[root]
        if root <= START:
            return "start"
        number = root - HANDLERS
        vector = self._chip.read(int(self._chip.state.vtor) + 4 * number, 4)
        name = self._image.function_at(int.from_bytes(vector, "little") & ~1)
        return f"exception {number} {name}".strip()

    def _name(self, function: int) -> str:
        return self._functions[function - 1].name if function else OUTSIDE

    def _place(self, site: int) -> str:
        """Return the line of a call by the address after it, an offset in flash."""
        return self._image.debug.line_at(FLASH + site - 2)

    def _calls(self, nodes: Any, index: int, name: str) -> Calls:
        node = nodes[index]
        children = tuple(
            self._calls(nodes, child, self._name(nodes[child].function)) for child in _children(nodes, index)
        )
        return Calls(name, int(node.cycles), int(node.asleep), int(node.calls), children)

    def _task_times(self, nodes: Any) -> Iterator[TaskTimes]:
        log = np.frombuffer(self._chip.buffer(self._profile.log), np.uint64).reshape(-1, 4)
        log = log[: self._profile.logged].astype(np.int64)
        for task, name in enumerate(self._tasks):
            own = log[log[:, 3] == task]
            if len(own):
                begin, end = (own[:, column] / CYCLES_PER_US - self._ahead_us for column in (0, 1))
                yield TaskTimes(name, begin, end, own[:, 2], self._longest(nodes, task))

    def _longest(self, nodes: Any, task: int) -> Longest:
        worst = self._profile.worst[task]
        spent: dict[int, list[tuple[int, int]]] = {}  # of each function: cycles and node
        for i, at in enumerate(worst.node[0 : worst.count]):
            if (function := nodes[at].function) < ROOT:
                spent.setdefault(function, []).append((int(worst.recent[i]), at))
        parts = [
            Part(
                self._name(function),
                sum(cycles for cycles, _ in places),
                self._hottest(function),
                self._callers(nodes, max(places)[1]),
            )
            for function, places in spent.items()
        ]
        others = [
            (self._root_name(root), int(cycles))
            for root, cycles in enumerate(worst.others)
            if cycles and root != task
        ]
        return Longest(
            self._us(worst.begin), (worst.end - worst.begin) / CYCLES_PER_US, int(worst.cycles),
            tuple(sorted(parts, key=lambda one: -one.cycles)), tuple(sorted(others, key=lambda one: -one[1])),
        )  # fmt: skip

    def _callers(self, nodes: Any, at: int) -> str:
        """Return the callers of a node, innermost first, each with the line of its call."""
        found: list[str] = []
        while len(found) < CALLERS and nodes[at].site and nodes[nodes[at].parent].function < ROOT:
            place, at = self._place(nodes[at].site), nodes[at].parent
            found.append(f"{self._name(nodes[at].function)} ({place})")
        return " < ".join(found)

    def _hottest(self, function: int) -> str:
        if not function:
            return ""
        symbol = self._functions[function - 1]
        begin = (symbol.address - FLASH) // 2
        cycles = self._line_cycles[begin : begin + symbol.size // 2]
        lines: dict[str, int] = {}
        for at in np.flatnonzero(cycles):
            line = self._image.debug.line_at(symbol.address + 2 * int(at))
            lines[line] = lines.get(line, 0) + int(cycles[at])
        return max(lines, key=lines.__getitem__, default="")

    def _handler_times(self) -> Iterator[HandlerTimes]:
        for number, one in enumerate(self._profile.service):
            if one.count:
                shares = np.cumsum(np.array(list(one.bin))) / one.count
                ends = tuple(
                    min(_end_of(int(np.searchsorted(shares, part))), int(one.worst))
                    for part in (0.5, 0.95, 0.99)
                )
                yield HandlerTimes(
                    self._root_name(HANDLERS + number), int(one.count), int(one.cycles), int(one.worst),
                    self._us(one.when), (ends[0], ends[1], ends[2]),
                )  # fmt: skip

    def _masked(self) -> Iterator[Masked]:
        for by, one in zip(("PRIMASK or FAULTMASK", "BASEPRI"), self._profile.masked, strict=True):
            if one.cycles:
                begin, end = (self._image.place(FLASH + place - 2) for place in (one.begin, one.end))
                yield Masked(by, int(one.cycles), self._us(one.when), begin, end, self._root_name(one.root))


def _children(nodes: Any, index: int) -> Iterator[int]:
    child = nodes[index].child
    while child:
        yield int(child)
        child = nodes[child].sibling


def _end_of(index: int) -> int:
    """Return the most cycles that a bin counts."""
    octave, part = divmod(index, BIN_PER_OCTAVE)
    return ((BIN_PER_OCTAVE + part + 1) << octave) - 1


def _cycles_of_code(chip: Chip) -> NDArray[np.int64]:
    """Return the cycles of each half word of flash in the whole flight; a refill belongs to the jump."""
    counts = chip.passages
    cycles: NDArray[np.int64] = runs_of(counts) * chip.cycles_of_code()
    cycles[:-1] += REFILL * counts[1:-1, 2].astype(np.int64)
    return cycles
