"""The experiments' pictures that are not over time, by matplotlib: deadlines over load, the power of vehicles over mass.

The comparison of vehicles is the paper's, figure robustness a and b.
"""

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure

from hil.laboratory.experiments.overload import ROWS_PER_SECOND, thief_load
from hil.laboratory.experiments.power import CONVENTIONAL_W_PER_KG, VEHICLES
from hil.laboratory.experiments.power import power as mean_power
from hil.laboratory.metrics import BOX, column, free_flight, position_error
from hil.pictures import curves
from hil.pictures.drawing import beside, stack

KIND_COLOURS = {"quadcopter": curves.SKY, "drone": curves.BLUE, "helicopter": curves.GREEN}


def overload(rows: pa.Table, *trials: pa.Table) -> Figure:
    """Draw late tasks and position error over the thief's share, of the first flight."""
    flight = free_flight(rows)
    load = 5 * np.round(20 * thief_load(flight)).astype(int)  # the steps of the experiment
    shares = np.unique(load)
    figure, axes = stack((2.1, 2.1))
    late = [name for name in flight.column_names if name.startswith("late.")]
    for name in late:
        misses = np.diff(column(flight, name), prepend=0.0)
        per_second = [misses[load == share].mean() * ROWS_PER_SECOND for share in shares]
        task = name.removeprefix("late.")
        axes[0].plot(shares, per_second, "o-", color=curves.task_colour(task), label=task)
    axes[0].set_ylabel("missed deadlines [1/s]")
    axes[0].set_yscale("symlog", linthresh=1.0)
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    error = 100 * np.abs(position_error(flight))
    for axis, name, colour in zip(range(3), "xyz", curves.AXIS_COLOURS, strict=True):
        worst = [error[load == share, axis].max() for share in shares]
        axes[1].plot(shares, worst, "o-", color=colour, label=name)
    axes[1].axhline(100 * BOX, color="black", linestyle="--", linewidth=0.8)
    axes[1].set_ylabel("largest error [cm]")
    axes[1].set_yscale("log")
    axes[1].set_xlabel("share of every tick that the thief takes [%]")
    axes[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def compare(*flights: pa.Table) -> Figure:
    """Draw specific power as bars, and power over mass, with this flight's Floaty in red."""
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
