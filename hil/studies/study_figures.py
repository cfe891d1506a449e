"""The picture of a study: the error over its sizes, a curve per variant, and below it the outcome of every cell.

A curve is the mean over the surviving seeds, its band their range; it ends where all are lost.
"""

import numpy as np
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from hil.pictures import curves
from hil.pictures.drawing import WIDTH
from hil.studies.study import OUTCOMES, StudyResult

COLOURS = dict(zip(OUTCOMES, (curves.GREEN, curves.YELLOW, curves.SKY, curves.RED, curves.GREY), strict=True))
SHORT = {"holds": "holds", "degrades": "degr.", "failsafe": "f-safe", "lost": "lost", "error": "error"}
STYLES = ("-", "--", ":")


def picture(result: StudyResult) -> Figure:
    study, flown = result.study, result.curves
    strip = 0.27 * len(flown) + 0.6
    figure = Figure(figsize=(WIDTH, 2.3 + strip), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2.3, strip))
    for index, curve in enumerate(flown):
        alive = [cell for cell in curve.cells if cell.errors]
        places = [study.sizes.index(cell.size) for cell in alive]
        colour = curves.SERIES_COLOURS[index % len(curves.SERIES_COLOURS)]
        errors = [100 * np.array(cell.errors) for cell in alive]
        above.plot(
            places, [e.mean() for e in errors], "o" + STYLES[index % 3], color=colour, markersize=3,
            label=curve.variant.name,
        )  # fmt: skip
        above.fill_between(
            places, [e.min() for e in errors], [e.max() for e in errors], color=colour, alpha=0.12, linewidth=0
        )  # fmt: skip
    above.set_yscale("log")
    above.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    above.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    above.yaxis.set_minor_formatter(NullFormatter())
    above.set_ylabel("rms distance\nfrom the goal [cm]")
    above.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    for row, curve in enumerate(flown):
        for cell in curve.cells:
            place = study.sizes.index(cell.size)
            typical = cell.typical
            below.add_patch(
                Rectangle((place - 0.48, row - 0.45), 0.96, 0.9, color=to_rgba(COLOURS[typical], 0.75))
            )
            count = cell.outcomes.count(typical)
            of_all = "" if count == len(cell.outcomes) else f" {count}/{len(cell.outcomes)}"
            below.text(place, row, SHORT[typical] + of_all, ha="center", va="center", fontsize=7.5)
    below.set_ylim(len(flown) - 0.4, -0.6)
    below.set_yticks(range(len(flown)), [curve.variant.name for curve in flown])
    below.grid(visible=False)
    below.set_xlim(-0.55, len(study.sizes) - 0.45)
    below.set_xticks(range(len(study.sizes)), [f"{size:g}" for size in study.sizes])
    below.set_xlabel(f"{study.axis} [{study.unit}]" if study.unit else study.axis)
    return figure
