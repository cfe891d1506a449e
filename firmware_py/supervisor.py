"""The supervisor decides, before every controller step, whether the loop may be closed.

Whatever forbids it leads to the same defined flap state, the hover angles, and is announced once on the console. State
and cause are log variables (`supervisor.state`, `supervisor.cause`). How it ends depends on the cause:

    silence         no accepted pose for 500 ms (parameter): the next accepted pose ends it
    out of bounds   the estimator was held at its bounds for 200 ms: ends after 500 ms inside them
    disarmed        by request: ends with the request to arm
    not finite      own logic returned NaN or infinity, the controller or the estimator: ends with a recovery request
    emergency stop  by request, because a started emergency stop watchdog was not fed for 1 s, or because a stream of
                    set-points fell silent for 2 s: ends only with a reboot. A stop by the parameter floaty.stop ends
                    with a recovery request, too
    low battery     below the limit for 5 s: ends only with a recovery request when the voltage is back above it

Before the first pose, and with absolute poses while the high-level commander has nothing to do, it waits. The board arms
itself at boot. One outlier pose is refused by the estimator's gate and has no effect here.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import Protocol

from firmware_py.config import SupervisorConfig
from firmware_py.core.structs import MODE_FLY, MODE_HOVER, MODE_MANUAL, Estimator
from firmware_py.wire.supervisor import Cause, State

WATCHDOG_US = 1_000_000  # Crazyflie firmware
BATTERY_LOW_US = 5_000_000  # original firmware
EPISODE_GAP_US = 50_000  # two bounded steps closer than this belong to one episode
EPISODE_LIMIT_US = 200_000
BOUNDS_RECOVERY_US = 500_000
NEVER_US = -(1 << 40)


class Manual(IntEnum):
    """Who moves the flaps: the original's parameter `extCtrl.manual`."""

    OFF = 0  # the controller, when the state allows it
    ANGLES = 1  # angles from outside, with or without poses, while a client is there to take them back
    HOVER = 2  # hover angles


class GoalSource(Protocol):
    """Knows where to fly."""

    def flies(self, now_us: int) -> bool:
        """Whether there is something to fly to."""
        ...

    def forsaken(self, now_us: int) -> bool:
        """Whether set-points led the robot and have stopped arriving."""
        ...

    def abort(self) -> None:
        """Give up the plan, because the robot may not fly."""
        ...


class BoundsWatch:
    """Notices when the estimator has been held at its bounds for too long; `estimator` is the core's fields."""

    def __init__(self, estimator: Estimator) -> None:
        self.estimator = estimator
        self._bounded = 0
        self._episode_start_us = self._bounded_us = self._outside_until_us = NEVER_US

    def is_outside(self, now_us: int) -> bool:
        """Whether the state counts as out of bounds; called every 10 ms."""
        bounded = int(self.estimator.bounded)
        if bounded != self._bounded:
            self._bounded = bounded
            if now_us - self._bounded_us > EPISODE_GAP_US:
                self._episode_start_us = now_us
            self._bounded_us = now_us
            if now_us - self._episode_start_us >= EPISODE_LIMIT_US or now_us < self._outside_until_us:
                self._outside_until_us = now_us + BOUNDS_RECOVERY_US
        return now_us < self._outside_until_us


class LogicWatch:
    """Remembers in `cause` which of the user's modules has returned NaN or infinity since `reset`."""

    def __init__(self) -> None:
        self.cause = Cause.NONE
        self._controller_faults = self._estimator_faults = 0

    def see(self, controller_faults: int, estimator_faults: int) -> None:
        """Take how often that has happened since boot."""
        if estimator_faults > self._estimator_faults:
            self.cause = Cause.ESTIMATOR_NOT_FINITE
        elif controller_faults > self._controller_faults:
            self.cause = Cause.CONTROLLER_NOT_FINITE
        self._controller_faults, self._estimator_faults = controller_faults, estimator_faults

    def reset(self) -> None:
        """Forget the cause."""
        self.cause = Cause.NONE


class Supervisor:
    """State machine over the facts in its attributes; `estimator` is the core's fields, read for its bounds."""

    def __init__(
        self, config: SupervisorConfig, estimator: Estimator, announce: Callable[[str], None]
    ) -> None:
        self.state = State.CALIBRATING
        self.cause = Cause.NONE
        self.calibrated = False
        self.armed = True
        self.controlling = False  # whether the flaps obey controller or manual angles, as `mode` said last
        self.manual = Manual.OFF
        self.last_pose_us: int | None = None
        self.pose_timeout_us = config.pose_timeout_us
        self.low_battery_mv = config.low_battery_mv
        self.battery_mv = 0
        self.goals: GoalSource | None = None  # None: there is always something to fly to
        self.connected: Callable[[], bool] = lambda: True  # whether a client is there
        self.logic = LogicWatch()
        self.bounds = BoundsWatch(estimator)
        self._announce = announce
        self._stopped = self._locked = False
        self._battery_empty = False
        self._battery_good_us = 0
        self._watchdog_us: int | None = None  # instant at which it triggers, None until it is fed once

    @property
    def stopped(self) -> bool:
        """Whether the robot was stopped, for a while or until a reboot."""
        return self._stopped

    @property
    def locked(self) -> bool:
        """Whether an emergency stop holds until the board reboots."""
        return self._locked

    @property
    def battery_empty(self) -> bool:
        """Whether the battery counts as empty."""
        return self._battery_empty

    @property
    def can_be_armed(self) -> bool:
        """Whether a request to arm is obeyed: neither a stop nor the battery forbids it."""
        return not self._stopped and not self._battery_empty and self.logic.cause is Cause.NONE

    @property
    def can_fly(self) -> bool:
        """Whether nothing but poses is needed."""
        return self.calibrated and self.armed and self.can_be_armed

    def mode(self, now_us: int) -> int:
        """Return the controller's mode at this instant and announce a change of state; called every 10 ms."""
        outside = self.bounds.is_outside(now_us)
        if self._watchdog_us is not None and now_us >= self._watchdog_us:
            self.emergency_stop()
        if self.goals is not None:
            if self.goals.forsaken(now_us):
                self.emergency_stop()
            if not self.can_fly:
                self.goals.abort()
        state, cause = self._state(now_us, outside)
        if state is not self.state or cause is not self.cause:
            self.state, self.cause = state, cause
            reason = "" if cause is Cause.NONE else f", {cause.name.lower().replace('_', ' ')}"
            self._announce(f"supervisor: {state.name.lower()}{reason}")
        mode = self._mode()
        self.controlling = mode != MODE_HOVER
        return mode

    def _mode(self) -> int:
        """Return the mode that follows from state, cause and who moves the flaps."""
        if self.cause > Cause.OUT_OF_BOUNDS or self.manual is Manual.HOVER:
            return MODE_HOVER
        if self.manual is Manual.ANGLES:
            return MODE_MANUAL if self.connected() else MODE_HOVER
        return MODE_FLY if self.state is State.FLYING else MODE_HOVER

    def emergency_stop(self) -> None:
        """Stop until the board reboots."""
        self._stopped = self._locked = True

    def stop(self) -> None:
        """Stop until `recover`."""
        self._stopped = True

    def feed_watchdog(self, now_us: int) -> None:
        """Start the emergency stop watchdog, or hold it off for another second."""
        self._watchdog_us = now_us + WATCHDOG_US

    def arm(self, armed: bool) -> bool:
        """Arm or disarm; False when the request to arm was refused."""
        if armed and not self.can_be_armed:
            return False
        self.armed = armed
        return True

    def recover(self, now_us: int) -> bool:
        """Leave a lasting failsafe: a stop, logic that failed, and with a good voltage the low battery.

        False while the battery is low. The emergency stop cannot be left.
        """
        self._stopped = self._locked
        self.logic.reset()
        if self.battery_mv >= self.low_battery_mv:
            self._battery_empty = False
            self._battery_good_us = now_us
        return not self._battery_empty

    def see_battery(self, now_us: int, battery_mv: int) -> None:
        """Take the supply voltage [mV]."""
        self.battery_mv = battery_mv
        if battery_mv >= self.low_battery_mv:
            self._battery_good_us = now_us
        elif now_us - self._battery_good_us >= BATTERY_LOW_US:
            self._battery_empty = True

    def _state(self, now_us: int, outside: bool) -> tuple[State, Cause]:
        if self._stopped:
            return State.FAILSAFE, Cause.EMERGENCY_STOP
        if self.logic.cause is not Cause.NONE:
            return State.FAILSAFE, self.logic.cause
        if self._battery_empty:
            return State.FAILSAFE, Cause.LOW_BATTERY
        if not self.armed:
            return State.FAILSAFE, Cause.DISARMED
        if not self.calibrated:
            return State.CALIBRATING, Cause.NONE
        if self.last_pose_us is None or (self.goals is not None and not self.goals.flies(now_us)):
            return State.WAITING, Cause.NONE
        if now_us - self.last_pose_us >= self.pose_timeout_us:
            return State.FAILSAFE, Cause.SILENCE
        if outside:
            return State.FAILSAFE, Cause.OUT_OF_BOUNDS
        return State.FLYING, Cause.NONE
