"""The paper's results that a laboratory without hardware can reproduce: what the paper says, where, and what we measure.

One row per experiment. Verdicts come from the limits of the experiments, not from here. `why` says why a row misses the
paper's value, or what the paper's figure means; physics.md, named there, is the specification of the plant.
"""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the paper's table."""

    title: str
    claim: str  # the paper's, in short
    place: str  # in the paper
    values: Mapping[str, str]  # metric -> the paper's value, empty where it gives none
    why: str = ""


HOVER_PLACE = "Hover performance, Fig. Hover_figure"

ROWS: Mapping[str, Row] = {
    "hover": Row(
        "Hover for 30 s at 1.15 m",
        "inside a 20 cm box; below 6 cm per axis most of the time; attitude below 20°; y worst",
        HOVER_PLACE,
        {
            "in_box": "always",
            "within_6cm_x": "mostly", "within_6cm_y": "mostly", "within_6cm_z": "mostly",
            "attitude_max": "< 20 deg", "rms_x": "", "rms_y": "", "rms_z": "", "y_over_x": "> 1",
        },
        "y is the worst axis with the author's gains only: they leave the y loop at +0.26 ± 4.9i, a limit cycle of "
        "0.8 Hz. With roll gains that damp it (floaty) y becomes the best axis.",
    ),
}  # fmt: skip

OUTSIDE = ("overload",)  # experiments that are not the paper's
