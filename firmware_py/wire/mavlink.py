"""MAVLink messages and our values: the only file with the standard's units and frames.

Outside: north-east-down (NED) for the world, forward-right-down (FRD) for the body, whatever units the standard has.
Inside: SI, W with z up, B forward-left-up. W and B turn into NED and FRD by half a turn about x, so a vector (x, y, z)
becomes (x, -y, -z), a quaternion (w, x, y, z) becomes (w, x, -y, -z), and pitch and yaw change their signs.

Downlink values saturate where an integer is too narrow and never raise; bad input from outside raises `WireError`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from math import degrees, hypot, isfinite, isnan, nan

import pymavlink.dialects.v20.development as dialect

from firmware_py.geometry import Quaternion, Vector, from_euler_zyx, wrap_angle
from firmware_py.wire import WireError
from firmware_py.wire.crtp import check_place, check_pose
from firmware_py.wire.mavlink_dialect import Message
from firmware_py.wire.mavlink_services import u16, u32
from firmware_py.wire.telemetry import BATTERY, BLOCKS, LOAD, TIMESTAMP_MASK, Sample

POSES = (
    "ATT_POS_MOCAP",
    "VISION_POSITION_ESTIMATE",
    "GLOBAL_VISION_POSITION_ESTIMATE",
    "VICON_POSITION_ESTIMATE",
    "ODOMETRY",
)
# They end a transaction, or answer: no answer is due.
ENDS = ("MISSION_ACK", "COMMAND_ACK", "LOG_REQUEST_END")
# All messages about missions except the request for the list and its end.
MISSION_MESSAGES = (
    *("MISSION_REQUEST_PARTIAL_LIST", "MISSION_WRITE_PARTIAL_LIST", "MISSION_ITEM", "MISSION_REQUEST"),
    *("MISSION_SET_CURRENT", "MISSION_COUNT", "MISSION_CLEAR_ALL", "MISSION_REQUEST_INT", "MISSION_ITEM_INT"),
)

FLIGHT_ARRAY = "floaty"
FLIGHT_ARRAY_SIZE = sum(len(block.variables) for block in BLOCKS) - 4  # without excitation
COUNTS_PER_US = 21  # of the servo timer

_U16_MAX = 0xFFFF
_FRAME_LOCAL_NED = dialect.MAV_FRAME_LOCAL_NED
_IGNORE_POSITION = 0x007  # bits of POSITION_TARGET_TYPEMASK
_IGNORE_VELOCITY, _IGNORE_ACCELERATION, _IGNORE_YAW_RATE = 0x038, 0x1C0, 0x800
_IGNORE_REST = _IGNORE_VELOCITY | _IGNORE_ACCELERATION | _IGNORE_YAW_RATE
_IS_FORCE = 0x200
_IGNORE_YAW = 0x400
_MOCAP_NED = 14  # reserved today, but it is what MAVSDK sends
# With x of W as north, or as forward.
_WORLD_FRAMES = (dialect.MAV_FRAME_LOCAL_NED, _MOCAP_NED, dialect.MAV_FRAME_LOCAL_FRD)
_BODY_FRAME = dialect.MAV_FRAME_BODY_FRD
# The diagonal of a covariance: index and greatest standard deviation [m, rad].
_DIAGONAL = ((0, 0.1), (6, 0.1), (11, 0.1), (15, 0.2), (18, 0.2), (20, 0.2))
_UNKNOWN = (nan, *(0.0,) * 20)  # covariance
_FAILED = -1  # quality of odometry
_STANDARD_GRAVITY = 9.80665  # [m/s^2 per g]
_GYRO_AND_ACCELEROMETER = 0x3F  # fields of HIGHRES_IMU
_IMU = dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO | dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL
_SENSORS = (
    _IMU
    | dialect.MAV_SYS_STATUS_SENSOR_ANGULAR_RATE_CONTROL
    | dialect.MAV_SYS_STATUS_SENSOR_ATTITUDE_STABILIZATION
    | dialect.MAV_SYS_STATUS_SENSOR_YAW_POSITION
    | dialect.MAV_SYS_STATUS_SENSOR_Z_ALTITUDE_CONTROL
    | dialect.MAV_SYS_STATUS_SENSOR_XY_POSITION_CONTROL
    | dialect.MAV_SYS_STATUS_SENSOR_MOTOR_OUTPUTS
)
# A Floaty has no geofence, but MAVProxy would report it as breached otherwise.
_HEALTHY = _SENSORS | dialect.MAV_SYS_STATUS_GEOFENCE
_ESTIMATES = (
    dialect.ESTIMATOR_ATTITUDE
    | dialect.ESTIMATOR_VELOCITY_HORIZ
    | dialect.ESTIMATOR_VELOCITY_VERT
    | dialect.ESTIMATOR_POS_HORIZ_REL
    | dialect.ESTIMATOR_POS_HORIZ_ABS
    | dialect.ESTIMATOR_POS_VERT_ABS
)


@dataclass(frozen=True, slots=True)
class Pose:
    """The body's pose in the world at an instant of the sender's clock."""

    t_us: int
    p_WB: Vector  # [m]
    q_WB: Quaternion  # w x y z, length 0.9..1.1
    frame: int = 0  # another number: the sender has moved the frame, as after a relocalisation


@dataclass(frozen=True, slots=True)
class Target:
    """The goal for a client's target; None stays unchanged."""

    p_WG: Vector | None  # [m]
    yaw: float | None  # [rad] about z up
    moves: bool = False  # whether it has a velocity, acceleration or yaw rate, which is not flown


def turn(v: Vector) -> Vector:
    """Convert a vector of W or B to NED or FRD, and back."""
    return (v[0], -v[1], -v[2])


def turn_quaternion(q: Quaternion) -> Quaternion:
    """Convert `q_WB` to FRD in NED, and back."""
    return (q[0], q[1], -q[2], -q[3])


# Uplink


def pose(t_us: int, p_WB: Vector, q_WB: Quaternion) -> Message:
    """Return the pose of a motion capture frame taken at `t_us` of the sender's clock; the covariance is not stated."""
    return dialect.MAVLink_att_pos_mocap_message(max(0, t_us), turn_quaternion(q_WB), *turn(p_WB))


def read_pose(message: Message) -> Pose:
    """Return the pose in one of `POSES`; `WireError` also for other frames, or a pose declared unreliable."""
    kind = message.get_type()
    if kind == "ODOMETRY":
        _check_odometry(message)
        t_us, q, covariance = message.time_usec, tuple(message.q), message.pose_covariance
    elif kind == "ATT_POS_MOCAP":
        t_us, q, covariance = message.time_usec, tuple(message.q), message.covariance
    else:
        angles = message.roll, message.pitch, message.yaw
        q = from_euler_zyx(*angles) if isfinite(sum(angles)) else (nan, nan, nan, nan)
        t_us, covariance = message.usec, message.covariance
    _check_covariance(covariance)
    p_WB, q_WB = turn((message.x, message.y, message.z)), turn_quaternion(q)
    check_pose(p_WB, q_WB)
    return Pose(t_us, p_WB, q_WB, getattr(message, "reset_counter", 0))


def _check_odometry(message: Message) -> None:
    frames = message.frame_id, message.child_frame_id
    if frames[0] not in _WORLD_FRAMES or frames[1] != _BODY_FRAME:
        raise WireError(
            f"odometry in frames {frames}: {_WORLD_FRAMES}, which are NED, with {_BODY_FRAME}, BODY_FRD, are served"
        )
    if message.quality == _FAILED:
        raise WireError("odometry of quality -1: its sender says that it has failed")
    if message.estimator_type == dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT:
        raise WireError(
            "odometry of an autopilot: that is an estimate, of ours or another's, and no measurement"
        )


def _check_covariance(covariance: Sequence[float]) -> None:
    """Raise `WireError` for a pose whose stated variances are too large for the estimator to neglect.

    NaN first, or zeros, which MAVLink 2 omits: nothing is stated.
    """
    if isnan(covariance[0]):
        return
    if not all(0 <= covariance[index] <= limit * limit for index, limit in _DIAGONAL):
        stated = [covariance[index] for index, _ in _DIAGONAL]
        raise WireError(f"pose with variances {stated}: at most (0.1 m)^2 and (0.2 rad)^2 are of use")


def target(t_ms: int, p_WG: Vector | None, yaw: float | None, system: int = 1, component: int = 1) -> Message:
    """Return the goal for the board; None is masked out."""
    mask = _IGNORE_REST | (_IGNORE_POSITION if p_WG is None else 0) | (_IGNORE_YAW if yaw is None else 0)
    x, y, z = turn(p_WG or (0.0, 0.0, 0.0))
    return dialect.MAVLink_set_position_target_local_ned_message(
        u32(t_ms), system, component, _FRAME_LOCAL_NED, mask, x, y, z, 0, 0, 0, 0, 0, 0, -(yaw or 0.0), 0
    )  # fmt: skip


def read_target(message: Message) -> Target:
    """Return the goal in a SET_POSITION_TARGET_LOCAL_NED."""
    mask = message.type_mask
    if message.coordinate_frame != _FRAME_LOCAL_NED:
        raise WireError(f"target in frame {message.coordinate_frame}: LOCAL_NED is flown")
    ignored = mask & _IGNORE_POSITION
    if ignored not in (0, _IGNORE_POSITION) or mask & _IS_FORCE:
        raise WireError("target refused: x, y, z together, and no force")
    if ignored and mask & _IGNORE_REST != _IGNORE_REST:
        raise WireError("target refused: it has a velocity, no position")
    p_WG = None if ignored else turn((message.x, message.y, message.z))
    yaw = None if mask & _IGNORE_YAW else -message.yaw
    if p_WG is None and yaw is None:
        raise WireError("target refused: neither position nor yaw")
    if p_WG is not None:
        check_place(p_WG)
    if yaw is not None and not isfinite(yaw):
        raise WireError(f"target with yaw {yaw} rad: must be finite")
    beside = (
        (_IGNORE_VELOCITY, (message.vx, message.vy, message.vz)),
        (_IGNORE_ACCELERATION, (message.afx, message.afy, message.afz)),
        (_IGNORE_YAW_RATE, (message.yaw_rate,)),
    )
    moves = any(
        mask & ignore != ignore and any(value and not isnan(value) for value in values)
        for ignore, values in beside
    )
    return Target(p_WG, yaw, moves)


# Downlink


def sys_status(
    battery_mV: int, drop_rate: float, errors: int, load: float, imu_alive: bool = True
) -> Message:
    """Return the supply, the share of received frames that were lost, receive errors, and the load, 0..1."""
    healthy = _HEALTHY if imu_alive else _HEALTHY & ~_IMU
    return dialect.MAVLink_sys_status_message(
        _SENSORS, _SENSORS, healthy, round(1000 * min(1.0, max(0.0, load))), u16(battery_mV), -1, -1,
        round(10_000 * min(1.0, max(0.0, drop_rate))), u16(errors), 0, 0, 0, 0,
    )  # fmt: skip


def attitude(t_ms: int, roll: float, pitch: float, yaw: float, p: float, q: float, r: float) -> Message:
    """Return zyx angles [rad] of B in W, and body rates [rad/s]."""
    return dialect.MAVLink_attitude_message(u32(t_ms), roll, -pitch, -yaw, p, -q, -r)


def attitude_quaternion(t_ms: int, q_WB: Quaternion, p: float, q: float, r: float) -> Message:
    """Return the attitude as a quaternion, and body rates [rad/s]."""
    return dialect.MAVLink_attitude_quaternion_message(u32(t_ms), *turn_quaternion(q_WB), p, -q, -r)


def local_position(t_ms: int, p_WB: Vector, v_W: Vector) -> Message:
    """Return position [m] and velocity [m/s] in the world."""
    return dialect.MAVLink_local_position_ned_message(u32(t_ms), *turn(p_WB), *turn(v_W))


def position_target(t_ms: int, p_WG: Vector, yaw: float) -> Message:
    """Return the goal in force."""
    return dialect.MAVLink_position_target_local_ned_message(
        u32(t_ms), _FRAME_LOCAL_NED, _IGNORE_REST, *turn(p_WG), 0, 0, 0, 0, 0, 0, wrap_angle(-yaw), 0
    )


def hud(p_WB: Vector, v_W: Vector, yaw: float) -> Message:
    """Return speed over ground, heading, height and climb; the air speed is not known, and there is no throttle."""
    heading = round(degrees(-yaw)) % 360
    return dialect.MAVLink_vfr_hud_message(nan, hypot(v_W[0], v_W[1]), heading, 0, p_WB[2], v_W[2])


def servo_outputs(t_us: int, counts: Sequence[int]) -> Message:
    """Return the pulse lengths of the four servos [us], from timer counts."""
    return dialect.MAVLink_servo_output_raw_message(u32(t_us), 0, *_pulses_us(counts), 0, 0, 0, 0)


def actuator_outputs(t_us: int, counts: Sequence[int]) -> Message:
    """Return the same in the newer message."""
    pulses = _pulses_us(counts)
    return dialect.MAVLink_actuator_output_status_message(
        max(0, t_us), (1 << len(pulses)) - 1, (*map(float, pulses), *(0.0,) * (32 - len(pulses)))
    )


def _pulses_us(counts: Sequence[int]) -> tuple[int, ...]:
    return tuple(u16((count + COUNTS_PER_US // 2) // COUNTS_PER_US) for count in counts)


def battery(battery_mV: int) -> Message:
    """Return the supply as one cell; current and charge are not measured."""
    voltages = [u16(battery_mV)] + [_U16_MAX] * 9
    return dialect.MAVLink_battery_status_message(0, 0, 0, 0x7FFF, voltages, -1, -1, -1, -1)


def estimator_status(t_us: int, healthy: bool, std_xy: float, std_z: float) -> Message:
    """Return whether the estimates may be used, and the standard deviations of the position [m]."""
    return dialect.MAVLink_estimator_status_message(
        max(0, t_us), _ESTIMATES if healthy else 0, 0, 0, 0, 0, 0, 0, std_xy, std_z
    )


def home_position(t_us: int, p_WG: Vector) -> Message:
    """Return the goal as home; there is no geographic position."""
    return dialect.MAVLink_home_position_message(
        0, 0, 0, *turn(p_WG), (1.0, 0.0, 0.0, 0.0), 0.0, 0.0, 0.0, max(0, t_us)
    )


def global_position(t_ms: int, p_WB: Vector, v_W: Vector, yaw: float, home_z: float) -> Message:
    """Return height, velocity and heading; latitude and longitude stay 0, because they are not known."""
    vx, vy, vz = (_i16(100 * speed) for speed in turn(v_W))
    heading = round(100 * degrees(-yaw)) % 36_000
    return dialect.MAVLink_global_position_int_message(
        u32(t_ms), 0, 0, round(1000 * p_WB[2]), round(1000 * (p_WB[2] - home_z)), vx, vy, vz, heading
    )


def odometry(t_us: int, p_WB: Vector, q_WB: Quaternion, v_B: Vector, rates: Vector) -> Message:
    """Return pose in the world, velocity [m/s] and rates [rad/s] in the body; the covariances are not stated."""
    return dialect.MAVLink_odometry_message(
        max(0, t_us), _FRAME_LOCAL_NED, _BODY_FRAME, *turn(p_WB), turn_quaternion(q_WB), *turn(v_B), *turn(rates),
        _UNKNOWN, _UNKNOWN, 0, dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT, 0,
    )  # fmt: skip


def imu(t_us: int, rates: Vector, acceleration: Vector) -> Message:
    """Return the measured rates [rad/s, B] and acceleration [g, B]; there are no other sensors."""
    x, y, z = (_STANDARD_GRAVITY * g for g in acceleration)
    return dialect.MAVLink_highres_imu_message(
        max(0, t_us), *turn((x, y, z)), *turn(rates), 0, 0, 0, 0, 0, 0, 0, _GYRO_AND_ACCELEROMETER
    )


def flight_array(t_us: int, values: Sequence[float]) -> Message:
    """Return the samples of `telemetry.BLOCKS` in their order, relative to the goal as the board knows them, in SI.

    The excitation comes last: zeros at the end are not sent.
    """
    data = (*values, *(0.0,) * (58 - len(values)))
    return dialect.MAVLink_debug_float_array_message(max(0, t_us), FLIGHT_ARRAY.encode(), 0, data)


# Downlink, at the station


def read_flight_array(message: Message) -> tuple[Sample, ...]:
    if message.name != FLIGHT_ARRAY:
        raise WireError(f"array {message.name!r}: not {FLIGHT_ARRAY!r}")
    values, timestamp_ms = iter(message.data), message.time_usec // 1000 & TIMESTAMP_MASK
    return tuple(Sample(block, timestamp_ms, tuple(islice(values, len(block.variables)))) for block in BLOCKS)


def read_sys_status(message: Message, timestamp_ms: int) -> tuple[Sample, ...]:
    """Return the samples in a SYS_STATUS, which has no own time; NaN for an unknown voltage."""
    voltage = nan if message.voltage_battery == _U16_MAX else 1e-3 * message.voltage_battery
    return Sample(BATTERY, timestamp_ms, (voltage,)), Sample(LOAD, timestamp_ms, (0.1 * message.load,))


def _i16(value: float) -> int:
    """Return the nearest number that signed 16 bits can hold."""
    return round(max(-0x8000, min(0x7FFF, value)))
