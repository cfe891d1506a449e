"""The planner behind the high-level commander (planner.c, pptraj.c): from "go to" or a trajectory to goals over time.

A path is a sequence of pieces, each a polynomial of 7th degree in time for x, y, z and yaw. Between two states of motion it
is the one whose jerk is zero at both ends. Positions in the frame of the external poses [m], angles in rad, times in seconds
from the beginning of the path. Only + - * / in a fixed order, and the functions of `elementary`: the same bits everywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum, auto
from math import comb, pi, tau

from firmware_py.elementary import cos, sin
from firmware_py.geometry import Vector, rotate, wrap_angle, yaw_quaternion

AXES = 4  # x, y, z, yaw
SHORTEST_S = 1e-3  # a path that takes less time jumps to its end
Coefficients = tuple[float, ...]  # ascending powers of the time in a piece


@dataclass(frozen=True, slots=True)
class PathPoint:
    """The position and motion of a path at an instant."""

    position: Vector
    yaw: float
    velocity: Vector = (0.0, 0.0, 0.0)  # [m/s]
    acceleration: Vector = (0.0, 0.0, 0.0)  # [m/s^2]
    yaw_rate: float = 0.0  # [rad/s]


@dataclass(frozen=True, slots=True)
class Piece:
    """Four polynomials and their duration."""

    duration: float
    axes: tuple[Coefficients, Coefficients, Coefficients, Coefficients]


@dataclass(frozen=True, slots=True)
class Path:
    """Pieces one after the other, slower by `timescale`, perhaps reversed, and moved.

    As in the firmware, `turn` is about the pieces' origin, not about their beginning, and a reversed path is not turned.
    """

    pieces: tuple[Piece, ...]
    timescale: float = 1.0
    reverse: bool = False
    turn: float = 0.0
    shift: Vector = (0.0, 0.0, 0.0)

    @property
    def duration(self) -> float:
        """How long the path takes."""
        return sum(piece.duration for piece in self.pieces) * self.timescale

    def at(self, t: float) -> PathPoint:
        """Return the motion at a time; the path rests before its beginning and after its end."""
        rests = not 0.0 <= t < self.duration
        t = min(max(t, 0.0), self.duration) / self.timescale
        if self.reverse:
            t = self.duration / self.timescale - t
        motion = self._placed(_evaluate(*_find(self.pieces, t)))
        if rests:
            return PathPoint(motion.position, motion.yaw)
        rate = (-1.0 if self.reverse else 1.0) / self.timescale
        velocity, acceleration = _scaled(motion.velocity, rate), _scaled(motion.acceleration, rate * rate)
        return PathPoint(motion.position, motion.yaw, velocity, acceleration, motion.yaw_rate * rate)

    def begun_at(self, position: Vector, yaw: float | None) -> "Path":
        """Return the same path, shifted as if it were not turned, and turned if a yaw is given."""
        begin = self.at(0.0)
        turn = 0.0 if yaw is None else wrap_angle(yaw - begin.yaw)
        return replace(self, turn=turn, shift=_sum(position, _scaled(begin.position, -1.0)))

    def _placed(self, motion: PathPoint) -> PathPoint:
        if self.turn == 0.0 or self.reverse:
            return replace(motion, position=_sum(motion.position, self.shift))
        q = yaw_quaternion(self.turn)
        return PathPoint(
            _sum(rotate(q, motion.position), self.shift),
            motion.yaw + self.turn,
            rotate(q, motion.velocity),
            rotate(q, motion.acceleration),
            motion.yaw_rate,
        )


class Phase(IntEnum):
    """The planner's activity."""

    IDLE = auto()  # the null set-point
    FLYING = auto()
    LANDING = auto()


class Planner:
    """Holds the path in force; times are in seconds."""

    def __init__(self) -> None:
        self.phase = Phase.IDLE
        self._path: Path | None = None
        self._begin = 0.0

    @property
    def rests(self) -> bool:
        """Whether no path is in force."""
        return self.phase is Phase.IDLE

    def finished(self, t: float) -> bool:
        """Return whether the last path is over."""
        return self._path is None or t - self._begin >= self._path.duration

    def goal(self, t: float) -> PathPoint | None:
        """Return the goal at a time, None without one; the end of a landing is the end of the flight."""
        if self.phase is Phase.LANDING and self.finished(t):
            self.phase = Phase.IDLE
        if self._path is None or self.rests:
            return None
        return self._path.at(t - self._begin)

    def stop(self) -> None:
        """End the flight."""
        self.phase = Phase.IDLE

    def follow(self, path: Path, t: float, landing: bool = False) -> None:
        """Start a path now."""
        self._path, self._begin = path, t
        self.phase = Phase.LANDING if landing else Phase.FLYING


def straight_up(begin: PathPoint, height: float, yaw: float, duration: float) -> Path:
    """Return the path to a height above or below, from rest to rest, turning the shorter way to a yaw."""
    x, y, _ = begin.position
    return between(
        PathPoint(begin.position, begin.yaw),
        PathPoint((x, y, height), begin.yaw + wrap_angle(yaw - begin.yaw)),
        duration,
    )


def go_to(
    begin: PathPoint, position: Vector, yaw: float, duration: float, relative: bool, linear: bool
) -> Path:
    """Return the path from a motion to a position and a yaw: to rest, or straight at constant speed."""
    if relative:
        position, yaw = _sum(begin.position, position), begin.yaw + yaw
    turn = wrap_angle(yaw - begin.yaw)
    end = PathPoint(position, begin.yaw + turn)
    if linear and duration >= SHORTEST_S:
        velocity = _scaled(_sum(position, _scaled(begin.position, -1.0)), 1.0 / duration)
        rate = turn / duration
        begin = PathPoint(begin.position, begin.yaw, velocity, (0.0, 0.0, 0.0), rate)
        end = PathPoint(end.position, end.yaw, velocity, (0.0, 0.0, 0.0), rate)
    return between(begin, end, duration)


@dataclass(frozen=True, slots=True)
class Spiral:
    """A turn by `angle` about a centre beside the robot or, `sideways`, before it, from a first radius to a last."""

    sideways: bool
    clockwise: bool
    angle: float  # [rad], at most one turn either way
    first_radius: float  # [m]
    last_radius: float
    ascent: float  # [m]
    duration: float  # [s]


def spiral(begin: PathPoint, wish: Spiral) -> Path:
    """Return one piece that begins and ends with the motion of a spiral; `duration` is above 0."""
    sense = 1.0 if wish.clockwise else -1.0
    angle = min(max(wish.angle, -tau), tau)
    r0, r1 = max(wish.first_radius, 0.0), max(wish.last_radius, 0.0)
    turn = -sense * angle  # of the yaw
    rate, growth = turn / wish.duration, (r1 - r0) / wish.duration
    climb = wish.ascent / wish.duration
    # The centre is seen from the robot along the yaw (sideways) or a quarter turn to the right of it.
    aside = 0.0 if wish.sideways else -pi / 2

    def motion(yaw: float, radius: float) -> tuple[Vector, Vector, Vector]:
        """Return position relative to the centre, velocity and acceleration."""
        c, s = -sense * cos(yaw + aside), -sense * sin(yaw + aside)
        return (
            (radius * c, radius * s, 0.0),
            (growth * c - radius * rate * s, growth * s + radius * rate * c, climb),
            (
                -radius * rate * rate * c - 2.0 * growth * rate * s,
                -radius * rate * rate * s + 2.0 * growth * rate * c,
                0.0,
            ),
        )

    (p0, v0, a0), (p1, v1, a1) = motion(begin.yaw, r0), motion(begin.yaw + turn, r1)
    end = _sum(_sum(begin.position, _scaled(p0, -1.0)), (p1[0], p1[1], wish.ascent))
    return between(
        PathPoint(begin.position, begin.yaw, v0, a0, rate),
        PathPoint(end, begin.yaw + turn, v1, a1, rate),
        wish.duration,
    )


def between(begin: PathPoint, end: PathPoint, duration: float) -> Path:
    """Return the piece between two motions with zero jerk at its ends; without time for it, the end at once."""
    if duration < SHORTEST_S:
        axes = ((end.position[0],), (end.position[1],), (end.position[2],), (end.yaw,))
        return Path((Piece(0.0, axes),))
    first, second, third = (
        _connect(
            (begin.position[i], begin.velocity[i], begin.acceleration[i]),
            (end.position[i], end.velocity[i], end.acceleration[i]),
            duration,
        )
        for i in range(3)
    )
    turn = _connect((begin.yaw, begin.yaw_rate, 0.0), (end.yaw, end.yaw_rate, 0.0), duration)
    return Path((Piece(duration, (first, second, third, turn)),))


def bezier(points: Sequence[float], duration: float) -> Coefficients:
    """Return the polynomial whose Bezier curve over a duration has these control points (1 to 8)."""
    n = len(points) - 1
    powers = []
    scale = 1.0
    for j in range(n + 1):
        total = 0.0
        for i in range(j + 1):
            total += (-1.0) ** (i + j) * comb(j, i) * points[i]
        powers.append(comb(n, j) * total / scale)
        scale *= duration
    return tuple(powers)


def _connect(begin: Vector, end: Vector, duration: float) -> Coefficients:
    """Solve for the powers 4 to 7: value, first and second derivative at both ends are given, the third is 0 there.

    In the share s of the duration: d0 to d2 are the errors at s = 1 after the powers 0 to 2; the numbers are the
    inverse of the four equations for position, velocity, acceleration and jerk at s = 1.
    """
    x0, v0, a0 = begin[0], begin[1] * duration, begin[2] * duration * duration
    x1, v1, a1 = end[0], end[1] * duration, end[2] * duration * duration
    d0 = x1 - x0 - v0 - 0.5 * a0
    d1 = v1 - v0 - a0
    d2 = a1 - a0
    shares = (
        x0,
        v0,
        0.5 * a0,
        0.0,
        35.0 * d0 - 15.0 * d1 + 2.5 * d2,
        -84.0 * d0 + 39.0 * d1 - 7.0 * d2,
        70.0 * d0 - 34.0 * d1 + 6.5 * d2,
        -20.0 * d0 + 10.0 * d1 - 2.0 * d2,
    )
    powers = []
    scale = 1.0
    for share in shares:
        powers.append(share / scale)
        scale *= duration
    return tuple(powers)


def _find(pieces: Sequence[Piece], t: float) -> tuple[Piece, float]:
    """Return the piece at a time, and the time in it."""
    for piece in pieces[:-1]:
        if t < piece.duration:
            return piece, t
        t -= piece.duration
    return pieces[-1], min(t, pieces[-1].duration)


def _evaluate(piece: Piece, t: float) -> PathPoint:
    (x, vx, ax), (y, vy, ay), (z, vz, az), (yaw, yaw_rate, _) = (_derivatives(axis, t) for axis in piece.axes)
    return PathPoint((x, y, z), yaw, (vx, vy, vz), (ax, ay, az), yaw_rate)


def _derivatives(powers: Coefficients, t: float) -> Vector:
    """Return value, first and second derivative, by Horner's scheme."""
    value = first = second = 0.0
    for coefficient in reversed(powers):
        second = second * t + 2.0 * first
        first = first * t + value
        value = value * t + coefficient
    return value, first, second


def _sum(a: Vector, b: Vector) -> Vector:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


def _scaled(a: Vector, factor: float) -> Vector:
    return a[0] * factor, a[1] * factor, a[2] * factor
