"""Time that runs backwards: what the flight, woken at a checkpoint, looks for on its way forward again.

An instant between two instructions is a `Position`. Going back means to fly again from a checkpoint before it to exactly
there: by whole blocks of instructions first, then instruction by instruction. The last stop before an instant is found
by flying again up to it and noting each stop on the way.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any, NamedTuple

from hil.emulator.stm32f405.chip import CYCLES_PER_US, Chip

PERIOD = 50_000 * CYCLES_PER_US  # between checkpoints
NEAR = (
    2_000 * CYCLES_PER_US
)  # a checkpoint so close before an instant makes further steps back from there quick
SHARE = 8  # of a long way, checkpoints lie so close
TRAIL = 64  # instants passed


class Position(NamedTuple):
    """An instant of the chip between two instructions; `order` sorts those of one flight by time."""

    resets: int
    begun: int  # instructions executed before the block
    exceptions: int  # entered before it
    pc: int
    at: int  # [cycles] a run until then ends in front of this instant, at most a block before it
    before: int  # and a run until then at least an instruction before it

    @property
    def order(self) -> tuple[int, ...]:
        return self[:4]


def position_of(chip: Chip) -> Position:
    """Return the present instant of a stopped chip."""
    state, pc = chip.state, chip.register("pc")
    if state.resume == pc:  # within a block
        begun, at, before = state.begun, state.begun_at, state.earlier_at
    else:
        begun, at, before = state.instructions, state.begun_at + 1, state.begun_at
    return Position(chip.resets, int(begun), int(state.exceptions), pc, int(at), int(before))


def access_of(chip: Chip) -> Position:
    """Return the instant before the instruction with the last access of a watchpoint, in the block just executed."""
    state = chip.state
    return Position(
        chip.resets, int(state.begun), int(state.watch_exceptions), int(state.watch_pc),
        int(state.begun_at), int(state.earlier_at),
    )  # fmt: skip


class Goal(Enum):
    """What a search ends with."""

    THERE = "there"  # at its end
    AFTER = "after"  # at the instruction after its end: GDB steps back over the access of a watchpoint
    STEP = "step"  # at the instruction before its end
    STOP = "stop"  # at the last breakpoint or watchpoint before its end
    BEGIN = "begin"  # where the checkpoints begin


@dataclass(slots=True)
class Search:
    """A way forward to `end`, with what was passed on it."""

    goal: Goal
    end: Position
    watched: int | None = None  # the address whose access is reported at the end
    found: Position | None = None
    trail: list[Position] = field(default_factory=list)

    @property
    def slow_from(self) -> int:
        """Cycles from which the chip is stepped."""
        return self.end.before if self.goal is Goal.STEP else self.end.at

    def note(self, position: Position, watched: int | None = None) -> None:
        """Keep a stop, if it is before the end."""
        if self.goal is Goal.STOP and position.order < self.end.order:
            self.found, self.watched = position, watched

    def pass_by(self, position: Position) -> None:
        """Keep an instant before the end, unless it is known already."""
        if not self.trail or self.trail[-1].order < position.order:
            self.trail = [*self.trail[-TRAIL + 1 :], position]

    def may_begin(self, position: Position) -> bool:
        """Return whether a checkpoint there is before the end."""
        before = position.order < self.end.order
        return before or (self.goal in (Goal.THERE, Goal.AFTER) and position.order == self.end.order)

    def is_over(self, position: Position) -> bool:
        """Return whether the way ends there."""
        return position.order > self.end.order or (
            position.order == self.end.order and self.goal is not Goal.AFTER
        )

    def is_due(self, last: int, now: int) -> bool:
        """Return whether another checkpoint is due, after one at `last` [cycles]."""
        if now - last > NEAR and 0 <= self.slow_from - now <= NEAR:
            return True
        return now - last >= max(PERIOD, (self.end.at - last) // SHARE)

    def stored(self) -> dict[str, Any]:
        """Return it as JSON has it."""
        return {**asdict(self), "goal": self.goal.value}

    @classmethod
    def of(cls, stored: dict[str, Any]) -> Search:
        """Return what `stored` has returned."""
        end, trail = Position(*stored["end"]), [Position(*one) for one in stored["trail"]]
        found = None if stored["found"] is None else Position(*stored["found"])
        return cls(Goal(stored["goal"]), end, stored["watched"], found, trail)
