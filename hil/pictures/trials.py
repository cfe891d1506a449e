"""The experiments' own pictures, like the paper's figures: every trial light, the first, a representative one, dark.

Time counts from the release.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pyarrow as pa

from hil.laboratory.experiments import measures, take_off
from hil.laboratory.files.recorder import stored_in
from hil.laboratory.metrics import BOX, column, free_flight, position_error
from hil.pictures.curves import AXIS_COLOURS, BLUE, GREEN, GREY, ORANGE, SKY
from hil.pictures.panels import INK, Panel, Plot, Series, Signal, lanes

# Colours of the paper's figure experiments_fig: all trials, one of them, the target.
LIGHT, DARK, WANTED = "#9dbac6", "#1381b2", "#d04030"
HEIGHT = 2.6  # [in] of one axis
SECOND = 100  # rows


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


def column_of(
    trials: Sequence[pa.Table], name: str, scale: float = 1.0, zero: float = 0.0
) -> tuple[Series, ...]:
    """Return the lines of a column of flights, scaled from its zero."""
    return lines_of((measures.seconds(one), scale * (column(one, name) - zero)) for one in trials)


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
    times = measures.seconds(free[0])
    height = 100 * (column(free[0], "goal.z") - take_off.STANDING_Z)
    goal = Series("goal", INK, times, height, width=0.8, dashed=True)
    fans = [
        (take_off.SPIN_UP, f"take-off {take_off.TAKE_OFF:.0%}"),
        (take_off.FLIGHT_FROM, f"flight {take_off.FLIGHT:.0%}"),
    ]
    fans += [(take_off.LANDING_FROM, f"landing {take_off.LANDING:.0%}"), (take_off.FANS_OFF, "off")]
    begins = np.array([begin for begin, _ in fans])
    end_s = float(times.max(initial=take_off.FANS_OFF))
    names = [name for _, name in fans]
    colours = dict(zip(names, (SKY, BLUE, ORANGE, GREY), strict=True))
    switched = np.array([take_off.CONTROLLER_ON, take_off.FANS_OFF])
    controller = ("controller", switched, ["on", "off"], {"on": GREEN, "off": GREY})
    stages = lanes((controller, ("fans", begins, names, colours)), end_s)
    heights = column_of(free, "truth.z", 100.0, take_off.STANDING_Z)
    return Plot(
        (
            Panel("height over the net [cm]", (*heights, goal), height=2.2),
            Panel("climb [cm/s]", column_of(free, "truth.vz", 100.0)),
            Panel("air, upwards [m/s]", column_of(free, "flow.z")),
            Panel("stages", height=0.8, bars=stages),
        )
    )


def discharge(*flights: pa.Table) -> Plot:
    """Draw voltage, power and charge; the first flight dark, further ones light."""
    free = [*map(free_flight, flights)]
    times = measures.seconds(free[0])
    powers = [column(flight, "battery.power") for flight in free]
    whole = np.array([0.0, times.max(initial=0.0)])
    mean = Series(f"mean {powers[0].mean():.2f} W", GREY, whole, np.full(2, powers[0].mean()))
    config = stored_in(flights[0].schema.metadata, "config")
    low = (1e-3 * config["supervisor"]["low_battery_mv"],) if config else ()
    shown = lines_of(map(_seconds_mean, map(measures.seconds, free), powers))
    return Plot(
        (
            Panel("cell [V]", column_of(free, "battery.voltage"), height=1.6, limits=low),
            Panel("power [W]", (*shown, mean), height=1.6, least=0.0),
            Panel("charge [%]", column_of(free, "battery.charge", 100.0), height=1.2),
        )
    )


def _seconds_mean(times: Signal, values: Signal) -> tuple[Signal, Signal]:
    """Return means over whole seconds: times and values, (N // 100,)."""
    rows = len(times) // SECOND * SECOND
    return times[:rows].reshape(-1, SECOND).mean(axis=1), values[:rows].reshape(-1, SECOND).mean(axis=1)
