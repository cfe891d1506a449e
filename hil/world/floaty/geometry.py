"""The shape of flap 2 and the robot's mass properties: computes surfaces, mass, centre of mass and inertia from a profile.

Frames: F has its origin on the body's z axis where the flap axes meet, and is parallel to B. Flap 2 lies in the quadrant
(+,+) of F when its angle is 0; the others are mirror images. An impossible geometry is refused here, in one line.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from firmware_py.elementary import cos, sin
from hil.errors import LabError
from hil.world.config import GeometryConfig

Points = NDArray[np.float64]
Corner = tuple[float, float]

HEIGHT_MAX = 0.5  # [m] of the flap axes above the centre of mass
SLACK = 1e-9  # [m, m2] tolerance for parts that only touch
PRODUCT_MAX = 0.01  # of inertia, as a share of the least moment: the plant's axes are the principal ones


@dataclass(frozen=True, slots=True)
class Surface:
    """A part of flap 2: convex, its corners in turn, (N, 3) [m] in F."""

    corners: Points
    unfolded: Points  # the corners before the strip was bent


@dataclass(frozen=True, slots=True)
class Weight:
    """Mass, centre of mass and inertia."""

    mass: float  # [kg]
    axis_height: float  # [m] of the flap axes above the centre of mass
    inertia: tuple[float, float, float]  # about x, y, z of B [kg m2]


def surfaces(geometry: GeometryConfig) -> tuple[Surface, ...]:
    """Return the flat parts of flap 2 and, last, the kinked strip."""
    swap = geometry.kink_side == "x"
    outline = [(y, x) for x, y in geometry.outline] if swap else list(geometry.outline)
    if outline:
        fold = max(y for _, y in outline) - geometry.strip_width
        flats, strip = [_cut(outline, 1, fold, above=False)], _cut(outline, 1, fold, above=True)
    else:
        side, corner = geometry.footprint / 2, geometry.base_side / 2
        fold = side - geometry.strip_width
        flats = [
            [(corner, 0.0), (side, 0.0), (side, fold), (corner, fold)],
            [(0.0, corner), (corner, corner), (corner, fold), (0.0, fold)],
        ]
        strip = [(0.0, fold), (side, fold), (side, side), (0.0, side)]
    c, s = cos(geometry.kink_angle), sin(geometry.kink_angle)
    level = [[(x, y, 0.0) for x, y in part] for part in (*flats, strip)]
    bent = [(x, fold + (y - fold) * c, (y - fold) * s) for x, y in strip]
    order = (1, 0, 2) if swap else (0, 1, 2)
    return tuple(
        Surface(*(raised(np.array(corners)[:, order], geometry) for corners in both))
        for both in zip((*level[:-1], bent), level, strict=True)
    )


def axis_of(geometry: GeometryConfig) -> Points:
    """Return the unit vector of flap 2's axis in F, outwards."""
    return raised(_level_axis(geometry), geometry)


def raised(vectors: Points, geometry: GeometryConfig) -> Points:
    """Return vectors (..., 3) of a flap without dihedral turned by the dihedral."""
    level, up = _level_axis(geometry), np.array([0.0, 0.0, 1.0])
    c, s = cos(geometry.dihedral), sin(geometry.dihedral)
    along = (vectors * level).sum(axis=-1)[..., None]
    turned: Points = (
        vectors + along * ((c * level + s * up) - level) + vectors[..., 2:] * (c * up - s * level - up)
    )
    return turned


def _level_axis(geometry: GeometryConfig) -> Points:
    azimuth = geometry.axis_azimuth
    return np.array([cos(azimuth), cos(math.pi / 2 - azimuth), 0.0])  # so that 45 degrees are exact


def _cut(polygon: list[Corner], axis: int, at: float, above: bool) -> list[Corner]:
    """Return the part of a convex polygon with coordinate 0 or 1 above or below `at`."""
    kept: list[Corner] = []
    for a, b in pairwise([*polygon, polygon[0]]):
        a_in, b_in = (p[axis] == at or (p[axis] > at) == above for p in (a, b))
        if a_in:
            kept.append(a)
        if a_in != b_in and a[axis] != at and b[axis] != at:
            share = (at - a[axis]) / (b[axis] - a[axis])
            kept.append((a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])))
    return kept


def triangles(corners: Points) -> Points:
    """Return a convex polygon (N, 3) as triangles, (N - 2, 3, 3)."""
    return np.stack([(corners[0], b, c) for b, c in pairwise(corners[1:])])


def _doubled_areas(triangles: Points) -> Points:
    """Return twice the areas of triangles (N, 3, 3), (N,)."""
    a, b, c = triangles.swapaxes(0, 1)
    return np.asarray(np.sqrt((np.cross(b - a, c - a) ** 2).sum(axis=1)))


def area_and_centre(corners: Points) -> tuple[float, Points]:
    """Return area and centroid (3,) of a flat convex polygon."""
    parts = triangles(corners)
    areas = _doubled_areas(parts) / 2
    area = math.fsum(areas.tolist())
    return area, np.array([math.fsum((areas * parts.mean(axis=1)[:, i]).tolist()) / area for i in range(3)])


@lru_cache(256)
def weigh(geometry: GeometryConfig) -> Weight:
    """Return mass, centre of mass and inertia, in steps of 1e-9 kg and m and 1e-12 kg m2. Raises `LabError`."""
    mass, moment, second = 0.0, np.zeros(3), np.zeros((3, 3))  # the two moments about the origin of F
    for point_mass, place, box in _points(geometry):
        mass += point_mass
        moment += point_mass * place
        second += point_mass * (place[:, None] * place + np.diag(box * box) / 12.0)
    centre = moment / mass
    height = round(-float(centre[2]), 9)
    if abs(centre[:2]).max() > geometry.base_side * 1e-3:
        raise LabError(
            f"geometry.masses: centre of mass at x, y = {1e3 * centre[0]:.1f}, {1e3 * centre[1]:.1f} mm: "
            "outside the axis of symmetry, expected 0, 0"
        )
    if not 0.0 <= height <= HEIGHT_MAX:
        raise LabError(
            f"geometry.masses: centre of mass {1e3 * height:.1f} mm below the flap axes: "
            f"outside 0..{1e3 * HEIGHT_MAX:g}"
        )
    second -= mass * centre[:, None] * centre
    xx, yy, zz = np.diag(second).tolist()
    moments = (yy + zz, xx + zz, xx + yy)
    products = float(abs(second - np.diag(np.diag(second))).max())
    if products > PRODUCT_MAX * min(moments):
        raise LabError(
            f"geometry.masses: product of inertia {products:.2g} kg m2: expected masses in mirror symmetry about x and y"
        )
    ix, iy, iz = (round(one, 12) for one in moments) if geometry.inertia == "masses" else geometry.inertia
    return Weight(round(mass, 9), height, (ix, iy, iz))


def _points(geometry: GeometryConfig) -> list[tuple[float, Points, Points]]:
    """Return mass [kg], place (3,) in F and box (3,) of every piece; a triangle is a third at the middle of each side.

    A flap weighs as if it were not bent: its centre of mass is designed to lie at its axis (paper, Force analysis).
    """
    pieces = []
    parts = np.concatenate([triangles(surface.unfolded) for surface in surfaces(geometry)])
    areas = _doubled_areas(parts)
    shares = (geometry.flap_mass / 3.0 / math.fsum(areas.tolist()) * areas).tolist()
    mirrors = [np.array([x, y, 1.0]) for x in (1.0, -1.0) for y in (1.0, -1.0)]
    for share, part in zip(shares, parts, strict=True):
        middles = (part + np.roll(part, 1, axis=0)) / 2
        pieces += [(share, mirror * middle, np.zeros(3)) for mirror in mirrors for middle in middles]
    for one in geometry.masses:
        for mirror in mirrors if one.mirrored else mirrors[:1]:
            pieces.append((one.mass, mirror * np.array(one.place), np.array(one.size)))
    return pieces


def check(geometry: GeometryConfig) -> None:
    """Raise `LabError` for an impossible robot."""
    side, corner = geometry.footprint / 2, geometry.base_side / 2
    if corner >= side:
        raise LabError(
            f"geometry.base_side = {geometry.base_side:g}: leaves no flaps inside footprint = {geometry.footprint:g}"
        )
    outline = list(geometry.outline)
    if outline:
        _check_outline(outline, side, corner)
    across = [y if geometry.kink_side == "y" else x for x, y in outline or [(corner, corner), (side, side)]]
    width = max(across) - min(across)
    if geometry.strip_width >= width:
        raise LabError(
            f"geometry.strip_width = {geometry.strip_width:g}: leaves no flat part of the flap, which is {width:g} wide"
        )
    weigh(geometry)


def _check_outline(outline: list[Corner], side: float, corner: float) -> None:
    if len(outline) < 3:
        raise LabError(f"geometry.outline: {len(outline)} corners: expected three or more")
    for index, (x, y) in enumerate(outline):
        where = f"geometry.outline[{index}] = ({x:g}, {y:g})"
        if min(x, y) < -SLACK:
            raise LabError(f"{where}: beyond the quadrant (+,+): the flaps overlap")
        if max(x, y) > side + SLACK:
            raise LabError(f"{where}: outside footprint / 2 = {side:g}")
    turns = [
        (b[0] - a[0]) * (c[1] - b[1]) - (b[1] - a[1]) * (c[0] - b[0])
        for a, b, c in zip(outline, outline[1:] + outline[:1], outline[2:] + outline[:2], strict=True)
    ]
    if not (min(turns) > 0.0 or max(turns) < 0.0):
        raise LabError("geometry.outline: not convex, or its corners are not in turn")
    inside = outline
    for axis in (0, 1):
        inside = _cut(inside, axis, corner, above=False) if inside else []
    doubled = sum(a[0] * b[1] - a[1] * b[0] for a, b in pairwise([*inside, *inside[:1]]))
    if abs(doubled) > SLACK:
        raise LabError(f"geometry.outline: the flap overlaps the base plate, which reaches to {corner:g}")
