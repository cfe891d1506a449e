"""Floaty's look: base plate, four turning flaps, stand, and the markers of the cameras.

Shapes of flaps are in F, which has its origin on the body's z axis where the flap axes meet and is parallel to B at flap
angle 0; a flap turns about its outward axis by its signed angle.

The places of the real robot's markers are not published; here they are on rigid parts, not on the flaps: four on the flap
axes, which do not move when the flaps turn, two on posts over the base plate, two on the frame below. All arms differ, so
that no other assignment of labels fits (the closest misses by 19 mm, test_markers.py). No three markers are close to one
line. Their spread gives both noise figures of `[mocap]` from one: 1.1 mm per marker and axis makes 0.4 mm and 0.004 rad
of the pose.
"""

import numpy as np

from hil.world.config import GeometryConfig, NetConfig
from hil.world.floaty.geometry import axis_of, surfaces, triangles, weigh
from hil.world.floaty.shape import MIRRORS
from hil.world.scene import PALE, Markers, Part, Points, VisualModel

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7")  # of flaps 1 to 4, as of their curves
TURN = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)], float)


def flap_axes(geometry: GeometryConfig) -> Points:
    """Return the flaps' axes, (4, 3) unit vectors in B."""
    return np.asarray(axis_of(geometry) * MIRRORS)


def base_triangles(geometry: GeometryConfig) -> Points:
    """Return the base plate in F."""
    a, b, c, d = (np.array((x, y, 0.0)) for x, y in geometry.base_side / 2 * TURN[:4])
    return np.array([(a, b, c), (a, c, d)])


def flap_triangles(geometry: GeometryConfig, flap: int) -> Points:
    """Return flap 0..3 in F: first the triangles of the flat parts, then those of the kinked strip."""
    corners = np.concatenate([triangles(surface.corners) for surface in surfaces(geometry)])
    return np.asarray(corners * MIRRORS[flap])


def outline(geometry: GeometryConfig) -> tuple[Points, ...]:
    """Return the lines of the robot's ghost in B: the footprint, the base plate and the rod to the centre of mass."""
    halves, height = (geometry.footprint / 2, geometry.base_side / 2), weigh(geometry).axis_height
    squares = [np.column_stack((TURN * half, np.full(5, height))) for half in halves]
    return (*squares, np.array([(0.0, 0.0, 0.0), (0.0, 0.0, height)]))


def stand_lines(geometry: GeometryConfig, ground: NetConfig) -> tuple[Points, ...]:
    """Return the stand in B: from each corner of the base plate to a foot, and around the feet."""
    corner, foot, height = geometry.base_side / 2, ground.foot_spread, weigh(geometry).axis_height
    feet = np.column_stack((foot * TURN, np.full(5, -ground.foot_below)))
    corners = np.column_stack((corner * TURN, np.full(5, height)))
    return (feet, *np.stack((corners[:4], feet[:4]), axis=1))


def marker_places(geometry: GeometryConfig, ground: NetConfig) -> Points:
    """Return the markers' places in B, (8, 3) [m]."""
    corner, base, axis = geometry.footprint / 2, geometry.base_side, weigh(geometry).axis_height
    spread, below = ground.foot_spread, ground.foot_below
    return np.array(
        [
            (1.00 * corner, -1.00 * corner, axis),  # on the axes of flaps 1 to 4
            (0.85 * corner, 0.85 * corner, axis),
            (-0.95 * corner, 0.95 * corner, axis),
            (-0.70 * corner, -0.70 * corner, axis),
            (0.375 * base, 0.0, axis + 0.02),  # on posts over the base plate
            (-0.375 * base, 0.25 * base, axis + 0.06),
            (spread, 0.0, -0.4 * below),  # on the frame that holds batteries and feet
            (-0.5 * spread, -spread, -below),
        ]
    )


def markers_of(geometry: GeometryConfig, ground: NetConfig) -> Markers:
    """Return the markers; base plate and flaps hide them as one flat square, at any flap angles."""
    return Markers(marker_places(geometry, ground), weigh(geometry).axis_height, geometry.footprint / 2)


def look_of(geometry: GeometryConfig, ground: NetConfig) -> VisualModel:
    """Return the whole robot."""
    height, axes = weigh(geometry).axis_height, flap_axes(geometry).tolist()
    place = (0.0, 0.0, height)
    flaps = [
        Part(
            f"flap_{flap + 1}", flap_triangles(geometry, flap), colour, place, tuple(axes[flap]),
            f"truth.flap_{flap + 1}", f"force.flap{flap + 1}", str(flap + 1),
        )
        for flap, colour in enumerate(COLOURS)
    ]  # fmt: skip
    base = Part("base", base_triangles(geometry), PALE, place, force="force.base")
    rod = np.array([(0.0, 0.0, 0.0), place])
    return VisualModel(
        (base, *flaps), (rod, *stand_lines(geometry, ground)), outline(geometry), place,
        tuple(map(tuple, marker_places(geometry, ground).tolist())),
    )  # fmt: skip
