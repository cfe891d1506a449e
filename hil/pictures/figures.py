"""The figures of a flight, like the paper's figure Hover_figure; also for a flight that was lost or never began.

Axes have cm, degrees, ms and seconds from the release. Figures over time are panels, which a page can zoom.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from ground_station.latency import STAGES, reported_stages
from hil.laboratory.experiments.measures import yaw_and_goal
from hil.laboratory.faults import spans_of
from hil.laboratory.files.recorder import release_of
from hil.laboratory.metrics import BOX, body, column, free_flight, rows_at
from hil.laboratory.schedule import runs
from hil.pictures import curves
from hil.pictures.curves import since_release
from hil.pictures.panels import (
    INK,
    KNOWN,
    LINK,
    PROCESSOR,
    WHAT,
    Bar,
    Panel,
    Picture,
    Plot,
    Series,
    Still,
    lanes,
    panel,
)
from hil.pictures.path import FlownPath, path_of

TENTH, SECOND = 10, 100  # rows
BUSY_PERCENT = 0.02  # of the processor, above which a task gets a colour
SCHEDULE_US = 20_000  # of the scheduler's picture
LANE_INCH = 0.25  # a task's row there


def course_of(rows: pa.Table) -> FlownPath:
    """Return the path of the body and of its goal after the release [cm], from the first goal in W."""
    flight = free_flight(rows)
    goal = 100 * column(flight, "goal.x", "goal.y", "goal.z")
    times = since_release(flight)
    troubled = np.zeros(len(times), np.bool_)
    for span in spans_of(rows.schema.metadata):
        troubled |= (times >= span.begin_s) & (times <= span.end_s)
    return FlownPath(100 * body(flight, "x", "y", "z") - goal[:1], goal - goal[:1], troubled, 100 * BOX)


def track(rows: pa.Table) -> Still:
    """Draw the path against the goal's: in space, from above, from the side."""
    return path_of(course_of(rows))


def course(rows: pa.Table) -> Plot:
    """Draw position and yaw over time against a goal that moves."""
    flight, shown = free_flight(rows), course_of(rows)
    times = since_release(flight)
    lines = []
    for axis, (name, colour) in enumerate(zip(curves.POSITION.names, curves.POSITION.colours, strict=True)):
        lines += [
            Series(name, colour, times, shown.flown[:, axis], width=1.2),
            Series(f"goal {name}", colour, times, shown.goal[:, axis], dashed=True),
        ]
    yaw, wanted = (np.degrees(angle) for angle in yaw_and_goal(flight))
    turns = Series("yaw", curves.BLUE, times, yaw, width=1.2), Series("goal", INK, times, wanted, dashed=True)
    return Plot((Panel("position [cm]", tuple(lines), height=2.1), Panel("yaw [deg]", turns)))


def goal_moves(rows: pa.Table) -> bool:
    """Whether the goal moved or turned after the release."""
    goal = column(free_flight(rows), "goal.x", "goal.y", "goal.z", "goal.yaw")
    return len(goal) > 1 and bool(np.ptp(goal, axis=0).any())


def curves_of(*shown: tuple[curves.Curves, str], **look: Any) -> Callable[[pa.Table], Plot]:
    """Return what draws curves, each with its label, one above the other."""
    return lambda rows: Plot(tuple(panel(curve, rows, label, **look) for curve, label in shown))


def errors(rows: pa.Table) -> Plot:
    """Draw position and attitude errors over time with the paper's limits."""
    shown = (
        (curves.POSITION, "position error", curves.NEAR_CM),
        (curves.ATTITUDE, "attitude error", curves.ATTITUDE_DEG),
    )
    return Plot(
        tuple(panel(one, rows, label, height=2.1, limits=(-bound, bound)) for one, label, bound in shown)
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
    plots = [plot for plot in (curves.AGE, curves.HORIZON) if plot.fits(rows.column_names)]
    series = [line for plot in plots for line in panel(plot, rows, "").series]
    panels = [Panel("age on board [ms]", tuple(series), least=0.0)]
    return Plot((*panels, *without_a_pose(rows)))


def without_a_pose(rows: pa.Table) -> tuple[Panel, ...]:
    """Draw the longest time since a fused pose in every tenth of a second; nothing for a board that does not report it."""
    if curves.SINCE_FUSION.needs not in rows.column_names or rows.num_rows == 0:
        return ()
    begins = np.arange(0, rows.num_rows, TENTH)
    longest = np.fmax.reduceat(curves.since_fusion(rows)[:, 0], begins)
    line = Series("longest since a fused pose", curves.RED, since_release(rows)[begins], longest, width=1.2)
    return (Panel("without a pose [ms]", (line,), height=1.1, least=0.0),)


def latency_budget(ages: pa.Table) -> Plot:
    """Draw where the poses of `ages.ages_in_time_of` spent their time, stage on stage."""
    columns = {name: ages.column(name).to_numpy() for name in STAGES}
    times = since_release(ages)
    names = reported_stages(columns)
    stages = tuple(Series(name, curves.STAGE_COLOURS[name], times, columns[name]) for name in names)
    return Plot((Panel("age [ms]", stages, height=1.8, stacked=True, least=0.0),))


def radio(rows: pa.Table) -> Plot:
    """Draw the time in the air and the packets that were lost."""
    air = _up_and_down(rows, SECOND, curves.latency, "mean latency [ms]")
    return Plot((air, panel(curves.PACKETS, rows, "so far")))


def serial_line(rows: pa.Table) -> Plot:
    """Draw the load of the line, the time on it and what was lost or damaged."""
    load = replace(_up_and_down(rows, TENTH, curves.line_load, "load of the line [%]"), least=0.0, most=105.0)
    air = _up_and_down(rows, SECOND, curves.latency, "mean latency [ms]")
    return Plot((load, air, panel(curves.SERIAL_FAULTS, rows, "bytes or frames")))


def _up_and_down(
    rows: pa.Table, step: int, read: Callable[[pa.Table], NDArray[np.float64]], label: str
) -> Panel:
    """Draw the curves of `read` on every `step`-th row, for both directions of the link."""
    thinned = _every(step, rows, "link.", "serial.")
    times, values = since_release(thinned)[1:], read(thinned)
    lines = zip(("up", "down"), curves.FLAP_COLOURS, values.T, strict=False)
    return Panel(label, tuple(Series(name, colour, times, share) for name, colour, share in lines))


def _every(step: int, rows: pa.Table, *groups: str) -> pa.Table:
    """Return `t` and groups of columns in every `step`-th row; a long log is mapped, so only these are read."""
    names = [name for name in rows.column_names if name == "t" or name.startswith(groups)]
    return rows_at(rows.select(names), np.arange(0, rows.num_rows, step))


def station(rows: pa.Table) -> Plot:
    """Draw what a real link and its station could not use, reported battery and load."""
    health = [
        panel(plot, rows, label, height=1.2)
        for plot, label in ((curves.BATTERY, "battery"), (curves.LOAD, "processor"))
        if plot.needs in rows.column_names and np.isfinite(plot.read(rows)).any()
    ]
    return Plot((panel(curves.STATION, rows, "not used"), *health))


def board(rows: pa.Table) -> Plot:
    """Draw the load of the processor by task, and the measurement queue."""
    load, tenths = curves.processor(rows.column_names), _every(TENTH, rows, "cpu.")
    times, shares = since_release(tenths)[1:], load.read(tenths).T
    busy = [index for index, share in enumerate(shares) if share.max(initial=0.0) >= BUSY_PERCENT] or [0]
    tasks = tuple(Series(load.names[index], load.colours[index], times, shares[index]) for index in busy)
    shares_of_tasks = Panel("processor [%]", tasks, height=1.8, stacked=True, least=0.0)
    return Plot((shares_of_tasks, panel(curves.QUEUE, rows, "queue", height=1.1)))


def lanes_of_states(rows: pa.Table) -> Panel:
    """Return the states of supervisor and robot, or real flight, as bars."""
    release_us, end_s = release_of(rows.schema.metadata), since_release(rows)[-1:]
    rows_of_bars = []
    for lane, states in reversed(curves.lanes_of(rows.column_names).items()):
        begins, names = curves.changes(rows, states)
        colours = dict(zip(states.names, states.colours, strict=True))
        rows_of_bars.append((lane, 1e-6 * (begins - release_us), names, colours))
    return Panel("states", height=0.8, bars=lanes(rows_of_bars, float(end_s[0]) if len(end_s) else 0.0))


def own(group: str, rows: pa.Table) -> Plot:
    """Draw what the user's own `logic` or `robot` logs, one axis for each unit."""
    return Plot(
        tuple(panel(plot, rows, OWN[group].title.lower()) for plot in curves.own_columns(rows, group))
    )


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
        "Errors",
        "Position and attitude against the goal: the truth, in a real flight the cameras' poses. Dashed: 6 cm, which the "
        "paper's robot mostly keeps, and 20 degrees, which it always keeps.",
        errors,
    ),
    Picture(
        "Flaps",
        "True angle of each flap and the commanded angle; of a real board, the angle that its estimator has.",
        flaps,
        needs=curves.FLAPS.needs,
        question=WHAT,
    ),
    Picture(
        "Rotors",
        "Thrust of each rotor: M1 front right, M2 back right, M3 back left, M4 front left. The words that the firmware "
        "sends to their timers, as shares of the whole.",
        curves_of((curves.ROTORS, "thrust"), (curves.MOTORS, "command"), height=1.8),
        needs=curves.ROTORS.needs,
        question=WHAT,
    ),
    Picture(
        "States",
        "What the supervisor on board decided, and whether the robot was free.",
        lambda rows: Plot((lanes_of_states(rows),)),
        question=KNOWN,
    ),
    Picture(
        "Estimate",
        "The board's estimate less the truth, in the goal frame; of a real flight, less the cameras' poses.",
        curves_of((curves.POSITION_MISS, "position"), (curves.ATTITUDE_MISS, "attitude"), height=1.8),
        needs=curves.POSITION_MISS.needs,
        question=KNOWN,
    ),
    Picture(
        "Replay",
        "What the replayed core computed beside the flight: its estimate less the truth, above that of the flight; the "
        "poses that each refused, by reason.",
        curves_of(
            (curves.REPLAYED_POSITION_MISS, "position, replayed"),
            (curves.POSITION_MISS, "position, flown"),
            (curves.REPLAYED_ATTITUDE_MISS, "attitude, replayed"),
            (curves.ATTITUDE_MISS, "attitude, flown"),
            (curves.REPLAYED_REFUSALS, "poses refused"),
            height=1.5,
        ),
        needs=curves.REPLAYED_POSITION_MISS.needs,
        question=KNOWN,
    ),
    Picture(
        "Age",
        "Age of the pose when the estimator takes it, and the horizon of its predictor (0: it is switched off); the longest "
        "time since a fused pose, which grows while none comes or each is refused (a real board has the age only).",
        age,
        needs=curves.AGE.needs,
        question=KNOWN,
    ),
    Picture(
        "Radio",
        "Mean time of a packet in the air, per second; packets lost and sent again, since the start.",
        radio,
        needs="link.retried",
        question=LINK,
        about=("radio",),
    ),
    Picture(
        "Serial line",
        "Share of the time in which the line carries bytes, over 0.1 s; mean time from sender to receiver, per second; "
        "since the start: bytes that overran the board's receive buffer or found no room to be sent, frames that neither "
        "end could read.",
        serial_line,
        needs="serial.up_busy",
        question=LINK,
        about=("serial",),
    ),
    Picture(
        "Station",
        "Poses that were late or could not be used, telemetry that could not be read, since the start; the board's battery "
        "and load, if it reports them.",
        station,
        needs="link.late",
        question=LINK,
    ),
    Picture(
        "Board",
        "Share of the processor by task, over 0.1 s, of tasks with 0.02 % or more; fullest state so far of the measurement "
        "queue (poses, gyro and accelerometer samples) and what it dropped.",
        board,
        needs="rtos.measurements_dropped",
        question=PROCESSOR,
    ),
)
TRACK = Picture(
    "Path",
    "Flown path (blue, red while a fault was in force; ring: release, dot: end) from the first goal (cross), W. A goal that "
    "moves is dashed; around one that does not, the 20 cm box.",
    track,
)
COURSE = Picture(
    "Path against goal",
    "Flown (solid) and wanted (dashed) position from the first goal in W, and yaw.",
    course,
)
OWN: Mapping[str, Picture] = {  # by the group of columns
    "robot": Picture("Robot", "What your own robot logs of itself.", partial(own, "robot"), question=WHAT),
    "logic": Picture(
        "Own logic", "What your own modules log of their memory.", partial(own, "logic"), question=KNOWN
    ),
}
LATENCY_BUDGET = Picture(
    "Latency budget",
    "Where poses spent their time from the exposure to the board, as the ground station reported for each that it sent.",
    latency_budget,
    question=LINK,
    about=("mocap", "radio", "serial"),
)
SCHEDULE = Picture(
    "Scheduler",
    "Which task had the processor, for 20 ms.",
    schedule,
    needs="us",
    alone=True,
    question=PROCESSOR,
    about=("cpu",),
)
