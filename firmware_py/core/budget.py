"""The processor time of a call of the user's own logic: a loop whose length depends on data is charged before it begins.

Only logic that has such loops takes this in; `firmware_py/logic/budget.py` writes the calls. A loop for which too little is
left does not begin, and the call has no result: the guard behind it finds NaN, with all that follows from it.
"""

from firmware_py.core.maths import ZERO
from firmware_py.core.structs import Control, Estimator
from firmware_py.core.subset import Integer, Struct, i32, kernel

# Of the 10 ms between two steps of the controller the tasks take up to 2 ms; half of the rest is the controller's, half the
# estimator's: 4 ms of a Cortex-M4 at 168 MHz.
CALL_CYCLES = 672000


class LoopBudget(Struct):
    """What is known of the calls of one module."""

    cycles: i32  # counted in the present call
    exceeded: i32  # whether a loop has not begun since the last result
    line: i32  # of the first loop ever that did not begin, 0: none
    end: i32  # of that loop's range


@kernel
def begin_call(budget: LoopBudget, cycles: Integer) -> None:
    """Begin a call, with the cycles that it takes besides the loops that are charged."""
    budget.cycles = i32(cycles)


@kernel
def charged_end(budget: LoopBudget, start: Integer, end: Integer, cycles: Integer, line: Integer) -> i32:
    """Return the end of a range, each step of which takes some cycles; its start when the budget does not suffice."""
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
    """Put NaN in place of the result of a law that exceeded its budget."""
    if budget.exceeded != 0:
        budget.exceeded = i32(0)
        control.u[0] = ZERO / ZERO


@kernel
def spoil_estimate(budget: LoopBudget, estimator: Estimator) -> None:
    """Put NaN in place of the result of an estimator that exceeded its budget."""
    if budget.exceeded != 0:
        budget.exceeded = i32(0)
        estimator.now[0] = ZERO / ZERO
