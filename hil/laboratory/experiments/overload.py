"""Overload: a task of the highest priority takes more and more processor time while the robot hovers.

The thief's share of every tick rises from 0 to 100 % in steps of 5 % and 1.5 s. Its load makes the estimator, and
then the controller, miss their deadlines (the end of the tick in which they became ready); the effect on the hover is
in the position error. Losing the robot at full load does not fail the experiment: the limits state the load that the
flight must withstand.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from hil.laboratory.experiment import Experiment
from hil.laboratory.flight import Flight
from hil.laboratory.metrics import BOX, column, position_error
from hil.laboratory.robot import Robot

STEP_PERCENT = 5
STEP_US = 1_500_000
ROWS_PER_SECOND = 100  # of the log


def with_a_thief(robot: Robot) -> None:
    """Create the thief on board, with a share of 0."""
    robot.thief.share = 0.0


def steal_more_and_more(flight: Flight) -> None:
    """Plan the steps of the thief's share."""
    for index, percent in enumerate(range(0, 101, STEP_PERCENT)):
        flight.events.at(flight.release_us + index * STEP_US, partial(_take, flight, percent))


def _take(flight: Flight, percent: int, now_us: int) -> None:
    flight.robot.thief.share = percent / 100
    flight.note("lab", f"the thief takes {percent} % of the processor")


def thief_load(flight: pa.Table) -> NDArray[np.float64]:
    """Return the thief's share of the processor in every row, (N,), since the row before."""
    taken_us, times_us = column(flight, "cpu.THIEF"), column(flight, "t")
    return np.append(0.0, np.diff(taken_us) / np.diff(times_us))


def loads_that_hurt(flight: pa.Table) -> Mapping[str, float]:
    """Return the loads at which tasks are first late, infinity if never, and the last step inside the box."""
    load, error = thief_load(flight), np.abs(position_error(flight))

    def first(wrong: Any) -> float:
        return float(np.round(load[np.argmax(wrong)], 2)) if wrong.any() else np.inf

    def last_before(wrong: Any) -> float:
        percent = STEP_PERCENT * np.round(load * 100 / STEP_PERCENT)
        whole = percent[percent < percent[np.argmax(wrong)]] if wrong.any() else percent
        return float(whole.max(initial=0.0)) / 100 if len(whole) else np.nan

    return {
        "estimator_late_from": first(np.diff(column(flight, "late.KALMAN"), prepend=0.0) > 0),
        "controller_late_from": first(np.diff(column(flight, "late.STABILIZER"), prepend=0.0) > 0),
        "held_up_to": last_before((error > BOX).any(axis=1)),
    }


OVERLOAD = Experiment(
    name="overload",
    summary="hover while a task above all others takes 0 to 100 % of the processor",
    duration_s=21 * STEP_US * 1e-6,
    limits={
        "estimator_late_from": 0.10, "controller_late_from": 0.60, "held_up_to": 0.60, "lost": 1.0,
        "uncontrolled": 21 * STEP_US * 1e-6,
    },
    prepare=with_a_thief,
    script=steal_more_and_more,
    measure=loads_that_hurt,
    pictures=("overload",),
)  # fmt: skip
