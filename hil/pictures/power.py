"""Figures of power: the comparison of vehicles (paper, figure robustness a and b) and the discharge of the battery."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from hil.experiments.measures import seconds
from hil.experiments.power import power
from hil.experiments.specific_power import CONVENTIONAL_W_PER_KG, VEHICLES
from hil.laboratory.metrics import column, free_flight
from hil.laboratory.recorder import stored_in
from hil.pictures import curves
from hil.pictures.figures import SECOND
from hil.pictures.panels import Panel, Plot, Series
from hil.pictures.picture import Picture, painted
from hil.pictures.trials import DARK, LIGHT

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KIND_COLOURS = {"quadcopter": curves.SKY, "drone": curves.BLUE, "helicopter": curves.GREEN}


def compare(*flights: pa.Table) -> Figure:
    """Draw specific power as bars, and power over mass, with this flight's Floaty in red."""
    means = [power(free_flight(flight)) for flight in flights]
    mean, specific = (
        float(np.mean([values[name] for values in means])) for name in ("power", "specific_power")
    )
    return _beside_others(mean, mean / specific)


def _beside_others(power: float, mass: float) -> Figure:
    """Draw the comparison with `power` [W] and `mass` [kg] of Floaty."""
    from hil.pictures.drawing import beside

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
        marker = "*" if vehicle.updraft else "o"
        scatter.plot(
            vehicle.mass,
            vehicle.power,
            marker,
            color=KIND_COLOURS[vehicle.kind],
            markersize=9 if vehicle.updraft else 5,
        )
    for kind, colour in KIND_COLOURS.items():
        scatter.plot([], [], "o", color=colour, markersize=5, label=kind)
    scatter.plot(mass, power, "*", color=curves.RED, markersize=13, label="Floaty")
    scatter.set(xscale="log", yscale="log", xlim=masses, xlabel="mass [kg]", ylabel="power in hover [W]")
    scatter.legend(loc="upper left")
    return figure


def discharge(*flights: pa.Table) -> Plot:
    """Draw voltage, power and charge; the first flight dark, further ones light."""
    voltages, powers, charges = [], [], []
    for index, flight in reversed(list(enumerate(map(free_flight, flights)))):
        times, power = seconds(flight), column(flight, "battery.power")
        name, colour = ("" if index > 1 else "trials", LIGHT) if index else ("flight", DARK)
        voltages.append(Series(name, colour, times, column(flight, "battery.voltage")))
        powers.append(Series(name, colour, *_seconds_mean(times, power)))
        charges.append(Series(name, colour, times, 100 * column(flight, "battery.charge")))
    whole = np.array([0.0, times.max(initial=0.0)])
    mean = Series(f"mean {power.mean():.2f} W", curves.GREY, whole, np.full(2, power.mean()))
    config = stored_in(flights[0].schema.metadata, "config")
    low = (1e-3 * config["supervisor"]["low_battery_mv"],) if config else ()
    return Plot(
        (
            Panel("cell [V]", tuple(voltages), height=1.6, limits=low),
            Panel("power [W]", (*powers, mean), height=1.6, least=0.0),
            Panel("charge [%]", tuple(charges), height=1.2),
        )
    )


def _seconds_mean(
    times: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return means over whole seconds: times and values, (N // 100,)."""
    rows = len(times) // SECOND * SECOND
    return times[:rows].reshape(-1, SECOND).mean(axis=1), values[:rows].reshape(-1, SECOND).mean(axis=1)


COMPARISON = Picture(
    "Specific power",
    "Left: power in hover per mass. Right: power over mass; grey: 100 to 250 W/kg, which the paper calls typical. Stars: in "
    "an updraft. Bars on helicopters: the paper's range of hover power, as a share of the rated one. Red: this flight.",
    partial(painted, compare),
    needs="battery.power",
)
DISCHARGE = Picture(
    "Battery",
    "Voltage of one cell under load, with the supervisor's limit; power, mean over 1 s, and over the flight; charge left.",
    discharge,
    needs="battery.power",
)
