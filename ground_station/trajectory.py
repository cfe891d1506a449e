"""The robot's goal as a function of time.

`Hold` stays; `Offsets` adds one signal per axis to a home goal. The experiments of the paper are one line
each, for example `Offsets(home, start_us, yaw=Sine(pi / 2, 0.15))`. Signals count time from the start of the
trajectory, so that a flight can be repeated.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite, tau
from typing import Protocol

from firmware_py.elementary import sin


@dataclass(frozen=True, slots=True)
class Goal:
    """The goal frame G: upright, turned by `yaw`."""

    p_WG: tuple[float, float, float]  # [m]
    yaw: float  # [rad]


class Trajectory(Protocol):
    """A goal for every instant."""

    def at(self, t_us: int) -> Goal:
        """Return the goal at `t_us`."""


@dataclass(frozen=True, slots=True)
class Hold:
    """One goal for ever."""

    goal: Goal

    def at(self, t_us: int) -> Goal:
        return self.goal


class FlightPlan:
    """The station's flight: `home` until `start` is called, then the trajectory that `make(home, start_us)` returns.

    An operator's `steer` overrides it.
    """

    def __init__(self, home: Goal, make: Callable[[Goal, int], Trajectory]) -> None:
        self.home = home
        self.start_us: int | None = None  # start of the trajectory's clock, once known
        self._make = make
        self._flown: Trajectory = Hold(home)
        self._steered = False

    def start(self, start_us: int) -> None:
        """Start the trajectory's clock at an instant; only the first call counts."""
        if self.start_us is None:
            self.start_us = start_us
            if not self._steered:
                self._flown = self._make(self.home, start_us)

    def steer(self, trajectory: Trajectory) -> None:
        """Fly another trajectory from now on."""
        self._flown, self._steered = trajectory, True

    def at(self, t_us: int) -> Goal:
        return self._flown.at(t_us)


Signal = Callable[[int], float]  # time since the start [us], never negative, to an offset [m or rad]


@dataclass(frozen=True, slots=True)
class Sine:
    """A sine from zero."""

    amplitude: float
    frequency_hz: float

    def __call__(self, elapsed_us: int) -> float:
        return self.amplitude * sin(tau * self.frequency_hz * elapsed_us * 1e-6)


@dataclass(frozen=True, slots=True)
class Square:
    """`high` in the first half of each period, `low` in the second."""

    high: float
    low: float
    frequency_hz: float

    def __call__(self, elapsed_us: int) -> float:
        return self.high if self.frequency_hz * elapsed_us * 1e-6 % 1.0 < 0.5 else self.low


@dataclass(frozen=True, slots=True)
class Step:
    """A jump by `size` at the start."""

    size: float

    def __call__(self, elapsed_us: int) -> float:
        return self.size


def _zero(elapsed_us: int) -> float:
    return 0.0


@dataclass(frozen=True, slots=True)
class Offsets:
    """`home` until `start_us`, then `home` and the signal of each axis."""

    home: Goal
    start_us: int
    x: Signal = _zero
    y: Signal = _zero
    z: Signal = _zero
    yaw: Signal = _zero

    def at(self, t_us: int) -> Goal:
        elapsed_us = t_us - self.start_us
        if elapsed_us < 0:
            return self.home
        x, y, z = self.home.p_WG
        return Goal(
            (x + self.x(elapsed_us), y + self.y(elapsed_us), z + self.z(elapsed_us)),
            self.home.yaw + self.yaw(elapsed_us),
        )


# From the time since the start [s] to x, y, z [m] from home, W, and optionally yaw [rad].
PathFunction = Callable[[float], Sequence[float]]


@dataclass(frozen=True, slots=True)
class Course:
    """`home` until `start_us`, then `home` and what a function of time returns. `at` raises `ValueError` otherwise."""

    home: Goal
    start_us: int
    path: PathFunction

    def at(self, t_us: int) -> Goal:
        if t_us < self.start_us:
            return self.home
        offset = self.path((t_us - self.start_us) * 1e-6)
        try:
            dx, dy, dz, turn = (*map(float, offset), 0.0)[:4] if len(offset) in (3, 4) else ()
        except (TypeError, ValueError):
            raise ValueError(f"{offset!r}: expected x, y, z [m] or x, y, z [m], yaw [rad]") from None
        if not isfinite(dx + dy + dz + turn):
            raise ValueError(f"{offset!r}: expected finite numbers")
        x, y, z = self.home.p_WG
        return Goal((x + dx, y + dy, z + dz), self.home.yaw + turn)


@dataclass(frozen=True, slots=True)
class Along:
    """Makes a trajectory from a function of time, for experiments that move the goal."""

    path: PathFunction

    def __call__(self, home: Goal, start_us: int) -> Trajectory:
        return Course(home, start_us, self.path)
