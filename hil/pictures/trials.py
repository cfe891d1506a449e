"""The experiments' own pictures, like the paper's figures: every trial light, the first, a representative one, dark.

Time counts from the release.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hil.experiments import measures, take_off
from hil.experiments.overload import ROWS_PER_SECOND, thief_load
from hil.laboratory.metrics import BOX, column, free_flight, position_error
from hil.pictures.curves import AXIS_COLOURS, BLUE, GREEN, GREY, ORANGE, SKY, task_colour
from hil.pictures.panels import INK, Panel, Plot, Series, Signal, lanes

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure

# Colours of the paper's figure experiments_fig: all trials, one of them, the target.
LIGHT, DARK, WANTED = "#9dbac6", "#1381b2", "#d04030"
HEIGHT = 2.6  # [in] of one axis


@dataclass(frozen=True, slots=True)
class TrialCurve:
    """A quantity on a vertical axis: (value, goal) of a flight, (N,) each, in the unit of the label."""

    label: str
    read: Callable[[pa.Table], tuple[Signal, Signal]]


def yaw_degrees(flight: pa.Table) -> tuple[Signal, Signal]:
    yaw, goal = measures.yaw_and_goal(flight)
    return np.degrees(yaw), np.degrees(goal)


def centimetres(axis: str, flight: pa.Table) -> tuple[Signal, Signal]:
    value, goal = measures.axis_and_goal(axis, flight)
    return 100 * value, 100 * goal


def openings(flight: pa.Table) -> tuple[Signal, Signal]:
    """Return the mean opening of the four flaps, and the commanded one, over a tenth of a second [deg]."""
    signs = np.array([1.0, -1.0, 1.0, -1.0])
    value, command = (
        np.degrees(column(flight, *(f"{kind}.flap_{flap}" for flap in (1, 2, 3, 4))) @ signs / 4)
        for kind in ("truth", "control")
    )
    return _tenth(value), _tenth(command)


def _tenth(values: Signal) -> Signal:
    return np.convolve(np.pad(values, (5, 4), "edge"), np.full(10, 0.1), "valid")


YAW = TrialCurve("yaw [deg]", yaw_degrees)
X, Y, Z = (TrialCurve(f"{axis} [cm]", partial(centimetres, axis)) for axis in "xyz")
OPENING = TrialCurve("mean opening [deg]", openings)


def lines_of(
    trials: Iterable[tuple[Signal, Signal]], colour: str = DARK, width: float = 0.9
) -> tuple[Series, ...]:
    """Return the lines of times and values: the first, the flight, over the light ones of the others, named once."""
    first, *others = trials
    light = [Series("" if index else "trials", LIGHT, *other) for index, other in enumerate(others)]
    return (*reversed(light), Series("flight", colour, *first, width=width))


def follow(quantities: tuple[TrialCurve, ...], window_s: tuple[float, float], *flights: pa.Table) -> Plot:
    """Draw quantities and their goals, one panel each, of one flight or of several trials, inside a window of time."""
    panels = []
    for quantity in quantities:
        read = [(measures.seconds(flight), *quantity.read(flight)) for flight in map(free_flight, flights)]
        lines = lines_of(((times, value) for times, value, _ in read), width=1.6)
        goal = Series("target", WANTED, read[0][0], read[0][2], width=1.1, dashed=True)
        panels.append(Panel(quantity.label, (*lines, goal), HEIGHT))
    longest = max(float(line.times.max(initial=0.0)) for line in panels[0].series)
    return Plot(tuple(panels), (window_s[0], max(min(window_s[1], longest), window_s[0] + 0.1)))


def disturbed(*flights: pa.Table) -> Plot:
    """Draw the position error of one flight with the 20 cm box; trials light."""
    read = [(measures.seconds(flight), 100 * position_error(flight)) for flight in map(free_flight, flights)]
    box_cm = 100 * BOX
    panels = []
    for axis, (name, colour) in enumerate(zip("xyz", AXIS_COLOURS, strict=True)):
        lines = lines_of(((times, error[:, axis]) for times, error in read), colour, 1.4)
        panels.append(Panel(f"{name} error [cm]", lines, height=1.7, limits=(-box_cm, box_cm)))
    return Plot(tuple(panels))


def take_off_and_landing(*flights: pa.Table) -> Plot:
    """Draw height, vertical speed and the air at the robot over time; the first flight dark, further ones light."""
    free = [*map(free_flight, flights)]
    times = [measures.seconds(flight) for flight in free]

    def lines(name: str, scale: float, zero: float = 0.0) -> tuple[Series, ...]:
        return lines_of(zip(times, (scale * (column(flight, name) - zero) for flight in free), strict=True))

    height = 100 * (column(free[0], "goal.z") - take_off.STANDING_Z)
    goal = Series("goal", INK, times[0], height, width=0.8, dashed=True)
    fans = [
        (take_off.SPIN_UP, f"take-off {take_off.TAKE_OFF:.0%}"),
        (take_off.FLIGHT_FROM, f"flight {take_off.FLIGHT:.0%}"),
    ]
    fans += [(take_off.LANDING_FROM, f"landing {take_off.LANDING:.0%}"), (take_off.FANS_OFF, "off")]
    begins = np.array([begin for begin, _ in fans])
    end_s = float(times[0].max(initial=take_off.FANS_OFF))
    names = [name for _, name in fans]
    colours = dict(zip(names, (SKY, BLUE, ORANGE, GREY), strict=True))
    controller = (
        np.array([take_off.CONTROLLER_ON, take_off.FANS_OFF]),
        ["on", "off"],
        {"on": GREEN, "off": GREY},
    )
    stages = lanes((("controller", *controller), ("fans", begins, names, colours)), end_s)
    return Plot(
        (
            Panel(
                "height over the net [cm]", (*lines("truth.z", 100.0, take_off.STANDING_Z), goal), height=2.2
            ),
            Panel("climb [cm/s]", lines("truth.vz", 100.0)),
            Panel("air, upwards [m/s]", lines("flow.z", 1.0)),
            Panel("stages", height=0.8, bars=stages),
        )
    )


def overload(rows: pa.Table, *trials: pa.Table) -> Figure:
    """Draw late tasks and position error over the thief's share, of the first flight."""
    from hil.pictures.drawing import stack

    flight = free_flight(rows)
    load = 5 * np.round(20 * thief_load(flight)).astype(int)  # the steps of the experiment
    shares = np.unique(load)
    figure, axes = stack((2.1, 2.1))
    late = [name for name in flight.column_names if name.startswith("late.")]
    for name in late:
        misses = np.diff(column(flight, name), prepend=0.0)
        per_second = [misses[load == share].mean() * ROWS_PER_SECOND for share in shares]
        task = name.removeprefix("late.")
        axes[0].plot(shares, per_second, "o-", color=task_colour(task), label=task)
    axes[0].set_ylabel("missed deadlines [1/s]")
    axes[0].set_yscale("symlog", linthresh=1.0)
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    error = 100 * np.abs(position_error(flight))
    for axis, name, colour in zip(range(3), "xyz", AXIS_COLOURS, strict=True):
        worst = [error[load == share, axis].max() for share in shares]
        axes[1].plot(shares, worst, "o-", color=colour, label=name)
    axes[1].axhline(100 * BOX, color="black", linestyle="--", linewidth=0.8)
    axes[1].set_ylabel("largest error [cm]")
    axes[1].set_yscale("log")
    axes[1].set_xlabel("share of every tick that the thief takes [%]")
    axes[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure
