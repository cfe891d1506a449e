"""Take-off and landing: height, climb and air, with the stages of the fans."""

from __future__ import annotations

from typing import TYPE_CHECKING

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
from hil.laboratory.metrics import column, free_flight
from hil.pictures.picture import Picture

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure


def draw(*flights: pa.Table) -> Figure:
    """Draw height, vertical speed and the air at the robot over time; the first flight dark, further ones light."""
    from hil.pictures.curves import BLUE, GREY
    from hil.pictures.drawing import stack

    figure, axes = stack((2.2, 1.5, 1.5))
    for index, flight in reversed(list(enumerate(map(free_flight, flights)))):
        times = 1e-6 * (column(flight, "t") - column(flight, "t")[0])
        curves = (
            100 * (column(flight, "truth.z") - STANDING_Z),
            100 * column(flight, "truth.vz"),
            column(flight, "flow.z"),
        )
        for one, curve in zip(axes, curves, strict=True):
            one.plot(times, curve, color=BLUE, alpha=0.3 if index else 1.0)
    goal = 100 * (column(flight, "goal.z") - STANDING_Z)
    axes[0].plot(times, goal, color="black", linestyle="--", linewidth=0.8, label="goal")
    axes[0].legend(loc="center right")
    for one, label in zip(
        axes, ("height over the net [cm]", "climb [cm/s]", "air, upwards [m/s]"), strict=True
    ):
        one.set_ylabel(label)
        one.axvspan(CONTROLLER_ON, FANS_OFF, color=GREY, alpha=0.12, linewidth=0)
        for start in (SPIN_UP, FLIGHT_FROM, LANDING_FROM, FANS_OFF):
            one.axvline(start, color="black", linewidth=0.6)
        one.margins(x=0)
    stages = (
        (SPIN_UP, f"take-off {TAKE_OFF:.0%}"),
        (FLIGHT_FROM, f"flight {FLIGHT:.0%}"),
        (LANDING_FROM, f"landing {LANDING:.0%}"),
        (FANS_OFF, "fans off"),
    )
    for start, name in stages:
        axes[2].text(start + 0.15, 0.3, name, fontsize=8)
    axes[2].set_xlabel("time after the release [s]")
    return figure


TAKE_OFF_LANDING = Picture(
    "Take-off and landing",
    "Height over the net, vertical speed and the air at the robot. Lines: a new speed of the fans; grey: controller on.",
    draw,
    needs="flow.z",
)
