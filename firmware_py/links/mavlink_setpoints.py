"""Goals from MAVLink clients, and the board's two modes; runs in the receiving task.

Hold: the robot flies at the last goal; a target of any client moves it.
Offboard: started by a client, whose targets alone are then accepted. When none has arrived for 0.5 s, the board returns to
Hold and stays at the last goal.

Goals are in W. Poses from MAVLink are compared with `goal` itself, which moves with their frame: a robot that
holds stays where it is. Poses from CRTP pass the pilot, which then gets the goal; its origin is home while they are
corrections.
"""

from collections.abc import Sequence
from math import isnan

from firmware_py.crazyflie.planner import PathPoint
from firmware_py.geometry import Vector, in_goal_frame, rotate, to_euler_zyx, yaw_quaternion
from firmware_py.links.mavlink_stack import INFO, WARNING, MavlinkStack, Task
from firmware_py.pilot import Pilot
from firmware_py.rtos import FOREVER, TICK_US
from firmware_py.wire import WireError, mavlink
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_dialect import Message, sender_of
from firmware_py.wire.mavlink_numbers import Command, CommandResult, Mode

SILENCE_US = 500_000  # of set-points, which ends offboard; PX4: COM_OF_LOSS_T is 1 s

Source = tuple[int, int]  # system and component
Goal = tuple[Vector, float]  # position in W [m] and yaw [rad]


class SetpointService:
    """`mode` is the one in force; `home` is where goals begin."""

    def __init__(self, stack: MavlinkStack, pilot: Pilot, home: Vector) -> None:
        self.mode = Mode.HOLD
        self._goal: Goal = (home, 0.0)
        self._seen_from = self._goal  # for the last pose from MAVLink
        self._seen_us = -1  # arrival of that pose
        self._stack = stack
        self._pilot = pilot
        self.home = home
        self._leader: Source | None = None  # in offboard
        self._led_us = 0  # arrival of its last set-point
        self._started = stack.kernel.create_binary_semaphore("mavOffboard")
        stack.handle("SET_POSITION_TARGET_LOCAL_NED", self._take_target)
        stack.handle("SET_MODE", self._take_mode)
        stack.kernel.create_task("MAV-MODE", 1, self._watch)

    def choose(self, command: Message) -> tuple[CommandResult, Sequence[Message]]:
        """Execute MAV_CMD_DO_SET_MODE: the custom mode as one number or, as for PX4, as main and sub-mode.

        A mode that the board lacks is a wrong parameter of a known command.
        """
        main, sub = command.param2, 0.0 if isnan(command.param3) else command.param3
        for mode in Mode:
            if main == mode or (main, sub) == (mode >> 16 & 0xFF, mode >> 24):
                return CommandResult.ACCEPTED, self._enter(mode, sender_of(command))
        return CommandResult.DENIED, ()

    def note_pose(self) -> PathPoint:
        """Return the goal for a pose from MAVLink that has just arrived."""
        self._seen_from, self._seen_us = self._goal, self._stack.kernel.now_us
        return PathPoint(*self._goal)

    def follow_frame(self, before: mavlink.Pose, after: mavlink.Pose) -> None:
        """Keep the goal where it is to the robot, whose pose in two frames this is."""
        p_WG, yaw = self._goal
        (*_, yaw_before), (*_, yaw_after) = to_euler_zyx(before.q_WB), to_euler_zyx(after.q_WB)
        p_BG, _ = in_goal_frame(p_WG, yaw_quaternion(yaw), before.p_WB, yaw_before)
        x, y, z = rotate(yaw_quaternion(yaw_after), p_BG)
        px, py, pz = after.p_WB
        self._goal = (x + px, y + py, z + pz), yaw + yaw_after - yaw_before

    @property
    def goal(self) -> Goal:
        """The goal in force."""
        return self.frame if self._piloted else self._goal

    @property
    def frame(self) -> Goal:
        """The origin of the estimate: the goal of the last pose."""
        if not self._piloted:
            return self._seen_from
        motion = self._pilot.frame()
        if motion is None:
            return self.home, 0.0
        x, y, z = motion.position
        ox, oy, oz = self._origin
        return (x + ox, y + oy, z + oz), motion.yaw

    @property
    def _piloted(self) -> bool:
        """Whether poses come from CRTP."""
        return self._pilot.seen_us > self._seen_us

    def _take_target(self, message: Message) -> None:
        target, source, now_us = mavlink.read_target(message), sender_of(message), self._stack.kernel.now_us
        if self._leader not in (None, source):
            raise WireError("target refused: another client is in offboard")
        p_WG, yaw = self._goal
        if target.p_WG is not None and not self._pilot.admits_place(target.p_WG, p_WG, absolute=True):
            raise WireError("target refused: outside the box, see BOX_RADIUS, BOX_BELOW and BOX_ABOVE")
        self._goal = (p_WG if target.p_WG is None else target.p_WG, yaw if target.yaw is None else target.yaw)
        self._led_us = now_us
        if self._piloted:
            self._lead()
        if target.moves:
            self._stack.notice(message, "only position and yaw of targets are flown")

    def _lead(self) -> None:
        """Have the pilot fly to the goal."""
        (x, y, z), yaw = self._goal
        ox, oy, oz = self._origin
        self._pilot.lead((x - ox, y - oy, z - oz), yaw)

    @property
    def _origin(self) -> Vector:
        """The origin of the pilot's frame in W."""
        return (0.0, 0.0, 0.0) if self._pilot.absolute else self.home

    def _take_mode(self, message: Message) -> None:
        """Take SET_MODE, which MAV_CMD_DO_SET_MODE has replaced."""
        number, source = message.custom_mode, sender_of(message)
        known = number in tuple(Mode)
        result = CommandResult.ACCEPTED if known else CommandResult.DENIED
        self._stack.reply(services.command_ack(Command.DO_SET_MODE, result, *source))
        for answer in self._enter(Mode(number), source) if known else ():
            self._stack.reply(answer)

    def _enter(self, mode: Mode, source: Source) -> Sequence[Message]:
        if mode is Mode.OFFBOARD:
            self._leader, self._led_us = source, self._stack.kernel.now_us
            self._started.give_nowait()
        else:
            self._leader = None
        return self._change(mode, INFO, f"mode: {mode.name.lower()}")

    def _change(self, mode: Mode, severity: int, text: str) -> Sequence[Message]:
        """Change the mode; return the messages for all clients."""
        texts = () if mode is self.mode else services.status_text(severity, text)
        self.mode = mode
        return (*texts, services.current_mode(mode))

    def _watch(self) -> Task:
        """Leave offboard when its set-points stop."""
        kernel = self._stack.kernel
        while True:
            if self._leader is None:
                yield from self._started.take(FOREVER)
                continue
            left_us = self._led_us + SILENCE_US - kernel.now_us
            if left_us > 0:
                yield from kernel.delay(-(-left_us // TICK_US))
            else:
                self._leader = None
                for news in self._change(
                    Mode.HOLD, WARNING, "offboard left: no set-points for 0.5 s, holding"
                ):
                    yield from self._stack.offer(news)
