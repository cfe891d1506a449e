"""How every figure is drawn: its size, its style, and the way to PNG. matplotlib is loaded here."""

import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from hil.laboratory.recorder import release_of
from hil.pictures.curves import BLUE, marks_of

MARK_LENGTH = 28  # letters
WIDTH, DPI = 9.2, 115  # [in], 1/in
MARK_COLOUR = BLUE
STYLE: Any = {
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "agg.path.chunksize": 10_000,  # a long flight's noise overflows the renderer otherwise
    "font.size": 8.5,
    "grid.alpha": 0.3,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "lines.linewidth": 0.9,
}


def png(draw: Callable[..., Figure], *flights: pa.Table) -> bytes:
    """Return the figure that `draw` makes of flight logs, or of a schedule."""
    with matplotlib.rc_context(STYLE):
        file = io.BytesIO()
        draw(*flights).savefig(file, format="png", dpi=DPI)
    return file.getvalue()


def draw_marks(axes: Sequence[Axes], log: pa.Table) -> None:
    """Draw a line for each mark, which the first of the axes names; the time axis is zero at the release."""
    release_us = release_of(log.schema.metadata)
    for t_us, text in marks_of(log):
        at_s = 1e-6 * (t_us - release_us)
        for one in axes:
            one.axvline(at_s, color=MARK_COLOUR, linestyle=":", linewidth=0.9)
        short = text if len(text) <= MARK_LENGTH else f"{text[: MARK_LENGTH - 1]}…"
        axes[0].text(
            at_s, 0.02, short, transform=axes[0].get_xaxis_transform(), color=MARK_COLOUR, fontsize=6.5,
            rotation=90, ha="right", va="bottom", clip_on=True,
        )  # fmt: skip


def stack(heights: Sequence[float]) -> tuple[Figure, list[Axes]]:
    """Return a figure of axes one above the other [in] that share their time axis."""
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0].tolist()
    axes[-1].set_xlabel("time from the release [s]")
    return figure, axes
