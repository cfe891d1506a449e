"""A picture of the report, and the loading of matplotlib, which is slow, for the few that need it."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hil.pictures.panels import Plot, Still

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure


WHERE, WHAT, KNOWN, LINK, PROCESSOR = (
    "Where was it?",
    "What did it do?",
    "What did the board know?",
    "What did the link do?",
    "What did the processor do?",
)
QUESTIONS = (WHERE, WHAT, KNOWN, LINK, PROCESSOR)


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the report. An experiment's own takes several flights, the trials, and emphasises the first."""

    title: str
    caption: str
    draw: Callable[..., Plot | Still]  # of the log of a flight, of several, or of a schedule
    needs: str = "t"  # columns of which it needs one at least
    alone: bool = False  # panels with a time axis of their own
    question: str = WHERE  # that it answers, in whose part of the report it is
    folded: bool = False  # until a reader opens it, or a fault of the groups `about` was injected
    about: tuple[str, ...] = ()

    def fits(self, columns: Iterable[str]) -> bool:
        """Whether it can be drawn of a log with these columns."""
        return not set(self.needs.split()).isdisjoint(columns)


def painted(draw: Callable[..., Figure], *flights: pa.Table) -> Still:
    """Return the figure that `draw` makes of flights with matplotlib."""
    from hil.pictures.drawing import png

    return Still(png(draw, *flights), "png")
