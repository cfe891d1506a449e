"""The capacity of a serial line for a flight over MAVLink: whether it can fly at all, and the rate of telemetry.

The sizes are those of real frames, from the wire module. A byte takes 10 bits on the line.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from firmware_py.wire import mavlink
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_dialect import Message, Timesync
from firmware_py.wire.mavlink_frames import SIGNATURE_SIZE, FrameSender
from firmware_py.wire.mavlink_numbers import Mode
from ground_station.errors import LinkError

BYTE_BITS = 10  # start, 8 data, stop
UP_LIMIT = 0.9  # of the line, so that poses do not wait
DOWN_LIMIT = 0.8  # of the line; the rest is for parameters, texts and answers
TELEMETRY_HZ = (50, 25, 20, 10, 4)
STANDING_GOAL_HZ = 2.0  # rate of repetitions of an unchanged goal
HOUSEKEEPING_HZ = 1.0  # of the station: heartbeat, time request
BOARD_TIME_HZ = 2.0  # time requests of the board

_U = (0.1, 0.2, 0.3)  # not zero, because trailing zeros are cut on the wire
_Q = (0.5, 0.5, 0.5, 0.5)


@dataclass(frozen=True, slots=True)
class Budget:
    """The use of a line."""

    up_load: float  # share of the line while the goal does not move, 0..1
    down_load: float
    telemetry_hz: int
    goal_period_us: int  # between goals while the goal moves; 0: every pose may have one
    text: str  # one line


def link_budget(baud: int, pose_hz: float, signed: bool = False) -> Budget:
    """Return the use of a line at `baud` with `pose_hz` poses per second; `LinkError` if it cannot carry a flight."""
    line = baud / BYTE_BITS  # [bytes/s]
    pose, goal, house = (_bytes(messages, signed) for messages in (_POSE, _GOAL, _HOUSEKEEPING))
    time = _bytes(_TIME, signed)
    fixed = HOUSEKEEPING_HZ * house + (BOARD_TIME_HZ + HOUSEKEEPING_HZ) * time
    up = pose_hz * pose + STANDING_GOAL_HZ * goal + fixed
    if up > UP_LIMIT * line:
        raise LinkError(
            f"{baud} baud: {pose_hz:g} poses/s need {up / 1000:.2f} kB/s, {100 * UP_LIMIT:.0f} % of the line are "
            f"{UP_LIMIT * line / 1000:.2f}: lower station.corrections_hz or raise serial.baud"
        )
    goal_hz = STANDING_GOAL_HZ + (UP_LIMIT * line - up) / goal
    goal_period_us = 0 if goal_hz >= pose_hz else round(1e6 / goal_hz)
    standing = sum(rate * _bytes((message,), signed) for rate, message in _BOARD) + 3 * time
    sample = _bytes(_SAMPLE, signed)
    for telemetry_hz in TELEMETRY_HZ:
        down = standing + telemetry_hz * sample
        if down <= DOWN_LIMIT * line:
            break
    else:
        raise LinkError(
            f"{baud} baud: {telemetry_hz} Hz of telemetry need {down / 1000:.2f} kB/s, {100 * DOWN_LIMIT:.0f} % of "
            f"the line are {DOWN_LIMIT * line / 1000:.2f}: raise serial.baud"
        )
    text = (
        f"{baud} baud: uplink {up / 1000:.1f} kB/s, {100 * up / line:.0f} %; "
        f"telemetry {telemetry_hz} Hz, {down / 1000:.1f} kB/s, {100 * down / line:.0f} %"
    )
    return Budget(up / line, down / line, telemetry_hz, goal_period_us, text)


def _bytes(messages: Iterable[Message], signed: bool) -> int:
    """Return the bytes of one frame of each."""
    sender = FrameSender(1, 1)
    return sum(len(sender.encode(0, message)) + SIGNATURE_SIZE * signed for message in messages)


_POSE = (mavlink.pose(10**12, _U, _Q),)
_GOAL = (mavlink.target(10**9, _U, 0.1),)
_HOUSEKEEPING = (services.station_heartbeat(),)
_TIME = (Timesync(10**15, 10**15, 1, 1),)  # an answer, which is longer than a request
_SAMPLE = (mavlink.flight_array(10**12, (0.5,) * mavlink.FLIGHT_ARRAY_SIZE),)
# What the board sends unasked: rate [Hz] and message.
_BOARD = (
    (1.0, services.heartbeat(True, 2)),
    (1.0, mavlink.sys_status(3900, 0.1, 1, 0.1)),
    (1.0, mavlink.battery(3900)),
    (4.0, mavlink.attitude(10**9, *_U, *_U)),
    (4.0, mavlink.attitude_quaternion(10**9, _Q, *_U)),
    (4.0, mavlink.local_position(10**9, _U, _U)),
    (2.0, mavlink.servo_outputs(10**9, (31_500,) * 4)),
    (1.0, mavlink.estimator_status(10**12, True, 0.1, 0.1)),
    (3.0, services.named_value(10**9, "ten_letter", 0.1)),
    (0.2, services.system_time(10**15, 10**9)),
    (0.2, services.current_mode(Mode.OFFBOARD)),
    (0.2, mavlink.position_target(10**9, _U, 0.1)),
    (0.2, mavlink.hud(_U, _U, 0.1)),
    (0.2, mavlink.actuator_outputs(10**12, (31_500,) * 4)),
    (0.2, mavlink.home_position(10**12, _U)),
    (0.2, mavlink.odometry(10**12, _U, _Q, _U, _U)),
)
