"""The supervisor of the flight core, as the rest of the firmware sees it: requests go in, state and cause come out.

The rules are in `firmware_py/core/supervisor.py`. A change of state or cause is announced once on the console; both
are log variables (`supervisor.state`, `supervisor.cause`). The board arms itself at boot.
"""

from collections.abc import Callable

from firmware_py.core import structs
from firmware_py.core.subset import i32
from firmware_py.core_runner import CoreBlocks
from firmware_py.wire.supervisor import Cause, State


class CoreSupervisor:
    """Requests to the core's supervisor, and a view on it."""

    def __init__(
        self, core: CoreBlocks, announce: Callable[[str], None], connected: Callable[[], bool]
    ) -> None:
        self.state = State.CALIBRATING
        self.cause = Cause.NONE
        self._core = core
        self._data, self._fields = core.data.fields, core.supervisor.fields
        self._sampling, self._parameters = core.sampling.fields, core.parameters.fields
        self._announce = announce
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
        data = self._data
        data.now_us, data.connected = wrapped(now_us), i32(self._connected())
        if self._core.run.call("supervise"):
            self.state, self.cause = State(int(self._fields.state)), Cause(int(self._fields.cause))
            cause = self.cause
            reason = "" if cause is Cause.NONE else f", {cause.name.lower().replace('_', ' ')}"
            self._announce(f"supervisor: {self.state.name.lower()}{reason}")

    def emergency_stop(self) -> None:
        """Stop until the board reboots."""
        self._request(structs.REQUEST_LOCK)

    def stop(self) -> None:
        """Stop until `recover`."""
        self._request(structs.REQUEST_STOP)

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
