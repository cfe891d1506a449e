"""Better shapes: kink, centre of mass, base plate and kinked strip that maximise a figure, at fixed span, mass and speed.

The hover angle follows: mass, speed and drag coefficient leave one for each flap area. Every robot is passively
stable in roll and pitch and steers sideways with one sign at openings up to `RESERVE` smaller and larger than the hover's: a
robot like the paper's reverses its sign there (its steady x per u2). All shapes tried are kept, for the Pareto picture.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import differential_evolution

from hil.design.authority import least
from hil.design.axes import PITCH, ROLL
from hil.design.sweeps import RESERVE, Point, authorities
from hil.design.trim import balanced, changed, opening_at, speed_at
from hil.errors import LabError
from hil.floaty.geometry import weigh

BOUNDS = {  # shares of the footprint, except the kink
    "kink": (0.0, math.radians(80.0)), "height": (0.0, 0.5), "base": (0.15, 0.5), "strip": (0.02, 0.2),
}  # fmt: skip
POPULATION, GENERATIONS = 10, 25
STEP = math.radians(3.0)  # between the openings at which a range of speeds is checked
BAD = -1.0  # figure of a robot that violates a condition


@dataclass(frozen=True, slots=True)
class Tried:
    """A robot that was evaluated."""

    point: Point
    stiffness: float  # f_αα [1/s2]
    authority: float  # the least over the axes, as a share of the reference's
    ratio: float  # greatest over least updraft that it holds; 0: not evaluated


@dataclass(frozen=True, slots=True)
class Optimum:
    best: Tried
    reference: Tried
    tried: tuple[Tried, ...]


def held(point: Point) -> tuple[float, float]:
    """Return the updrafts [m/s] around the hover that the robot holds: stable, steering, 8° of each flap in reserve."""
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


def least_authority(point: Point, reference: Mapping[str, float]) -> float:
    """Return the least authority over roll, pitch, yaw and lift as a share of the reference's; BAD when it cannot fly."""
    around = (point.opening - RESERVE, point.opening, point.opening + RESERVE)
    robots = [replace(point, opening=one) for one in around]
    return least(authorities(point), dict(reference)) if all(map(_flies, robots)) else BAD


def speed_range(point: Point, reference: Mapping[str, float]) -> float:
    """Return the greatest over the least updraft that the robot holds."""
    low, high = held(point)
    return high / low if math.isfinite(low) else BAD


FIGURES: Mapping[str, Callable[[Point, Mapping[str, float]], float]] = {
    "least-authority": least_authority,
    "speed-range": speed_range,
}


def optimise(reference: Point, figure: str, seed: int, generations: int = GENERATIONS) -> Optimum:
    """Return the robot with the largest figure at the reference's span, mass, drag coefficient and speed."""
    of, share, speed = FIGURES[figure], authorities(reference), reference.speed
    tried: list[Tried] = []

    def build(x: NDArray[np.float64]) -> Point | None:
        span = reference.geometry.footprint
        try:
            shape = changed(
                reference.geometry,
                kink_angle=float(x[0]),
                base_side=float(x[2]) * span,
                strip_width=float(x[3]) * span,
            )
            shape = balanced(shape, float(x[1]) * span)
            opening = opening_at(shape, reference.coefficient, speed)
        except LabError:  # no hover at this speed
            return None
        return replace(reference, geometry=shape, opening=opening)

    def loss(x: NDArray[np.float64]) -> float:
        point = build(x)
        if point is None or not point.low < point.opening < point.high:
            return -BAD
        value = of(point, share)
        if value > BAD:
            tried.append(_look(point, share, value if of is speed_range else 0.0))
        return -value

    found = differential_evolution(
        loss,
        list(BOUNDS.values()),
        popsize=POPULATION,
        maxiter=generations,
        seed=seed,
        polish=False,
        tol=1e-4,
    )
    if -found.fun <= 0.0 or not tried:
        size = f"{reference.geometry.footprint:g} m and {weigh(reference.geometry).mass:.3g} kg"
        raise LabError(
            f"no robot of {size} is stable and steers at {speed:.3g} m/s with openings of "
            f"{math.degrees(reference.low):.0f} to {math.degrees(reference.high):.0f} deg"
        )
    best = max(tried, key=lambda one: one.ratio if of is speed_range else one.authority)
    return Optimum(best, _look(reference, share, speed_range(reference, share)), tuple(tried))


def _look(point: Point, reference: Mapping[str, float], ratio: float) -> Tried:
    f = point.linear.constants
    return Tried(point, f.roll_roll, least(authorities(point), dict(reference)), ratio)


def front(tried: tuple[Tried, ...], figure: str) -> NDArray[np.float64]:
    """Return (M, 2) of stability -f_αα and figure: robots that no other one beats in both."""
    found = sorted(places(tried, figure).tolist(), reverse=True)
    kept: list[list[float]] = []
    for place in found:
        if not kept or place[1] > kept[-1][1]:
            kept.append(place)
    return np.array(kept)


def places(tried: tuple[Tried, ...], figure: str) -> NDArray[np.float64]:
    """Return stability -f_αα [1/s2] and figure of each robot, (N, 2)."""
    return np.array(
        [(-one.stiffness, one.ratio if figure == "speed-range" else one.authority) for one in tried]
    )


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
