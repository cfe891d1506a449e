"""The parts of a figure over time, and its marks, as values; `drawing` draws them, `pages` makes them zoomable.

Times are seconds from the release.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.wire.supervisor import State
from hil.laboratory.faults import spans_of
from hil.laboratory.files.recorder import release_of, stored_in
from hil.laboratory.metrics import column, free_flight
from hil.pictures.curves import GREY, MOTORS, Curves, marks_of, since_release

Signal = NDArray[np.float64]  # (N,)
ROUNDING = 1e-6  # [rad] float32 of a command at its limit
TOGETHER_S = 0.1  # a flap that leaves its limit for less is drawn as staying there
QUESTIONS = WHERE, WHAT, KNOWN, LINK, PROCESSOR = (
    "Where was it?", "What did it do?", "What did the board know?", "What did the link do?", "What did the processor do?"
)  # fmt: skip
INK = "black"  # of the page: in dark mode it is white


@dataclass(frozen=True, slots=True)
class Series:
    """One line. NaN: a gap."""

    name: str
    colour: str
    times: Signal  # [s]
    values: Signal  # in the unit of the panel's label
    width: float = 0.9  # [pt]
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Bar:
    """A state that lasted, on a lane of its own."""

    lane: str
    name: str
    colour: str
    begin_s: float
    end_s: float


@dataclass(frozen=True, slots=True)
class Panel:
    """One pair of axes: lines, or bars on lanes."""

    label: str  # with the unit
    series: tuple[Series, ...] = ()
    height: float = 1.5  # [in]
    limits: tuple[float, ...] = ()  # horizontal, dashed
    least: float | None = None  # of the vertical axis
    most: float | None = None
    stacked: bool = False
    bars: tuple[Bar, ...] = ()


@dataclass(frozen=True, slots=True)
class Plot:
    """Panels one above the other that share their time axis."""

    panels: tuple[Panel, ...]
    window_s: tuple[float, float] | None = None  # the part shown of a longer flight; None: all


@dataclass(frozen=True, slots=True)
class Still:
    """A picture that cannot be zoomed."""

    content: bytes
    kind: str  # png or svg+xml


@dataclass(frozen=True, slots=True)
class Interval:
    """An interval of a flight that every figure shades."""

    kind: str  # held, fault, failsafe, limit
    begin_s: float
    end_s: float
    text: str = ""


@dataclass(frozen=True, slots=True)
class Instant:
    """A moment of a flight that every figure marks."""

    kind: str  # operator, lost, paper
    t_s: float
    text: str


@dataclass(frozen=True, slots=True)
class Marks:
    """The marks of every figure of a flight."""

    intervals: tuple[Interval, ...] = ()
    instants: tuple[Instant, ...] = ()

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of marks, without repetition."""
        return tuple(
            dict.fromkeys([*(one.kind for one in self.intervals), *(one.kind for one in self.instants)])
        )


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the report. An experiment's own takes several flights, the trials, and emphasises the first."""

    title: str
    caption: str
    draw: Callable[..., Plot | Still]  # of the log of a flight, of several, or of a schedule
    needs: str = "t"  # columns of which it needs one at least
    alone: bool = False  # panels with a time axis of their own
    question: str = WHERE  # that it answers, in whose part of the report it is
    about: tuple[str, ...] = ()  # folded, unless a fault of these groups was injected; empty: never folded

    def fits(self, columns: Iterable[str]) -> bool:
        """Whether it can be drawn of a log with these columns."""
        return not set(self.needs.split()).isdisjoint(columns)


def panel(curves: Curves, rows: pa.Table, label: str, **look: float | tuple[float, ...]) -> Panel:
    """Return a panel of curves over the rows of a log."""
    times, values = since_release(rows), curves.read(rows)
    lines = tuple(
        Series(name, colour, times, values[:, index])
        for index, (name, colour) in enumerate(zip(curves.names, curves.colours, strict=True))
    )
    return Panel(f"{label} [{curves.unit}]", lines, **look)  # type: ignore[arg-type]


def marks_of_flight(log: pa.Table, lost: str | None = None) -> Marks:
    """Return the marks for every figure of a flight; `lost`: why it was lost, if it was."""
    times = since_release(log)
    if len(times) == 0:
        return Marks()
    held = times[(column(log, "flight.free") < 0.5) & (times < 0.0)]
    intervals = [Interval("held", held[0], held[-1])] if len(held) > 1 else []
    release_us = release_of(log.schema.metadata)
    for span in spans_of(log.schema.metadata):
        if span.begin_s < times[-1]:
            intervals.append(
                Interval("fault", span.begin_s, min(span.end_s, float(times[-1])), str(span.fault))
            )
    intervals += _intervals("failsafe", times, column(log, "supervisor.state") == State.FAILSAFE)
    for name, at_limit in saturated(log):
        intervals += _intervals("limit", times, at_limit & (times > 0.0), name)
    instants = [Instant("operator", 1e-6 * (us - release_us), text) for us, text in marks_of(log)]
    free = free_flight(log)
    if lost is not None and free.num_rows:
        instants.append(Instant("lost", float(since_release(free)[-1]), lost))
    return Marks(tuple(intervals), tuple(instants))


def spans(acts: NDArray[np.bool_]) -> list[list[int]]:
    """Return first and last row + 1 of every run of true values."""
    edges: list[list[int]] = (
        np.flatnonzero(np.diff(acts, prepend=False, append=False)).reshape(-1, 2).tolist()
    )
    return edges


def _intervals(kind: str, times: Signal, acts: NDArray[np.bool_], text: str = "") -> Iterator[Interval]:
    joined: list[list[float]] = []
    for begin, end in spans(acts):
        begin_s, end_s = float(times[begin]), float(times[min(end, len(times) - 1)])
        if joined and begin_s - joined[-1][1] < TOGETHER_S:
            joined[-1][1] = end_s
        else:
            joined.append([begin_s, end_s])
    return (Interval(kind, begin_s, end_s, text) for begin_s, end_s in joined)


def saturated(flight: pa.Table) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield the flaps and motors whose commands reach an end of their range, and the rows in which they do."""
    if MOTORS.fits(flight.column_names):
        for name, share in zip(MOTORS.names, MOTORS.read(flight).T, strict=True):
            if (share >= 100.0).any():
                yield name, share >= 100.0
        return
    limits = stored_in(flight.schema.metadata, "config").get("allocation")
    # a real board does not report its commands
    if limits is None or "control.flap_1" not in flight.column_names:
        return
    for flap, sign in ((1, 1), (2, -1), (3, 1), (4, -1)):
        opening = sign * column(flight, f"control.flap_{flap}")
        at_limit = (opening <= limits["opening_min"] + ROUNDING) | (
            opening >= limits["opening_max"] - ROUNDING
        )
        if at_limit.any():
            yield f"flap {flap}", at_limit


def lanes(states: Iterable[tuple[str, Signal, list[str], dict[str, str]]], end_s: float) -> tuple[Bar, ...]:
    """Return the bars of lanes, each given as name, begins of its states [s], their names and colours."""
    bars = []
    for lane, begins, names, colours in states:
        edges = [*begins.tolist(), end_s]
        bars += [
            Bar(lane, name, colours.get(name, GREY), begin, end)
            for name, begin, end in zip(names, edges[:-1], edges[1:], strict=True)
        ]
    return tuple(bars)
