"""The figures of a flight as PNG, after the paper's figure Hover_figure; also of a flight that was lost or never began.

Axes carry cm, degrees, ms and seconds from the release. Grey: the robot was still held; red: a fault was in force; dotted
blue: an operator did something.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ground_station.latency import STAGES, stages_told
from hil.laboratory.faults import spans_of
from hil.laboratory.metrics import BOX, column, free_flight
from hil.laboratory.recorder import release_of
from hil.laboratory.schedule import runs
from hil.pictures import curves, scene
from hil.pictures.curves import Curves
from hil.pictures.drawing import WIDTH, draw_marks, stack
from hil.pictures.overlays import since_release
from hil.pictures.picture import Picture

TENTH, SECOND = 10, 100  # rows
BUSY_PERCENT = 0.02  # of the processor, that makes a task worth a colour
SCHEDULE_US = 20_000  # of the scheduler's picture
BOX_CM = 100 * BOX


def _lines(
    axes: Axes, times: NDArray[np.float64], plot: Curves, values: NDArray[np.float64], label: str
) -> None:
    for index, (name, colour) in enumerate(zip(plot.names, plot.colours, strict=True)):
        axes.plot(times, values[:, index], color=colour, label=name)
    axes.set_ylabel(f"{label} [{plot.unit}]")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _limits(axes: Axes, limit: float) -> None:
    for value in (-limit, limit):
        axes.axhline(value, color="black", linestyle="--", linewidth=0.8)


def shade(axes: Sequence[Axes], rows: pa.Table) -> None:
    """Shade when the robot was held and when a fault was in force, and mark what an operator did; the first axes name it."""
    times = since_release(rows)
    held = times[column(rows, "flight.free") < 0.5]
    for one in axes:
        one.margins(x=0)
        if len(held) > 1:
            one.axvspan(held[0], held[-1], color=curves.GREY, alpha=0.2, linewidth=0)
    names: dict[float, list[str]] = {}  # by begin
    release_us = release_of(rows.schema.metadata)
    for span in spans_of(rows.schema.metadata):
        begin, end = (1e-6 * (us - release_us) for us in (span.begin_us, span.end_us))
        end = min(end, times[-1] if len(times) else begin)
        if begin >= end:
            continue
        for one in axes:
            one.axvspan(begin, end, color=curves.RED, alpha=0.15, linewidth=0.5)
        names.setdefault(begin, []).append(span.fault.kind)
    for begin, kinds in names.items():
        axes[0].text(
            begin, 0.98, ", ".join(kinds), transform=axes[0].get_xaxis_transform(), color=curves.RED, fontsize=6.5,
            rotation=90, ha="left", va="top", clip_on=True,
        )  # fmt: skip
    draw_marks(axes, rows)


def track(rows: pa.Table) -> Figure:
    """Draw the way around the target: in space, from above, from the side."""
    points = curves.POSITION.read(free_flight(rows))
    x, y, z = points.T
    figure = Figure(figsize=(WIDTH, 3.3), layout="constrained")
    grid = figure.add_gridspec(1, 3, width_ratios=(1.3, 1, 1), wspace=0.12)
    space: Any = figure.add_subplot(grid[0], projection="3d")
    space.plot(x, y, z, color=curves.BLUE, linewidth=0.6)
    space.plot([0.0], [0.0], [0.0], "+", color="red", markersize=9, markeredgewidth=1.8)
    for line in scene.box_lines(BOX_CM):
        space.plot(*line.T, color="black", linewidth=0.7)
    space.set(xlabel="x [cm]", ylabel="y [cm]", zlabel="z [cm]")
    reach = max(1.1 * BOX_CM, float(np.abs(points).max(initial=0.0)))
    space.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach))
    space.locator_params(nbins=5)
    space.set_box_aspect((1, 1, 1), zoom=0.9)
    square = BOX_CM * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
    for place, across, up, label in ((grid[1], x, y, "y"), (grid[2], x, z, "z")):
        axes = figure.add_subplot(place)
        axes.plot(across, up, color=curves.BLUE, linewidth=0.6)
        axes.plot(*square.T, color="black", linewidth=0.9)
        axes.plot(0.0, 0.0, "+", color="red", markersize=9, markeredgewidth=1.8)
        axes.set(
            xlabel="x [cm]",
            ylabel=f"{label} [cm]",
            aspect="equal",
            xlim=(-reach, reach),
            ylim=(-reach, reach),
        )
    return figure


def errors(rows: pa.Table) -> Figure:
    """Draw position and attitude errors over time with the paper's limits."""
    figure, axes = stack((2.1, 2.1))
    times = since_release(rows)
    _lines(axes[0], times, curves.POSITION, curves.POSITION.read(rows), "position error")
    _limits(axes[0], curves.NEAR_CM)
    _lines(axes[1], times, curves.ATTITUDE, curves.ATTITUDE.read(rows), "attitude error")
    _limits(axes[1], curves.ATTITUDE_DEG)
    shade(axes, rows)
    return figure


def flaps(rows: pa.Table) -> Figure:
    """Draw what the flaps were told and what they did; of a real board, what it believes that they did."""
    figure = Figure(figsize=(WIDTH, 3.8), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True)
    times, angles = since_release(rows), curves.FLAPS.read(rows)
    commanded = curves.FLAPS_COMMAND.needs in rows.column_names
    commands = curves.FLAPS_COMMAND.read(rows) if commanded else None
    for index, axes in enumerate((grid[0, 1], grid[0, 0], grid[1, 0], grid[1, 1])):
        if commands is not None:
            axes.plot(times, commands[:, index], color="black", linewidth=0.6, alpha=0.55, label="command")
        label = "true" if commanded else "by telemetry"
        axes.plot(times, angles[:, index], color=curves.FLAPS.colours[index], label=label)
        axes.set_title(curves.FLAPS.names[index], loc="left", fontsize=9)
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=2)
    for axes in grid[:, 0]:
        axes.set_ylabel("angle [deg]")
    for axes in grid[1]:
        axes.set_xlabel("time from the release [s]")
    shade(list(grid.flat), rows)
    return figure


def age(rows: pa.Table) -> Figure:
    """Draw how old poses are when the estimator takes them, and for how long there were none, where that is told."""
    told = curves.SINCE_FUSION.needs in rows.column_names
    figure, axes = stack((1.5, 1.2) if told else (1.5,))
    for plot in (curves.AGE, curves.HORIZON):
        if plot.needs in rows.column_names:
            _lines(axes[0], since_release(rows), plot, plot.read(rows), "on board")
    if told:
        _lines(axes[1], since_release(rows), curves.SINCE_FUSION, curves.SINCE_FUSION.read(rows), "without")
    shade(axes, rows)
    return figure


def way(told: pa.Table) -> Figure:
    """Draw where the poses of `ages.told_in_time_of` spent their time, stage on stage."""
    figure, (axes,) = stack((1.8,))
    columns = {name: told.column(name).to_numpy() for name in STAGES}
    names = stages_told(columns)
    colours = [curves.STAGE_COLOURS[name] for name in names]
    axes.stackplot(since_release(told), *[columns[name] for name in names], labels=names, colors=colours)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), reverse=True)
    axes.margins(x=0.0)
    axes.set_ylabel("age [ms]")
    return figure


def radio(rows: pa.Table) -> Figure:
    """Draw the time in the air and the packets that were lost."""
    figure, axes = stack((1.5, 1.5))
    _up_and_down(axes[0], rows, SECOND, curves.latency, "mean latency [ms]")
    _lines(axes[1], since_release(rows), curves.PACKETS, curves.PACKETS.read(rows), "so far")
    shade(axes, rows)
    return figure


def serial_line(rows: pa.Table) -> Figure:
    """Draw the load of the line, the time on it and what was lost or spoilt."""
    figure, axes = stack((1.5, 1.5, 1.5))
    _up_and_down(axes[0], rows, TENTH, curves.line_load, "load of the line [%]")
    axes[0].set_ylim(0.0, 105.0)
    _up_and_down(axes[1], rows, SECOND, curves.latency, "mean latency [ms]")
    _lines(
        axes[2], since_release(rows), curves.SERIAL_FAULTS, curves.SERIAL_FAULTS.read(rows), "bytes or frames"
    )
    shade(axes, rows)
    return figure


def _up_and_down(
    axes: Axes, rows: pa.Table, step: int, read: Callable[[pa.Table], NDArray[np.float64]], label: str
) -> None:
    """Draw what `read` makes of every `step`-th row, for both directions of the link."""
    thinned = rows.take(np.arange(0, rows.num_rows, step))
    for index, name in enumerate(("up", "down")):
        axes.plot(
            since_release(thinned)[1:], read(thinned)[:, index], color=curves.FLAP_COLOURS[index], label=name
        )
    axes.set_ylabel(label)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def station(rows: pa.Table) -> Figure:
    """Draw what a real link and its ground station could not use, and the states."""
    figure, axes = stack((1.5, 0.8))
    _lines(axes[0], since_release(rows), curves.STATION, curves.STATION.read(rows), "not used")
    _states(axes[1], rows)
    shade(axes, rows)
    return figure


def board(rows: pa.Table) -> Figure:
    """Draw the load of the processor by task, the measurement queue and the states."""
    figure, axes = stack((1.8, 1.4, 0.8))
    load, tenths = curves.processor(rows.column_names), rows.take(np.arange(0, rows.num_rows, TENTH))
    shares = load.read(tenths).T
    busy = [index for index, share in enumerate(shares) if share.max(initial=0.0) >= BUSY_PERCENT] or [0]
    axes[0].stackplot(
        since_release(tenths)[1:], shares[busy],
        labels=[load.names[index] for index in busy], colors=[load.colours[index] for index in busy],
    )  # fmt: skip
    axes[0].set_ylim(bottom=0.0)
    axes[0].set_ylabel("processor [%]")
    axes[0].legend(loc="upper left", bbox_to_anchor=(1.0, 1.1), labelspacing=0.25)
    _lines(axes[1], since_release(rows), curves.QUEUE, curves.QUEUE.read(rows), "queue")
    _states(axes[2], rows)
    shade(axes, rows)
    return figure


def _states(axes: Axes, rows: pa.Table) -> None:
    """Draw the states of supervisor and robot as bars."""
    lanes = (curves.SUPERVISOR, curves.RELEASE)
    end = since_release(rows)[-1:]
    for height, states in enumerate(lanes):
        begins, names = curves.changes(rows, states)
        edges = np.append(1e-6 * (begins - release_of(rows.schema.metadata)), end)
        for start, stop, name in zip(edges[:-1], edges[1:], names, strict=True):
            colour = states.colours[states.names.index(name)]
            axes.barh(height, stop - start, 0.8, start, color=colour, label=name)
    axes.set_yticks(range(len(lanes)), ("supervisor", "robot"))
    axes.grid(visible=False)
    named = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))  # one entry per name
    axes.legend(named.values(), named.keys(), loc="upper left", bbox_to_anchor=(1.0, 1.2))


def estimate(rows: pa.Table) -> Figure:
    """Draw what the estimator believed, less what was, in the goal frame."""
    figure, axes = stack((1.8, 1.8))
    _lines(axes[0], since_release(rows), curves.POSITION_MISS, curves.POSITION_MISS.read(rows), "position")
    _lines(axes[1], since_release(rows), curves.ATTITUDE_MISS, curves.ATTITUDE_MISS.read(rows), "attitude")
    shade(axes, rows)
    return figure


def own_logic(rows: pa.Table) -> Figure:
    """Draw what logic of the user's own logs, one axis for each unit."""
    plots = curves.own_logic(rows)
    figure, axes = stack((1.5,) * len(plots))
    for one, plot in zip(axes, plots, strict=True):
        _lines(one, since_release(rows), plot, plot.read(rows), "own logic")
    shade(axes, rows)
    return figure


def schedule(table: pa.Table) -> Figure:
    """Draw which task has the processor, over the first 20 ms of a schedule."""
    figure = Figure(figsize=(WIDTH, 2.4), layout="constrained")
    axes = figure.subplots()
    stretches = [run for run in runs(table) if run.task != "IDLE"]
    begin_us = table.column("us")[0].as_py()
    begin_s = 1e-6 * (begin_us - release_of(table.schema.metadata))
    stretches = [run for run in stretches if run.start_us < begin_us + SCHEDULE_US]
    names = sorted({run.task for run in stretches}, reverse=True)
    for height, name in enumerate(names):
        bars = [
            (1e-3 * (r.start_us - begin_us), 1e-3 * (r.end_us - r.start_us))
            for r in stretches
            if r.task == name
        ]
        axes.broken_barh(bars, (height - 0.4, 0.8), color=curves.task_colour(name))
    axes.set_yticks(range(len(names)), names)
    axes.set_xlim(0.0, 1e-3 * SCHEDULE_US)
    axes.set_xticks(range(0, SCHEDULE_US // 1000 + 1))
    axes.set_xlabel(f"time from {begin_s:.3f} s after the release [ms]; a line per tick")
    return figure


PICTURES = (
    Picture(
        "Track",
        "Position of the body relative to the target (red +) after the release, in the goal frame, with the 20 cm box.",
        track,
    ),
    Picture(
        "Errors",
        "Truth, in a real flight the cameras' poses, against the goal. Dashed: 6 cm, which the paper's robot mostly keeps, "
        "and 20 degrees, which it always keeps.",
        errors,
    ),
    Picture(
        "Flaps",
        "True angle of each flap and the angle that the controller asked for, placed as seen from above; of a real board, "
        "the angle that its estimator has.",
        flaps,
    ),
    Picture(
        "Age",
        "Age of the pose when the estimator takes it, and the horizon of its predictor (0: it is switched off); "
        "time since the last fused pose, which grows while none comes or each is refused (a real board tells only the age).",
        age,
    ),
    Picture(
        "Radio",
        "Mean time of a packet in the air, per second; packets lost and sent again, since the start.",
        radio,
        needs="link.retried",
    ),
    Picture(
        "Serial line",
        "Share of the time in which the line carries bytes, over 0.1 s; mean time from sender to receiver, per second; "
        "since the start: bytes that overran the board's receive buffer or found no room to be sent, frames that neither "
        "end could read.",
        serial_line,
        needs="serial.up_busy",
    ),
    Picture(
        "Board",
        "Share of the processor by task, over 0.1 s, of tasks with 0.02 % or more; fullest state so far of the measurement "
        "queue (poses, gyro and accelerometer samples) and what it dropped; states of the supervisor and of the robot.",
        board,
        needs="rtos.measurements_dropped",
    ),
    Picture(
        "Station",
        "Poses that were late or could not be used, telemetry that could not be read, since the start; states of the "
        "supervisor and of the flight: free while the trajectory is judged.",
        station,
        needs="link.late",
    ),
    Picture(
        "Estimate",
        "What the estimator believed, less the truth, in the goal frame; of a real flight, less what the cameras saw.",
        estimate,
    ),
)
OWN_LOGIC = Picture("Own logic", "What the modules of `[logic]` log of their memory.", own_logic)
WAY = Picture(
    "Way of the poses",
    "Where poses spent their time from the exposure to the board, as the ground station told each that it sent.",
    way,
)
SCHEDULE = Picture("Scheduler", "Which task had the processor, for 20 ms.", schedule)
