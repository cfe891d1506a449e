"""Close-ups of a flight: what happened around each fault, and in the last seconds before a loss."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import pyarrow as pa

from hil.pictures import curves
from hil.pictures.curves import since_release
from hil.pictures.pages import PageFigure, embedded
from hil.pictures.panels import Marks, Plot, Spell, panel

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
