"""Overload: a task above all others takes more and more of the processor while the robot hovers.

The thief's share of every tick rises from 0 to 100 % in steps of 5 % and 1.5 s. Its load is what makes the estimator, and
then the controller, miss their deadlines (the end of the tick in which they became ready); what the hover makes of it is
in the position error. Losing the robot at full load is no failure of the experiment: the limits say up to which load
the flight has to hold.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from hil.experiments.experiment import Experiment

if TYPE_CHECKING:
    from firmware_py.firmware import Thief
    from hil.harness import Flight

STEP_PERCENT = 5
STEP_US = 1_500_000


def steal_more_and_more(flight: Flight) -> None:
    """Plan the steps of the thief's share."""
    thief = flight.thief
    for index, percent in enumerate(range(0, 101, STEP_PERCENT)):
        flight.events.at(flight.release_us + index * STEP_US, partial(_take, thief, flight, percent))


def _take(thief: Thief, flight: Flight, percent: int, now_us: int) -> None:
    thief.share = percent / 100
    flight.note("lab", f"the thief takes {percent} % of the processor")


OVERLOAD = Experiment(
    name="overload",
    summary="hover while a task above all others takes 0 to 100 % of the processor",
    duration_s=21 * STEP_US * 1e-6,
    limits={"estimator_late_from": 0.10, "controller_late_from": 0.60, "held_up_to": 0.60},
    script=steal_more_and_more,
)
