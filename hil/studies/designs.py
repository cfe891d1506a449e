"""Studies of three designs side by side: flat flaps with the centre of mass in their plane, the paper's, an optimised one.

All three are isolated plates of one drag coefficient, with gains by `hil.design.gains`. At another updraft the hover
angle on board is the one that carries the robot there; gains and model remain the design's.
"""

from collections.abc import Callable
from functools import cache

import numpy as np

from hil.config import load_config
from hil.design.sweeps import RESERVE, Point, point_of
from hil.design.trim import opening_at
from hil.errors import LabError
from hil.studies.study import Change, Expected, Study, Variant

FLAT, PAPER, BEST = "design-flat", "design-paper", "design-best"


@cache
def _point(profile: str) -> Point:
    return point_of(load_config(profile))


def _updraft(profile: str) -> Callable[[float], Change]:
    """Return the change that sets an updraft of each speed [m/s] and adapts the hover angle within the flaps' range."""

    def change(speed: float) -> Change:
        point = _point(profile)
        try:
            opening = opening_at(point.geometry, point.coefficient, speed)
        except LabError:  # it sinks with all flaps closed
            opening = point.low
        opening = float(np.clip(opening, point.low, point.high - RESERVE))
        return Change((f"tunnel.speed={speed:g}", f"allocation.hover_angle={opening:.4f}"))

    return change


def _push(size: float) -> Change:
    return Change(faults=(f"push.roll@2:0.1={size:g}",)) if size else Change()


UPDRAFTS = Study(
    "design-updrafts", "Which updrafts do the designs hold?", "updraft", "m/s", (11, 10.5, 10, 9.5, 9),
    (
        Variant(FLAT, _updraft(FLAT), Expected(flies_to=9.5), FLAT),
        Variant(PAPER, _updraft(PAPER), Expected(flies_to=10.5, lost_from=9), PAPER),
        Variant(BEST, _updraft(BEST), Expected(flies_to=10.5, lost_from=9), BEST),
    ),
    6.0,
    remark="The hover angle is adapted to each speed. Where the flaps close below 22 degrees the paper's robot reverses "
    "in x: its steady x per u2 changes sign.",
)  # fmt: skip
PUSHES = Study(
    "design-pushes", "Which pushes do the designs withstand?", "roll torque for 0.1 s", "N m", (0, 0.02, 0.04, 0.06, 0.08),
    tuple(Variant(name, _push, Expected(flies_to=0.04), name) for name in (FLAT, PAPER, BEST)),
    6.0,
    remark="By isolated plates roll is damped by 1 to 2 1/s alone, twenty times less than by the Table: pushes that the "
    "default profile withstands are too much for all three.",
)  # fmt: skip
