"""Compares two flights: first difference of their logs, metrics side by side, differences in the configuration.

Logs are compared bit for bit, row by row, in the columns that both have; a NaN equals a NaN. Flights released at
different times of their logs, real ones and those over a real link, share no rows: their distance over the time since the
release then shows what the model lacks.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from hil.errors import LabError, unlinked, writing
from hil.laboratory.experiments import find_shipped
from hil.laboratory.files.recorder import load_log, release_of, stored_in
from hil.laboratory.files.result import Result, read_result
from hil.laboratory.metric_pairs import MetricPair, pairs_of
from hil.laboratory.metrics import column, free_flight, is_real, measure, rows_where
from hil.laboratory.request import Find
from hil.pictures import curves
from hil.pictures.curves import since_release
from hil.pictures.drawing import png
from hil.pictures.pages import PageFigure, embedded, write_page, zoomable
from hil.pictures.panels import Panel, Plot, Series, Signal
from hil.pictures.trials import DARK

ROW_S = 0.01
AROUND_US = 1_000_000  # shown before and after the judged part of a real flight
PICTURE, PAGE = "compare.png", "compare.html"
PAIR = (DARK, curves.ORANGE)
# The keys of a result that describe its settings.
SETTINGS = ("experiment", "profile", "overrides", "faults", "seed", "duration_s", "link", "board")


@dataclass(frozen=True, slots=True)
class FlownRun:
    log: pa.Table
    result: Result


@dataclass(frozen=True, slots=True)
class FirstDifference:
    """The first position at which two logs differ; a value is None where that log has ended."""

    row: int
    t_s: float  # from the release
    column: str
    values: tuple[float | None, float | None]

    def __str__(self) -> str:
        a, b = ("the log has ended" if value is None else f"{value!r}" for value in self.values)
        return f"row {self.row}, {self.t_s:.6f} s from the release, {self.column}: {a} | {b}"


@dataclass(frozen=True, slots=True)
class Apart:
    """The distance of two flights at the same time since the release."""

    name: str
    unit: str
    rms: float
    largest: float


@dataclass(frozen=True, slots=True)
class Comparison:
    """The differences between two runs."""

    first: FirstDifference | None  # None: identical
    # Columns that only the second flight has, and that only the first has.
    missing: tuple[tuple[str, ...], tuple[str, ...]]
    span: str  # of the metrics
    metrics: tuple[MetricPair, ...]
    # For flights of which one is real or over a real link, if they have time in common.
    apart: tuple[Apart, ...]
    one_is_real: bool  # and the other is not
    settings: tuple[tuple[str, str, str], ...]  # name, first, second: those that differ
    # Experiments whose own metrics are missing, because the span is not that of the flight and their code not executed.
    unmeasured: tuple[str, ...]

    @property
    def identical(self) -> bool:
        """Whether both logs hold the same columns with the same bits."""
        return self.first is None and self.missing == ((), ())


def load_flown(folder: Path, find: Find = find_shipped) -> FlownRun:
    """Return the log and result of a run folder; `find` returns its experiment. Raises `LabError` if it cannot be read."""
    run = FlownRun(load_log(folder), read_result(folder, find))
    if "flight.free" not in run.log.column_names:
        raise LabError(f"{folder}: its log is not that of a flight")
    return run


def compare(a: FlownRun, b: FlownRun) -> Comparison:
    names_a, names_b = a.log.column_names, b.log.column_names
    common = [name for name in names_a if name in names_b]
    flown_s = tuple(_flown_s(run) for run in (a, b))
    first, second = (_up_to(run, min(flown_s)).metrics for run in (a, b))
    return Comparison(
        _first_difference(a.log, b.log, common),
        (
            tuple(name for name in names_b if name not in common),
            tuple(name for name in names_a if name not in common),
        ),
        _span(*flown_s),
        tuple(pairs_of(first, second, {**a.result.own_metrics, **b.result.own_metrics})),
        tuple(_apart(a.log, b.log)),
        is_real(a.log) != is_real(b.log),
        tuple(_differing_settings(a, b)),
        tuple(filter(None, dict.fromkeys(_unmeasured(run, min(flown_s)) for run in (a, b)))),
    )


def write_comparison(
    folder: Path, a: FlownRun, b: FlownRun, comparison: Comparison, why: Sequence[str] = ()
) -> Path:
    """Write `compare.png` and `compare.html` into a folder; returns the page. Raises `LabError`.

    `why` are lines on what makes them differ.
    """
    logs, names = (_judged(a.log), _judged(b.log)), (str(a.result.folder), str(b.result.folder))
    plot = pair(logs, names)
    figures = [PageFigure(
        "both",
        "Both flights",
        f"Position and attitude against the goal, and what moves the robots, if it is the same. Blue: {names[0]}; orange: "
        f"{names[1]}. Times count from the release of each.",
        plot=embedded(plot),
    )]  # fmt: skip
    if apart := difference(a.log, b.log):
        figures.append(PageFigure(
            "difference", "Difference", "Second less first at the same time since the release.", plot=embedded(apart)
        ))  # fmt: skip
    with writing("--out", folder):
        folder.mkdir(parents=True, exist_ok=True)
        unlinked(folder / PICTURE).write_bytes(png(lambda: plot))
        return write_page(
            folder / PAGE, "compare.html.j2", a=a, b=b, comparison=comparison, why=why, figures=figures,
            zoomable=zoomable(figures),
        )  # fmt: skip


def shown_curves(a: pa.Table, b: pa.Table) -> tuple[tuple[str, curves.Curves], ...]:
    """Return the curves that are compared, with their names; of flaps against rotors position and attitude alone."""
    moving = [plot for plot in curves.actuators(a) if plot[1].fits(b.column_names)]
    return (("position", curves.POSITION), ("attitude", curves.ATTITUDE), *moving)


def pair(logs: tuple[pa.Table, pa.Table], names: Sequence[str]) -> Plot:
    """Return position, attitude and what moves the robots of two flights over time."""
    times = [since_release(log) for log in logs]
    panels = []
    for _, curve in shown_curves(*logs):
        read = [curve.read(log) for log in logs]
        for index, title in enumerate(curve.names):
            both = tuple(
                Series(name, colour, at, values[:, index])
                for name, colour, at, values in zip(names, PAIR, times, read, strict=True)
            )
            panels.append(Panel(f"{title} [{curve.unit}]", both, height=1.25))
    return Plot(tuple(panels))


def difference(a: pa.Table, b: pa.Table) -> Plot | None:
    """Return the second flight less the first over the time that both flew; None where they have none in common."""
    panels = []
    for label, curve in shown_curves(a, b):
        times, miss = _miss(a, b, curve)
        if len(times) > 1:
            lines = zip(curve.names, curve.colours, miss.T, strict=True)
            series = tuple(Series(name, colour, times, values) for name, colour, values in lines)
            panels.append(Panel(f"{label} [{curve.unit}]", series))
    return Plot(tuple(panels)) if panels else None


def _judged(log: pa.Table) -> pa.Table:
    """Return the part of a flight that a picture shows; a real one may have gone on long after the judged part."""
    free = free_flight(log)
    if not is_real(log) or free.num_rows == 0:
        return log
    times, (first_us, last_us) = column(log, "t"), column(free, "t")[[0, -1]]
    return rows_where(log, (times >= first_us - AROUND_US) & (times <= last_us + AROUND_US))


def _apart(a: pa.Table, b: pa.Table) -> Iterator[Apart]:
    free = [free_flight(log) for log in (a, b)]
    lined_up = release_of(a.schema.metadata) == release_of(b.schema.metadata)
    if (lined_up and not (is_real(a) or is_real(b))) or min(log.num_rows for log in free) < 2:
        return
    for _, curve in shown_curves(a, b):
        _, differences = _miss(a, b, curve)
        for name, values in zip(curve.names, differences.T, strict=True):
            miss = values[np.isfinite(values)]
            if len(miss):
                yield Apart(name, curve.unit, float(np.sqrt((miss**2).mean())), float(np.abs(miss).max()))


def _miss(a: pa.Table, b: pa.Table, curve: curves.Curves) -> tuple[Signal, Signal]:
    """Return the times since the release that both flew, and second less first there, (N, names)."""
    free = [free_flight(log) for log in (a, b)]
    if min(log.num_rows for log in free) < 2:
        return np.empty(0), np.empty((0, len(curve.names)))
    times, others = (since_release(log) for log in free)
    common = times <= others[-1]
    first, second = (curve.read(log) for log in free)
    if curve is curves.ATTITUDE:
        second = np.unwrap(second, period=360, axis=0)
    columns = [np.interp(times[common], others, values) for values in second.T]
    miss = np.stack(columns, axis=1) - first[common]
    return times[common], (miss + 180) % 360 - 180 if curve is curves.ATTITUDE else miss


def _first_difference(a: pa.Table, b: pa.Table, columns: list[str]) -> FirstDifference | None:
    rows = min(a.num_rows, b.num_rows)
    row, column = rows, ""
    for name in columns:
        x, y = (table.column(name).to_numpy()[:row] for table in (a, b))
        differs = ~((x == y) | ((x != x) & (y != y)))
        if differs.any():
            row, column = int(np.argmax(differs)), name
    if column:
        x, y = (table.column(column)[row].as_py() for table in (a, b))
        return FirstDifference(row, float(since_release(a)[row]), column, (x, y))
    if a.num_rows == b.num_rows:
        return None
    times = [table.column("t")[rows].as_py() if table.num_rows > rows else None for table in (a, b)]
    longer = a if times[0] is not None else b
    return FirstDifference(rows, float(since_release(longer)[rows]), "t", (times[0], times[1]))


def _flown_s(run: FlownRun) -> float:
    # A real flight may go on after the part that was judged.
    flown = free_flight(run.log) if is_real(run.log) else run.log
    return float(since_release(flown).max(initial=0.0))


def _span(first_s: float, second_s: float) -> str:
    if abs(first_s - second_s) < ROW_S:
        return f"Over the {first_s:.2f} s after the release that both flew."
    return (
        f"Over the first {min(first_s, second_s):.2f} s after the release, which both flew; the flights go on to "
        f"{first_s:.2f} s and {second_s:.2f} s."
    )


def _is_longer(run: FlownRun, end_s: float) -> bool:
    return _flown_s(run) >= end_s + ROW_S


def _unmeasured(run: FlownRun, end_s: float) -> str:
    """Return the experiment of a run whose own metrics over its first `end_s` need code that is not executed; or empty."""
    experiment = run.result.request.experiment
    needs_code = bool(run.result.own_metrics) and _is_longer(run, end_s)
    return experiment.reference if needs_code and not experiment.is_known else ""


def _up_to(run: FlownRun, end_s: float) -> Result:
    """Return the result of a flight with the metrics of its first `end_s` after the release."""
    if not _is_longer(run, end_s):
        return run.result
    log = rows_where(run.log, since_release(run.log) < end_s + ROW_S / 2)
    metrics = measure(log, lost=False)
    experiment = run.result.request.experiment
    if experiment.is_known and (free := free_flight(log)).num_rows > 1:
        metrics.update(experiment.measured(free))
    return replace(run.result, metrics=metrics)


def _differing_settings(a: FlownRun, b: FlownRun) -> list[tuple[str, str, str]]:
    trees = [
        {name: value for name, value in run.result.request.stored().items() if name in SETTINGS}
        | {"outcome": run.result.outcome}
        | _flat(stored_in(run.log.schema.metadata, "config"))
        | {"commit": run.result.program.commit}
        | {f"versions.{name}": number for name, number in run.result.program.versions.items()}
        for run in (a, b)
    ]
    names = [*trees[0], *(name for name in trees[1] if name not in trees[0])]
    shown = [(name, *(_text(tree.get(name)) for tree in trees)) for name in names]
    return [(name, x, y) for name, x, y in shown if x != y]


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(str, value)) or "–"
    return "–" if value is None else str(value)
