"""Joins the Crazyflie's commanders to the flight core, as the exported app does on the flashed board.

The set-point of the commanders moves the core's goal; a pose is compared with the goal in force when it is filed. While
nothing is commanded the goal stays. With corrections the goal belongs to their sender, and set-points are not followed.

A pose travels as `Arrived` through the measurement queue, from the radio or the UART to the estimator.
"""

from collections.abc import Callable, Sequence

from firmware_py.core.structs import (
    GOAL_ABSOLUTE,
    GOAL_NONE,
    GOAL_OF_CORRECTIONS,
    SETPOINT_OF_CORRECTIONS,
    SETPOINT_OTHER,
    SETPOINT_OUTSIDE,
    SETPOINT_POSITION,
    Input,
)
from firmware_py.core.subset import i32
from firmware_py.core_runner import CoreBlocks
from firmware_py.crazyflie.commander import HIGH_LEVEL, Setpoint
from firmware_py.crazyflie.planner import PathPoint
from firmware_py.crazyflie.stabilizer import Stabilizer
from firmware_py.crazyflie.supervisor import State
from firmware_py.geometry import Vector
from firmware_py.supervisor import CoreSupervisor
from firmware_py.wire.crtp import Correction

# Arrival of a pose on board [us], the pose, whether it is absolute, and its own goal (of MAVLink); None: that in force.
Arrived = tuple[int, Correction, bool, PathPoint | None]

BOX = "it leaves the box, see box.radius, box.below and box.above"
REASONS = {
    SETPOINT_OTHER: "only positions are",
    SETPOINT_OUTSIDE: BOX,
    SETPOINT_OF_CORRECTIONS: "poses are corrections, see extPose.absolute",
}


class Pilot:
    """`stabilizer` is the Crazyflie's part; `refuse` takes the kind and the text of what is not flown."""

    def __init__(
        self,
        core: CoreBlocks,
        supervisor: CoreSupervisor,
        acceleration: Callable[[], Vector],
        refuse: Callable[[str, str], None],
    ) -> None:
        self.stabilizer = Stabilizer(self, lambda kind, text: refuse(kind, f"commander: {text}"))
        self.seen_us = -1  # arrival of the last pose over CRTP
        self._core, self._data = core, core.data.fields
        self._supervisor = supervisor
        self._acceleration = acceleration
        self._refuse = refuse
        self._state = State.NOT_INITIALIZED
        self._reason = ""  # why the last set-point is not followed
        self._held = False  # the Crazyflie's supervisor is kept disarmed
        self._waits = False  # and waits for the request to arm

    @property
    def absolute(self) -> bool:
        """Whether poses over CRTP are absolute."""
        return bool(self._data.absolute)

    def step(self, now_us: int) -> None:
        """Move the goal as the commanders want, and stop as their supervisor wants; called every 10 ms."""
        self._match_arming()
        turning = bool(self._core.supervisor.fields.led)
        setpoint = self.stabilizer.step(now_us, turning, self._acceleration)
        crazyflie = self.stabilizer.supervisor
        if crazyflie.stop_wanted or crazyflie.locked:
            self._supervisor.emergency_stop()
        if crazyflie.state is not self._state:
            self._state = crazyflie.state
            if self._state is State.LEVEL_OUT:
                self._refuse(
                    "silence", "commander: set-points stopped without their notice; 1.5 s more lock the board"
                )
        if self._state is not State.LEVEL_OUT:
            self._follow(setpoint)

    def admits(self, places: Sequence[Vector]) -> bool:
        """Return whether a path ends in the box and is never further outside than at its beginning."""
        if not self.absolute or self.stabilizer.commander.priority > HIGH_LEVEL:
            return True  # it is not followed
        begin, *rest = places
        inside = all(self.admits_place(place, begin, True) for place in rest)
        if inside and self.admits_place(rest[-1], None, True):
            return True
        self._refuse("path in the box", f"commander: path refused: {BOX}")
        return False

    def admits_place(self, place: Vector, goal: Vector | None, absolute: bool) -> bool:
        """Return whether a place is in the box, or at most as far outside as a goal."""
        data = self._data
        kept = data.goal.tolist(), data.goal_velocity.tolist(), data.goal_kind, data.poses_absolute
        data.poses_absolute = i32(absolute)
        data.setpoint[:3] = place
        put_goal(data, None if goal is None else PathPoint(goal, 0.0))
        admitted = bool(self._core.run.call("admits"))
        data.goal[:], data.goal_velocity[:], data.goal_kind, data.poses_absolute = kept
        return admitted

    def lead(self, position: Vector, yaw: float) -> None:
        """Make a target of another link the goal, in the frame of the poses over CRTP."""
        self._data.poses_absolute = i32(self.absolute)
        put_goal(self._data, PathPoint(position, yaw))

    def estimate(self) -> PathPoint:
        """Return the estimated motion in the frame of the poses."""
        report = self._core.report.fields
        x, y, z = report.position.tolist()
        vx, vy, vz = report.velocity.tolist()
        return PathPoint((x, y, z), float(report.attitude[2]), (vx, vy, vz))

    def frame(self) -> PathPoint | None:
        """Return the goal of poses over CRTP; None while it is theirs."""
        data = self._data
        if data.goal_kind == GOAL_NONE:
            return None
        x, y, z, yaw = data.goal.tolist()
        return PathPoint((x, y, z), yaw)

    def measured(self, pose: Correction, now_us: int) -> Arrived:
        """Return a pose that has just arrived over CRTP."""
        self.seen_us = now_us
        return now_us, pose, self.absolute, None

    def _follow(self, setpoint: Setpoint) -> None:
        """Hand the core a set-point; report one that is not followed."""
        reason = ""
        if setpoint.place is not None or setpoint.other:
            data = self._data
            data.poses_absolute = i32(self.absolute)
            data.setpoint_kind = i32(SETPOINT_OTHER if setpoint.place is None else SETPOINT_POSITION)
            data.setpoint[:3], data.setpoint[3] = setpoint.place or (0.0, 0.0, 0.0), setpoint.yaw
            data.setpoint_velocity[:] = setpoint.velocity
            reason = REASONS.get(self._core.run.call("follow"), "")
        if reason and reason != self._reason:
            self._refuse(f"set-point: {reason}", f"commander: set-point not followed: {reason}")
        self._reason = reason

    def _match_arming(self) -> None:
        """Disarm and arm together with the Crazyflie's supervisor, which arms itself: a client's disarming lasts."""
        own, other = self._supervisor, self.stabilizer.supervisor
        if own.armed and other.armed:
            self._held = False
        elif own.armed and self._held:
            other.request_arming(True)
        elif own.armed and (other.can_fly or other.can_arm):
            own.arm(False)
        elif other.armed and self._waits:
            own.arm(True)
        if not own.armed:
            other.request_arming(False)
            self._held, self._waits = True, other.can_arm


def put_goal(data: Input, goal: PathPoint | None) -> None:
    """Hand the core the goal in the frame of the poses."""
    if goal is None:
        data.goal_kind = i32(GOAL_NONE)
        return
    data.goal_kind = i32(GOAL_ABSOLUTE if data.poses_absolute else GOAL_OF_CORRECTIONS)
    data.goal[:3] = goal.position
    data.goal[3] = goal.yaw
    data.goal_velocity[:] = goal.velocity
