"""The stability margins of an axis' loop, opened between command and servo, and its tolerance of late poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import control
import numpy as np
from scipy.optimize import brentq

from hil.config import LabConfig
from hil.research.design.axes import STEP_S, Axis, Matrix, Robot
from hil.research.design.loop import FREQUENCIES, Complex, Loop, Timing, build

DOUBLINGS = 6  # of a tick, up to the latest tried poses
FINE_S = 1e-4  # resolution of their margin


@dataclass(frozen=True, slots=True)
class Margins:
    stable: bool
    gain: float  # factor on the gain up to which it is stable; inf: any
    least_gain: float  # factor below 1 down to which it is stable; 0: any
    phase: float  # [rad]
    delay: float  # [s] between command and servo, added to the existing delay
    peak: float  # of the sensitivity 1 / (1 + L)


UNSTABLE = Margins(False, 1.0, 1.0, 0.0, 0.0, np.inf)


def margins(loop: Loop, gains: Matrix) -> Margins:
    """Return the margins of a loop with gains; none if it is unstable."""
    if loop.radius(gains) >= 1.0:
        return UNSTABLE
    return margins_of(2 * np.pi * FREQUENCIES, loop.open_loop(gains))


def margins_of(w: Matrix, L: Complex) -> Margins:
    """Return the margins of a stable loop from its open-loop response on a fine grid [rad/s]."""
    factors, phases, _, _, crossings, _ = control.stability_margins(control.frd(L, w), returnall=True)
    return Margins(
        True,
        float(np.min(factors[factors > 1], initial=np.inf)),
        float(np.max(factors[factors < 1], initial=0.0)),
        float(np.radians(np.min(np.abs(phases), initial=np.inf))),
        float(np.min(np.radians(phases % 360) / crossings, initial=np.inf)),
        peak_of(L),
    )


def peak_of(L: Complex) -> float:
    """Return the peak of the sensitivity on the lines."""
    return float(np.max(1 / np.abs(1 + L)))


def pose_delay_margin(axis: Axis, robot: Robot, config: LabConfig, timing: Timing, gains: Matrix) -> float:
    """Return how much older than stated poses may be [s] before the loop is unstable; at most 0.64 s."""

    def excess(seconds: float) -> float:
        return build(axis, robot, config, timing.later(seconds)).radius(gains) - 1.0

    if excess(0.0) >= 0.0:
        return 0.0
    least = 0.0
    for most in STEP_S * 2.0 ** np.arange(1 + DOUBLINGS):
        if excess(most) >= 0.0:
            return float(brentq(excess, least, most, xtol=FINE_S))
        least = most
    return float(least)


def worst(found: Sequence[Margins]) -> Margins:
    """Return the least of each margin over several loops."""
    return Margins(
        all(one.stable for one in found),
        min(one.gain for one in found),
        max(one.least_gain for one in found),
        min(one.phase for one in found),
        min(one.delay for one in found),
        max(one.peak for one in found),
    )
