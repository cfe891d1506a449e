"""The commander: one set-point with the priority of its sender (commander.c).

A set-point is accepted when its priority is at least that of the present one. That of a client's stays until the client
sends the notice of the end of its set-points: only then the high-level commander leads again. Time is in ms ticks.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import nan

from firmware_py.geometry import Vector

DISABLED, HIGH_LEVEL, CLIENT = 0, 1, 2  # priorities


@dataclass(frozen=True, slots=True)
class Setpoint:
    """`place` and a yaw that may be free, or another wish, or neither: the null set-point, which wants no motion."""

    place: Vector | None = None  # [m]
    yaw: float = nan  # [rad]
    velocity: Vector = (0.0, 0.0, 0.0)  # [m/s]
    other: bool = False  # attitude, rates or velocity are wanted
    tick: int = 0  # when it was set


NULL = Setpoint()


class Commander:
    """`stop_high_level` is called when a client takes the lead."""

    def __init__(self, stop_high_level: Callable[[], None]) -> None:
        self.priority = DISABLED
        self.setpoint = NULL
        self._stop_high_level = stop_high_level

    def set(self, setpoint: Setpoint, priority: int, tick: int) -> None:
        """Take a set-point unless one of a higher priority is there."""
        if priority < self.priority:
            return
        self.setpoint, self.priority = replace(setpoint, tick=tick), priority
        if priority > HIGH_LEVEL:
            self._stop_high_level()

    def relax(self) -> None:
        """Let the high-level commander lead from its next set-point on."""
        self.priority = HIGH_LEVEL
