"""The story of a flight, which its report begins with: what happened when, in seconds from the release; and close-ups of
what happened around each fault, and in the last seconds before a loss.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.wire.supervisor import State
from hil.laboratory.faults import spans_of
from hil.laboratory.metrics import BOX, NEAR, attitude_error, column, free_flight, position_error
from hil.laboratory.recorder import release_of
from hil.laboratory.result import Result
from hil.pictures import curves
from hil.pictures.curves import since_release
from hil.pictures.pages import PageFigure, embedded
from hil.pictures.panels import Marks, Plot, Spell, panel, saturated


@dataclass(frozen=True, slots=True)
class Moment:
    """What happened at an instant."""

    t_s: float  # from the release
    text: str


def story_of(log: pa.Table, result: Result) -> list[Moment]:
    """Return release, faults, the first limit passed, the first saturated flap, failsafes and loss in the order of time."""
    release_us = release_of(log.schema.metadata)
    free = free_flight(log)
    if free.num_rows == 0:
        return []
    seconds = 1e-6 * (column(free, "t") - release_us)
    moments = [Moment(0.0, "released")]
    for span in spans_of(log.schema.metadata):
        begin_s, end_s = (1e-6 * (us - release_us) for us in (span.begin_us, span.end_us))
        moments += [Moment(begin_s, f"fault {span.fault} begins")] if begin_s <= seconds[-1] else []
        moments += [Moment(end_s, f"fault {span.fault} ends")] if end_s <= seconds[-1] else []
    passed = [(_first(wrong), name) for name, wrong in _passed(free, result)]
    if passed:
        row, name = min(passed)
        moments.append(Moment(seconds[row], f"first limit passed: {name}"))
    for flap, at_limit in saturated(free):
        moments.append(Moment(seconds[_first(at_limit)], f"flap {flap} saturates for the first time"))
    failsafe = column(free, "supervisor.state") == State.FAILSAFE
    for row in np.flatnonzero(np.diff(failsafe, prepend=False)).tolist():
        moments.append(Moment(seconds[row], f"failsafe {'begins' if failsafe[row] else 'ends'}"))
    if result.outcome == "lost":
        moments.append(Moment(seconds[-1], f"lost: {result.cause}"))
    return sorted(moments, key=lambda moment: moment.t_s)


def _first(wrong: NDArray[np.bool_]) -> int:
    return int(np.argmax(wrong))


def _passed(flight: pa.Table, result: Result) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield the limits that failed and have an instant at which they were passed, and the rows beyond them."""
    error = np.abs(position_error(flight))
    beyond: Mapping[str, tuple[NDArray[np.float64], float | None]] = {
        **{f"max_{axis}": (error[:, index], None) for index, axis in enumerate("xyz")},
        **{f"within_6cm_{axis}": (error[:, index], NEAR) for index, axis in enumerate("xyz")},
        "in_box": (error.max(axis=1), BOX),
        "attitude_max": (np.abs(attitude_error(flight)).max(axis=1), None),
    }
    for verdict in result.verdicts:
        if not verdict.holds and verdict.metric in beyond:
            values, bound = beyond[verdict.metric]
            wrong = values > (verdict.bound if bound is None else bound)
            if wrong.any():
                yield verdict.metric, wrong


BEFORE_S, AFTER_S = 0.5, 1.0  # of a fault
FAULT_S = 2.0  # shown of the beginning of a longer fault
LAST_S = 3.0  # before a loss


@dataclass(frozen=True, slots=True)
class CloseUp:
    """A close-up, with its begin and end [s]."""

    figure: PageFigure
    at_s: float
    begin_s: float
    end_s: float


def close_ups(log: pa.Table, marks: Marks) -> list[CloseUp]:
    """Return a figure for each instant at which faults begin, and for the loss."""
    times = since_release(log)
    shown: list[CloseUp] = []
    for title, at_s, begin_s, end_s in _windows(marks):
        rows = log.filter((times >= begin_s) & (times <= end_s))
        if rows.num_rows > 1:
            plot = embedded(_plot(rows, (begin_s, end_s)))
            figure = PageFigure(f"close-up-{len(shown) + 1}", title, "", plot=plot, alone=True, marks=marks)
            shown.append(CloseUp(figure, at_s, begin_s, end_s))
    return shown


def _windows(marks: Marks) -> Iterator[tuple[str, float, float, float]]:
    """Yield title, instant, begin and end [s]."""
    faults = [spell for spell in marks.spells if spell.kind == "fault"]
    for begin_s, together in groupby(sorted(faults, key=_begin), key=_begin):
        spells = list(together)
        end_s = min(max(spell.end_s for spell in spells), begin_s + FAULT_S) + AFTER_S
        yield ", ".join(spell.text for spell in spells), begin_s, begin_s - BEFORE_S, end_s
    for loss in marks.instants:
        if loss.kind == "lost":
            yield f"Loss: {loss.text}", loss.t_s, loss.t_s - LAST_S, loss.t_s + BEFORE_S


def _begin(spell: Spell) -> float:
    return spell.begin_s


def _plot(rows: pa.Table, window_s: tuple[float, float]) -> Plot:
    since = [
        panel(plot, rows, label, height=1.2)
        for plot, label in ((curves.SINCE_FUSION, "without a pose"), (curves.AGE, "age of the pose"))
        if plot.needs in rows.column_names
    ]
    return Plot(
        (
            panel(curves.POSITION, rows, "position error"),
            panel(curves.ATTITUDE, rows, "attitude error"),
            panel(curves.FLAPS, rows, "flaps"),
            *since[:1],
        ),
        window_s,
    )
