"""Sweeps over the shape: stability of roll, the hover angle with most authority, the effects of size and mass."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import radians

import numpy as np
from numpy.typing import NDArray

from hil.research.design.authority import INPUT_CONSTANTS, QUANTITIES
from hil.research.design.axes import ROLL
from hil.research.design.linear import Point, stiffness
from hil.research.design.trim import balanced, changed, scaled, speed_at
from hil.world.config import GeometryConfig
from hil.world.floaty.correction import Constants
from hil.world.floaty.geometry import weigh
from hil.world.floaty.shape import AIR_DENSITY

KINKS = np.radians(np.arange(0.0, 90.1, 3.75))
HEIGHTS = np.arange(0.0, 0.1201, 0.015)  # [m] of the flap axes above the centre of mass
OPENINGS = np.radians(np.arange(10.0, 45.1, 0.5))
FACTORS = np.array([0.5, 0.7, 1.0, 1.4, 2.0])  # on length or mass
VISCOSITY = 1.81e-5  # [Pa s] of air at 15 deg C, dynamic
NEAR_BEST = 0.95  # share of the best figure at which hover angles count as equally good
RESERVE = radians(
    8.0
)  # of the opening, for attitude: 95 % of the hover's time (hil/laboratory/experiments/airspeed.py)
Curve = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Stability:
    """f_αα [1/s2] over kink and height, and the roll poles over the kink at the robot's own height; the inertia is kept."""

    stiffness: Curve  # (HEIGHTS, KINKS)
    along: Curve  # (KINKS,) at the robot's own height
    poles: NDArray[np.complex128]  # (KINKS, 3)
    crossing: float  # [rad] kink at which f_αα is 0 at that height, NaN: nowhere


def stability(point: Point) -> Stability:
    """Return the sweep over kink and centre of mass, at the same hover angle."""
    from scipy.optimize import brentq

    rows = [balanced(point.geometry, height, keep_inertia=True) for height in HEIGHTS.tolist()]
    surface = [[_stiffness(point, row, kink) for kink in KINKS.tolist()] for row in rows]
    along = np.array([_stiffness(point, point.geometry, kink) for kink in KINKS.tolist()])
    kinked = [changed(point.geometry, kink_angle=kink) for kink in KINKS.tolist()]
    poles = [replace(point, geometry=one).linear.poles(ROLL) for one in kinked]
    falling = np.flatnonzero((along[:-1] > 0.0) & (along[1:] <= 0.0))
    crossing = np.nan
    if len(falling):
        ends = KINKS[falling[0]], KINKS[falling[0] + 1]
        crossing = brentq(lambda kink: _stiffness(point, point.geometry, kink), *ends)
    return Stability(np.array(surface), along, np.array(poles), crossing)


def _stiffness(point: Point, geometry: GeometryConfig, kink: float) -> float:
    bent = changed(geometry, kink_angle=kink)
    return stiffness(bent, speed_at(bent, point.coefficient, point.opening), point.opening)


@dataclass(frozen=True, slots=True)
class HoverAngles:
    """Input constants over the hover angle, and three readings of "authority over all axes"."""

    constants: Mapping[str, Curve]  # by QUANTITIES, (OPENINGS,), signed
    criteria: Mapping[str, Curve]  # each as a share of its best

    def best(self, criterion: str) -> tuple[float, float, float]:
        """Return the best hover angle and the range within 5 % of it [rad]."""
        curve = self.criteria[criterion]
        near = OPENINGS[curve >= NEAR_BEST * curve.max()]
        return float(OPENINGS[curve.argmax()]), float(near[0]), float(near[-1])


def hover_angles(point: Point) -> HoverAngles:
    """Return the sweep over the hover angle; the updraft follows."""
    points = [replace(point, opening=opening) for opening in OPENINGS.tolist()]
    found = [one.linear.constants for one in points]
    constants = {key: np.array([getattr(f, name) for f in found]) for key, name in INPUT_CONSTANTS.items()}
    sizes = {key: np.maximum(values, 0.0) for key, values in constants.items()}
    shares = np.array([sizes[key] / sizes[key].max() for key in QUANTITIES])
    reaches = np.array([one.reach for one in points])
    criteria = {
        "√(yaw · lift)": np.sqrt(sizes["yaw"] * sizes["lift"]),
        "mean of four × flaps' reach": np.prod(shares, axis=0) ** 0.25 * reaches,
        "least of four, each by its largest": shares.min(axis=0),
    }
    return HoverAngles(constants, {name: curve / curve.max() for name, curve in criteria.items()})


@dataclass(frozen=True, slots=True)
class PowerLaw:
    """A power law: fitted on a sweep, and the paper's."""

    quantity: str
    cause: str
    x: Curve
    y: Curve
    exponent: float
    paper: float


def scaling(point: Point) -> tuple[PowerLaw, ...]:
    """Return the effect of size and mass at the same hover angle."""
    sizes = [replace(point, geometry=scaled(point.geometry, factor, 1.0)) for factor in FACTORS.tolist()]
    masses = [replace(point, geometry=scaled(point.geometry, 1.0, factor)) for factor in FACTORS.tolist()]

    def law(
        quantity: str, cause: str, points: list[Point], of: Callable[[Point], float], paper: float
    ) -> PowerLaw:
        x = np.array([_CAUSES[cause](one) for one in points])
        y = np.array([abs(of(one)) for one in points])
        return PowerLaw(quantity, cause, x, y, float(np.polyfit(np.log(x), np.log(y), 1)[0]), paper)

    def f(point: Point) -> Constants:
        return point.linear.constants

    return (
        law("roll acceleration per input", "l", sizes, lambda p: f(p).roll_u1, -1.0),
        law("pitch acceleration per input", "l", sizes, lambda p: f(p).pitch_u2, -1.0),
        law("yaw acceleration per input", "l", sizes, lambda p: f(p).yaw_u3, -1.0),
        law("lift acceleration per input", "l", sizes, lambda p: f(p).z_u4, 0.0),
        law("lift acceleration / l per input", "l", sizes, lambda p: f(p).z_u4 / _length(p), -1.0),
        law("roll acceleration per input", "m", masses, lambda p: f(p).roll_u1, 0.0),
        law("airspeed", "m / l²", [*sizes, *masses], lambda p: p.speed, 0.5),
        law("Reynolds number", "l", sizes, reynolds, 0.0),
        law("Reynolds number", "m", masses, reynolds, 0.5),
    )


def reynolds(point: Point) -> float:
    """Return the Reynolds number over the side of the footprint."""
    return AIR_DENSITY * point.speed * _length(point) / VISCOSITY


def _length(point: Point) -> float:
    return point.geometry.footprint


_CAUSES: Mapping[str, Callable[[Point], float]] = {
    "l": _length,
    "m": lambda point: weigh(point.geometry).mass,
    "m / l²": lambda point: weigh(point.geometry).mass / _length(point) ** 2,
}


def updrafts(point: Point) -> tuple[float, float]:
    """Return the smallest and largest updraft [m/s] for the flaps with `RESERVE` to both limits."""
    slow, fast = (replace(point, opening=one) for one in (point.low + RESERVE, point.high - RESERVE))
    return slow.speed, fast.speed


def flat_high(point: Point) -> Point:
    """Return the paper's first idea: flat flaps, the centre of mass in their plane, the same inertia."""
    return replace(point, geometry=balanced(point.geometry, 0.0, keep_inertia=True, kink_angle=0.0))
