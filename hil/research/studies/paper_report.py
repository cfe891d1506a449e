"""The report of the paper: `report.html` with its pages for readers, `result.json` for programs.

`report.html` has the table and the contents, `EXPERIMENT.html` the figures of one experiment as in the paper (every trial
light, the one with the median error dark) beside the paper's numbers, `drag-model/drag_model.html`, `design/design.html` and
`studies.html` the rest.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, replace
from functools import partial
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from hil.config import load_config
from hil.laboratory.experiments import find_experiment
from hil.laboratory.files.installation import commit, versions
from hil.laboratory.files.recorder import load_log
from hil.laboratory.files.result import RESULT
from hil.laboratory.files.whole_files import write_whole
from hil.laboratory.metrics import METRICS
from hil.pictures import curves
from hil.pictures.drawing import WIDTH
from hil.pictures.figures import PICTURES, TRACK
from hil.pictures.gallery import pictures_of
from hil.pictures.pages import PageFigure, draw, saved, write_page, zoomable
from hil.pictures.panels import marks_of_flight
from hil.research.design.analysis import Analysis
from hil.research.design.analysis import write as write_design
from hil.research.studies import drag_model
from hil.research.studies.catalogue import PROFILES
from hil.research.studies.drag_model import MountedRow
from hil.research.studies.paper import Paper, Spread, Trials
from hil.research.studies.paper_identification import COLUMNS, WHY, PaperConstant
from hil.research.studies.paper_rows import PaperRow
from hil.research.studies.study import OUTCOMES, StudyResult

REPORT = "report.html"
# Names of the pages beside those of the experiments.
DRAG_MODEL, STUDIES, DESIGN = "drag-model/drag_model", "studies", "design/design"
OF_EVERY_FLIGHT = (TRACK, PICTURES[0])  # for an experiment without own pictures
COLOURS = dict(zip(OUTCOMES, (curves.GREEN, curves.YELLOW, curves.SKY, curves.RED, curves.GREY), strict=True))
SHORT = {"holds": "holds", "degrades": "degr.", "failsafe": "f-safe", "lost": "lost", "error": "error"}
STYLES = ("-", "--", ":")


def write_paper(
    out: Path,
    paper: Paper,
    mounted: Sequence[MountedRow] = (),
    shape: Analysis | None = None,
    constants: Sequence[PaperConstant] = (),
) -> Path:
    """Write `result.json`, `report.html`, its pages and their pictures; return the report.

    `mounted` is the test of the drag model, `shape` the analysis of the design; each has a folder of its own. `constants`
    are the rows of the identification.
    """
    content = _content(paper) | ({"design": [asdict(claim) for claim in shape.claims]} if shape else {})
    if constants:
        content["identification"] = [asdict(one) for one in constants]
    write_whole(out / RESULT, json.dumps(content, indent=1) + "\n")
    pages = [(name, row.title) for name, row, _ in paper.rows]
    if mounted:
        pages.append((DRAG_MODEL, "Drag model"))
        drag_model.write(mounted, degrees(load_config().plant.hover_angle), _folder_of(out, DRAG_MODEL))
    if shape:
        pages.append((DESIGN, "Design"))
        write_design(shape, _folder_of(out, DESIGN))
    studies = [
        (one, saved(out, f"study-{one.study.name}", one.study.question, one.study.remark, partial(study_picture, one)))
        for one in paper.studies
        if one.curves
    ]  # fmt: skip
    if studies:
        pages.append((STUDIES, "Robustness beyond the paper"))
    common = {"pages": pages, "metrics": METRICS, "spread": Spread.of, "profile": PROFILES[0]}
    for name, row, trials in paper.rows:
        _write_experiment(out, name, row, trials, common)
    if studies:
        write_page(out / f"{STUDIES}.html", "paper_studies.html.j2", name=STUDIES, studies=studies, **common)
    return write_page(
        out / REPORT, "paper.html.j2", paper=paper, rows=paper.rows, missing=[row for row, _, _ in paper.misses],
        studies=studies, shape=shape, constants=[astuple(one) for one in constants], columns=COLUMNS,
        why=WHY, commit=commit(), versions=versions(), **common,
    )  # fmt: skip


def _folder_of(out: Path, page: str) -> Path:
    """Make the folder of a page that has one, and return it."""
    folder = (out / page).parent
    folder.mkdir(exist_ok=True)
    return folder


def _write_experiment(
    out: Path, name: str, row: PaperRow, trials: tuple[Trials, ...], common: Mapping[str, Any]
) -> None:
    figures = _figures(row, trials)
    shown = [one for _, pictures in figures for one in pictures]
    write_page(
        out / f"{name}.html", "paper_experiment.html.j2", name=name, row=row, both=trials, figures=figures,
        kinds=dict.fromkeys(kind for one in shown for kind in one.marks.kinds), zoomable=zoomable(shown), **common,
    )  # fmt: skip


def _figures(row: PaperRow, both: Sequence[Trials]) -> list[tuple[str, list[PageFigure]]]:
    """Return the profiles with the pictures of a row, the default profile first."""
    figures = []
    for trials in both:
        ordered = trials.representative_first()
        if not ordered:
            continue
        logs = [load_log(one.folder) for one in ordered]
        own = pictures_of(find_experiment(ordered[0].job.experiment))
        marks = marks_of_flight(logs[0], ordered[0].error if ordered[0].outcome == "lost" else None)
        marks = replace(marks, instants=(*marks.instants, *row.marks))
        drawn = [draw(one, marks, *(logs if own else logs[:1])) for one in own or OF_EVERY_FLIGHT]
        shown = [replace(one, name=f"{trials.profile}-{one.name}", alone=True) for one in drawn]
        figures.append((trials.profile, shown))
    return figures


def _content(paper: Paper) -> dict[str, Any]:
    return {
        "holds": paper.holds,
        "interrupted": paper.interrupted,
        "rows": [
            {
                "experiment": name,
                **asdict(row),
                "profiles": {one.profile: _trials(row, one) for one in trials},
            }
            for name, row, trials in paper.rows
        ],
        "studies": [_study(result) for result in paper.studies],
        "commit": commit(),
        "versions": versions(),
    }


def _trials(shown: PaperRow, trials: Trials) -> dict[str, Any]:
    return {
        "holds": trials.holds,
        "missed": trials.gaps(shown),
        "metrics": {
            name: {
                key: value if not isinstance(value, float) or math.isfinite(value) else None
                for key, value in asdict(Spread.of(name, trials.results)).items()
            }
            for name in shown.claims
        },
        "flights": [
            {
                "seed": row.seed, "outcome": row.outcome, "cause": row.error or None, "passed": row.passed,
                "failed": row.failed, "hash": row.hash, "folder": row.folder.name,
            }
            for row in trials.results
        ],
    }  # fmt: skip


def _study(result: StudyResult) -> dict[str, Any]:
    study = result.study
    return {
        **{name: getattr(study, name) for name in ("name", "axis", "unit", "sizes")},
        "as_expected": result.holds,
        "variants": [
            {
                "name": curve.variant.name,
                "expected": curve.variant.expected.text(study.unit),
                "surprises": result.surprises(curve),
                "cells": [asdict(cell) for cell in curve.cells],
            }
            for curve in result.curves
        ],
    }


def study_picture(result: StudyResult) -> Figure:
    """Draw the error over the sizes, a curve per variant, and below it the outcome of every cell.

    A curve is the mean over the surviving seeds, its band their range; it ends where all are lost.
    """
    study, flown = result.study, result.curves
    strip = 0.27 * len(flown) + 0.6
    figure = Figure(figsize=(WIDTH, 2.3 + strip), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.3, strip))
    for index, curve in enumerate(flown):
        alive = [cell for cell in curve.cells if cell.errors]
        places = [study.sizes.index(cell.size) for cell in alive]
        colour = curves.SERIES_COLOURS[index % len(curves.SERIES_COLOURS)]
        errors = [100 * np.array(cell.errors) for cell in alive]
        above.plot(
            places, [e.mean() for e in errors], "o" + STYLES[index % 3], color=colour, markersize=3,
            label=curve.variant.name,
        )  # fmt: skip
        above.fill_between(
            places, [e.min() for e in errors], [e.max() for e in errors], color=colour, alpha=0.12, linewidth=0
        )  # fmt: skip
    above.set_yscale("log")
    above.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    above.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    above.yaxis.set_minor_formatter(NullFormatter())
    above.set_ylabel("rms distance\nfrom the goal [cm]")
    above.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    for row, curve in enumerate(flown):
        for cell in curve.cells:
            place = study.sizes.index(cell.size)
            typical = cell.typical
            below.add_patch(
                Rectangle((place - 0.48, row - 0.45), 0.96, 0.9, color=to_rgba(COLOURS[typical], 0.75))
            )
            count = cell.outcomes.count(typical)
            of_all = "" if count == len(cell.outcomes) else f" {count}/{len(cell.outcomes)}"
            below.text(place, row, SHORT[typical] + of_all, ha="center", va="center", fontsize=7.5)
    below.set_ylim(len(flown) - 0.4, -0.6)
    below.set_yticks(range(len(flown)), [curve.variant.name for curve in flown])
    below.grid(visible=False)
    below.set_xlim(-0.55, len(study.sizes) - 0.45)
    below.set_xticks(range(len(study.sizes)), [f"{size:g}" for size in study.sizes])
    below.set_xlabel(f"{study.axis} [{study.unit}]" if study.unit else study.axis)
    return figure
