"""The room around a robot as its distance sensors see it: a floor, four walls and a ceiling, flat, in W (z up).

All of it is seen alike well; other robots are not seen.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

Vector = Sequence[float]


def to_world(q_WB: Vector, v_B: Vector) -> tuple[float, float, float]:
    """Return a vector of B in W."""
    w, x, y, z = q_WB
    a, b, c = v_B
    d, e, f = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return a + w * d + y * f - z * e, b + w * e + z * d - x * f, c + w * f + x * e - y * d


def to_body(q_WB: Vector, v_W: Vector) -> tuple[float, float, float]:
    """Return a vector of W in B."""
    w, x, y, z = q_WB
    return to_world((w, -x, -y, -z), v_W)


@dataclass(frozen=True, slots=True)
class Room:
    """Walls at x and y = +- `walls` [m]; infinitely far: there are none."""

    floor: float = 0.0  # z [m]
    walls: float = math.inf
    ceiling: float = math.inf  # z [m]

    def distance(self, p_W: Vector, direction_W: Vector, cos_cone: float) -> float:
        """Return the distance [m] of the nearest surface from a place, within a cone; inf without one.

        `direction_W` is the cone's axis, of length 1, `cos_cone` the cosine of its half angle.
        """
        (x, y, z), (ax, ay, az) = p_W, direction_W
        sin_cone = math.sqrt(1.0 - cos_cone * cos_cone)
        nearest = math.inf
        for away, towards in (
            (z - self.floor, -az), (self.ceiling - z, az),
            (self.walls - x, ax), (self.walls + x, -ax), (self.walls - y, ay), (self.walls + y, -ay),
        ):  # fmt: skip
            if towards < cos_cone:  # the cone's ray that is steepest on the surface
                towards = towards * cos_cone + math.sqrt(max(1.0 - towards * towards, 0.0)) * sin_cone
            else:
                towards = 1.0
            if towards > 0.0:
                nearest = min(nearest, max(away, 0.0) / towards)
        return nearest
