"""The target of the high-level commander: the goal that a pose is compared with, and set-points for the core.

Poses are in a frame X: corrections in the goal frame of the ground station, absolute poses in that of the cameras.
The planner moves the goal in X; a pose is compared with the goal at the instant when it was measured. While the planner
is idle, corrections are errors already (the goal is X's origin); with absolute poses there is no target: the goal stays
under the robot, and the supervisor keeps the flaps at hover.

A pose travels as `Arrived` through the measurement queue, from the radio or the UART to the estimator.
"""

from firmware_py.core.structs import (
    GOAL_ABSOLUTE,
    GOAL_NONE,
    GOAL_OF_CORRECTIONS,
    SETPOINT_OTHER,
    SETPOINT_POSITION,
    Input,
)
from firmware_py.core.subset import i32
from firmware_py.core_runner import CoreBlocks
from firmware_py.geometry import Vector, to_euler_zyx
from firmware_py.planner import Path, PathPoint, Phase, Planner, stay
from firmware_py.wire.crtp import Correction

# Arrival of a pose on board [us], the pose, whether it is absolute, and the goal at the instant when it was measured, in
# the frame of the pose; None: the goal is not known.
Arrived = tuple[int, Correction, bool, PathPoint | None]

ORIGIN = PathPoint((0.0, 0.0, 0.0), 0.0)
SETPOINT_SILENCE_US = 2_000_000  # Crazyflie firmware: COMMANDER_WDT_TIMEOUT_SHUTDOWN


class Pilot:
    """`goal` is the one for the last pose, None for an unchanged correction."""

    def __init__(self, core: CoreBlocks) -> None:
        self.planner = Planner()
        self.goal: PathPoint | None = None
        self.here: PathPoint | None = None  # the last absolute pose
        self.seen_us = -1  # arrival of the last pose
        self._setpoint_us: int | None = None  # arrival of the last set-point, while they lead
        self._core = core

    @property
    def absolute(self) -> bool:
        """Whether poses over CRTP are absolute."""
        return bool(self._core.data.fields.absolute)

    def has_target(self, now_us: int) -> bool:
        """Return whether there is a target; poses from links other than CRTP do not pass the pilot."""
        idle = self.planner.phase(now_us) is Phase.IDLE
        return not (idle and self.here is not None and self.absolute)

    @property
    def led(self) -> bool:
        """Whether set-points lead."""
        return self._setpoint_us is not None

    def setpoints_stopped(self, now_us: int) -> bool:
        """Return whether set-points lead and have stopped arriving."""
        return self._setpoint_us is not None and now_us - self._setpoint_us >= SETPOINT_SILENCE_US

    def evaluate(self, setpoint: tuple[Vector, float] | None, now_us: int) -> int:
        """Return the outcome for a set-point, `SETPOINT_...`; None: it gives no position."""
        data = self._core.data.fields
        data.poses_absolute = i32(self.absolute)
        data.setpoint_kind = i32(SETPOINT_OTHER)
        if setpoint is not None:
            data.setpoint_kind = i32(SETPOINT_POSITION)
            data.setpoint[:3], data.setpoint[3] = setpoint
        put_goal(data, self.begin(now_us))
        return self._core.run.call("follow")

    def admits(self, path: Path) -> bool:
        """Return whether a path ends in the box and is never further outside than at its beginning."""
        begin, *places = path.places()
        return all(self.admits_place(place, begin, self.absolute) for place in places) and self.admits_place(
            places[-1], None, self.absolute
        )

    def admits_place(self, place: Vector, goal: Vector | None, absolute: bool) -> bool:
        """Return whether a place is in the box, or at most as far outside as a goal."""
        data = self._core.data.fields
        data.poses_absolute = i32(absolute)
        data.setpoint[:3] = place
        put_goal(data, None if goal is None else PathPoint(goal, 0.0))
        return bool(self._core.run.call("admits"))

    def follow(self, path: Path, now_us: int, lands: bool = False) -> None:
        """Start a path of the high-level commander, which needs no further messages."""
        self.planner.follow(path, now_us, lands)
        self._setpoint_us = None

    def hold(self, position: Vector, yaw: float, now_us: int) -> None:
        """Fly to a set-point; the next one has to arrive soon."""
        self.planner.follow(stay(position, yaw), now_us)
        self._setpoint_us = now_us

    def release(self) -> None:
        """Note that no further set-points will come; the last one stays in force."""
        self._setpoint_us = None

    def abort(self) -> None:
        """Give up the path or set-point."""
        self.planner.stop()
        self._setpoint_us = None

    def begin(self, now_us: int) -> PathPoint | None:
        """Return the start of a new path: a point of the present path, else the robot's place; None when unknown."""
        if self.planner.phase(now_us) is not Phase.IDLE:
            return self.planner.at(now_us)
        return self.here if self.absolute else ORIGIN

    def frame(self, now_us: int) -> PathPoint | None:
        """Return the origin of the estimate in X now; None while they are the same."""
        return self.planner.at(now_us) if self.planner.phase(now_us) is not Phase.IDLE else self.goal

    def measured(self, pose: Correction, now_us: int) -> Arrived:
        """Return a pose that has just arrived over CRTP, with its goal."""
        self.seen_us = now_us
        age_us = int(self._core.parameters.fields.default_age_us) if pose.age_us is None else pose.age_us
        if self.absolute:
            self.here = PathPoint(pose.p_GB, to_euler_zyx(pose.q_GB)[2])
        if self.planner.phase(now_us) is not Phase.IDLE:
            self.goal = self.planner.at(now_us - age_us)
        else:
            self.goal = self.here if self.absolute else None
        return now_us, pose, self.absolute, self.goal


def put_goal(data: Input, goal: PathPoint | None) -> None:
    """Hand the core the goal in the frame of the poses."""
    if goal is None:
        data.goal_kind = i32(GOAL_NONE)
        return
    data.goal_kind = i32(GOAL_ABSOLUTE if data.poses_absolute else GOAL_OF_CORRECTIONS)
    data.goal[:3] = goal.position
    data.goal[3] = goal.yaw
    data.goal_velocity[:] = goal.velocity
