"""The experiments' own pictures, like the paper's figures: every trial light, the first, a representative one, dark.

Time counts from the release.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hil.experiments import measures
from hil.experiments.overload import ROWS_PER_SECOND, thief_load
from hil.experiments.take_off import (
    CONTROLLER_ON,
    FANS_OFF,
    FLIGHT,
    FLIGHT_FROM,
    LANDING,
    LANDING_FROM,
    SPIN_UP,
    STANDING_Z,
    TAKE_OFF,
)
from hil.laboratory.metrics import BOX, column, free_flight, position_error
from hil.pictures.curves import AXIS_COLOURS, BLUE, GREEN, GREY, ORANGE, SKY, task_colour
from hil.pictures.panels import INK, Panel, Plot, Series, Signal, lanes
from hil.pictures.picture import Picture, painted

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure

# Colours of the paper's figure experiments_fig: all trials, one of them, the target.
LIGHT, DARK, WANTED = (
    "#9dbac6",
    "#1381b2",
    "#d04030",
)
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


def follow(quantities: tuple[TrialCurve, ...], window_s: tuple[float, float], *flights: pa.Table) -> Plot:
    """Draw quantities and their goals, one panel each, of one flight or of several trials, inside a window of time."""
    panels = []
    for quantity in quantities:
        read = [(measures.seconds(flight), *quantity.read(flight)) for flight in map(free_flight, flights)]
        (times, value, goal), *others = read
        panels.append(
            Panel(
                quantity.label,
                (
                    *_light((times, value) for times, value, _ in others),
                    Series("flight", DARK, times, value, width=1.6),
                    Series("target", WANTED, times, goal, width=1.1, dashed=True),
                ),
                HEIGHT,
            )
        )
    longest = max(float(line.times.max(initial=0.0)) for line in panels[0].series)
    return Plot(tuple(panels), (window_s[0], max(min(window_s[1], longest), window_s[0] + 0.1)))


def disturbed(*flights: pa.Table) -> Plot:
    """Draw the position error of one flight with the 20 cm box; trials light."""
    read = [(measures.seconds(flight), 100 * position_error(flight)) for flight in map(free_flight, flights)]
    (times, error), *others = read
    box_cm = 100 * BOX
    return Plot(
        tuple(
            Panel(
                f"{name} error [cm]",
                (
                    *_light((times, error[:, axis]) for times, error in others),
                    Series("flight", AXIS_COLOURS[axis], times, error[:, axis], width=1.4),
                ),
                height=1.7,
                limits=(-box_cm, box_cm),
            )
            for axis, name in enumerate("xyz")
        )
    )


def _light(trials: Iterable[tuple[Signal, Signal]]) -> list[Series]:
    """Return the lines of the other trials; the first one names them."""
    return [
        Series("trials" if index == 0 else "", LIGHT, times, value)
        for index, (times, value) in reversed(list(enumerate(trials)))
    ]


def take_off(*flights: pa.Table) -> Plot:
    """Draw height, vertical speed and the air at the robot over time; the first flight dark, further ones light."""
    heights, climbs, flows = [], [], []
    for index, flight in reversed(list(enumerate(map(free_flight, flights)))):
        times, colour = measures.seconds(flight), LIGHT if index else DARK
        name = "" if index > 1 else "trials" if index else "flight"
        height = 100 * (column(flight, "truth.z") - STANDING_Z)
        heights.append(Series(name, colour, times, height))
        climbs.append(Series(name, colour, times, 100 * column(flight, "truth.vz")))
        flows.append(Series(name, colour, times, column(flight, "flow.z")))
    goal = 100 * (column(flight, "goal.z") - STANDING_Z)
    heights.append(Series("goal", INK, times, goal, width=0.8, dashed=True))
    fans = [(SPIN_UP, f"take-off {TAKE_OFF:.0%}"), (FLIGHT_FROM, f"flight {FLIGHT:.0%}")]
    fans += [(LANDING_FROM, f"landing {LANDING:.0%}"), (FANS_OFF, "off")]
    begins, end_s = np.array([begin for begin, _ in fans]), float(times.max(initial=FANS_OFF))
    names = [name for _, name in fans]
    colours = dict(zip(names, (SKY, BLUE, ORANGE, GREY), strict=True))
    controller = (np.array([CONTROLLER_ON, FANS_OFF]), ["on", "off"], {"on": GREEN, "off": GREY})
    stages = lanes((("controller", *controller), ("fans", begins, names, colours)), end_s)
    return Plot(
        (
            Panel("height over the net [cm]", tuple(heights), height=2.2),
            Panel("climb [cm/s]", tuple(climbs)),
            Panel("air, upwards [m/s]", tuple(flows)),
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


YAW_STEP = Picture(
    "Step in yaw",
    "Yaw and its target, as in the paper's figure of tracking, a; and the loss of height.",
    partial(follow, (YAW, Z), (0.5, 4.0)),
)
YAW_SINE = Picture(
    "Sine in yaw",
    "Yaw and its target, as in the paper's figure of tracking, b.",
    partial(follow, (YAW,), (0.0, 60.0)),
)
HEIGHT_SINE = Picture(
    "Sine in height",
    "Height and its target, W, as in the paper's figure of tracking, c.",
    partial(follow, (Z,), (0.0, 60.0)),
)
Y_SQUARE = Picture(
    "Square in y",
    "y and its target, W, as in the paper's figure of tracking, d.",
    partial(follow, (Y,), (0.0, 60.0)),
)
SIDE_WIND = Picture(
    "Side wind",
    "Position, W, while a fan beside the tunnel blows (red, darker with every step of its speed), as in the paper's "
    "figure of robustness, e; the loss of height from leaning.",
    partial(follow, (X, Y, Z), (0.0, 60.0)),
)
DISTURBED = Picture(
    "Disturbances",
    "Position error with each disturbance (red) and its size. Dashed: the 20 cm box.",
    disturbed,
)
AIRSPEED = Picture(
    "Airspeed",
    "Height, and the mean opening of the flaps (target: the commanded one), over 0.1 s.",
    partial(follow, (Z, OPENING), (0.0, 60.0)),
    needs="control.flap_1",
)
TAKE_OFF_LANDING = Picture(
    "Take-off and landing",
    "Height over the net, vertical speed and the air at the robot.",
    take_off,
    needs="flow.z",
)
OVERLOAD = Picture(
    "Overload",
    "Missed deadlines per second and largest position error while a task above all others takes a share of every tick. "
    "Dashed: the 20 cm box. A starved task completes no activation, late or not.",
    partial(painted, overload),
    needs="cpu.THIEF",
)
