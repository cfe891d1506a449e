"""The high-level commander: commands become paths, paths become set-points (crtp_commander_high_level.c).

Commands of too few bytes, with numbers that are not finite or with an impossible time are refused: the firmware itself
would plan them from what is in its buffer, or fall silent and so lock itself. The exported app refuses them, too. A path
is read when it is started: later writes to the memory do not change it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from firmware_py.crazyflie.commander import NULL, Setpoint
from firmware_py.crazyflie.planner import Path, PathPoint, Phase, Planner, Spiral, go_to, spiral, straight_up
from firmware_py.crazyflie.trajectories import (
    COMPRESSED,
    LOCATION_MEMORY,
    MEMORY_SIZE,
    POLYNOMIALS,
    decode_trajectory,
)
from firmware_py.geometry import Vector
from firmware_py.wire import WireError
from firmware_py.wire.high_level import (
    MAX_TRAJECTORIES,
    Define,
    Fields,
    GoTo,
    PathCommand,
    SpiralFields,
    Start,
    Vertical,
    VerticalWithVelocity,
    decode,
)

OK, REFUSED, ENOEXEC, EBUSY = 0, 1, 8, 16
LANDINGS = (PathCommand.LAND, PathCommand.LAND_1, PathCommand.LAND_WITH_VELOCITY)
ACTIVE, FINISHED = 1 << 8, 1 << 9  # bits of the supervisor's field


@dataclass(slots=True)
class Defaults:
    """Parameters of the commander."""

    groups: int = 0  # bits; 0: takes every command
    take_off_velocity: float = 0.5  # [m/s]
    landing_velocity: float = 0.5


class Surroundings(Protocol):
    """What the commander needs of its board."""

    def estimate(self) -> PathPoint:
        """Return where the robot is."""

    def admits(self, places: Sequence[Vector]) -> bool:
        """Return whether a path through these places, the first and the last included, may be flown."""


class HighLevelCommander:
    """`blocked` is set by the supervisor; times `t` are in seconds of the firmware's microsecond counter."""

    def __init__(self, board: Surroundings, report: Callable[[str, str], None]) -> None:
        self.defaults = Defaults()
        self.memory = bytearray(MEMORY_SIZE)
        self.planner = Planner()
        self._board = board
        self._report = report  # kind and text of what is not flown
        self._blocked = True
        self._definitions: dict[int, Define] = {}
        self._last = PathPoint((0.0, 0.0, 0.0), 0.0)  # set-point

    def block(self, blocked: bool) -> None:
        """Take no commands, or take them again; a path in force ends."""
        if blocked and not self._blocked and not self.planner.rests:
            self.planner.stop()
        self._blocked = blocked

    def setpoint(self, t: float) -> Setpoint:
        """Return the set-point of this instant, the null one while no path is in force."""
        goal = self.planner.goal(t)
        if goal is None:
            return NULL
        self._last = goal
        return Setpoint(goal.position, goal.yaw, goal.velocity)

    def bits(self, t: float) -> int:
        """Return its bits of the supervisor's field."""
        active = 0 if self.planner.rests else ACTIVE
        return active | (FINISHED if self.planner.finished(t) else 0)

    def execute(self, data: bytes, t: float) -> int:
        """Execute a command; return its status."""
        try:
            return self._execute(*decode(data), t)
        except WireError as error:
            known = data[:1] and data[0] in tuple(PathCommand)
            self._report(f"command {data[0]}" if known else "unknown command", str(error))
            return ENOEXEC

    def _execute(self, command: PathCommand, fields: Fields, t: float) -> int:
        if isinstance(fields, Define):
            return self._define(fields)
        if command is PathCommand.SET_GROUP_MASK:
            self.defaults.groups = fields.groups
            return OK
        if self.planner.rests:
            self._last = self._board.estimate()
        lands = command in LANDINGS
        path = self._path(fields, lands, t)
        # First, as in the exported app, which sees a command before the firmware does.
        if path is not None and not self._board.admits(
            (self._last.position, path.at(path.duration).position)
        ):
            return ENOEXEC
        if command is not PathCommand.STOP and self._blocked:
            return EBUSY
        if fields.groups and not fields.groups & self.defaults.groups:
            return OK  # for others
        if isinstance(fields, Start):
            return self._start(fields, t)
        if path is None:
            self.planner.stop()
            return OK
        phase = self.planner.phase
        climbs = isinstance(fields, Vertical | VerticalWithVelocity)
        if climbs and (phase is Phase.LANDING if lands else phase is not Phase.IDLE):
            return REFUSED
        self.planner.follow(path, t, lands)
        return OK

    def _path(self, fields: Fields, lands: bool, t: float) -> Path | None:
        """Return the path that a command asks for; None for a command that starts none."""
        match fields:
            case GoTo():
                return self._go_to(fields, t)
            case VerticalWithVelocity():
                return self._climb(self._timed(fields, lands))
            case Vertical():
                return self._climb(fields)
            case SpiralFields():
                return spiral(self._last, Spiral(*fields[1:]))
            case _:
                return None

    def _define(self, wish: Define) -> int:
        if wish.trajectory >= MAX_TRAJECTORIES:
            return ENOEXEC
        self._definitions[wish.trajectory] = wish
        return OK

    def _go_to(self, wish: GoTo, t: float) -> Path:
        begin = self.planner.goal(t) or self._last
        place = wish.x, wish.y, wish.z
        return go_to(begin, place, wish.yaw, wish.duration, bool(wish.relative), bool(wish.linear))

    def _timed(self, wish: VerticalWithVelocity, lands: bool) -> Vertical:
        """Return the same command with its duration in place of the velocity."""
        z = self._last.position[2]
        height = wish.height
        if wish.relative:
            height = z - height if lands else z + height
        default = self.defaults.landing_velocity if lands else self.defaults.take_off_velocity
        velocity = wish.velocity if wish.velocity > 0.0 else default
        return Vertical(wish.groups, height, wish.yaw, wish.current_yaw, abs(height - z) / velocity)

    def _climb(self, wish: Vertical) -> Path:
        yaw = self._last.yaw if wish.current_yaw else wish.yaw
        return straight_up(self._last, wish.height, yaw, wish.duration)

    def _start(self, wish: Start, t: float) -> int:
        definition = self._definitions.get(wish.trajectory)
        if (
            definition is None
            or definition.location != LOCATION_MEMORY
            or definition.type not in (POLYNOMIALS, COMPRESSED)
        ):
            self._report("no trajectory", f"trajectory {wish.trajectory} is not defined")
            return OK  # as the firmware answers
        turned = bool(wish.relative and wish.relative_yaw)
        if definition.type == COMPRESSED:
            if wish.timescale != 1.0 or wish.reverse:
                self._report("compressed", "a compressed trajectory is neither scaled nor reversed")
                return ENOEXEC
            turned = False
        path = decode_trajectory(self.memory, definition)
        path = replace(path, timescale=wish.timescale, reverse=bool(wish.reverse))
        if wish.relative:
            path = path.begun_at(self._last.position, self._last.yaw if turned else None)
        self.planner.follow(path, t)  # where it leaves the box, its set-points are not followed
        return OK
