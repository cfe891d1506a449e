"""The high-level commander on port 8, its trajectory memory, and the set-points of ports 3 and 7.

With absolute poses, set-points that give a position are flown, each a step of the goal; the others are refused.

Commands are few and are planned at once, in the receiving task. Each is answered with its own head and a status in the
fourth byte, as by the stock firmware.

Trajectories of type 0 are pieces of four polynomials (x, y, z, yaw, eight float32 each, ascending powers) and a duration
[s]; those of type 1 are compressed: a start and pieces of Bezier points in mm and tenths of a degree, the last one with the
duration 0. A path is read when it is started: later writes to the memory do not change it. Facts: crazyflie-firmware
2a18fc29, cflib.
"""

import struct
from dataclasses import dataclass, replace
from math import isfinite, pi

from firmware_py.core.structs import SETPOINT_OF_CORRECTIONS, SETPOINT_OUTSIDE, SETPOINT_POSITION
from firmware_py.links.console import Notices
from firmware_py.links.crtp_stack import CrtpStack, Task
from firmware_py.pilot import Pilot
from firmware_py.planner import Path, PathPoint, Phase, Piece, bezier, go_to, straight_up
from firmware_py.supervisor import CoreSupervisor
from firmware_py.wire import WireError, check_size, high_level, setpoints
from firmware_py.wire.crtp import PORT_COMMANDER, PORT_GENERIC_SETPOINT, Packet
from firmware_py.wire.high_level import (
    Define,
    Fields,
    GoTo,
    PathCommand,
    Start,
    Vertical,
    VerticalWithVelocity,
    decode,
)

OK, REFUSED, ENOEXEC, EBUSY = 0, 1, 8, 16
COMMANDS = {int(command) for command in PathCommand}


@dataclass(slots=True)
class Defaults:
    """Parameters of the commander."""

    groups: int = 0  # bits; 0: takes every command
    take_off_velocity: float = 0.5  # [m/s]
    landing_velocity: float = 0.5


class HighLevelService:
    """Hands paths to the pilot's planner."""

    def __init__(
        self, stack: CrtpStack, pilot: Pilot, supervisor: CoreSupervisor, memory: bytearray, notices: Notices
    ) -> None:
        self.defaults = Defaults()
        self._stack = stack
        self._pilot = pilot
        self._supervisor = supervisor
        self._memory = memory
        self._notices = notices
        self._definitions: dict[int, Define] = {}
        stack.handle(high_level.PORT, lambda packet: stack.answer(packet, self.answer, 0))
        stack.handle(PORT_COMMANDER, self._see_attitude)
        stack.handle(PORT_GENERIC_SETPOINT, self._see_setpoint)

    def answer(self, packet: Packet) -> tuple[bytes, ...]:
        """Execute a command and return the reply."""
        try:
            status = self._execute(*decode(packet.data))
        except WireError as error:
            number = packet.data[0] if packet.data else -1
            self._refuse(f"command {number}" if number in COMMANDS else "unknown command", str(error))
            status = ENOEXEC
        return (packet.data[:3].ljust(3, b"\0") + bytes((status,)),)

    def _execute(self, command: PathCommand, fields: Fields) -> int:
        if isinstance(fields, Define):
            if fields.trajectory >= high_level.MAX_TRAJECTORIES:
                return ENOEXEC
            self._definitions[fields.trajectory] = fields
            return OK
        if command is PathCommand.SET_GROUP_MASK:
            self.defaults.groups = fields.groups
            return OK
        if command is not PathCommand.STOP and not self._supervisor.can_fly:
            return EBUSY
        if fields.groups and not fields.groups & self.defaults.groups:
            return OK  # for others
        if command is PathCommand.STOP:
            self._pilot.abort()
            return OK
        begin = self._pilot.begin(self._stack.kernel.now_us)
        if begin is None:
            self._refuse("no pose", "there has been no pose yet")
            return EBUSY
        return self._plan(command, fields, begin)

    def _plan(self, command: PathCommand, fields: Fields, begin: PathPoint) -> int:
        """Turn a flight command into a path."""
        lands = command in (PathCommand.LAND, PathCommand.LAND_1, PathCommand.LAND_WITH_VELOCITY)
        match fields:
            case GoTo():
                place = fields.x, fields.y, fields.z
                return self._follow(
                    go_to(begin, place, fields.yaw, fields.duration, fields.relative, fields.linear)
                )
            case Start():
                return self._start(fields, begin)
            case Vertical():
                return self._climb(fields, begin, lands)
            case VerticalWithVelocity():
                return self._climb(self._timed(fields, begin, lands), begin, lands)
        self._refuse("spiral", "a spiral is not flown")
        return ENOEXEC

    def _timed(self, wish: VerticalWithVelocity, begin: PathPoint, lands: bool) -> Vertical:
        """Return the same command with its duration in place of the velocity."""
        z = begin.position[2]
        height = wish.height
        if wish.relative:
            height = z - height if lands else z + height
        default = self.defaults.landing_velocity if lands else self.defaults.take_off_velocity
        velocity = wish.velocity if wish.velocity > 0.0 else default
        return Vertical(wish.groups, height, wish.yaw, wish.current_yaw, abs(height - z) / velocity)

    def _climb(self, wish: Vertical, begin: PathPoint, lands: bool) -> int:
        now_us = self._stack.kernel.now_us
        phase = self._pilot.planner.phase(now_us)
        if phase is Phase.LANDING if lands else phase is not Phase.IDLE:
            return REFUSED
        yaw = begin.yaw if wish.current_yaw else wish.yaw
        return self._follow(straight_up(begin, wish.height, yaw, wish.duration), lands)

    def _start(self, wish: Start, begin: PathPoint) -> int:
        definition = self._definitions.get(wish.trajectory)
        if definition is None:
            raise WireError(f"trajectory {wish.trajectory} is not defined")
        if wish.timescale <= 0.0:
            raise WireError(f"time scale {wish.timescale:g}: must be above 0")
        path = decode_trajectory(self._memory, definition)
        path = replace(path, timescale=wish.timescale, reverse=wish.reverse)
        if wish.relative:
            path = path.begun_at(begin.position, begin.yaw if wish.relative_yaw else None)
        return self._follow(path)

    def _follow(self, path: Path, lands: bool = False) -> int:
        """Start a path unless it leaves the box."""
        if not self._pilot.admits(path):
            self._refuse_place("path")
            return ENOEXEC
        self._pilot.follow(path, self._stack.kernel.now_us, lands)
        return OK

    def _see_attitude(self, packet: Packet) -> Task:
        """Refuse roll, pitch, yaw rate and thrust (port 3). Without thrust clients send them to disconnect."""
        check_size("an attitude set-point", packet.data, setpoints.ATTITUDE_SIZE)
        if any(packet.data[12:14]):
            self._refuse_setpoint("attitude", self._pilot.evaluate(None, self._stack.kernel.now_us))
        yield from self._stack.kernel.yield_if_pending()

    def _see_setpoint(self, packet: Packet) -> Task:
        """Take set-points (port 7), and the notice that no more will come."""
        kind = packet.data[0] if packet.data else None
        if packet.channel == setpoints.CHANNEL_NOTICE:
            check_size("a notice", packet.data, setpoints.NOTICE_SIZE)
            self._pilot.release()
        elif packet.channel == setpoints.CHANNEL_SETPOINT and kind == setpoints.STOP:
            check_size("a stop", packet.data, setpoints.STOP_SIZE)
            self._pilot.abort()
        elif packet.channel == setpoints.CHANNEL_SETPOINT and kind is not None:
            self._hold(kind, packet.data)
        yield from self._stack.kernel.yield_if_pending()

    def _hold(self, kind: int, data: bytes) -> None:
        """Fly to a set-point if it gives a position and poses are absolute."""
        now_us = self._stack.kernel.now_us
        place = setpoints.decode_place(data) if kind in (setpoints.POSITION, setpoints.FULL_STATE) else None
        answer = self._pilot.evaluate(place, now_us)
        if answer == SETPOINT_OUTSIDE:
            self._refuse_place("set-point")
        elif place is None or answer != SETPOINT_POSITION:
            self._refuse_setpoint(setpoints.NAMES.get(kind, "unknown"), answer)
        elif self._supervisor.can_fly:
            self._pilot.hold(*place, now_us)

    def _refuse_place(self, what: str) -> None:
        self._refuse(
            f"{what} in the box",
            f"{what} refused: it leaves the box, see box.radius, box.below and box.above",
        )

    def _refuse_setpoint(self, kind: str, answer: int) -> None:
        of_corrections = answer == SETPOINT_OF_CORRECTIONS
        instead = "poses are corrections, see extPose.absolute" if of_corrections else "positions are"
        self._refuse(f"{kind} set-point", f"{kind} set-points are not flown, {instead}")

    def _refuse(self, kind: str, why: str) -> None:
        self._notices.refuse(kind, f"commander: {why}")


MEMORY_SIZE = 4096
LOCATION_MEMORY = 1
TYPE_POLYNOMIALS, TYPE_COMPRESSED = 0, 1
POINTS = (0, 1, 3, 7)  # by the two bits of an axis; the first point is the end of the piece before
MILLIMETRE = 1e-3
TENTH_DEGREE = pi / 1800.0

_POLYNOMIALS = struct.Struct("<33f")
_START = struct.Struct("<4h")
_HEAD = struct.Struct("<BH")


def decode_trajectory(memory: bytes | bytearray, definition: Define) -> Path:
    """Return the path of a definition; `WireError` when the memory does not hold one."""
    if definition.location != LOCATION_MEMORY:
        raise WireError(f"trajectory {definition.trajectory} is not defined")
    pieces: tuple[Piece, ...]
    try:
        if definition.type == TYPE_POLYNOMIALS:
            pieces = tuple(
                _polynomials(memory, definition.offset + number * _POLYNOMIALS.size)
                for number in range(definition.pieces)
            )
        elif definition.type == TYPE_COMPRESSED:
            pieces = tuple(_decompress(memory, definition.offset))
        else:
            raise WireError(f"trajectory type {definition.type} is unknown")
    except struct.error:
        raise WireError(f"trajectory {definition.trajectory} reaches beyond its memory") from None
    if not pieces or not all(piece.duration > 0.0 for piece in pieces):
        raise WireError(f"trajectory {definition.trajectory} has no pieces, or one that takes no time")
    return Path(pieces)


def _polynomials(memory: bytes | bytearray, offset: int) -> Piece:
    values = _POLYNOMIALS.unpack_from(memory, offset)
    if not all(isfinite(value) for value in values):
        raise WireError("a trajectory's coefficients must be finite")
    return Piece(values[32], (values[0:8], values[8:16], values[16:24], values[24:32]))


def _decompress(memory: bytes | bytearray, offset: int) -> list[Piece]:
    units = (MILLIMETRE, MILLIMETRE, MILLIMETRE, TENTH_DEGREE)
    ends = [value * unit for value, unit in zip(_START.unpack_from(memory, offset), units, strict=True)]
    offset += _START.size
    pieces: list[Piece] = []
    while True:
        kinds, duration_ms = _HEAD.unpack_from(memory, offset)
        offset += _HEAD.size
        if duration_ms == 0:
            return pieces
        duration = duration_ms * 1e-3
        axes = []
        for axis, unit in enumerate(units):
            count = POINTS[kinds >> 2 * axis & 3]
            layout = struct.Struct(f"<{count}h")
            points = [ends[axis], *(value * unit for value in layout.unpack_from(memory, offset))]
            offset += layout.size
            axes.append(bezier(points, duration))
            ends[axis] = points[-1]
        x, y, z, yaw = axes
        pieces.append(Piece(duration, (x, y, z, yaw)))
