"""Nine plates and their places, from the geometry to the kernel's constants.

A flap is a flat part and a strip bent up along one edge. It turns about an axis through the body's z axis. n and r of a part
are A + B cos phi + C sin phi (Rodrigues), stated for flap 2 in the quadrant (+,+); the others are mirror images.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from firmware_py.elementary import cos, sin
from hil.errors import LabError
from hil.world.config import GeometryConfig, PlantConfig
from hil.world.floaty.geometry import area_and_centre, axis_of, raised, surfaces, weigh
from hil.world.motion import GRAVITY
from hil.world.structs import Flaps

MIRRORS = np.array([[1, -1, 1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1]], float)  # signs of x, y, z for each flap
SIGNS = np.array([1, -1, 1, -1], float)  # of the flap angles at hover (paper, eq. input_signals)
MIX = np.array([[1, 1, -1, -1], [1, -1, -1, 1], [-1, -1, -1, -1], [-1, 1, -1, 1]], float)  # the same equation

AIR_DENSITY = 1.225  # [kg/m3] of the standard atmosphere at sea level
DRAG_COEFFICIENTS = (0.1, 3.0)  # plausible for a plate


def _turning(vector: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return A, B, C, (3, 3), of a vector that turns about the flap's axis."""
    along = axis * math.fsum(axis * vector)
    (x, y, z), (u, v, w) = axis.tolist(), vector.tolist()
    return np.array([along, vector - along, (y * w - z * v, z * u - x * w, x * v - y * u)])


@dataclass(frozen=True, slots=True)
class Plate:
    """A part of flap 2 at flap angle 0; the flap axes meet in the origin, other flaps are mirror images."""

    area: float  # [m2]
    normal: NDArray[np.float64]  # (3,) in B
    centre: NDArray[np.float64]  # (3,) [m] of pressure


def flap_plates(geometry: GeometryConfig) -> tuple[Plate, Plate]:
    """Return the flat part and the kinked strip of flap 2."""
    parts = surfaces(geometry) if geometry.outline else ()
    flat, strip = [area_and_centre(part.corners) for part in parts] or _quadrant(geometry)
    order = (1, 0, 2) if geometry.kink_side == "x" else (0, 1, 2)
    bend = np.array([0.0, -sin(geometry.kink_angle), cos(geometry.kink_angle)])[[*order]]
    normals = (raised(np.array([0.0, 0.0, 1.0]), geometry), raised(bend, geometry))
    return Plate(flat[0], normals[0], flat[1]), Plate(strip[0], normals[1], strip[1])


@lru_cache(256)
def turning_plates(geometry: GeometryConfig) -> list[tuple[float, NDArray[np.float64], NDArray[np.float64]]]:
    """Return the area [m2] of the parts of flap 2, and A, B, C, (3, 3), of normal and centre [m]."""
    axis = axis_of(geometry)
    return [
        (part.area, _turning(part.normal, axis), _turning(part.centre, axis))
        for part in flap_plates(geometry)
    ]


def _quadrant(geometry: GeometryConfig) -> list[tuple[float, NDArray[np.float64]]]:
    """Return area and centre for a quadrant without the base plate's corner; G0's hashes depend on these sums."""
    side, corner = geometry.footprint / 2, geometry.base_side / 2
    width, kink = geometry.strip_width, geometry.kink_angle
    quadrant, strip = side * side - corner * corner, width * side
    flat = quadrant - strip
    # First moment of the quadrant without its corner, about either side.
    moment = (side * side * side - corner * corner * corner) / 2
    flat_centre = np.array([moment - strip * side / 2, moment - strip * (side - width / 2), 0.0]) / flat
    strip_centre = np.array([side / 2, side - width + width / 2 * cos(kink), width / 2 * sin(kink)])
    order = [1, 0, 2] if geometry.kink_side == "x" else [0, 1, 2]
    return [(flat, raised(flat_centre[order], geometry)), (strip, raised(strip_centre[order], geometry))]


def drag_coefficient(geometry: GeometryConfig, airspeed: float, hover_angle: float) -> float:
    """Return the C_D at which the robot hovers at a speed [m/s] and an opening of its flaps [rad]."""
    lift = geometry.base_side * geometry.base_side  # [m2] per dynamic pressure and C_D
    c, s = cos(hover_angle), -sin(hover_angle)  # flap 2 hovers at the negative angle
    for area, normal, _ in turning_plates(geometry):
        a, b, d = normal[:, 2].tolist()
        across = a + b * c + d * s
        lift += 4.0 * area * across * across * abs(across)
    pressure = AIR_DENSITY * airspeed * airspeed
    return 2.0 * weigh(geometry).mass * GRAVITY / (pressure * lift) if lift > 0.0 else math.inf


def check_hover(geometry: GeometryConfig, plant: PlantConfig) -> None:
    """Raise `LabError` when no plates of this size carry the robot at its design speed and hover angle."""
    found = drag_coefficient(geometry, plant.airspeed, plant.hover_angle)
    low, high = DRAG_COEFFICIENTS
    if not low <= found <= high:
        angle = math.degrees(plant.hover_angle)
        raise LabError(
            f"geometry: no lift for a hover at {plant.airspeed:g} m/s and {angle:.0f} deg: needs a drag coefficient of "
            f"{found:.1f}: outside {low}..{high:g}, flat plates have 1 to 2"
        )


def place_plates(flaps: Flaps, geometry: GeometryConfig, hover_angle: float) -> None:
    """Write the areas, normals and centres of pressure of all plates, and the hover angles."""
    height = weigh(geometry).axis_height
    flaps.base_area = geometry.base_side * geometry.base_side
    flaps.hover[:] = SIGNS * hover_angle
    flaps.hover_turn[:] = cos(hover_angle), -sin(hover_angle)
    flaps.flow_points[:, :2], flaps.flow_points[:, 2] = geometry.flow_point * MIRRORS[:, :2], height
    lift = np.array([[0.0, 0.0, height], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for plate, (mirror, (area, normal, centre)) in enumerate(product(MIRRORS, turning_plates(geometry))):
        flaps.area[plate] = area
        flaps.normal[plate] = (mirror * normal).ravel()
        flaps.centre[plate] = (mirror * centre + lift).ravel()
