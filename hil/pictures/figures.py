"""The figures of a flight, after the paper's figure Hover_figure; also of a flight that was lost or never began.

Axes carry cm, degrees, ms and seconds from the release. What has a time axis are panels, which a page can zoom.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from ground_station.latency import STAGES, reported_stages
from hil.laboratory.metrics import BOX, free_flight
from hil.laboratory.recorder import release_of
from hil.laboratory.schedule import runs
from hil.pictures import curves, monitor
from hil.pictures.curves import since_release
from hil.pictures.panels import INK, Bar, Panel, Plot, Series, Still, lanes, panel
from hil.pictures.path import path_around
from hil.pictures.picture import Picture

TENTH, SECOND = 10, 100  # rows
BUSY_PERCENT = 0.02  # of the processor, above which a task gets a colour
SCHEDULE_US = 20_000  # of the scheduler's picture
LANE_INCH = 0.25  # a task's row there


def track(rows: pa.Table) -> Still:
    """Draw the path around the target: in space, from above, from the side."""
    return path_around(curves.POSITION.read(free_flight(rows)), 100 * BOX)


def errors(rows: pa.Table) -> Plot:
    """Draw position and attitude errors over time with the paper's limits."""
    near, level = (
        (-curves.NEAR_CM, curves.NEAR_CM),
        (-curves.ATTITUDE_DEG, curves.ATTITUDE_DEG),
    )
    return Plot(
        (
            panel(curves.POSITION, rows, "position error", height=2.1, limits=near),
            panel(curves.ATTITUDE, rows, "attitude error", height=2.1, limits=level),
        )
    )


def flaps(rows: pa.Table) -> Plot:
    """Draw the commanded and the actual flap angles; of a real board, its estimate of the actual ones."""
    times, angles = since_release(rows), curves.FLAPS.read(rows)
    commanded = curves.FLAPS_COMMAND.needs in rows.column_names
    commands = curves.FLAPS_COMMAND.read(rows) if commanded else None
    panels = []
    for index, (name, colour) in enumerate(zip(curves.FLAPS.names, curves.FLAPS.colours, strict=True)):
        angle = Series("true" if commanded else "by telemetry", colour, times, angles[:, index], width=1.2)
        command = () if commands is None else (Series("command", INK, times, commands[:, index], width=0.6),)
        panels.append(Panel(f"{name} [deg]", (*command, angle), height=1.3))
    return Plot(tuple(panels))


def age(rows: pa.Table) -> Plot:
    """Draw the age of each pose at the estimator and, where it is reported, the time without one."""
    plots = [plot for plot in (curves.AGE, curves.HORIZON) if plot.needs in rows.column_names]
    series = [line for plot in plots for line in panel(plot, rows, "").series]
    panels = [Panel("on board [ms]", tuple(series))]
    if curves.SINCE_FUSION.needs in rows.column_names:
        panels.append(panel(curves.SINCE_FUSION, rows, "without", height=1.2))
    return Plot(tuple(panels))


def latency_budget(ages: pa.Table) -> Plot:
    """Draw where the poses of `ages.ages_in_time_of` spent their time, stage on stage."""
    columns = {name: ages.column(name).to_numpy() for name in STAGES}
    times = since_release(ages)
    stages = [
        Series(name, curves.STAGE_COLOURS[name], times, columns[name]) for name in reported_stages(columns)
    ]
    return Plot((Panel("age [ms]", tuple(stages), height=1.8, stacked=True, least=0.0),))


def radio(rows: pa.Table) -> Plot:
    """Draw the time in the air and the packets that were lost."""
    return Plot(
        (
            _up_and_down(rows, SECOND, curves.latency, "mean latency [ms]"),
            panel(curves.PACKETS, rows, "so far"),
        )
    )


def serial_line(rows: pa.Table) -> Plot:
    """Draw the load of the line, the time on it and what was lost or damaged."""
    load = _up_and_down(rows, TENTH, curves.line_load, "load of the line [%]")
    return Plot(
        (
            replace(load, least=0.0, most=105.0),
            _up_and_down(rows, SECOND, curves.latency, "mean latency [ms]"),
            panel(curves.SERIAL_FAULTS, rows, "bytes or frames"),
        )
    )


def _up_and_down(
    rows: pa.Table, step: int, read: Callable[[pa.Table], NDArray[np.float64]], label: str
) -> Panel:
    """Draw the curves of `read` on every `step`-th row, for both directions of the link."""
    thinned = rows.take(np.arange(0, rows.num_rows, step))
    times, values = since_release(thinned)[1:], read(thinned)
    return Panel(
        label,
        tuple(
            Series(name, curves.FLAP_COLOURS[index], times, values[:, index])
            for index, name in enumerate(("up", "down"))
        ),
    )


def station(rows: pa.Table) -> Plot:
    """Draw what a real link and its station could not use, reported battery and load, and the states."""
    health = [
        panel(plot, rows, label, height=1.2)
        for plot, label in ((monitor.BATTERY, "battery"), (monitor.LOAD, "processor"))
        if plot.needs in rows.column_names and np.isfinite(plot.read(rows)).any()
    ]
    return Plot((panel(curves.STATION, rows, "not used"), *health, _states(rows)))


def board(rows: pa.Table) -> Plot:
    """Draw the load of the processor by task, the measurement queue and the states."""
    load, tenths = curves.processor(rows.column_names), rows.take(np.arange(0, rows.num_rows, TENTH))
    times, shares = since_release(tenths)[1:], load.read(tenths).T
    busy = [index for index, share in enumerate(shares) if share.max(initial=0.0) >= BUSY_PERCENT] or [0]
    tasks = tuple(Series(load.names[index], load.colours[index], times, shares[index]) for index in busy)
    return Plot(
        (
            Panel("processor [%]", tasks, height=1.8, stacked=True, least=0.0),
            panel(curves.QUEUE, rows, "queue", height=1.4),
            _states(rows),
        )
    )


def _states(rows: pa.Table) -> Panel:
    """Draw the states of supervisor and robot, or real flight, as bars."""
    release_us, end_s = release_of(rows.schema.metadata), since_release(rows)[-1:]
    rows_of_bars = []
    for lane, states in reversed(curves.lanes_of(rows.column_names).items()):
        begins, names = curves.changes(rows, states)
        colours = dict(zip(states.names, states.colours, strict=True))
        rows_of_bars.append((lane, 1e-6 * (begins - release_us), names, colours))
    return Panel("states", height=0.8, bars=lanes(rows_of_bars, float(end_s[0]) if len(end_s) else 0.0))


def estimate(rows: pa.Table) -> Plot:
    """Draw the estimate less the truth, in the goal frame."""
    return Plot(
        (
            panel(curves.POSITION_MISS, rows, "position", height=1.8),
            panel(curves.ATTITUDE_MISS, rows, "attitude", height=1.8),
        )
    )


def own_logic(rows: pa.Table) -> Plot:
    """Draw what the user's own logic logs, one axis for each unit."""
    return Plot(tuple(panel(plot, rows, "own logic") for plot in curves.own_logic(rows)))


def schedule(table: pa.Table) -> Plot:
    """Draw which task has the processor, over the first 20 ms of a schedule."""
    release_us, begin_us = release_of(table.schema.metadata), table.column("us")[0].as_py()
    window_s = (1e-6 * (begin_us - release_us), 1e-6 * (begin_us - release_us + SCHEDULE_US))
    busy = [run for run in runs(table) if run.task != "IDLE" and run.start_us < begin_us + SCHEDULE_US]
    bars = tuple(
        Bar(run.task, "", curves.task_colour(run.task), *(1e-6 * (us - release_us) for us in (run.start_us, run.end_us)))
        for run in sorted(busy, key=lambda run: run.task, reverse=True)
    )  # fmt: skip
    height = LANE_INCH * len({bar.lane for bar in bars})
    return Plot((Panel("processor", height=max(height, LANE_INCH), bars=bars),), window_s)


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
        "True angle of each flap and the commanded angle; of a real board, the angle that its estimator has.",
        flaps,
    ),
    Picture(
        "Age",
        "Age of the pose when the estimator takes it, and the horizon of its predictor (0: it is switched off); "
        "time since the last fused pose, which grows while none comes or each is refused (a real board has the age only).",
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
        "Poses that were late or could not be used, telemetry that could not be read, since the start; the board's battery "
        "and load, if it reports them; states of the supervisor and of the flight.",
        station,
        needs="link.late",
    ),
    Picture(
        "Estimate",
        "Estimate less truth, in the goal frame; of a real flight, estimate less the cameras' poses.",
        estimate,
    ),
)
OWN_LOGIC = Picture("Own logic", "What the modules of `[logic]` log of their memory.", own_logic)
LATENCY_BUDGET = Picture(
    "Latency budget",
    "Where poses spent their time from the exposure to the board, as the ground station reported for each that it sent.",
    latency_budget,
)
SCHEDULE = Picture("Scheduler", "Which task had the processor, for 20 ms.", schedule, alone=True)
