"""Where goals may be: an upright cylinder of the flow in which the robot holds a hover."""

from collections.abc import Iterable
from math import sqrt

from firmware_py.config import BoxConfig
from firmware_py.core.subset import f32
from firmware_py.geometry import Vector

# A correction has the robot no further from its goal than this [m]: the flow is 0.9 m wide, the cameras see 0.85 m above
# the hover point and goals are at most 0.65 m below it; a take-off begins 1.1 m below the goal.
SIDEWAYS, BELOW, ABOVE = 0.9, 2.0, 1.0


class GoalBox:
    """A cylinder around `centre` in the frame of the poses; its sizes are parameters of the board."""

    def __init__(self, config: BoxConfig) -> None:
        self.radius = float(f32(config.radius))
        self.below = float(f32(config.below))
        self.above = float(f32(config.above))

    def excess(self, place: Vector, centre: Vector) -> float:
        """Return how far a place is outside [m], 0 inside."""
        x, y, z = (place[i] - centre[i] for i in range(3))
        return max(sqrt(x * x + y * y) - self.radius, -z - self.below, z - self.above, 0.0)

    def holds(self, places: Iterable[Vector], centre: Vector) -> bool:
        """Return whether a path ends inside and is never further outside than at its beginning."""
        outside = [self.excess(place, centre) for place in places]
        return outside[-1] == 0.0 and max(outside) <= outside[0]


def is_correction(p_GB: Vector) -> bool:
    """Return whether the robot can be there from its goal."""
    x, y, z = p_GB
    return sqrt(x * x + y * y) <= SIDEWAYS and -BELOW <= z <= ABOVE
