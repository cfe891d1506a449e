"""Figures of several flights in the same axes: two that are compared, the trials of an experiment.

Time runs from the release, in seconds. Trials as in the paper's figure experiments_fig: every one light, one dark.
"""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.laboratory.metrics import column
from hil.laboratory.recorder import release_of
from hil.pictures import curves
from hil.pictures.drawing import WIDTH, png

LIGHT, DARK = (157 / 255, 186 / 255, 198 / 255), (19 / 255, 129 / 255, 178 / 255)  # the paper's two blues
PAIR = (DARK, curves.ORANGE)


def pair(logs: Sequence[pa.Table], names: Sequence[str]) -> bytes:
    """Return position, attitude and flap angles of two flights over time as PNG."""
    return png(lambda a, b: _pair((a, b), names), *logs)


def _pair(logs: Sequence[pa.Table], names: Sequence[str]) -> Figure:
    panels = [
        (f"{name} [{plot.unit}]", plot.read, index)
        for plot in (curves.POSITION, curves.ATTITUDE, curves.FLAPS)
        for index, name in enumerate(plot.names)
    ]
    figure = Figure(figsize=(WIDTH, 0.95 * len(panels)), layout="constrained")
    grid = figure.subplots(len(panels), 1, sharex=True)
    for axes, (label, read, index) in zip(grid, panels, strict=True):
        for log, name, colour in zip(logs, names, PAIR, strict=True):
            axes.plot(since_release(log), read(log)[:, index], color=colour, label=name)
        axes.set_ylabel(label)
        axes.margins(x=0)
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=2)
    grid[-1].set_xlabel("time from the release [s]")
    figure.align_ylabels(list(grid))
    return figure


def since_release(log: pa.Table) -> NDArray[np.float64]:
    """Return the time of every row [s], zero at the release."""
    return np.asarray(1e-6 * (column(log, "t") - release_of(log.schema.metadata)))
