"""Late tasks and position error over the share of the processor that is taken away."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hil.experiments.overload import ROWS_PER_SECOND, thief_load
from hil.laboratory.metrics import BOX, column, free_flight, position_error
from hil.pictures import curves
from hil.pictures.picture import Picture

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure


def draw(rows: pa.Table, *trials: pa.Table) -> Figure:
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
        axes[0].plot(shares, per_second, "o-", color=curves.task_colour(task), label=task)
    axes[0].set_ylabel("missed deadlines [1/s]")
    axes[0].set_yscale("symlog", linthresh=1.0)
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    error = 100 * np.abs(position_error(flight))
    for axis, name, colour in zip(range(3), "xyz", curves.POSITION.colours, strict=True):
        worst = [error[load == share, axis].max() for share in shares]
        axes[1].plot(shares, worst, "o-", color=colour, label=name)
    axes[1].axhline(100 * BOX, color="black", linestyle="--", linewidth=0.8)
    axes[1].set_ylabel("largest error [cm]")
    axes[1].set_yscale("log")
    axes[1].set_xlabel("share of every tick that the thief takes [%]")
    axes[1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


OVERLOAD = Picture(
    "Overload",
    "Missed deadlines per second and largest position error while a task above all others takes a share of every tick. "
    "Dashed: the 20 cm box. A task that starves completes nothing, late or not.",
    draw,
    needs="cpu.THIEF",
)
