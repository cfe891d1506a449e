"""The experiments' own pictures, after the paper's figures: every trial light, a representative one, the first, dark.

Time counts from the release; grey: a fault acts. matplotlib is loaded when the first picture is drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from hil.experiments import measures
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import spans_of
from hil.laboratory.metrics import BOX, column, free_flight, position_error
from hil.laboratory.recorder import release_of
from hil.pictures.curves import AXIS_COLOURS, GREY
from hil.pictures.picture import Picture

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LIGHT, DARK, WANTED = (
    "#9dbac6",
    "#1381b2",
    "#d04030",
)  # the paper's figure experiments_fig: trials, one of them, target
HEIGHT = 2.6  # [in] of one axis
Signal = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Quantity:
    """What goes on a vertical axis: (value, goal) of a flight, (N,) each, in the unit of the label."""

    label: str
    read: Callable[[pa.Table], tuple[Signal, Signal]]


def yaw_degrees(flight: pa.Table) -> tuple[Signal, Signal]:
    yaw, goal = measures.yaw_and_goal(flight)
    return np.degrees(yaw), np.degrees(goal)


def centimetres(axis: str, flight: pa.Table) -> tuple[Signal, Signal]:
    value, goal = measures.axis_and_goal(axis, flight)
    return 100 * value, 100 * goal


def openings(flight: pa.Table) -> tuple[Signal, Signal]:
    """Return mean opening of the four flaps, and what the controller asked for, over a tenth of a second [deg]."""
    signs = np.array([1.0, -1.0, 1.0, -1.0])
    value, command = (
        np.degrees(column(flight, *(f"{kind}.flap_{flap}" for flap in (1, 2, 3, 4))) @ signs / 4)
        for kind in ("truth", "control")
    )
    return _tenth(value), _tenth(command)


def _tenth(values: Signal) -> Signal:
    return np.convolve(np.pad(values, (5, 4), "edge"), np.full(10, 0.1), "valid")


YAW = Quantity("yaw [deg]", yaw_degrees)
X, Y, Z = (Quantity(f"{axis} [cm]", partial(centimetres, axis)) for axis in "xyz")
OPENING = Quantity("mean opening [deg]", openings)


def follow(quantities: tuple[Quantity, ...], window_s: tuple[float, float], *flights: pa.Table) -> Figure:
    """Draw quantities and their goals, one axis each, of one flight or of several trials, inside a window of time."""
    from hil.pictures.drawing import stack

    figure, axes = stack([HEIGHT] * len(quantities))
    free = [free_flight(flight) for flight in flights]
    for one, quantity in zip(axes, quantities, strict=True):
        for index, flight in reversed(list(enumerate(free))):
            times, (value, goal) = measures.seconds(flight), quantity.read(flight)
            if index:
                one.plot(times, value, color=LIGHT, label="trials" if index == 1 else None)
            else:
                one.plot(times, value, color=DARK, linewidth=1.6, label="flight")
                one.plot(
                    times, goal, color=WANTED, linestyle="--", linewidth=1.1, drawstyle="steps-post", label="target"
                )  # fmt: skip
        one.set_ylabel(quantity.label)
        _shade_faults(one, flights[0])
        _mark(one, flights[0])
        one.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    longest = max(float(measures.seconds(flight).max(initial=0.0)) for flight in free)
    axes[-1].set_xlim(window_s[0], max(min(window_s[1], longest), window_s[0] + 0.1))
    return figure


def disturbed(*flights: pa.Table) -> Figure:
    """Draw the position error of one flight with its disturbances and the 20 cm box; trials light."""
    from hil.pictures.drawing import stack

    figure, axes = stack([1.7] * 3)
    for index, flight in reversed(list(enumerate(map(free_flight, flights)))):
        times, error = measures.seconds(flight), 100 * position_error(flight)
        for axis, one in enumerate(axes):
            colour, width = (LIGHT, 0.9) if index else (AXIS_COLOURS[axis], 1.4)
            one.plot(times, error[:, axis], color=colour, linewidth=width)
    for one, name in zip(axes, "xyz", strict=True):
        one.set_ylabel(f"{name} error [cm]")
        one.margins(x=0)
        for limit in (-100 * BOX, 100 * BOX):
            one.axhline(limit, color="black", linestyle="--", linewidth=0.8)
        _shade_faults(one, flights[0])
    for begin_s, text in _names(flights[0]).items():
        place: Any = axes[0].get_xaxis_transform()
        axes[0].text(begin_s, 1.02, text, transform=place, fontsize=7.5, ha="left", va="bottom")
    return figure


def _spans(flight: pa.Table) -> list[tuple[float, float, str]]:
    """Return begin and end [s after the release] and text of the faults of a flight, clipped to its end."""
    rows = free_flight(flight)
    if rows.num_rows == 0:
        return []
    release_us, end_us = release_of(flight.schema.metadata), column(rows, "t")[-1]
    return [
        (
            1e-6 * (span.begin_us - release_us), 1e-6 * (min(span.end_us, end_us) - release_us),
            f"{span.fault.kind.partition('.')[2]} {span.fault.size:+g} {KINDS[span.fault.kind].unit}".rstrip(),
        )
        for span in spans_of(flight.schema.metadata)
        if span.begin_us < end_us
    ]  # fmt: skip


def _shade_faults(axes: Axes, flight: pa.Table) -> None:
    for begin_s, end_s, _ in _spans(flight):
        axes.axvspan(begin_s, end_s, color=GREY, alpha=0.15, linewidth=0)


def _mark(axes: Axes, flight: pa.Table) -> None:
    from hil.pictures.drawing import draw_marks

    draw_marks([axes], flight)


def _names(flight: pa.Table) -> dict[float, str]:
    return {begin_s: text for begin_s, _, text in _spans(flight)}


YAW_STEP = Picture(
    "Step in yaw",
    "Yaw and its target, as in the paper's figure of tracking, a; and the height that it costs.",
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
    "Position, W, while a fan beside the tunnel blows (grey, darker with every step of its speed), as in the paper's "
    "figure of robustness, e; the height that leaning costs.",
    partial(follow, (X, Y, Z), (0.0, 60.0)),
)
DISTURBED = Picture(
    "Disturbances",
    "Position error with each disturbance (grey) and its size. Dashed: the 20 cm box.",
    disturbed,
)
AIRSPEED = Picture(
    "Airspeed",
    "Height, and the mean opening of the flaps (target: what the controller asks for), over 0.1 s.",
    partial(follow, (Z, OPENING), (0.0, 60.0)),
    needs="control.flap_1",
)
