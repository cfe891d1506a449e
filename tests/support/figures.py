"""What stands on a matplotlib figure."""

from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure


def words_of(figure: Figure) -> list[tuple[str, ...]]:
    """The words of each pair of axes: title, along x, along y, and the names of the legend."""
    return [(axes.get_title(), axes.get_xlabel(), axes.get_ylabel(), *named(axes)) for axes in figure.axes]


def named(axes: Axes) -> list[str]:
    """The names in a legend."""
    legend = axes.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


def looks_of(axes: Axes) -> list[tuple[str, str, str]]:
    """The colour, line style and marker of each line."""
    return [(to_hex(line.get_color()), line.get_linestyle(), line.get_marker()) for line in axes.lines]
