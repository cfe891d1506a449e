"""Processor time of the user's own logic: a loop whose length depends on data is charged before it starts.

Only logic with such loops uses this; `firmware_py/logic/budget.py` inserts the calls. A loop that exceeds the remaining
budget does not start and the call has no result: the guard behind it finds NaN and reacts.
"""

from firmware_py.core.maths import ZERO
from firmware_py.core.structs import Control, Estimator
from firmware_py.core.subset import Integer, Struct, i32, kernel

# Tasks take up to 2 ms of the controller's 10 ms period; controller and estimator get half of the rest each: 4 ms of a
# Cortex-M4 at 168 MHz.
CALL_CYCLES = 672000


class LoopBudget(Struct):
    """The loop budget of one module's calls."""

    cycles: i32  # counted in the present call
    exceeded: i32  # 1: a loop was skipped since the last result
    line: i32  # of the first loop ever skipped, 0: none
    end: i32  # of that loop's range


@kernel
def begin_call(budget: LoopBudget, cycles: Integer) -> None:
    """Begin a call; `cycles` is its cost without the charged loops."""
    budget.cycles = i32(cycles)


@kernel
def charged_end(budget: LoopBudget, start: Integer, end: Integer, cycles: Integer, line: Integer) -> i32:
    """Charge a range, each step of which takes `cycles`; return its end, or its start when the budget is too small."""
    if end <= start:
        return i32(start)
    room = (CALL_CYCLES - budget.cycles) // cycles
    fits = True
    if start < 0:  # one of the two differences cannot overflow
        fits = bool(end <= start + room)
    else:
        fits = bool(end - start <= room)
    if fits:
        budget.cycles = i32(budget.cycles + (end - start) * cycles)
        return i32(end)
    budget.exceeded = i32(1)
    if budget.line == 0:
        budget.line = i32(line)
        budget.end = i32(end)
    return i32(start)


@kernel
def spoil_control(budget: LoopBudget, control: Control) -> None:
    """Replace the result of a law that exceeded its budget by NaN."""
    if budget.exceeded != 0:
        budget.exceeded = i32(0)
        control.u[0] = ZERO / ZERO


@kernel
def spoil_estimate(budget: LoopBudget, estimator: Estimator) -> None:
    """Replace the result of an estimator that exceeded its budget by NaN."""
    if budget.exceeded != 0:
        budget.exceeded = i32(0)
        estimator.now[0] = ZERO / ZERO
