"""The supervisor's states and causes, as they travel in telemetry; channels and commands of the Crazyflie's platform and
supervisor ports, for both ends of a link.
"""

from enum import IntEnum


class State(IntEnum):
    """The robot's permissions."""

    CALIBRATING = 0  # the gyro's zero is unknown: flaps at hover
    WAITING = 1  # no pose yet: flaps at hover
    FLYING = 2  # loop closed
    FAILSAFE = 3  # flaps at hover, see the cause


class Cause(IntEnum):
    """Why the robot is in failsafe."""

    NONE = 0
    SILENCE = 1
    OUT_OF_BOUNDS = 2
    EMERGENCY_STOP = 3
    LOW_BATTERY = 4
    DISARMED = 5
    NO_CONTROL = 6  # of a real board: no controller step ran, or another controller runs
    CONTROLLER_NOT_FINITE = 7  # own logic returned NaN or infinity
    ESTIMATOR_NOT_FINITE = 8
    IMU_STALE = 9  # the gyro's counts do not change


PLATFORM_COMMAND, PLATFORM_VERSION, PLATFORM_APP = 0, 1, 2
VERSION_PROTOCOL, VERSION_FIRMWARE, VERSION_DEVICE = 0, 1, 2
COMMAND_ARM, COMMAND_RECOVER, COMMAND_NOTIFY = 1, 2, 3

PORT_SINCE = 12  # version of the protocol, with which boards have the supervisor's port
SUPERVISOR_INFO, SUPERVISOR_COMMAND = 0, 1
GET_BITS = 0x0C
ARM, RECOVER, STOP, STOP_WATCHDOG = 1, 2, 3, 4
REPLY = 0x80
LOCKED = 1 << 6  # of the supervisor's bits: stopped until a reboot
