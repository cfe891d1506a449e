"""Numbers of the MAVLink standard that cross the board's pins, for both sides of them and without pymavlink."""

from enum import IntEnum


class Result(IntEnum):
    """MAV_RESULT: what becomes of a command."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Unit(IntEnum):
    """FAILURE_UNIT, those that a Floaty has."""

    GYRO = 0
    ACCELEROMETER = 1
    POSES = 6  # SENSOR_VIO: position and attitude as somebody sees them
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
