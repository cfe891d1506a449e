"""The supervisor of the flight core, as the rest of the firmware sees it: requests go in, state and cause come out.

The rules are in `firmware_py/core/supervisor.py`. A change of state or cause is announced once on the console; both
are log variables (`supervisor.state`, `supervisor.cause`). Set-points that stop for 2 s stop the robot until a
reboot, as on the Crazyflie. The board arms itself at boot.
"""

from collections.abc import Callable

from firmware_py.core import structs
from firmware_py.core.subset import i32
from firmware_py.core_runner import CoreBlocks
from firmware_py.pilot import Pilot
from firmware_py.wire.supervisor import Cause, State


class CoreSupervisor:
    """Requests to the core's supervisor, and a view on it."""

    def __init__(
        self, core: CoreBlocks, announce: Callable[[str], None], goals: Pilot, connected: Callable[[], bool]
    ) -> None:
        self.state = State.CALIBRATING
        self.cause = Cause.NONE
        self._core = core
        self._data, self._fields = core.data.fields, core.supervisor.fields
        self._sampling, self._parameters = core.sampling.fields, core.parameters.fields
        self._announce = announce
        self._goals = goals
        self._connected = connected  # whether a client is connected
        self.arm(True)

    @property
    def calibrated(self) -> bool:
        """Whether the gyro's zero is known."""
        return bool(self._sampling.calibrated)

    @property
    def armed(self) -> bool:
        return bool(self._fields.armed)

    @property
    def stopped(self) -> bool:
        """Whether the robot was stopped, for a while or until a reboot."""
        return bool(self._fields.stopped)

    @property
    def locked(self) -> bool:
        """Whether an emergency stop holds until the board reboots."""
        return bool(self._fields.locked)

    @property
    def battery_empty(self) -> bool:
        return bool(self._fields.battery_empty)

    @property
    def can_be_armed(self) -> bool:
        """Whether a request to arm would be accepted."""
        return bool(self._fields.lasting == structs.CAUSE_NONE)

    @property
    def can_fly(self) -> bool:
        """Whether only poses are missing."""
        return bool(self._fields.ready) and not self.imu_is_stale

    @property
    def imu_is_stale(self) -> bool:
        """Whether the gyro's counts do not change."""
        return bool(self._sampling.recovering > 0)

    @property
    def has_recent_pose(self) -> bool:
        """Whether the last accepted pose is recent enough."""
        return bool(self._fields.pose_seen and self._fields.silent_us < self._parameters.pose_timeout_us)

    @property
    def controlling(self) -> bool:
        """Whether the controller or manual angles move the flaps."""
        return bool(self._data.mode != structs.MODE_HOVER)

    @property
    def battery_mv(self) -> int:
        return int(self._data.battery_mv)

    def update(self, now_us: int) -> None:
        """Update the controller's mode and announce a change of state; called every 10 ms."""
        data, goals = self._data, self._goals
        data.now_us, data.connected = wrapped(now_us), i32(self._connected())
        if goals.setpoints_stopped(now_us):
            self.emergency_stop()
        data.idle = i32(not goals.has_target(now_us))
        if self._core.run.call("supervise"):
            self.state, self.cause = State(int(self._fields.state)), Cause(int(self._fields.cause))
            cause = self.cause
            reason = "" if cause is Cause.NONE else f", {cause.name.lower().replace('_', ' ')}"
            self._announce(f"supervisor: {self.state.name.lower()}{reason}")
        if not self._fields.ready:
            goals.abort()

    def emergency_stop(self) -> None:
        """Stop until the board reboots."""
        self._request(structs.REQUEST_LOCK)

    def stop(self) -> None:
        """Stop until `recover`."""
        self._request(structs.REQUEST_STOP)

    def feed_watchdog(self, now_us: int) -> None:
        """Start the emergency stop watchdog, or hold it off for another second."""
        self._data.now_us = wrapped(now_us)
        self._request(structs.REQUEST_FEED)

    def arm(self, armed: bool) -> bool:
        """Arm or disarm; False when the request to arm was refused."""
        return self._request(structs.REQUEST_ARM if armed else structs.REQUEST_DISARM)

    def recover(self) -> bool:
        """Clear a lasting failsafe: a stop, logic that failed and, at a good voltage, the low battery.

        False while the battery is low. The emergency stop cannot be cleared.
        """
        return self._request(structs.REQUEST_RECOVER)

    def _request(self, request: int) -> bool:
        self._data.request = i32(request)
        return bool(self._core.run.call("request"))


def wrapped(time_us: int) -> i32:
    """Return an instant on the core's 32-bit clock."""
    return i32(((time_us + 0x8000_0000) & 0xFFFF_FFFF) - 0x8000_0000)
