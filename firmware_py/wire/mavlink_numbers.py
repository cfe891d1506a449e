"""Numbers of the MAVLink standard for both ends of a line, and both sides of the board's pins; without pymavlink."""

from enum import IntEnum

WRITE_ALL = 1  # PREFLIGHT_STORAGE


class Command(IntEnum):
    """MAV_CMD: what the board can do."""

    DO_SET_MODE = 176
    DO_FLIGHTTERMINATION = 185
    PREFLIGHT_STORAGE = 245
    PREFLIGHT_REBOOT_SHUTDOWN = 246
    COMPONENT_ARM_DISARM = 400
    GET_HOME_POSITION = 410
    INJECT_FAILURE = 420
    GET_MESSAGE_INTERVAL = 510
    SET_MESSAGE_INTERVAL = 511
    REQUEST_MESSAGE = 512
    REQUEST_PROTOCOL_VERSION = 519
    REQUEST_AUTOPILOT_CAPABILITIES = 520


class Mode(IntEnum):
    """The board's modes, as custom modes. The numbers are PX4's, which MAVSDK expects of all but ArduPilot."""

    HOLD = 4 << 16 | 3 << 24  # main mode 4, sub-mode 3: fly at the last goal
    OFFBOARD = 6 << 16  # one client's stream of set-points leads


class CommandResult(IntEnum):
    """MAV_RESULT: the outcome of a command."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Unit(IntEnum):
    """FAILURE_UNIT, those of a Floaty."""

    GYRO = 0
    ACCELEROMETER = 1
    POSES = 6  # SENSOR_VIO: position and attitude from outside
    BATTERY = 100
    MOTOR = 101
    SERVO = 102
    SIGNAL = 105  # SYSTEM_MAVLINK_SIGNAL


class Failing(IntEnum):
    """FAILURE_TYPE: how a unit fails."""

    OK = 0
    OFF = 1
    STUCK = 2
    GARBAGE = 3
    WRONG = 4
    SLOW = 5
    DELAYED = 6
    INTERMITTENT = 7
