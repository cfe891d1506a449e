"""The numbers of a shape that `floaty design optimise` searches, and the bounds of the search.

Lengths are shares of the footprint. A result at a bound is not the best shape, but the best within the bound: the command
names it with the reason for the bound.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hil.world.config import GeometryConfig
from hil.world.floaty.geometry import weigh

AT_BOUND = 1e-3  # of the range


@dataclass(frozen=True, slots=True)
class Bounds:
    """The ends of the search over one number, and the reasons for them."""

    name: str
    low: float
    high: float
    why_low: str
    why_high: str

    def reached(self, value: float) -> str:
        """Return a sentence when a value lies at one of the ends, else nothing."""
        for end, at, why in (("lower", self.low, self.why_low), ("upper", self.high, self.why_high)):
            if abs(value - at) <= AT_BOUND * (self.high - self.low):
                angle = self.name == "kink"
                shown = f"{math.degrees(value):.0f} deg" if angle else f"{value:.3g} of the footprint"
                return f"{self.name} = {shown}: at the {end} bound of the search ({why})"
        return ""


SEARCHED = (
    Bounds("kink", 0.0, math.radians(80.0), "a flat flap", "nearly upright"),
    Bounds("height", 0.0, 0.5, "in the flaps' plane", "a chosen length"),
    Bounds(
        "base", 0.15, 0.5, "it carries board and bearings, which the model does not know", "half is for flaps"
    ),
    Bounds("strip", 0.02, 0.2, "a chosen width", "the flap beside the largest base is little wider"),
)
LOW, HIGH = np.array([(one.low, one.high) for one in SEARCHED]).T


def shape_of(geometry: GeometryConfig) -> NDArray[np.float64]:
    """Return a robot's numbers in the order of SEARCHED, (4,)."""
    lengths = (weigh(geometry).axis_height, geometry.base_side, geometry.strip_width)
    return np.array([geometry.kink_angle, *(length / geometry.footprint for length in lengths)])


def at_bounds(geometry: GeometryConfig) -> list[str]:
    """Return, in sentences, which numbers of a shape lie at a bound of the search."""
    texts = [one.reached(x) for one, x in zip(SEARCHED, shape_of(geometry).tolist(), strict=True)]
    return list(filter(None, texts))
