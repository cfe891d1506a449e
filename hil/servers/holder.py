"""The launch clamp: it releases a robot once that flies in the holder, and a lost robot returns to it."""

from collections.abc import Callable

from firmware_py.wire.supervisor import State
from hil.laboratory.robot import Robot

HOLD_US = 1_000_000  # flying in the holder before the release
PUT_BACK_US = 1_000_000  # after a loss
WATCH_PERIOD_US = 10_000


class LaunchClamp:
    """Holds one robot. Calls `let_go` when it has flown in its holder for a second, or stands on the floor."""

    def __init__(self, robot: Robot, let_go: Callable[[int], None]) -> None:
        self._robot = robot
        self._let_go = let_go
        self._flying_since_us: int | None = None
        robot.events.every(WATCH_PERIOD_US, WATCH_PERIOD_US, self._watch)

    def put_back_later(self, now_us: int) -> None:
        """Return the robot to the holder after a delay."""
        self._robot.catch()
        self._robot.events.at(now_us + PUT_BACK_US, self._put_back)

    def _put_back(self, now_us: int) -> None:
        self._robot.put_back(now_us)
        self._flying_since_us = None

    def _watch(self, now_us: int) -> None:
        robot = self._robot
        if robot.free or robot.body.lost is not None:
            return
        if robot.config.pilot.enabled:  # it stands on the floor
            self._let_go(now_us)
            return
        if not robot.powered or robot.firmware.signals.supervisor.state is not State.FLYING:
            self._flying_since_us = None
        elif self._flying_since_us is None:
            self._flying_since_us = now_us
        elif now_us - self._flying_since_us >= HOLD_US:
            self._let_go(now_us)
