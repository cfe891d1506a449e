"""A picture of the report; drawing code is loaded when the first one is drawn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pyarrow as pa
    from matplotlib.figure import Figure

    from hil.pictures.panels import Plot


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure of the report. An experiment's own takes several flights, the trials, and emphasises the first."""

    title: str
    caption: str
    draw: Callable[..., Plot | Figure]  # of the log of a flight, of several, or of a schedule
    needs: str = "t"  # the column that it needs

    def png(self, *flights: pa.Table) -> bytes:
        """Return the figure, marked as the first flight was."""
        from hil.pictures.drawing import png

        return png(self.draw, *flights)
