"""Figures of power: the comparison of vehicles (paper, figure robustness a and b) and the discharge of the battery."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from hil.experiments.measures import seconds
from hil.experiments.power import power as mean_power
from hil.experiments.specific_power import CONVENTIONAL_W_PER_KG, VEHICLES
from hil.laboratory.metrics import column, free_flight
from hil.laboratory.recorder import stored_in
from hil.pictures import curves
from hil.pictures.figures import SECOND
from hil.pictures.panels import Panel, Plot, Series
from hil.pictures.trials import lines_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KIND_COLOURS = {"quadcopter": curves.SKY, "drone": curves.BLUE, "helicopter": curves.GREEN}


def compare(*flights: pa.Table) -> Figure:
    """Draw specific power as bars, and power over mass, with this flight's Floaty in red."""
    from hil.pictures.drawing import beside

    means = [mean_power(free_flight(flight)) for flight in flights]
    power, specific = (
        float(np.mean([values[name] for values in means])) for name in ("power", "specific_power")
    )
    mass = power / specific
    figure, (bars, scatter) = beside(1.15, 1.0)
    names = ["Floaty", *(vehicle.name for vehicle in VEHICLES)]
    values = [power / mass, *(vehicle.specific_power for vehicle in VEHICLES)]
    spreads = [0.0, *(np.ptp(vehicle.power_range) / 2 / vehicle.mass for vehicle in VEHICLES)]
    colours = [curves.RED, *(KIND_COLOURS[vehicle.kind] for vehicle in VEHICLES)]
    stars = [True, *(vehicle.updraft for vehicle in VEHICLES)]
    rows = np.arange(len(names))
    bars.barh(
        rows, values, color=colours, xerr=[spread or np.nan for spread in spreads], ecolor="black", capsize=2
    )
    for row, (value, spread, star) in enumerate(zip(values, spreads, stars, strict=True)):
        bars.text(value + spread + 6, row, f"{value:.0f}{' ★' if star else ''}", va="center", fontsize=8)
    bars.set_yticks(rows, names)
    bars.invert_yaxis()
    bars.set_xlim(0.0, 1.12 * max(values))
    bars.set_xlabel("specific power [W/kg]")
    bars.grid(visible=False, axis="y")

    masses = np.array([0.01, 30_000.0])
    low, high = CONVENTIONAL_W_PER_KG
    scatter.fill_between(masses, low * masses, high * masses, color=curves.GREY, alpha=0.3, linewidth=0)
    for vehicle in VEHICLES:
        marker, size = ("*", 9) if vehicle.updraft else ("o", 5)
        colour = KIND_COLOURS[vehicle.kind]
        scatter.plot(vehicle.mass, vehicle.power, marker, color=colour, markersize=size)
    for kind, colour in KIND_COLOURS.items():
        scatter.plot([], [], "o", color=colour, markersize=5, label=kind)
    scatter.plot(mass, power, "*", color=curves.RED, markersize=13, label="Floaty")
    scatter.set(xscale="log", yscale="log", xlim=masses, xlabel="mass [kg]", ylabel="power in hover [W]")
    scatter.legend(loc="upper left")
    return figure


def discharge(*flights: pa.Table) -> Plot:
    """Draw voltage, power and charge; the first flight dark, further ones light."""
    free = [*map(free_flight, flights)]
    times = [seconds(flight) for flight in free]

    def lines(name: str, scale: float = 1.0) -> tuple[Series, ...]:
        return lines_of(zip(times, (scale * column(flight, name) for flight in free), strict=True))

    powers = [column(flight, "battery.power") for flight in free]
    whole = np.array([0.0, times[0].max(initial=0.0)])
    mean = Series(f"mean {powers[0].mean():.2f} W", curves.GREY, whole, np.full(2, powers[0].mean()))
    config = stored_in(flights[0].schema.metadata, "config")
    low = (1e-3 * config["supervisor"]["low_battery_mv"],) if config else ()
    shown = lines_of(map(_seconds_mean, times, powers))
    return Plot(
        (
            Panel("cell [V]", lines("battery.voltage"), height=1.6, limits=low),
            Panel("power [W]", (*shown, mean), height=1.6, least=0.0),
            Panel("charge [%]", lines("battery.charge", 100.0), height=1.2),
        )
    )


def _seconds_mean(
    times: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return means over whole seconds: times and values, (N // 100,)."""
    rows = len(times) // SECOND * SECOND
    return times[:rows].reshape(-1, SECOND).mean(axis=1), values[:rows].reshape(-1, SECOND).mean(axis=1)
