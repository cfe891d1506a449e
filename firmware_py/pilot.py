"""Where to fly, as the high-level commander has it, and external poses as errors against that.

Poses come in a frame X: corrections are in the goal frame of the ground station, absolute ones in that of the cameras.
The error that the estimator takes is the pose as it looks from the goal, which the planner moves in X, at the instant at
which the pose was true. While the planner is idle, corrections are errors already (the goal is X's origin); with absolute
poses there is nothing to fly to: the goal stays under the robot, and the supervisor keeps the flaps at hover.
"""

from firmware_py.box import GoalBox
from firmware_py.config import PredictorConfig
from firmware_py.geometry import Vector, in_goal_frame, to_euler_zyx
from firmware_py.planner import Motion, Path, Phase, Planner, stay
from firmware_py.wire.crtp import Correction

ORIGIN = Motion((0.0, 0.0, 0.0), 0.0)
SETPOINT_SILENCE_US = 2_000_000  # Crazyflie firmware: COMMANDER_WDT_TIMEOUT_SHUTDOWN


class Pilot:
    """`absolute` says what poses are. `goal` is what the last error was formed against, None for an unchanged correction."""

    def __init__(self, config: PredictorConfig, box: GoalBox, home: Vector) -> None:
        self.box = box
        self.planner = Planner()
        self.absolute: bool = config.absolute
        self.goal: Motion | None = None
        self.here: Motion | None = None  # the last absolute pose
        self.seen_us = -1  # when the last pose came
        self._setpoint_us: int | None = None  # when the last set-point came, while they lead
        self._default_age_us: int = config.default_age_us
        self._home = home  # of absolute poses

    def flies(self, now_us: int) -> bool:
        """Whether there is something to fly to; poses from links other than CRTP do not pass the pilot."""
        idle = self.planner.phase(now_us) is Phase.IDLE
        return not (self.absolute and idle and self.here is not None)

    @property
    def led(self) -> bool:
        """Whether set-points lead."""
        return self._setpoint_us is not None

    def forsaken(self, now_us: int) -> bool:
        """Whether set-points lead and have stopped arriving."""
        return self._setpoint_us is not None and now_us - self._setpoint_us >= SETPOINT_SILENCE_US

    def admits(self, path: Path) -> bool:
        """Return whether a path stays in the box, or returns to it."""
        return self.box.holds(path.places(), self._centre)

    def admits_place(self, position: Vector, now_us: int) -> bool:
        """Return whether a set-point is in the box, or no further outside than what is flown to now."""
        begin = self.begin(now_us)
        allowed = self.box.excess(begin.position, self._centre) if begin is not None else 0.0
        return self.box.excess(position, self._centre) <= allowed

    @property
    def _centre(self) -> Vector:
        return self._home if self.absolute else ORIGIN.position

    def follow(self, path: Path, now_us: int, lands: bool = False) -> None:
        """Start a path of the high-level commander, which needs no further messages."""
        self.planner.follow(path, now_us, lands)
        self._setpoint_us = None

    def hold(self, position: Vector, yaw: float, now_us: int) -> None:
        """Fly to a set-point; the next one has to arrive soon."""
        self.planner.follow(stay(position, yaw), now_us)
        self._setpoint_us = now_us

    def release(self) -> None:
        """Note that no further set-points are promised; the last one stays in force."""
        self._setpoint_us = None

    def abort(self) -> None:
        """Give up the path or set-point."""
        self.planner.stop()
        self._setpoint_us = None

    def begin(self, now_us: int) -> Motion | None:
        """Where a new path begins: where the present one is, else where the robot is; None when that is not known."""
        if self.planner.phase(now_us) is not Phase.IDLE:
            return self.planner.at(now_us)
        return self.here if self.absolute else ORIGIN

    def frame(self, now_us: int) -> Motion | None:
        """Where the origin of the estimate is in X now; None while they are the same."""
        return self.planner.at(now_us) if self.planner.phase(now_us) is not Phase.IDLE else self.goal

    def error(self, pose: Correction, now_us: int) -> Correction:
        """Return the error that the estimator takes for a pose that has just arrived."""
        self.seen_us = now_us
        age_us = self._default_age_us if pose.age_us is None else pose.age_us
        if self.absolute:
            self.here = Motion(pose.p_GB, to_euler_zyx(pose.q_GB)[2])
        if self.planner.phase(now_us) is not Phase.IDLE:
            self.goal = self.planner.at(now_us - age_us)
        else:
            self.goal = self.here if self.absolute else None
        if self.goal is None:
            return pose
        return Correction(
            *in_goal_frame(pose.p_GB, pose.q_GB, self.goal.position, self.goal.yaw), pose.age_us
        )
