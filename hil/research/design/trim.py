"""Hover angle and airspeed of a robot of known drag coefficient, and robots of another size, mass or centre of mass.

The plates' coefficient does not change with shape, mass or speed: the profile's design airspeed and hover angle determine
it. Openings are flap angles, positive for every flap.
"""

import math
from typing import Any

import numpy as np

from hil.config import LabConfig
from hil.errors import LabError
from hil.world.config import GeometryConfig
from hil.world.floaty.geometry import weigh
from hil.world.floaty.shape import drag_coefficient

OPENINGS = np.radians(np.arange(-20.0, 75.5, 2.5))  # searched for a trim


def coefficient_of(config: LabConfig) -> float:
    """Return the drag coefficient at which a profile's robot hovers at its design point."""
    return drag_coefficient(config.geometry, config.plant.airspeed, config.plant.hover_angle)


def speed_at(geometry: GeometryConfig, coefficient: float, opening: float) -> float:
    """Return the updraft [m/s] that carries the robot at an opening [rad] of all flaps."""
    return math.sqrt(drag_coefficient(geometry, 1.0, opening) / coefficient)


def opening_at(geometry: GeometryConfig, coefficient: float, speed: float) -> float:
    """Return the hover opening [rad] at a speed [m/s]: there a larger opening makes the robot sink.

    Raises `LabError` when there is none.
    """
    from scipy.optimize import brentq

    speeds = np.array([speed_at(geometry, coefficient, opening) for opening in OPENINGS.tolist()])
    below = np.flatnonzero((speeds[:-1] <= speed) & (speeds[1:] > speed))
    if not len(below):
        raise LabError(
            f"no hover at {speed:g} m/s: with openings of {math.degrees(OPENINGS[0]):.0f} to "
            f"{math.degrees(OPENINGS[-1]):.0f} deg the flaps carry {weigh(geometry).mass:.3g} kg at "
            f"{speeds.min():.2f} to {speeds.max():.2f} m/s"
        )
    ends = OPENINGS[below[-1]], OPENINGS[below[-1] + 1]
    return float(brentq(lambda opening: speed_at(geometry, coefficient, opening) - speed, *ends))


def changed(geometry: GeometryConfig, **changes: Any) -> GeometryConfig:
    """Return a geometry with some values replaced, checked like a profile's."""
    return GeometryConfig.model_validate(geometry.model_dump() | changes)


def scaled(geometry: GeometryConfig, length: float, mass: float) -> GeometryConfig:
    """Return the similar robot: all lengths times `length`, all masses times `mass`."""
    masses = []
    for one in geometry.masses:
        longer = {name: tuple(length * x for x in getattr(one, name)) for name in ("place", "size")}
        masses.append(one.model_dump() | longer | {"mass": mass * one.mass})
    lengths = ("footprint", "base_side", "strip_width", "flow_point")
    changes: dict[str, Any] = {name: length * getattr(geometry, name) for name in lengths}
    changes["outline"] = tuple((length * x, length * y) for x, y in geometry.outline)
    if geometry.inertia != "masses":
        changes["inertia"] = tuple(mass * length * length * moment for moment in geometry.inertia)
    return changed(geometry, **changes, flap_mass=mass * geometry.flap_mass, masses=masses)


def balanced(
    geometry: GeometryConfig, height: float, keep_inertia: bool = False, **shape: float
) -> GeometryConfig:
    """Return the robot of another `shape` with the centre of mass `height` [m] below the flap axes.

    `masses` move up or down. A fitted inertia changes like the computed one of flaps and masses, unless it is kept: a
    smaller base plate has flaps that reach further inwards.
    """
    shaped = changed(geometry, **shape)
    before = weigh(shaped)
    hung = sum(one.mass * (4 if one.mirrored else 1) for one in geometry.masses)
    down = (height - before.axis_height) * before.mass / hung
    masses = [
        one.model_dump() | {"place": (one.place[0], one.place[1], one.place[2] - down)}
        for one in geometry.masses
    ]
    moved = changed(shaped, masses=masses)
    if keep_inertia or geometry.inertia == "masses":
        return moved
    old, new = (weigh(changed(one, inertia="masses")).inertia for one in (geometry, moved))
    return changed(moved, inertia=tuple(i * b / a for i, a, b in zip(before.inertia, old, new, strict=True)))
