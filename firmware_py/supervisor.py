"""The supervisor decides, before every controller step, whether the loop may be closed."""

from collections.abc import Callable
from enum import IntEnum

from firmware_py.core.structs import MODE_FLY, MODE_HOVER


class State(IntEnum):
    """What the robot is allowed to do."""

    CALIBRATING = 0  # the gyro's zero is unknown: flaps at hover
    WAITING = 1  # no pose has come yet: flaps at hover
    FLYING = 2  # loop closed
    FAILSAFE = 3  # poses have stopped: flaps at hover until one comes


MODE_OF = {
    State.CALIBRATING: MODE_HOVER,
    State.WAITING: MODE_HOVER,
    State.FLYING: MODE_FLY,
    State.FAILSAFE: MODE_HOVER,
}


class Supervisor:
    """State machine over two facts: is the gyro's zero known, and when did the last pose arrive."""

    def __init__(self, pose_timeout_us: int, announce: Callable[[str], None]) -> None:
        self.state = State.CALIBRATING
        self.calibrated = False
        self.last_pose_us: int | None = None
        self._pose_timeout_us = pose_timeout_us
        self._announce = announce

    def mode(self, now_us: int) -> int:
        """Return the controller's mode at this instant and announce a change of state."""
        state = self._state(now_us)
        if state is not self.state:
            self.state = state
            self._announce(f"supervisor: {state.name.lower()}")
        return MODE_OF[state]

    def _state(self, now_us: int) -> State:
        if not self.calibrated:
            return State.CALIBRATING
        if self.last_pose_us is None:
            return State.WAITING
        if now_us - self.last_pose_us >= self._pose_timeout_us:
            return State.FAILSAFE
        return State.FLYING
