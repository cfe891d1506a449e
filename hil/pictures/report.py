"""The report of a flight: `report.html` in its run folder, one self-contained file.

Made from `result.json`, `log.parquet` and `events.jsonl`; lost, interrupted or killed flights have reports as well.
"""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import pyarrow as pa

from firmware_py.rtos.statistics import LATENCY_BOUNDS_US
from hil.laboratory.experiment import Experiment
from hil.laboratory.experiments import find_shipped
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Span, spans_of
from hil.laboratory.files.ages import ages_in_time_of
from hil.laboratory.files.recorder import forget_read_columns, load_events, load_log, release_of, stored_in
from hil.laboratory.files.result import Result, read_result
from hil.laboratory.metrics import METRICS, SHOWN, short_of
from hil.laboratory.schedule import load_schedule
from hil.pictures import figures
from hil.pictures.curves import own_columns, with_marks
from hil.pictures.gallery import pictures_of
from hil.pictures.links import link_to
from hil.pictures.pages import PageFigure, draw, write_page, zoomable
from hil.pictures.panels import QUESTIONS, Marks, marks_of_flight
from hil.pictures.timeline import close_ups, failures_of, story_of

REPORT = "report.html"


@dataclass(frozen=True, slots=True)
class MetricRow:
    """One line of the table of metrics, ready to print; `mark` is None where there is no limit."""

    name: str
    meaning: str
    value: str
    unit: str
    limit: str
    mark: str | None


@dataclass(frozen=True, slots=True)
class FaultRow:
    """One line of the table of faults, ready to print; times in seconds from the release."""

    kind: str
    begin_s: str
    end_s: str
    size: str
    meaning: str


def write_report(folder: Path, experiment: Experiment | None = None) -> Path:
    """Write `report.html` into a run folder and return its path. Raises `LabError` when the folder holds no log.

    `experiment` is the one flown. Without it, one of a file or package is not executed: see `not_executed`.
    """
    result, events = read_result(folder, find_shipped), load_events(folder)
    log = with_marks(load_log(folder), events)
    experiment, release_us = experiment or result.request.experiment, release_of(log.schema.metadata)
    marks = marks_of_flight(log, result.cause if result.outcome == "lost" else None)
    answers = _answers(folder, log, experiment, marks)
    failures = failures_of(log, result)
    close = close_ups(log, marks, failures[0].at_s if failures else None)
    return write_page(
        folder / REPORT,
        "report.html.j2",
        result=result,
        missing=not_executed(experiment, result.request.faults),
        rows=metric_rows(result),
        faults=fault_rows(spans_of(log.schema.metadata)),
        events=events,
        release_us=release_us,
        failures=failures,
        story=story_of(log, result, events),
        track=draw(figures.TRACK, marks, log),
        marked=marks.kinds,
        figures=answers,
        close_ups=close,
        link_to=link_to,
        zoomable=zoomable([*(one.figure for one in close), *chain(*answers.values())]),
        latency_bounds=LATENCY_BOUNDS_US,
        log_rows=log.num_rows,
        config=json.dumps(stored_in(log.schema.metadata, "config"), indent=2),
    )


def not_executed(experiment: Experiment, faults: Iterable[str]) -> str:
    """Return what a report lacks because the experiment's code was not executed, as one line; empty: nothing."""
    if experiment.is_known:
        return ""
    own = sorted({text.partition("@")[0] for text in faults} - KINDS.keys())
    lacking = ["its own picture"] * (experiment.draw is not None)
    lacking += [f"its own kinds of faults ({', '.join(own)})"] * bool(own)
    if not lacking:
        return ""
    command = f"--experiment {experiment.reference}"
    return f"without {' and '.join(lacking)}, which need the experiment's code: {command!r} executes it"


def _answers(
    folder: Path, log: pa.Table, experiment: Experiment, marks: Marks
) -> dict[str, list[PageFigure]]:
    """Return the figures of a flight by the question that they answer."""
    ages, schedule = ages_in_time_of(iter([log]), folder), load_schedule(folder)
    pictures = [figures.COURSE] if figures.goal_moves(log) else []
    pictures += [*pictures_of(experiment), *figures.PICTURES]
    pictures += [picture for group, picture in figures.OWN.items() if own_columns(log, group)]
    drawn = [(picture, log) for picture in pictures]
    if ages.num_rows:
        drawn.append((figures.LATENCY_BUDGET, ages))
    if schedule.num_rows:
        drawn.append((figures.SCHEDULE, schedule.replace_schema_metadata(log.schema.metadata)))
    answers: dict[str, list[PageFigure]] = {question: [] for question in QUESTIONS}
    for picture, rows in drawn:
        forget_read_columns()
        if picture.fits(rows.column_names):
            answers[picture.question].append(draw(picture, marks, rows))
    return answers


def metric_rows(result: Result) -> list[MetricRow]:
    """Return one row per metric that has a value or a limit, those with a limit first."""
    verdicts = {verdict.metric: verdict for verdict in result.verdicts}
    rows = []
    for name, metric in {**METRICS, **result.own_metrics}.items():
        value = result.metrics.get(name, math.nan)
        scale, unit = SHOWN.get(metric.unit, (1.0, metric.unit))
        verdict = verdicts.get(name)
        if math.isnan(value) and verdict is None:
            continue
        sign = "≤" if metric.bound == "max" else "≥"
        limit = "" if verdict is None else f"{sign} {verdict.bound * scale:.4g}"
        text = "–" if math.isnan(value) else "never" if math.isinf(value) else f"{value * scale:.4g}"
        unit += short_of(metric, value, result.metrics, result.request.duration_s)
        rows.append(
            MetricRow(name, metric.meaning, text, unit, limit, None if verdict is None else verdict.mark)
        )
    return sorted(rows, key=lambda row: row.mark is None)


def fault_rows(spans: Iterable[Span]) -> list[FaultRow]:
    """Return one row per fault, with its times from the release."""
    rows = []
    for span in spans:
        kind = KINDS[span.fault.kind]
        size = f"{span.fault.size:g} {kind.unit}".strip() if kind.sized else ""
        end = f"{span.end_s:.3f}" if span.end_s < math.inf else "with the flight"
        rows.append(FaultRow(span.fault.kind, f"{span.begin_s:.3f}", end, size, kind.meaning))
    return rows
