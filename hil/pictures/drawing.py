"""Draws figures as PNG: size, style, and panels in matplotlib, which is loaded here.

Grey: the robot was still held; red: a fault was active; pink: failsafe; yellow strip below: a command at its limit;
dotted blue: an operator's action; black: the flight was lost.
"""

import io
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import matplotlib
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from hil.laboratory.metrics import SHOWN, column
from hil.pictures import curves, panels
from hil.pictures.panels import INK, Marks, Panel, Plot, Series, marks_of_flight

MARK_LENGTH = 28  # letters
WIDTH, DPI = 9.2, 115  # [in], 1/in
INTERVAL_COLOURS = {"held": curves.GREY, "fault": curves.RED, "failsafe": curves.PINK, "limit": curves.YELLOW}
INSTANT_COLOURS = {"operator": curves.BLUE, "lost": INK}
KINDS = {
    "held": "held", "fault": "fault", "failsafe": "failsafe", "limit": "command at its limit", "operator": "operator",
    "lost": "lost",
}  # fmt: skip
SHADE = 0.18  # opacity
STRIP = 0.04  # of the axes' height: commands at their limits
STYLE: Any = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "agg.path.chunksize": 10_000,  # otherwise a long flight's noise overflows the renderer
    "font.size": 8.5,
    "grid.alpha": 0.3,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "lines.linewidth": 0.9,
    "text.usetex": False,  # a matplotlibrc in the current folder could otherwise have LaTeX executed
}


def png(draw: Callable[..., Plot | Figure], *flights: pa.Table) -> bytes:
    """Return what `draw` returns for flight logs as PNG; panels are marked as the first flight was."""
    file = io.BytesIO()
    with matplotlib.rc_context(STYLE):
        made = draw(*flights)
        if isinstance(made, Plot):
            made = figure_of(made, marks_of_flight(flights[0]) if flights else Marks())
        made.savefig(file, format="png", dpi=DPI)
    return file.getvalue()


SI = {
    "cm": (1e-2, "m"), "deg": (math.radians(1.0), "rad"), "us": (1e-6, "s"), "ms": (1e-3, "s"), "%": (1e-2, ""),
    "mN": (1e-3, "N"),
}  # fmt: skip
UNITS = {"SI": SI, "customary": {**SHOWN, "us": (1e-3, "ms")}}
QUANTITIES = {
    "m": "position", "cm": "position", "m/s": "velocity", "rad": "angle", "deg": "angle", "rad/s": "angular rate",
    "deg/s": "angular rate", "s": "time", "ms": "time", "N": "force", "V": "voltage", "W": "power", "counts": "counts",
    "": "value",
}  # fmt: skip


def plotted(
    log: pa.Table, names: Sequence[str], units: str = "customary", size: tuple[float, float] | None = None
) -> Figure:
    """Return a figure of columns of a log, a panel for each unit; without names, of errors and actuators.

    `units` is a key of UNITS; `size` [in]. What the caller has changed in matplotlib's rcParams is kept.
    """
    own = {name for name, value in matplotlib.rcParams.items() if value != matplotlib.rcParamsDefault[name]}
    colours: Sequence[str] = curves.SERIES_COLOURS
    if "axes.prop_cycle" in own:
        colours = matplotlib.rcParams["axes.prop_cycle"].by_key().get("color", colours)
    times, by_unit = curves.since_release(log), dict[str, list[Series]]()
    for index, name in enumerate(names):
        values = column(log, name)  # raises for a name that the log lacks
        unit = (log.schema.field(name).metadata or {}).get(b"unit", b"").decode()
        scale, shown = UNITS[units].get(unit, (1.0, unit))
        line = Series(name, colours[index % len(colours)], times, scale * values)
        by_unit.setdefault(shown, []).append(line)
    chosen = [
        Panel(f"{QUANTITIES.get(unit, 'value')} [{unit or '1'}]", tuple(lines), height=2.2)
        for unit, lines in by_unit.items()
    ]
    if not names:
        for label, curve in curves.errors_and_actuators(log):
            scale, shown = UNITS[units].get(curve.unit, (1.0, curve.unit))
            drawn = panels.panel(curve, log, label, height=1.9)
            lines = tuple(replace(one, values=scale * one.values) for one in drawn.series)
            chosen.append(replace(drawn, label=f"{label} [{shown or '1'}]", series=lines))
    with matplotlib.rc_context({name: value for name, value in STYLE.items() if name not in own}):
        width = matplotlib.rcParams["lines.linewidth"]
        thick = [
            replace(one, series=tuple(replace(line, width=width) for line in one.series)) for one in chosen
        ]
        marks = marks_of_flight(log)
        figure = figure_of(Plot(tuple(thick)), marks)
        if size is not None or "figure.figsize" in own:
            figure.set_size_inches(*(size or matplotlib.rcParams["figure.figsize"]))
        name_marks(figure, marks)
    return figure


def name_marks(figure: Figure, marks: Marks) -> None:
    """Add the legend of the marks that a figure has, below it."""
    shown = [
        Patch(color=INTERVAL_COLOURS[kind], alpha=0.9 if kind == "limit" else SHADE, label=KINDS[kind])
        if kind in INTERVAL_COLOURS
        else Line2D(
            [],
            [],
            color=INSTANT_COLOURS[kind],
            linestyle=":" if kind == "operator" else "-",
            label=KINDS[kind],
        )
        for kind in marks.kinds
    ]
    if shown:
        figure.legend(handles=shown, loc="outside lower center", ncols=len(shown))


def figure_of(plot: Plot, marks: Marks) -> Figure:
    figure, axes = stack([panel.height for panel in plot.panels])
    for one, panel in zip(axes, plot.panels, strict=True):
        one.margins(x=0)
        _draw(one, panel)
        one.set_ylabel(panel.label)
        one.set_ylim(panel.least, panel.most)
        # two states of a lane may have one name: one entry per name
        named = dict(zip(*reversed(one.get_legend_handles_labels()), strict=True))
        if named:
            one.legend(named.values(), named.keys(), loc="upper left", bbox_to_anchor=(1.0, 1.1))
    if plot.window_s is not None:
        axes[-1].set_xlim(plot.window_s)
    draw_marks(axes, marks)
    figure.align_ylabels(axes)
    return figure


def _draw(axes: Axes, panel: Panel) -> None:
    if panel.stacked and panel.series:
        axes.stackplot(
            panel.series[0].times, [one.values for one in panel.series],
            labels=[one.name for one in panel.series], colors=[one.colour for one in panel.series],
        )  # fmt: skip
    else:
        for one in panel.series:
            style = "--" if one.dashed else "-"
            axes.plot(
                one.times, one.values, style, color=one.colour, linewidth=one.width, label=one.name or None
            )
    for limit in panel.limits:
        axes.axhline(limit, color=INK, linestyle="--", linewidth=0.8)
    names = list(dict.fromkeys(bar.lane for bar in panel.bars))
    for bar in panel.bars:
        axes.barh(
            names.index(bar.lane), bar.end_s - bar.begin_s, 0.8, bar.begin_s, color=bar.colour, label=bar.name
        )
    if names:
        axes.set_yticks(range(len(names)), names)
        axes.grid(visible=False)


def draw_marks(axes: Sequence[Axes], marks: Marks) -> None:
    """Shade and mark the events; the first axes name them. The time axis is zero at the release."""
    for interval in marks.intervals:
        high = STRIP if interval.kind == "limit" else 1.0
        alpha = 0.9 if interval.kind == "limit" else SHADE
        for one in axes:
            one.axvspan(
                interval.begin_s, interval.end_s, 0.0, high, color=INTERVAL_COLOURS[interval.kind], alpha=alpha, linewidth=0
            )  # fmt: skip
    faults = [
        (interval.begin_s, interval.text, curves.RED)
        for interval in marks.intervals
        if interval.kind == "fault"
    ]
    for instant in marks.instants:
        colour = INSTANT_COLOURS[instant.kind]
        for one in axes:
            one.axvline(
                instant.t_s, color=colour, linestyle=":" if instant.kind == "operator" else "-", linewidth=0.9
            )
        faults.append((instant.t_s, instant.text, colour))
    for begins, text, colour in faults:
        short = text if len(text) <= MARK_LENGTH else f"{text[: MARK_LENGTH - 1]}…"
        axes[0].text(
            begins, 0.98, short, transform=axes[0].get_xaxis_transform(), color=colour, fontsize="x-small",
            rotation=90, ha="left", va="top", clip_on=True,
        )  # fmt: skip


def beside(*widths: float) -> tuple[Figure, list[Axes]]:
    """Return a figure of axes beside one another, with the ratio of their widths."""
    figure = Figure(figsize=(WIDTH, 3.9), layout="constrained")
    return figure, figure.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0].tolist()


def stack(heights: Sequence[float]) -> tuple[Figure, list[Axes]]:
    """Return a figure of axes one above the other [in] that share their time axis."""
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0].tolist()
    axes[-1].set_xlabel("time from the release [s]")
    return figure, axes
