"""Pages: self-contained HTML files from the templates beside this file; their figures, zoomable or as PNG.

Zoomable panels are data for `templates/figures.js`, drawn by uPlot (MIT licence; in the Python package
youplot), whose script is embedded once per file. A panel's curves are thinned to the lowest and highest values of some
1500 intervals, more than a screen shows.
"""

import base64
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from jinja2 import Environment, FileSystemBytecodeCache, FileSystemLoader, StrictUndefined
from jinja2.bccache import Bucket
from numpy.typing import NDArray
from youplot.vendor import uplot_css, uplot_js

from firmware_py.kept_code import kept_folder, may_load
from hil.errors import unlinked
from hil.pictures.panels import Marks, Panel, Picture, Plot, Series, Signal, Still

STRETCHES = 1500  # of a thinned line
NOTHING = Marks()


@dataclass(frozen=True, slots=True)
class PageFigure:
    """A figure of a page: a plot that can be zoomed, or a picture as a data URI."""

    name: str  # in the page's addresses
    title: str
    caption: str
    source: str = ""
    plot: dict[str, Any] | None = None  # by `embedded`
    alone: bool = False  # a plot with a window of time of its own
    marks: Marks = NOTHING
    folded: bool = False


class _KeptTemplates(FileSystemBytecodeCache):
    """Templates as bytecode: compiling them takes as long as filling them."""

    def load_bytecode(self, bucket: Bucket) -> None:
        if may_load(Path(self._get_cache_filename(bucket))):
            super().load_bytecode(bucket)


@cache
def _environment() -> Environment:
    return Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        bytecode_cache=_KeptTemplates(str(kept_folder("pages"))),
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip


def write_page(path: Path, template: str, **content: Any) -> Path:
    """Write a template with its content and return the path."""
    unlinked(path).write_text(_environment().get_template(template).render(content), encoding="utf-8")
    return path


def data_uri(content: bytes, kind: str = "png") -> str:
    """Return a picture as the text that embeds it in a page."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def saved(folder: Path, name: str, title: str, caption: str, draw: Callable[[], Any]) -> PageFigure:
    """Write the matplotlib figure that `draw` returns as `name.png` into a folder, and return it for a page."""
    from hil.pictures.drawing import png

    content = png(draw)
    unlinked(folder / f"{name}.png").write_bytes(content)
    return PageFigure(name, title, caption, data_uri(content))


def draw(picture: Picture, marks: Marks, *flights: pa.Table) -> PageFigure:
    """Return a picture of flights for a page."""
    acted = {interval.text.partition(".")[0] for interval in marks.intervals if interval.kind == "fault"}
    figure = PageFigure(
        picture.title.lower().replace(" ", "-"), picture.title, picture.caption,
        folded=bool(picture.about) and not acted.intersection(picture.about),
    )  # fmt: skip
    shown = picture.draw(*flights)
    if isinstance(shown, Still):
        return replace(figure, source=data_uri(shown.content, shown.kind))
    return replace(figure, plot=embedded(shown), alone=picture.alone, marks=marks)


def zoomable(shown: Iterable[PageFigure]) -> dict[str, Any]:
    """Return what `figures.html.j2` embeds: uPlot, and the plots among the figures as JSON values."""
    plots = [(one, one.plot) for one in shown if one.plot is not None]
    marks = list({id(one.marks): one.marks for one, _ in plots}.values())
    places = [id(one) for one in marks]
    return {
        **library(),
        "content": {
            "marks": [asdict(one) for one in marks],
            "figures": [
                {
                    "place": one.name,
                    "alone": one.alone,
                    "window": plot["window"] if one.alone else None,
                    "marks": places.index(id(one.marks)),
                    "panels": plot["panels"],
                }
                for one, plot in plots
            ],
        },
    }


def library() -> dict[str, str]:
    """Return uPlot's script and style, for a page to embed once."""
    return {"script": uplot_js(), "style": uplot_css()}


def embedded(plot: Plot) -> dict[str, Any]:
    """Return a plot as JSON values, its curves thinned: those of an hour would fill the memory."""
    return {"window": plot.window_s, "panels": [_panel(panel) for panel in plot.panels]}


def _panel(panel: Panel) -> dict[str, Any]:
    tables: list[tuple[Signal, list[Series]]] = []
    # lines with the same instants, in the order in which they are drawn
    for line in panel.series:
        if tables and tables[-1][0] is line.times:
            tables[-1][1].append(line)
        else:
            tables.append((line.times, [line]))
    return {
        **{name: getattr(panel, name) for name in ("label", "height", "limits", "least", "most", "stacked")},
        "bars": [asdict(bar) for bar in panel.bars],
        "series": [
            {"name": line.name, "colour": line.colour, "width": line.width, "dashed": line.dashed}
            for line in panel.series
        ],
        "tables": [_table(times, [line.values for line in lines]) for times, lines in tables],
    }


def _table(times: Signal, curves: list[Signal]) -> list[str]:
    """Return the instants and the values as little-endian float32 in base64."""
    rows = thinned(curves, STRETCHES)
    return [base64.b64encode(column[rows].astype("<f4").tobytes()).decode() for column in (times, *curves)]


def thinned(curves: list[Signal], stretches: int) -> NDArray[np.intp]:
    """Return the rows with the lowest and highest value of every curve in every interval, and the first NaN of each."""
    count = len(curves[0])
    if count <= 2 * len(curves) * stretches:
        return np.arange(count)
    edges = np.linspace(0, count, stretches + 1).astype(int)[:-1]
    kept = [edges, np.array([count - 1])]
    stretch_of = np.repeat(np.arange(stretches), np.diff(edges, append=count))
    for curve in curves:
        gaps = np.isnan(curve)
        for order in (curve, -curve):
            # for each interval the first row in the order of its values
            ranked = np.lexsort((np.where(gaps, np.inf, order), stretch_of))
            kept.append(ranked[edges])
        kept.append(np.flatnonzero(np.diff(gaps, prepend=False)))
    return np.unique(np.concatenate(kept))
