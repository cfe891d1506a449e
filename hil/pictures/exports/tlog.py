"""A flight as a telemetry log of MAVLink, which ground stations and pymavlink open: each frame after its time.

Made from the flight log, for any link: the board's messages about its estimate (HEARTBEAT, ATTITUDE, LOCAL_POSITION_NED,
SERVO_OUTPUT_RAW, BATTERY_STATUS, STATUSTEXT), from system 255 the goal when it changes (SET_POSITION_TARGET_LOCAL_NED)
and the true pose, in a real flight the cameras' (ATT_POS_MOCAP). Times count from the start of the log, in microseconds;
STATUSTEXT "released" is the release. The log has the estimate relative to the goal, which reaches the board some 30 ms
late: after a jump of the goal the estimate here is wrong by that jump for this time.
"""

from collections.abc import Iterator
from math import isfinite
from pathlib import Path
from typing import Any

import pyarrow as pa

from firmware_py.extras import install_command
from firmware_py.geometry import rotate, wrap_angle, yaw_quaternion
from firmware_py.wire.supervisor import State
from hil.errors import LabError, unlinked
from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.metrics import body, column, known

try:
    from firmware_py.wire import mavlink
    from firmware_py.wire import mavlink_services as services
    from firmware_py.wire.mavlink_frames import FrameSender
except ImportError as error:
    raise LabError(f"no telemetry log without its package ({error}): {install_command('mavlink')}") from None

FILE = "flight.tlog"
BOARD, STATION = (1, 1), (255, 190)  # system and component
INFO = 6  # severity of a text
SLOW = 100  # rows between heartbeats, and between voltages: 1 Hz
ROWS = 2  # between motions: 50 Hz, MAVLink's usual best
ESTIMATED = ("x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw", "p", "q", "r")
Sent = tuple[int, tuple[int, int], Any]  # time [us], sender, message


def write_tlog(folder: Path) -> Path:
    """Write `flight.tlog` from the log and the texts of a run folder and return its path. Raises `LabError`."""
    log = load_log(folder)
    texts = [
        (event["t_us"], BOARD, message)
        for number, event in enumerate(load_events(folder), 1)
        for message in services.status_text(INFO, event["text"], number)
    ]
    senders = {who: FrameSender(*who) for who in (BOARD, STATION)}
    path = unlinked(folder / FILE)
    with path.open("wb") as file:
        for us, who, message in sorted((*_flown(log), *texts), key=lambda sent: sent[0]):
            file.write(us.to_bytes(8, "big") + senders[who].encode(us, message))
    return path


def _flown(log: pa.Table) -> Iterator[Sent]:
    log = known(log)
    columns = {name: log.column(name).to_pylist() for name in log.column_names}
    truth = body(log, "x", "y", "z", "qw", "qx", "qy", "qz").tolist()
    goal = column(log, "goal.x", "goal.y", "goal.z", "goal.yaw").tolist()
    estimate = column(log, *(f"estimate.{name}" for name in ESTIMATED)).tolist()
    sent_goal = None
    for row, us in enumerate(columns["t"]):
        if goal[row] != sent_goal:
            sent_goal = goal[row]
            yield us, STATION, mavlink.target(us // 1000, tuple(sent_goal[:3]), sent_goal[3])
        if row % SLOW == 0:
            state = columns["supervisor.state"][row]
            yield us, BOARD, services.heartbeat(state == State.FLYING, state)
            if "battery.voltage" in columns and isfinite(voltage := columns["battery.voltage"][row]):
                yield us, BOARD, mavlink.battery(round(1000 * voltage))
        if row % ROWS == 0:
            yield us, STATION, mavlink.pose(us, tuple(truth[row][:3]), tuple(truth[row][3:]))
            for message in _estimated(us // 1000, goal[row], estimate[row]):
                yield us, BOARD, message
            counts = [int(columns[f"motor.m{servo}"][row]) for servo in (1, 2, 3, 4)]
            yield us, BOARD, mavlink.servo_outputs(us, counts)


def _estimated(ms: int, goal: list[float], estimate: list[float]) -> Iterator[Any]:
    """Yield the log's estimate, converted from the goal frame to the world, as the board reports it."""
    goal_x, goal_y, goal_z, goal_yaw = goal
    x, y, z, vx, vy, vz, roll, pitch, yaw, *rates = estimate
    q_WG = yaw_quaternion(goal_yaw)
    x, y, z = rotate(q_WG, (x, y, z))
    yield mavlink.attitude(ms, roll, pitch, wrap_angle(yaw + goal_yaw), *rates)
    yield mavlink.local_position(ms, (goal_x + x, goal_y + y, goal_z + z), rotate(q_WG, (vx, vy, vz)))
