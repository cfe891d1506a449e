"""The report of robots that flew together: `report.html` in their folder, with a link to the report of each."""

from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hil.laboratory.files.recorder import load_log, release_of
from hil.laboratory.files.result import Result
from hil.laboratory.metrics import body, column
from hil.laboratory.swarms.result import SWARM_METRICS, SwarmResult
from hil.pictures.curves import SERIES_COLOURS
from hil.pictures.drawing import WIDTH, png
from hil.pictures.pages import PageFigure, data_uri, draw, write_page, zoomable
from hil.pictures.panels import INK, Marks, Panel, Picture, Plot, Series
from hil.pictures.report import REPORT

VIEWS = (("from above", 0, 1), ("from the side", 0, 2))  # title, axes across and up


@dataclass(frozen=True, slots=True)
class RobotRow:
    """One line of the table of robots, ready to print."""

    number: int
    colour: str
    result: Result
    home: str
    failed: str


def colour_of(number: int) -> str:
    """Return the colour of robot 1, 2, ...."""
    return SERIES_COLOURS[(number - 1) % len(SERIES_COLOURS)]


def write_swarm_report(result: SwarmResult) -> Path:
    """Write `report.html` and return its path."""
    logs = [load_log(one.folder) for one in result.robots]
    places = [body(log, *"xyz") + origin for log, origin in zip(logs, result.origins, strict=True)]
    homes = [
        np.add(one.request.config.flight.home, origin)
        for one, origin in zip(result.robots, result.origins, strict=True)
    ]
    figures = [_paths(places, homes), _distances(result, logs, places)]
    rows = [
        RobotRow(
            number, colour_of(number), one, ", ".join(f"{value:g}" for value in home.round(3)),
            one.cause or "; ".join(map(str, one.failed)),
        )
        for number, (one, home) in enumerate(zip(result.robots, homes, strict=True), 1)
    ]  # fmt: skip
    return write_page(
        result.folder / REPORT, "swarm.html.j2", result=result, robots=rows, metrics=SWARM_METRICS, figures=figures,
        zoomable=zoomable(figures),
    )  # fmt: skip


def _paths(places: list[NDArray[np.float64]], homes: list[NDArray[np.float64]]) -> PageFigure:
    """Draw where the robots were, from above and from the side."""

    def drawn() -> Figure:
        figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
        for axes, (title, across, up) in zip(figure.subplots(1, 2), VIEWS, strict=True):
            for number, (place, home) in enumerate(zip(places, homes, strict=True), 1):
                colour = colour_of(number)
                axes.plot(100 * place[:, across], 100 * place[:, up], color=colour)
                axes.plot(*(100 * place[-1, (across, up)]), "o", color=colour, label=f"{number}")
                axes.plot(*(100 * home[[across, up]]), "+", color=INK, markersize=9)
            axes.set(xlabel=f"{'xyz'[across]} [cm]", ylabel=f"{'xyz'[up]} [cm]", title=title)
            axes.set_aspect("equal", adjustable="datalim")
        figure.axes[0].legend(title="robot")
        return figure

    caption = "The paths of the robots in the room; dot: the end; cross: home."
    return PageFigure("paths", "Paths", caption, data_uri(png(drawn)))


def _distances(result: SwarmResult, logs: list[pa.Table], places: list[NDArray[np.float64]]) -> PageFigure:
    """Draw from each robot the distance to its nearest neighbour that flies."""
    times = column(max(logs, key=lambda log: log.num_rows), "t")
    nearest = np.full((len(logs), len(times)), np.nan)
    for a, b in combinations(range(len(logs)), 2):
        rows = min(logs[a].num_rows, logs[b].num_rows)
        apart = 100 * np.linalg.norm(places[a][:rows] - places[b][:rows], axis=1)
        for one in (a, b):
            nearest[one, :rows] = np.fmin(nearest[one, :rows], apart)
    since_s = 1e-6 * (times - release_of(logs[0].schema.metadata))
    series = tuple(
        Series(f"robot {number}", colour_of(number), since_s, values)
        for number, values in enumerate(nearest, 1)
    )
    panel = Panel("distance [cm]", series, 2.2, (100 * result.request.config.distance_min,), least=0.0)
    caption = "Between the centres of mass of a robot and its nearest neighbour; dashed: the limit."
    return draw(Picture("Distances", caption, lambda _: Plot((panel,))), Marks(), logs[0])
