"""The report of a campaign: `report.html`, which is self-contained, and `result.json` for programs."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from hil.laboratory.files.whole_files import write_whole
from hil.laboratory.metrics import SHOWN
from hil.pictures import curves
from hil.pictures.drawing import WIDTH, png
from hil.pictures.pages import data_uri, write_page
from hil.research.campaigns.config import Spec, spec_text
from hil.research.campaigns.dataset import Dataset, about
from hil.research.campaigns.findings import FailureMap, Findings, Limited, again, find
from hil.research.campaigns.run import Rate
from hil.research.campaigns.sampling import CubeAxis, value_at

REPORT, RESULT = "report.html", "result.json"
IN_A_ROW = 3
GRID = 60
TICKS = 5
SHADES = 10
BINS = (5, 40)  # of a histogram, by the number of flights
CELLS = (10, 8)  # of a failure map
NAMED = 3  # flights of a cell, failed ones first
FEW = 100  # with at most this many flights a histogram shows each and counts linearly


def write_report(named: str, spec: Spec, dataset: Dataset, complete: bool) -> tuple[Path, Findings]:
    """Write report and result of a campaign's dataset, under the user's name for it; return report and findings."""
    folder, findings = dataset.folder, find(spec, dataset.table())
    histograms = [one for one in findings.limits if len(one.values) > 1 and np.ptp(one.values) > 0.0]
    image, cells = "", []
    if (fitted := findings.failure_map) is not None:
        drawn = _map(fitted)
        image = data_uri(png(lambda: drawn.figure))  # this places its axes
        cells = sorted(_cells(spec, fitted, drawn), key=lambda cell: -cell.failed / cell.flown)
    page = write_page(
        folder / REPORT, "campaign.html.j2", spec=spec, found=findings, complete=complete,
        histograms=data_uri(png(lambda: _histograms(histograms))) if histograms else "",
        failure_map=image, map_cells=cells,
        named=quote(named), begun=about(dataset.plan)["commit"], folder=quote(str(folder)),
    )  # fmt: skip
    text = json.dumps(_content(spec, findings, complete), indent=2)
    write_whole(folder / RESULT, text + "\n")
    return page, findings


def _content(spec: Spec, found: Findings, complete: bool) -> dict[str, Any]:
    return {
        "spec": spec_text(spec),
        "complete": complete,
        **_counts(found.rate),
        "cells": [
            _fields(one, "experiment", "profile", "loss_allowed")
            | _counts(one.rate)
            | {"lost": _counts(one.lost)}
            for one in found.cells
        ],
        "errors": found.errors,
        "limits": [
            _fields(one, "experiment", "profile")
            | {"metric": one.name, "bound": one.bound}
            | _counts(one.rate)
            for one in found.limits
        ],
        "influences": [
            _fields(one, "figure", "method", "chance")
            | {"by_axis": dict(one.by_axis), "half_interval_95": dict(one.halves)}
            for one in found.influences
        ],
        "worst": [_fields(one, "index", "why", "command") for one in found.worst],
    }


def _fields(one: object, *names: str) -> dict[str, Any]:
    return {name: getattr(one, name) for name in names}


def _counts(rate: Rate) -> dict[str, Any]:
    return {"failed": rate.failed, "flown": rate.flown, "interval_95": rate.interval}


def _histograms(limits: list[Limited]) -> Figure:
    rows = -(-len(limits) // IN_A_ROW)
    figure = Figure(figsize=(WIDTH, 1.9 * rows), layout="constrained")
    grid = figure.subplots(rows, IN_A_ROW, squeeze=False).ravel()
    for axes, one in zip(grid, limits, strict=False):
        scale, unit = SHOWN.get(one.metric.unit, (1.0, one.metric.unit))
        count = len(one.values)
        width = np.ptp(one.values) / int(np.clip(2.0 * np.sqrt(count), *BINS))
        first, last = ((end - one.bound) / width for end in (one.values.min(), one.values.max()))
        # the limit is one of them
        edges = one.bound + width * np.arange(np.floor(first), np.ceil(last) + 1.5)
        fails = (one.values > one.bound) if one.metric.bound == "max" else (one.values < one.bound)
        parts = [one.values[~fails] * scale, one.values[fails] * scale]
        axes.hist(parts, bins=edges * scale, stacked=True, color=[curves.BLUE, curves.RED])
        axes.axvline(one.bound * scale, color=curves.RED, linestyle="--")
        if count > FEW:
            axes.set_yscale("log")  # so that the few failures are visible
            axes.set_ylim(bottom=0.7)
        else:
            axes.plot(one.values * scale, np.zeros(count), "|", color=curves.RED, markersize=8, clip_on=False)
            axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_xlabel(f"{one.name} [{unit}]" if unit else one.name)
        axes.set_title(f"{Path(one.experiment).name}, {Path(one.profile).name}", fontsize=8)
    for axes in grid[::IN_A_ROW]:
        axes.set_ylabel("flights")
    for axes in grid[len(limits) :]:
        axes.set_visible(False)
    return figure


@dataclass(frozen=True, slots=True)
class MapCell:
    """A part of a failure map with flights in it."""

    place: tuple[float, float, float, float]  # left, bottom, width, height [% of the figure]
    text: str  # the values there
    failed: int
    flown: int
    flights: tuple[tuple[int, bool, str], ...]  # number, whether it failed, command that repeats it


@dataclass(frozen=True, slots=True)
class DrawnMap:
    figure: Figure
    shown: tuple[int, int]  # the axes' numbers, across and up
    flights: NDArray[np.bool_]  # which are drawn


def _cells(spec: Spec, found: FailureMap, drawn: DrawnMap) -> Iterator[MapCell]:
    """Yield the cells with flights, after the figure was written."""
    numbers, failed = found.flights[drawn.flights], found.failed[drawn.flights]
    across, up = (found.axes[column] for column in drawn.shown)
    points = found.points[drawn.flights][:, drawn.shown]
    which = np.minimum((points * CELLS).astype(int), np.array(CELLS) - 1)
    for row, column in product(range(CELLS[1]), range(CELLS[0])):
        inside = np.flatnonzero((which == (column, row)).all(axis=1))
        if not len(inside):
            continue
        low, high = (np.array([column + n, row + n]) / CELLS for n in (0, 1))
        to_pixels = drawn.figure.axes[0].transData.transform
        corners = 100.0 * to_pixels(np.array([low, high])) / drawn.figure.bbox.size
        first = inside[np.argsort(~failed[inside], kind="stable")][:NAMED]
        yield MapCell(
            (*corners[0].tolist(), *np.diff(corners, axis=0)[0].tolist()),
            f"{_range(across, low[0], high[0])}, {_range(up, low[1], high[1])}",
            int(failed[inside].sum()),
            len(inside),
            tuple((n := int(numbers[at]), bool(failed[at]), again(spec, n)) for at in first),
        )


def _range(axis: CubeAxis, low: float, high: float) -> str:
    """Return the name of an axis and its values between two places."""
    if axis.varies is None:
        return f"{'with' if high == 1.0 else 'without'} {axis.name}"
    if axis.varies.choice is not None:
        return f"{axis.name} {value_at(axis.varies, 0.5 * (low + high))}"
    return f"{axis.name} {value_at(axis.varies, low):.3g} to {value_at(axis.varies, high):.3g}"


def _map(found: FailureMap) -> DrawnMap:
    """Draw the two numbers with most influence on failing, with their faults, and those flights.

    All other numbers are at their centres, all other faults at their frequencies.
    """
    strongest = np.argsort(-np.abs(found.weights))
    numbers_first = sorted(strongest, key=lambda n: found.axes[n].varies is None)
    across, up = [*numbers_first, 0][:2]
    drawn = {found.axes[n].fault for n in (across, up)}
    centre, those = np.full(len(found.axes), 0.5), np.full(len(found.failed), True)
    for column, axis in enumerate(found.axes):
        if axis.varies is None and column not in (across, up):
            centre[column] = 1.0 if axis.fault in drawn else found.points[:, column].mean()
            those &= (axis.fault not in drawn) | (found.points[:, column] == 1.0)
    line = np.linspace(0.0, 1.0, GRID)
    points = np.tile(centre, (GRID * GRID, 1))
    points[:, up] = np.repeat(line, GRID)
    points[:, across] = np.tile(line, GRID)
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    axes = figure.subplots()
    percent = 100.0 * found.chance(points).reshape(GRID, GRID)
    levels = np.linspace(0.0, percent.max(), SHADES + 1)
    shown = axes.contourf(line, line, percent, levels=levels, cmap="Reds", alpha=0.6)
    figure.colorbar(shown, label="chance of failing [%]", format="%.3g")
    for failed, colour, label in ((False, curves.BLUE, "holds"), (True, curves.RED, "fails")):
        flights = found.points[those & (found.failed == failed)]
        axes.plot(flights[:, across], flights[:, up], ".", color=colour, markersize=5, label=label)
    axes.set(xlabel=found.axes[across].name, ylabel=found.axes[up].name)
    axes.set_xticks(*_ticks(found.axes[across]))
    axes.set_yticks(*_ticks(found.axes[up]))
    axes.legend(loc="upper left", bbox_to_anchor=(1.2, 1.0))
    return DrawnMap(figure, (across, up), those)


def _ticks(axis: CubeAxis) -> tuple[list[float], list[str]]:
    """Return places on an axis of the cube, and the values there."""
    if axis.varies is None:
        return [0.0, 1.0], ["without", "with"]
    count = len(axis.varies.choice or ()) or TICKS
    places = [(n + 0.5) / count for n in range(count)]
    values = [value_at(axis.varies, place) for place in places]
    return places, [f"{value:.3g}" if isinstance(value, float) else str(value) for value in values]
