"""Geometry G0 (physics.md section 3): nine plates and their places, from the design to the kernel's constants.

A flap is a quadrant of the footprint without the base plate's corner; the strip along its y edge is bent up. It turns
about a horizontal radial axis through the body's z axis. n and r of a part are A + B cos phi + C sin phi (Rodrigues),
written down for flap 2 in the quadrant (+,+); the others are mirror images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from firmware_py.elementary import cos, sin
from hil.world import layout as at
from hil.world.config import PlantConfig
from hil.world.plates import State

MIRRORS = np.array([[1, -1, 1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1]], float)  # signs of x, y, z for each flap
SIGNS = np.array([1, -1, 1, -1], float)  # of the flap angles at hover (paper, eq. input_signals)
MIX = np.array([[1, 1, -1, -1], [1, -1, -1, 1], [-1, -1, -1, -1], [-1, 1, -1, 1]], float)  # the same equation
AXIS = np.array([math.sqrt(0.5), math.sqrt(0.5), 0.0])  # of flap 2, outwards


def _turning(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return A, B, C, (3, 3), of a vector that turns about AXIS."""
    along = AXIS * math.fsum(AXIS * vector)
    return np.array([along, vector - along, np.cross(AXIS, vector)])


@dataclass(frozen=True, slots=True)
class Plate:
    """A part of flap 2 when the flap is level; its flap axis goes through the origin, other flaps are mirror images."""

    area: float  # [m2]
    normal: NDArray[np.float64]  # (3,) in B
    centre: NDArray[np.float64]  # (3,) [m] of pressure


def flap_plates(config: PlantConfig) -> tuple[Plate, Plate]:
    """Return the flat part and the kinked strip of flap 2."""
    side, corner = config.footprint / 2, config.base_side / 2
    width, kink = config.strip_width, config.kink_angle
    quadrant, strip = side * side - corner * corner, width * side
    flat = quadrant - strip
    moment = (
        side * side * side - corner * corner * corner
    ) / 2  # of the quadrant without its corner, about either side
    flat_centre = np.array([moment - strip * side / 2, moment - strip * (side - width / 2), 0.0]) / flat
    strip_centre = np.array([side / 2, side - width + width / 2 * cos(kink), width / 2 * sin(kink)])
    return (
        Plate(flat, np.array([0.0, 0.0, 1.0]), flat_centre),
        Plate(strip, np.array([0.0, -sin(kink), cos(kink)]), strip_centre),
    )


def place_plates(s: State, config: PlantConfig) -> None:
    """Write the areas, normals and centres of pressure of all plates, and the hover angles."""
    s[at.BASE_AREA] = config.base_side * config.base_side
    s[at.AXIS_HEIGHT] = config.axis_height
    s[at.HOVER_FLAPS : at.HOVER_FLAPS + 4] = SIGNS * config.hover_angle
    lift = np.array([[0.0, 0.0, config.axis_height], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    parts = flap_plates(config)
    for flap in range(4):
        s[at.FLOW_POINTS + 2 * flap : at.FLOW_POINTS + 2 * flap + 2] = config.flow_point * MIRRORS[flap, :2]
        for index, part in enumerate(parts):
            plate = 2 * flap + index
            n = MIRRORS[flap] * _turning(part.normal)
            r = MIRRORS[flap] * _turning(part.centre) + lift
            s[at.AREA + plate] = part.area
            s[at.NORMAL + 9 * plate : at.NORMAL + 9 * plate + 9] = n.ravel()
            s[at.CENTRE + 9 * plate : at.CENTRE + 9 * plate + 9] = r.ravel()
