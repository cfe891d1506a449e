"""Searches kink, centre of mass, base plate and kinked strip that maximise a figure, at fixed span, mass and speed.

Mass, speed and drag coefficient determine the hover angle for each flap area. Every robot is passively stable in roll and
pitch and steers sideways with one sign at openings up to `RESERVE` smaller and larger than the hover's: a robot like the
paper's reverses its sign there (its steady x per u2). All tried shapes are kept for the Pareto picture.

Differential evolution starts from the profile's robot, its neighbours and random shapes; the loss of a shape grows with
its violation of conditions. The optimum lies on the boundary of conditions: sequential quadratic programming then climbs
the least authority along it, from the best shape and from the profile's, repeated while that gains.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution, minimize
from scipy.special import ndtri
from scipy.stats import qmc

from hil.errors import LabError
from hil.research.design.authority import QUANTITIES, authorities, least
from hil.research.design.axes import PITCH, ROLL
from hil.research.design.bounds import HIGH, LOW, SEARCHED, shape_of
from hil.research.design.linear import Linear, Point, places
from hil.research.design.sweeps import RESERVE
from hil.research.design.trim import balanced, opening_at, speed_at
from hil.world.floaty.geometry import weigh

POPULATION, GENERATIONS = 40, 25
NEAR = 0.1  # of the bounds, standard deviation of the reference's neighbours
AGAIN, GAIN = 5, 1e-4  # repetitions of a climb, as long as each gains that much
MARGIN = 1e-4  # of conditions during a climb, so that they hold at its end
NO_HOVER = 10.0  # loss
# Typical sizes of the conditions: Routh's three of an axis, and steering times stiffness.
SIZES = (5.0, 100.0, 1000.0, 1000.0)
STEP = math.radians(3.0)  # between the checked openings of a range of speeds
IS_SHARE = np.arange(len(QUANTITIES) + 24) < len(QUANTITIES)  # of what a climb keeps positive
BAD = -1.0  # figure of a robot that violates a condition


@dataclass(frozen=True, slots=True)
class Candidate:
    """A robot that the search has evaluated."""

    point: Point
    stiffness: float  # f_αα [1/s2]
    authority: float  # the smallest over the axes, as a share of the reference's
    ratio: float  # of its largest to its smallest updraft; 0: not evaluated

    def reached(self, figure: str) -> float:
        """Return the figure, one of FIGURES."""
        return self.ratio if figure == "speed-range" else self.authority


@dataclass(frozen=True, slots=True)
class Optimum:
    best: Candidate
    reference: Candidate
    reference_flies: bool  # by the conditions of the search
    tried: tuple[Candidate, ...]


def held(point: Point) -> tuple[float, float]:
    """Return the robot's updrafts [m/s] around the hover: stable, steering, 8° of each flap in reserve."""
    openings = np.arange(point.low + RESERVE, point.high - RESERVE + 1e-9, STEP)
    good = [_flies(replace(point, opening=one)) for one in openings.tolist()]
    middle = int(np.abs(openings - point.opening).argmin())
    if not good[middle]:
        return math.nan, math.nan
    first = last = middle
    while first > 0 and good[first - 1]:
        first -= 1
    while last < len(good) - 1 and good[last + 1]:
        last += 1
    speeds = [speed_at(point.geometry, point.coefficient, one) for one in openings[first : last + 1].tolist()]
    return min(speeds), max(speeds)


def _flies(point: Point) -> bool:
    model = point.linear
    return (
        max(model.growth(ROLL), model.growth(PITCH)) < 0.0
        and min(model.steady(ROLL), model.steady(PITCH)) > 0.0
    )


def around(point: Point) -> list[Point]:
    """Return the robot at its opening, and `RESERVE` below and above it."""
    return [replace(point, opening=point.opening + aside) for aside in (-RESERVE, 0.0, RESERVE)]


def conditions(point: Point) -> NDArray[np.float64]:
    """Return numbers (24,) that are positive where the robot is stable and steers, smooth in the shape, about 1."""
    return np.concatenate([_conditions(one.linear) for one in around(point)])


def _conditions(model: Linear) -> NDArray[np.float64]:
    f = model.constants
    steering = (f.y_u1 * f.roll_roll - f.y_roll * f.roll_u1, f.x_pitch * f.pitch_u2 - f.x_u2 * f.pitch_pitch)
    found = []
    for axis, steers in zip((ROLL, PITCH), steering, strict=True):
        A = model.A[np.ix_(places(axis), places(axis))]
        # Hurwitz: s^3 + a2 s^2 + a1 s + a0 is stable where these are positive.
        a2, a1, a0 = -np.trace(A), (np.trace(A) ** 2 - np.trace(A @ A)) / 2.0, -np.linalg.det(A)
        found.append(np.array([a2, a0, a2 * a1 - a0, steers]) / SIZES)
    return np.concatenate(found)


def least_authority(point: Point, reference: Mapping[str, float]) -> float:
    """Return the least authority over roll, pitch, yaw and lift as a share of the reference's; BAD when it cannot fly."""
    return least(authorities(point), dict(reference)) if all(map(_flies, around(point))) else BAD


def speed_range(point: Point, reference: Mapping[str, float]) -> float:
    """Return the ratio of the robot's largest to its smallest updraft."""
    low, high = held(point)
    return high / low if math.isfinite(low) else BAD


FIGURES: Mapping[str, Callable[[Point, Mapping[str, float]], float]] = {
    "least-authority": least_authority,
    "speed-range": speed_range,
}


class Shapes:
    """The shapes of a search, (4,) in the order of SEARCHED, and those already tried."""

    def __init__(self, reference: Point, figure: str) -> None:
        self._reference, self._of, self._speed = reference, FIGURES[figure], reference.speed
        self.share = authorities(reference)
        self.tried: list[Candidate] = []
        self.first = np.clip(shape_of(reference.geometry), LOW, HIGH)

    def build(self, x: NDArray[np.float64]) -> Point | None:
        """Return the robot of a shape; None if it cannot hover at the reference's speed within the flaps' range."""
        geometry, span = self._reference.geometry, self._reference.geometry.footprint
        kink, height, base, strip = np.clip(x, LOW, HIGH).tolist()
        try:
            shape = balanced(
                geometry, height * span, kink_angle=kink, base_side=base * span, strip_width=strip * span
            )
            opening = opening_at(shape, self._reference.coefficient, self._speed)
        except LabError:
            return None
        point = replace(self._reference, geometry=shape, opening=opening)
        return point if point.low < opening < point.high else None

    def loss(self, x: NDArray[np.float64]) -> float:
        """Return the negative figure, or the violation of the conditions, which is positive."""
        point = self.build(x)
        if point is None:
            return NO_HOVER
        lack = float(np.tanh(np.maximum(-conditions(point), 0.0)).sum())
        value = BAD if lack else self._of(point, self.share)
        if value > BAD:
            ratio = value if self._of is speed_range else 0.0
            self.tried.append(_look(point, self.share, ratio))
        return lack or -value

    def begin(self, seed: int) -> NDArray[np.float64]:
        """Return the first generation: the reference, its neighbours, and as many random shapes."""
        near = ndtri(qmc.LatinHypercube(len(LOW), rng=seed).random(POPULATION // 2 - 1))
        far = qmc.LatinHypercube(len(LOW), rng=seed).random(POPULATION // 2)
        places = [self.first, *(self.first + NEAR * near * (HIGH - LOW)), *(LOW + far * (HIGH - LOW))]
        return np.asarray(np.clip(places, LOW, HIGH), float)

    def climb(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the shape with the largest least authority, climbing along the conditions from x."""

        @lru_cache(2 * len(LOW))  # slopes ask for the shape where they begin again and again
        def reached(*z: float) -> NDArray[np.float64]:
            point = self.build(LOW + np.array(z) * (HIGH - LOW))
            if point is None:
                return np.full(len(IS_SHARE), -NO_HOVER)
            found = authorities(point)
            shares = [found[name] / self.share[name] for name in QUANTITIES]
            return np.concatenate([shares, conditions(point) - MARGIN])

        def above(z: NDArray[np.float64]) -> NDArray[np.float64]:
            *shape, level = z.tolist()
            found: NDArray[np.float64] = reached(*shape) - level * IS_SHARE
            return found

        z = np.append((x - LOW) / (HIGH - LOW), 0.0)
        slope = np.append(np.zeros(len(LOW)), -1.0)
        for _ in range(AGAIN):
            before = z[-1]
            z = minimize(
                lambda z: -z[-1], z, jac=lambda z: slope, method="SLSQP", bounds=[*[(0, 1)] * len(LOW), (None, None)],
                constraints={"type": "ineq", "fun": above}, options={"maxiter": 40, "ftol": 1e-7, "eps": 1e-5},
            ).x  # fmt: skip
            if abs(z[-1] - before) < GAIN:
                break
        return np.asarray(LOW + z[:-1] * (HIGH - LOW), float)


def optimise(reference: Point, figure: str, seed: int, generations: int = GENERATIONS) -> Optimum:
    """Return the robot with the largest figure at the reference's span, mass, drag coefficient and speed."""
    shapes = Shapes(reference, figure)
    bounds, first = [(one.low, one.high) for one in SEARCHED], shapes.begin(seed)
    found = differential_evolution(
        shapes.loss, bounds, init=first, maxiter=generations, seed=seed, polish=False, tol=1e-4
    )
    if figure == "least-authority":
        for x in (found.x, shapes.first):
            shapes.loss(shapes.climb(x))
    tried = shapes.tried
    if not tried:
        size = f"{reference.geometry.footprint:g} m and {weigh(reference.geometry).mass:.3g} kg"
        raise LabError(
            f"no robot of {size} is stable and steers at {reference.speed:.3g} m/s with openings of "
            f"{math.degrees(reference.low):.0f} to {math.degrees(reference.high):.0f} deg"
        )
    best = max(tried, key=lambda one: one.reached(figure))
    share = shapes.share
    own = _look(reference, share, speed_range(reference, share))
    return Optimum(best, own, all(map(_flies, around(reference))), tuple(tried))


def _look(point: Point, reference: Mapping[str, float], ratio: float) -> Candidate:
    f = point.linear.constants
    return Candidate(point, f.roll_roll, least(authorities(point), dict(reference)), ratio)


def front(tried: tuple[Candidate, ...], figure: str) -> NDArray[np.float64]:
    """Return (M, 2) of stability -f_αα and figure: robots not dominated in both."""
    found = sorted(placed(tried, figure).tolist(), reverse=True)
    kept: list[list[float]] = []
    for place in found:
        if not kept or place[1] > kept[-1][1]:
            kept.append(place)
    return np.array(kept)


def placed(tried: tuple[Candidate, ...], figure: str) -> NDArray[np.float64]:
    """Return stability -f_αα [1/s2] and figure of each robot, (N, 2)."""
    return np.array([(-one.stiffness, one.reached(figure)) for one in tried])


def exercise(optimum: Optimum, low: float, high: float) -> list[str]:
    """Return, in sentences, which robot could hold updrafts from `low` to `high` [m/s], and at what cost."""
    lines = []
    for name, one in (("the robot as it is", optimum.reference), ("the best shape", optimum.best)):
        slow, fast = held(one.point)
        weight = weigh(one.point.geometry).mass
        if not math.isfinite(slow):
            lines.append(f"{name} does not fly at its hover: no range")
            continue
        lines.append(
            f"{name} holds {slow:.2f} to {fast:.2f} m/s, a ratio of {fast / slow:.3f}; {high / low:.3f} are needed"
        )
        if fast / slow < high / low:
            continue
        mass = weight * (low / slow) ** 2
        width = 100 * one.point.geometry.footprint
        lines.append(
            f"with {1e3 * mass:.0f} g instead of {1e3 * weight:.0f} g at the same span, or {width * slow / low:.1f} cm "
            f"instead of {width:.1f} cm at the same mass, it holds {low:g} to {low * fast / slow:.2f} m/s; the wider one "
            f"turns by {100 * (low / slow - 1):+.0f} % per input"
        )
    return lines
