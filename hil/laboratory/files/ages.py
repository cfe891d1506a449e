"""The latency budget of a flight's poses, from its ground station's record `telemetry.csv`.

For a radio in lockstep the station knows only a typical latency; the flight log has the real one.

Each row in the log of a real flight has the newest available pose, some 40 ms old; the pose of the row's own time arrives
with a later row. `at_exposure` inserts it when the log is read from its stream, interpolated between the two exposures
around that time; NaN if they are too far apart or the second one is missing.
"""

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyarrow import csv

from ground_station.latency import STAGES, Stage, budget_of
from ground_station.telemetry_log import AGE_COLUMNS, GOAL_COLUMNS, TELEMETRY, TIME_COLUMN
from hil.errors import refusing
from hil.laboratory.metrics import column, is_real

# Column of the log: the computer's clock, used in a station's record.
STATION_CLOCK = "station.clock"
STATION_START = b"station_start_us"  # in the metadata of a real flight's log: that clock at the log's time 0

EXPOSED = "cameras.exposed"  # column: exposure of the row's pose, in the log's time [us]
GAP_US = 100_000  # between two exposures; with a longer gap the pose in between is unknown
ROTATION = ("cameras.qw", "cameras.qx", "cameras.qy", "cameras.qz")


def ages_of(reported: pa.Table, log: pa.Table, link: str) -> tuple[Stage, ...]:
    """Return the budget of a flight over `link`; empty without telemetry."""
    if not reported.num_rows:
        return ()
    columns = {stage: 1e3 * column(reported, stage) for stage in STAGES}
    if link == "radio" and len(radio_us := _on_air(log)):
        columns["link"] = np.resize(radio_us, reported.num_rows)
    medium = link.partition(":")[0]
    times = {stage: column.tolist() for stage, column in columns.items()}
    return budget_of(times, "serial" if medium == "mavlink" else medium)


def reported_ages(folder: Path) -> pa.Table:
    """Return the ages of sent poses that the station reported: `t` [us] by its clock, and each stage [ms].

    An unknown stage is NaN. The last line of the file may be cut.
    """
    times = _read(folder / TELEMETRY, (TIME_COLUMN, *AGE_COLUMNS))
    times = times[~np.isnan(times[:, -1])]
    times *= (1e6, *len(STAGES) * (1e3,))
    return pa.table(dict(zip(("t", *STAGES), times.T, strict=True)))


def ages_in_time_of(log: Iterator[pa.Table], folder: Path) -> pa.Table:
    """Return the station's reported ages, with `t` [us] in the time of the log, given in pieces, and its metadata.

    Empty for a real flight whose log lacks the station's clock at its start, as older logs do.
    """
    begin = next(log)  # first: it refuses other folders than runs
    table = reported_ages(folder)
    metadata = begin.schema.metadata or {}
    if STATION_START in metadata:
        start_us = int(metadata[STATION_START])
        table = table.set_column(0, "t", pa.array(column(table, "t") - start_us))
    elif is_real(begin):
        table = table.slice(0, 0)
    elif STATION_CLOCK in begin.column_names:
        clocks = np.concatenate([column(piece, "t", STATION_CLOCK) for piece in chain([begin], log)])
        times_us = np.interp(column(table, "t"), clocks[:, 1], clocks[:, 0])
        table = table.set_column(0, "t", pa.array(times_us))
    return table.replace_schema_metadata(begin.schema.metadata)


def goals_sent(telemetry: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Return the station's goals: times (N,) [us] by its clock, (N, 4) x, y, z [m] and yaw [rad] in W; None: none."""
    rows = _read(telemetry, (TIME_COLUMN, *GOAL_COLUMNS))
    if not len(rows):
        return None
    return np.round(1e6 * rows[:, 0]).astype(np.int64), rows[:, 1:]


def with_goals_sent(telemetry: Path, log: pa.Table) -> pa.Table:
    """Return a flight log with the goals that the station sent, from its record."""
    sent = goals_sent(telemetry)
    if sent is None:
        return log
    times_us, goals = sent
    latest = np.searchsorted(times_us, log.column(STATION_CLOCK).to_numpy(), side="right") - 1
    columns = {}
    for index, name in enumerate(("goal.x", "goal.y", "goal.z", "goal.yaw")):
        columns[name] = np.where(latest < 0, log.column(name).to_numpy(), goals[np.maximum(latest, 0), index])
    return _with(log, columns)


def _read(telemetry: Path, titles: tuple[str, ...]) -> NDArray[np.float64]:
    """Return columns of a telemetry record, (N, columns); the last line of the file may be cut."""
    types = dict.fromkeys(titles, pa.float64())
    convert = csv.ConvertOptions(include_columns=titles, column_types=types, include_missing_columns=True)
    parse = csv.ParseOptions(invalid_row_handler=lambda row: "skip")
    # A thread that still has the handler aborts Python's exit; bytes that are not UTF-8 would fail in it.
    read = csv.ReadOptions(use_threads=False, encoding="latin-1")
    try:
        with refusing(f"{telemetry}: ", IsADirectoryError, PermissionError), telemetry.open("rb") as file:
            table = csv.read_csv(file, read, parse, convert)
    except (FileNotFoundError, pa.ArrowInvalid):  # no telemetry, not even a complete line
        return np.empty((0, len(titles)))
    columns = np.column_stack([table.column(title).to_numpy() for title in titles])
    del table
    pa.default_memory_pool().release_unused()  # of an hour, more than the columns themselves
    return columns


def _on_air(log: pa.Table) -> NDArray[np.float64]:
    """Return each uplink packet's latency from sender to board [us], if a radio was simulated."""
    if "link.retried" not in log.column_names or log.num_rows < 2:
        return np.empty(0)
    delivered, sum_us = np.diff(column(log, "link.up_delivered", "link.up_latency_sum"), axis=0).T
    times: NDArray[np.float64] = sum_us[delivered > 0] / delivered[delivered > 0]
    return times


def at_exposure(log: pa.Table) -> pa.Table:
    """Return a log with camera columns moved to the times of their rows; unchanged without cameras."""
    if EXPOSED not in log.column_names:
        return log
    names = [name for name in log.column_names if name.startswith("cameras.") and name != EXPOSED]
    times = log.column("t").to_numpy().astype(np.float64)
    exposed = log.column(EXPOSED).to_numpy().astype(np.float64)
    with_pose = np.flatnonzero(np.isfinite(exposed))
    fresh = with_pose[np.diff(exposed[with_pose], prepend=-np.inf) > 0]
    if len(fresh) < 2:
        return _with(log, {name: np.full(len(times), np.nan) for name in names})
    seen = exposed[fresh]
    after = np.searchsorted(seen, times).clip(1, len(seen) - 1)
    gap = seen[after] - seen[after - 1]
    known = (times >= seen[0]) & (times <= seen[-1]) & (gap <= GAP_US)
    share = (times - seen[after - 1]) / gap
    columns = {}
    for name in names:
        values = log.column(name).to_numpy()[fresh]
        columns[name] = np.where(known, (1 - share) * values[after - 1] + share * values[after], np.nan)
    q = np.stack([log.column(name).to_numpy()[fresh] for name in ROTATION], axis=1)
    a, b = q[after - 1], q[after]
    b = b * np.where((a * b).sum(axis=1) < 0, -1.0, 1.0)[:, None]  # neighbours may have opposite signs
    between = (1 - share)[:, None] * a + share[:, None] * b
    between /= np.sqrt((between**2).sum(axis=1))[:, None]
    between[~known] = np.nan
    return _with(log, columns | dict(zip(ROTATION, between.T, strict=True)))


def _with(log: pa.Table, columns: dict[str, NDArray[np.float64]]) -> pa.Table:
    for name, values in columns.items():
        place = log.schema.get_field_index(name)
        log = log.set_column(place, log.schema.field(place), pa.array(values))
    return log
