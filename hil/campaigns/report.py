"""The report of a campaign: `report.html`, which is self-contained, and `result.json` for programs."""

from __future__ import annotations

import json
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from hil.campaigns.config import Spec, spec_text
from hil.campaigns.dataset import about, read_flights, schema_of
from hil.campaigns.findings import FailureMap, Findings, Limited, find
from hil.campaigns.flying import Campaign
from hil.laboratory.metrics import SHOWN
from hil.pictures import curves
from hil.pictures.drawing import WIDTH, png
from hil.pictures.pages import data_uri, write_page

REPORT, RESULT = "report.html", "result.json"
IN_A_ROW = 3
GRID = 60


def write_report(folder: Path, file: Path, campaign: Campaign, complete: bool) -> tuple[Path, Findings]:
    """Write report and result of the dataset of a spec's file; return the report's path and the findings."""
    spec = campaign.spec
    findings = find(spec, read_flights(folder, schema_of(campaign)))
    histograms = [one for one in findings.limits if len(one.values) > 1]
    mapped = findings.failure_map
    page = write_page(
        folder / REPORT, "campaign.html.j2", spec=spec, found=findings, complete=complete,
        histograms=data_uri(png(lambda: _histograms(histograms))) if histograms else "",
        failure_map=data_uri(png(lambda: _map(mapped))) if mapped is not None else "",
        file=quote(str(file)), begun=about(campaign)["commit"],
    )  # fmt: skip
    text = json.dumps(_content(spec, findings, complete), indent=2)
    (folder / RESULT).write_text(text + "\n", encoding="utf-8")
    return page, findings


def _content(spec: Spec, found: Findings, complete: bool) -> dict[str, Any]:
    return {
        "spec": spec_text(spec),
        "complete": complete,
        "failed": found.rate.failed,
        "flown": found.rate.flown,
        "interval_95": found.rate.interval,
        "errors": found.errors,
        "limits": [
            {
                "experiment": one.experiment, "profile": one.profile, "metric": one.name, "bound": one.bound,
                "failed": one.rate.failed, "flown": one.rate.flown, "interval_95": one.rate.interval,
            }
            for one in found.limits
        ],
        "influences": [
            {"figure": one.figure, "method": one.method, "chance": one.chance, "by_axis": dict(one.by_axis)}
            for one in found.influences
        ],
        "worst": [{"index": one.index, "why": one.why, "command": one.command} for one in found.worst],
    }  # fmt: skip


def _histograms(limits: list[Limited]) -> Figure:
    rows = -(-len(limits) // IN_A_ROW)
    figure = Figure(figsize=(WIDTH, 1.9 * rows), layout="constrained")
    grid = figure.subplots(rows, IN_A_ROW, squeeze=False).ravel()
    for axes, one in zip(grid, limits, strict=False):
        scale, unit = SHOWN.get(one.metric.unit, (1.0, one.metric.unit))
        axes.hist(one.values * scale, bins=40, color=curves.BLUE)
        axes.axvline(one.bound * scale, color=curves.RED, linestyle="--")
        axes.set_yscale("log")  # so that the few failures are visible
        axes.set_xlabel(f"{one.name} [{unit}]" if unit else one.name)
        axes.set_title(f"{Path(one.experiment).name}, {Path(one.profile).name}", fontsize=8)
    for axes in grid[::IN_A_ROW]:
        axes.set_ylabel("flights")
    for axes in grid[len(limits) :]:
        axes.set_visible(False)
    return figure


def _map(found: FailureMap) -> Figure:
    """Draw the two axes on which failing depends most, the others at their centres, and the flights in them."""
    across, up = ([*np.argsort(-np.abs(found.weights)), 0])[:2]
    line = np.linspace(0.0, 1.0, GRID)
    points = np.full((GRID * GRID, len(found.axes)), 0.5)
    points[:, across] = np.tile(line, GRID)
    if len(found.axes) > 1:
        points[:, up] = np.repeat(line, GRID)
    figure = Figure(figsize=(WIDTH, 4.2), layout="constrained")
    axes = figure.subplots()
    shown = axes.contourf(
        line, line, found.chance(points).reshape(GRID, GRID), levels=np.linspace(0, 1, 11), cmap="Reds", alpha=0.6
    )  # fmt: skip
    figure.colorbar(shown, label="chance of failing")
    for failed, colour, label in ((False, curves.BLUE, "holds"), (True, curves.RED, "fails")):
        those = found.points[found.failed == failed]
        axes.plot(those[:, across], those[:, up], ".", color=colour, markersize=3, label=label)
    axes.set_xlabel(f"{found.axes[across]}, from low to high")
    axes.set_ylabel(f"{found.axes[up]}, from low to high")
    axes.legend(loc="upper left", bbox_to_anchor=(1.2, 1.0))
    return figure
