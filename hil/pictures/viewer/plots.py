"""The curves below `/plot`, the rates of counters and the lanes of states below `/state`."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from ground_station.latency import STAGES
from hil.laboratory.metrics import BOX, column, rows_at
from hil.laboratory.schedule import runs
from hil.pictures import curves
from hil.pictures.curves import Curves
from hil.pictures.viewer.track import RecordingTrack, mark_path, rgba, rgba_array

PLOTS: Mapping[str, Curves] = {
    "position/error": curves.POSITION,
    "attitude/error": curves.ATTITUDE,
    "flaps/angle": curves.FLAPS,
    "flaps/command": curves.FLAPS_COMMAND,
    "inputs": curves.INPUTS,
    "rotors/thrust": curves.ROTORS,
    "rotors/command": curves.ROTORS_COMMAND,
    "motors": curves.MOTORS,
    "miss/position": curves.POSITION_MISS,
    "miss/attitude": curves.ATTITUDE_MISS,
    "age/pose": curves.AGE,
    "age/horizon": curves.HORIZON,
    "age/without": curves.SINCE_FUSION,
    "age/stages": curves.AGE_STAGES,
    "link/loss/radio": curves.PACKETS,
    "link/loss/serial": curves.SERIAL_FAULTS,
    "link/loss/station": curves.STATION,
    "link/air": curves.AIR,
    "battery": curves.BATTERY,
    "queue": curves.QUEUE,
    "processor/all": curves.LOAD,  # of a real board; a simulated one's is by task
}
# Counters whose rates the viewer shows.
RATES: Mapping[str, Curves] = {
    "link/rate/radio": curves.logged(
        ("packets up", "packets down"), (curves.BLUE, curves.GREEN), "1/s", "link.up_delivered", "link.down_delivered"
    ),
    "link/rate/station": curves.logged(
        ("poses sent", "frames seen", "telemetry blocks"), (curves.BLUE, curves.GREEN, curves.PINK), "1/s",
        "link.sent", "station.frames", "station.samples",
    ),
}  # fmt: skip
PALE = ("flaps/command", "rotors/command")
# They also keep the axes' scales fixed.
LIMITS = {"position/limit": curves.NEAR_CM, "position/box": 100 * BOX, "attitude/limit": curves.ATTITUDE_DEG}
SECOND_US, ROWS_OF_A_SECOND = 1_000_000, 100
SLOW = 10  # rows between samples of slow quantities: 10 Hz
STRETCHES_SHOWN = 2000  # of the schedule; the whole of it is for Perfetto


@dataclass(frozen=True, slots=True)
class ShownCurves:
    """The curves of a flight whose log has certain columns, by path."""

    plots: Mapping[str, Curves]
    rates: Mapping[str, Curves]  # of counters
    processor: Curves  # by task; without names: none

    @classmethod
    def of(cls, schema: pa.Schema) -> "ShownCurves":
        names = set(schema.names)
        return cls(
            {path: plot for path, plot in PLOTS.items() if plot.fits(names)},
            {path: plot for path, plot in RATES.items() if plot.fits(names)},
            curves.processor(schema.names),
        )

    @property
    def paths(self) -> set[str]:
        """Where there is something to see."""
        return {*self.plots, *self.rates, *LIMITS} | ({"processor"} if self.processor.names else set())


class Plots:
    """Draws curves, marks and states from the rows of a log."""

    def __init__(self, track: RecordingTrack, schema: pa.Schema) -> None:
        self._track, self._known = track, ShownCurves.of(schema)
        self._states = curves.lanes_of(schema.names)
        self._slow = schema.empty_table()  # the last row that was a sample of slow quantities
        self._fusion = schema.empty_table()  # the row of the last fused pose
        self._name_all()

    def add_rows(self, joined: pa.Table, fresh: int) -> None:
        """Draw the rows from `fresh` on; those before are known already."""
        rows = joined.slice(fresh)
        since_fusion = pa.concat_tables([self._fusion, rows])
        self._fusion = curves.row_of_last_fusion(since_fusion)
        for path, plot in self._known.plots.items():
            self._track.curve(path, column(rows, "t"), plot.read(since_fusion)[-rows.num_rows :])
        for path, states in self._states.items():
            begins, names = curves.changes(joined, states)
            self._track.send(f"state/{path}", begins[fresh:], rr.StateChange.columns(state=names[fresh:]))
        for name, (_, columns) in curves.MARK_KINDS.items():
            self._track.mark(name, column(joined, "t")[refused(joined, columns)])

    def add_slow(self, past: pa.Table, at: NDArray[np.int64]) -> None:
        """Draw slow quantities of rows `at`, with those of a second before them."""
        chosen = rows_at(past, at)
        times = column(chosen, "t")
        for path, limit in LIMITS.items():
            self._track.curve(path, times, np.full((len(times), 2), (limit, -limit)))
        for path, rate in self._known.rates.items():
            self._track.curve(path, times, rates(past, rate, at))
        if self._known.processor.names:
            slow = pa.concat_tables([self._slow, chosen])
            self._track.curve("processor", column(slow, "t")[1:], self._known.processor.read(slow))
        self._slow = chosen.slice(chosen.num_rows - 1)

    def add_schedule(self, schedule: pa.Table) -> None:
        """Draw which task had the processor, a lane per task."""
        stretches = list(islice(runs(schedule), STRETCHES_SHOWN))
        for name in sorted({run.task for run in stretches} - {"IDLE"}):
            mine = [run for run in stretches if run.task == name]
            times = np.array([us for run in mine for us in (run.start_us, run.end_us)], np.float64)
            states = [state for _ in mine for state in ("runs", "-")]
            self._name_lane(f"task/{name}", ("runs", "-"), (curves.GREEN, curves.GREY))
            self._track.send(f"state/task/{name}", times, rr.StateChange.columns(state=states))

    def add_ages(self, ages: pa.Table) -> None:
        """Draw the stages of the poses' age, from the station's own record: `t` [us] and each of `STAGES` [us]."""
        table = ages.rename_columns(["t", *(f"age.{stage}" for stage in STAGES)])
        path = "age/stages"
        if path in self._known.plots or table.num_rows == 0:  # they are in the log
            return
        self._name_curves(path, curves.AGE_STAGES)
        self._track.curve(path, column(table, "t"), curves.AGE_STAGES.read(table))

    def _name_all(self) -> None:
        for path, plot in {**self._known.plots, **self._known.rates}.items():
            self._name_curves(path, plot)
        if self._known.processor.names:
            self._name_curves("processor", self._known.processor)
        for path in LIMITS:
            names = [path.rpartition("/")[2]] * 2
            limit = rr.SeriesLines(names=names, colors=rgba_array([curves.GREY] * 2), widths=[1.0] * 2)
            self._track.static(f"plot/{path}", limit)
        for name, (colour, _) in curves.MARK_KINDS.items():
            points = rr.SeriesPoints(names=name, colors=rgba(colour), markers="diamond", marker_sizes=5.0)
            self._track.static(f"plot/{mark_path(name)}", points)
        for path, states in self._states.items():
            self._name_lane(path, states.names, states.colours)
        self._name_lane("faults", ("-",), (curves.GREY,))

    def _name_lane(self, path: str, names: tuple[str, ...], colours: tuple[str, ...]) -> None:
        lane = rr.StateConfiguration(values=names, colors=rgba_array(colours))
        self._track.static(f"state/{path}", lane)

    def _name_curves(self, path: str, plot: Curves) -> None:
        width, opacity = (1.0, 120) if path in PALE else (1.6, 255)
        colours, widths = rgba_array(plot.colours, opacity), [width] * len(plot.names)
        self._track.static(f"plot/{path}", rr.SeriesLines(names=plot.names, colors=colours, widths=widths))


def rates(rows: pa.Table, counters: Curves, at: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the rates of counters [1/s] at rows `at`, over the second before or its recorded part; (len(at), names)."""
    times, counts = column(rows, "t"), counters.read(rows)
    since = np.searchsorted(times, times[at] - SECOND_US)
    passed = 1e-6 * (times[at] - times[since])[:, None]
    return np.asarray((counts[at] - counts[since]) / np.where(passed > 0, passed, np.nan))


def refused(rows: pa.Table, names: tuple[str, ...]) -> NDArray[np.int64]:
    """Return the rows, except the first, at which any of some counters is larger than in the row before."""
    known = [name for name in names if name in rows.column_names]
    if not known:
        return np.empty(0, np.int64)
    counts = column(rows, *known).reshape(-1, len(known)).sum(axis=1)
    return np.asarray(1 + np.flatnonzero(np.diff(counts) > 0))
