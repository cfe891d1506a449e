"""The report of the paper: `report.html` for people, `result.json` for programs.

Figures as in the paper: every trial light, the one with the median error dark.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from math import degrees
from pathlib import Path
from typing import Any

import numpy as np

from hil.config import load_config
from hil.experiments import EXPERIMENTS
from hil.laboratory.metrics import METRICS
from hil.laboratory.recorder import load_log
from hil.laboratory.result import RESULT, commit, versions
from hil.pictures.figures import PICTURES
from hil.pictures.gallery import pictures_of
from hil.pictures.pages import data_uri, write_page
from hil.studies import drag_model, drag_model_report
from hil.studies.catalogue import PROFILES
from hil.studies.paper import Paper, Spread, Trials
from hil.studies.paper_rows import Row
from hil.studies.study_figures import picture
from hil.studies.study_run import StudyResult

REPORT = "report.html"
OPERATIONAL_DEG = 50  # flap angles of flight, in the steps of the test
OF_EVERY_FLIGHT = PICTURES[:2]  # for an experiment without pictures of its own


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture of one experiment on one profile."""

    profile: str
    title: str
    caption: str
    source: str


def write_paper(out: Path, paper: Paper, mounted: Sequence[drag_model.Row] = ()) -> Path:
    """Write `result.json`, `report.html` and the pictures of the studies; returns the report.

    `mounted` is the test of the drag model: with it, its files are written into `drag-model` as well.
    """
    (out / RESULT).write_text(json.dumps(_content(paper), indent=1) + "\n", encoding="utf-8")
    studies = []
    for result in paper.studies:
        if result.curves:
            png = picture(result)
            (out / f"study-{result.study.name}.png").write_bytes(png)
            studies.append((result, data_uri(png)))
    rows = [(name, row, trials, _figures(trials)) for name, row, trials in paper.rows]
    bench = _mounted(out / "drag-model", list(mounted)) if mounted else []
    return write_page(
        out / REPORT, "paper.html.j2", bench=bench, missing=[row for row, _, _ in paper.misses],
        paper=paper, profile=PROFILES[0], rows=rows, studies=studies, metrics=METRICS, spread=Spread.of, commit=commit(),
        versions=versions(),
    )  # fmt: skip


def _mounted(folder: Path, rows: list[drag_model.Row]) -> list[Figure]:
    """Write the test of the drag model into a folder; returns its figures."""
    folder.mkdir(exist_ok=True)
    drag_model.write_csv(rows, folder / "drag_model.csv")
    drag_model_report.write(rows, degrees(load_config().plant.hover_angle), folder)
    figures = []
    for robot, text in drag_model_report.ROBOTS.items():
        for sweep in drag_model.SWEEPS:
            png = (folder / f"drag_model_{robot}_{sweep.name}.png").read_bytes()
            chosen = [row for row in rows if (row.robot, row.sweep) == (robot, sweep.name)]
            misses = [np.abs(row.model - row.mean) for row in chosen if 0 <= row.angle_deg <= OPERATIONAL_DEG]
            force, torque = (float(np.max(misses, axis=0)[part].max()) for part in (slice(0, 3), slice(3, 6)))
            caption = (
                f"{sweep.title}. From 0 to {OPERATIONAL_DEG} degrees model and measurement differ by at most "
                f"{force:.2f} N and {torque:.3f} N m."
            )
            figures.append(Figure(text, f"Drag model, {text}", caption, data_uri(png)))
    return figures


def _figures(both: Sequence[Trials]) -> list[Figure]:
    """Return the pictures of a row, those of the default profile first."""
    figures = []
    for trials in both:
        ordered = trials.representative_first()
        if not ordered:
            continue
        logs = [load_log(result.folder) for result in ordered]
        own = pictures_of(EXPERIMENTS[ordered[0].experiment])
        figures += [
            Figure(
                trials.profile, one.title, one.caption, data_uri(one.png(*(logs if own else logs[:1])))
            )
            for one in own or OF_EVERY_FLIGHT
        ]  # fmt: skip
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


def _trials(row: Row, trials: Trials) -> dict[str, Any]:
    return {
        "holds": trials.holds,
        "missed": {name: gap for name in row.claims if (gap := trials.missed(row, name))},
        "metrics": {
            name: {
                key: value if not isinstance(value, float) or math.isfinite(value) else None
                for key, value in asdict(Spread.of(name, trials.results)).items()
            }
            for name in row.claims
        },
        "flights": [
            {
                "seed": result.seed,
                "outcome": result.outcome,
                "cause": result.cause,
                "passed": result.passed,
                "failed": [verdict.metric for verdict in result.verdicts if not verdict.holds],
                "hash": result.hash,
                "folder": result.folder.name,
            }
            for result in trials.results
        ],
    }


def _study(result: StudyResult) -> dict[str, Any]:
    study = result.study
    return {
        "name": study.name,
        "axis": study.axis,
        "unit": study.unit,
        "sizes": study.sizes,
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
