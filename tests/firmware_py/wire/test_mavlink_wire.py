"""MAVLink's units and frames against scipy and pymavlink: north-east-down outside, z up inside.

What a board (`test_mavlink_board.py`, `test_mavlink_on_request.py`) and a link (`test_mavlink_link.py`) show of poses,
targets, texts and streams is judged there.
"""

from math import inf, nan
from typing import Any

import numpy as np
import pymavlink.dialects.v20.development as dialect
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from firmware_py.wire import WireError, mavlink, telemetry
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.mavlink_frames import FrameSender
from firmware_py.wire.mavlink_numbers import Mode
from firmware_py.wire.supervisor import State
from support.crtp_client import PARAM, CrtpClient

# NED seen from W and FRD seen from B: x stays, y and z turn over.
D = np.diag([1.0, -1.0, -1.0])
V = (1.0, 2.0, 3.0)
U = (-4.0, 5.0, -6.0)
ANGLES = (0.1, 0.2, 0.3)  # roll, pitch, yaw
R_WB = Rotation.from_euler("ZYX", ANGLES[::-1])
R_NED_FRD = Rotation.from_matrix(D @ R_WB.as_matrix() @ D)
Q_WB = tuple(R_WB.as_quat(scalar_first=True).tolist())
SMALL = 1e-6  # float32


def over_the_wire(message: Any) -> Any:
    """What pymavlink reads from our frame."""
    return dialect.MAVLink(None).decode(bytearray(FrameSender(1, 1).encode(0, message)))


def vector(message: Any, names: str) -> list[float]:
    return [getattr(message, name) for name in names.split()]


def near(expected: Any) -> Any:
    return pytest.approx(np.asarray(expected).tolist(), abs=SMALL)


# Uplink


@pytest.mark.parametrize("kind", ["vision", "global_vision", "vicon"])
def test_a_pose_in_angles_is_read(kind: str) -> None:
    yaw, pitch, roll = R_NED_FRD.as_euler("ZYX")
    create = getattr(dialect, f"MAVLink_{kind}_position_estimate_message")
    pose = mavlink.read_pose(over_the_wire(create(99, *(D @ V), roll, pitch, yaw)))
    assert (pose.t_us, pose.p_WB, pose.q_WB) == (99, near(V), near(Q_WB))


NED, FRD_WORLD, BODY_FRD = (
    dialect.MAV_FRAME_LOCAL_NED,
    dialect.MAV_FRAME_LOCAL_FRD,
    dialect.MAV_FRAME_BODY_FRD,
)
NOT_STATED = (nan, *(0.0,) * 20)
SENSED = dialect.MAV_ESTIMATOR_TYPE_MOCAP


def odometry(
    world: int = NED,
    body: int = BODY_FRD,
    covariance: Any = NOT_STATED,
    estimator: int = SENSED,
    quality: int = 0,
) -> Any:
    q = R_NED_FRD.as_quat(scalar_first=True)
    return over_the_wire(
        dialect.MAVLink_odometry_message(
            99, world, body, *(D @ V), q, 0, 0, 0, 0, 0, 0, covariance, NOT_STATED, 0, estimator, quality
        )
    )


@pytest.mark.parametrize("world", [NED, 14, FRD_WORLD])  # 14: MOCAP_NED, as MAVSDK still calls it
@pytest.mark.parametrize("quality", [0, 1, 100])
def test_odometry_is_a_pose(world: int, quality: int) -> None:
    pose = mavlink.read_pose(odometry(world, quality=quality))
    assert (pose.t_us, pose.p_WB, pose.q_WB) == (99, near(V), near(Q_WB))


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"world": dialect.MAV_FRAME_BODY_FRD}, "frames"),
        ({"world": dialect.MAV_FRAME_LOCAL_ENU}, "frames"),
        ({"world": dialect.MAV_FRAME_LOCAL_FLU}, "frames"),
        ({"world": dialect.MAV_FRAME_GLOBAL}, "frames"),
        ({"body": dialect.MAV_FRAME_LOCAL_FRD}, "frames"),
        ({"body": dialect.MAV_FRAME_LOCAL_NED}, "frames"),
        ({"quality": -1}, "failed"),
        ({"estimator": dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT}, "autopilot"),
    ],
)
def test_foreign_odometry_is_refused(options: dict[str, int], why: str) -> None:
    with pytest.raises(WireError, match=why):
        mavlink.read_pose(odometry(**options))


def triangle(position: float, attitude: float) -> list[float]:
    """The upper right of a diagonal covariance, of standard deviations."""
    diagonal = np.diag([position**2] * 3 + [attitude**2] * 3)
    return diagonal[np.triu_indices(6)].tolist()  # type: ignore[no-any-return]


def with_covariance(covariance: Any) -> list[Any]:
    """A message of each kind."""
    angles = [
        over_the_wire(getattr(dialect, f"MAVLink_{kind}_message")(99, *V, 0, 0, 0, covariance))
        for kind in ("vision_position_estimate", "global_vision_position_estimate", "vicon_position_estimate")
    ]
    mocap = over_the_wire(dialect.MAVLink_att_pos_mocap_message(99, (1, 0, 0, 0), *V, covariance))
    return [*angles, mocap, odometry(covariance=covariance)]


@pytest.mark.parametrize(
    "covariance", [[0.0] * 21, NOT_STATED, [nan] * 21, triangle(0.002, 0.01), triangle(0.1, 0.2)]
)
def test_a_pose_whose_covariance_is_small_or_not_stated_counts(covariance: Any) -> None:
    for message in with_covariance(covariance):
        assert mavlink.read_pose(message).t_us == 99


def spoilt(index: int, value: float) -> list[float]:
    covariance = triangle(0.01, 0.01)
    covariance[index] = value
    return covariance


@pytest.mark.parametrize(
    "covariance",
    [
        spoilt(0, 0.011), spoilt(6, 0.011), spoilt(11, 0.011), spoilt(15, 0.041), spoilt(18, 0.041), spoilt(20, 0.041),
        spoilt(0, -1e-6), spoilt(11, nan), spoilt(20, inf),
    ],
)  # fmt: skip
def test_a_pose_of_large_covariance_is_refused(covariance: list[float]) -> None:
    for message in with_covariance(covariance):
        with pytest.raises(WireError, match="variances"):
            mavlink.read_pose(message)


def test_masked_parts_of_a_target_are_none() -> None:
    only_yaw = mavlink.read_target(over_the_wire(mavlink.target(0, None, 0.5)))
    assert (only_yaw.p_WG, only_yaw.yaw) == (None, near(0.5))
    only_position = mavlink.read_target(over_the_wire(mavlink.target(0, V, None)))
    assert (only_position.p_WG, only_position.yaw) == (near(V), None)


X, Y, Z = 1, 2, 4
FORCE, NO_YAW = 512, 1024


@pytest.mark.parametrize(
    ("frame", "mask", "x"),
    [
        (dialect.MAV_FRAME_BODY_NED, 0, 1.0),
        (dialect.MAV_FRAME_LOCAL_OFFSET_NED, 0, 1.0),
        (dialect.MAV_FRAME_GLOBAL, 0, 1.0),
        (dialect.MAV_FRAME_LOCAL_NED, X, 1.0),
        (dialect.MAV_FRAME_LOCAL_NED, Y | Z, 1.0),
        (dialect.MAV_FRAME_LOCAL_NED, X | Y | Z | NO_YAW, 1.0),  # velocity only
        (dialect.MAV_FRAME_LOCAL_NED, FORCE, 1.0),
        (dialect.MAV_FRAME_LOCAL_NED, 0, nan),
        (dialect.MAV_FRAME_LOCAL_NED, 0, inf),
        (dialect.MAV_FRAME_LOCAL_NED, 0, 1001.0),
    ],
)
def test_an_unsupported_target_is_refused(frame: int, mask: int, x: float) -> None:
    message = dialect.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, frame, mask, x, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0
    )
    with pytest.raises(WireError, match=r"target|position \("):
        mavlink.read_target(over_the_wire(message))


BESIDE = {"vx": 8, "vy": 16, "vz": 32, "afx": 64, "afy": 128, "afz": 256, "yaw_rate": 2048}  # and their masks
GROUPS = ({"vx", "vy", "vz"}, {"afx", "afy", "afz"}, {"yaw_rate"})


@pytest.mark.parametrize("name", BESIDE)
def test_each_part_beside_position_and_yaw_is_seen_unless_its_group_is_masked(name: str) -> None:
    group = next(sum(BESIDE[one] for one in group) for group in GROUPS if name in group)
    others = group - BESIDE[name]
    for value, ignored, moves in (
        (1.0, 0, True), (nan, 0, False), (0.0, 0, False), (1.0, group, False), (1.0, others, True),
    ):  # fmt: skip
        fields = {one: value * (one == name) for one in BESIDE} | {name: value}
        mask = (sum(BESIDE.values()) - group) | ignored
        message = dialect.MAVLink_set_position_target_local_ned_message(
            0,
            1,
            1,
            1,
            mask,
            *V,
            **{one: fields[one] for one in list(BESIDE)[:6]},
            yaw=0.5,
            yaw_rate=fields["yaw_rate"],
        )
        assert mavlink.read_target(over_the_wire(message)).moves == moves
        message.type_mask |= X | Y | Z
        if not ignored:
            with pytest.raises(WireError, match="no position"):
                mavlink.read_target(over_the_wire(message))


def test_station_is_a_station_whose_requests_are_addressed_to_the_board() -> None:
    for request in (
        services.parameter_list(7), services.parameter_read(7, "A"), services.parameter_set(7, "A", 1.0),
        services.command(7, 400), mavlink.target(0, V, 0.0, 7, 1),
    ):  # fmt: skip
        assert vector(over_the_wire(request), "target_system target_component") == [7, 1]
    message = over_the_wire(services.station_heartbeat())
    assert (message.type, message.autopilot) == (dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID)
    assert not message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED


# Downlink


def test_attitude_home_and_version_are_the_standards() -> None:
    attitude = over_the_wire(mavlink.attitude(77, *ANGLES, *U))
    assert vector(attitude, "yaw pitch roll") == near(R_NED_FRD.as_euler("ZYX"))
    quaternion = over_the_wire(mavlink.attitude_quaternion(77, Q_WB, *U))
    assert vector(quaternion, "q1 q2 q3 q4") == near(R_NED_FRD.as_quat(scalar_first=True))
    for message in (attitude, quaternion):
        assert vector(message, "rollspeed pitchspeed yawspeed") == near(D @ U)
    home = over_the_wire(mavlink.home_position(88, V))
    assert (vector(home, "x y z"), home.q, home.time_usec) == (near(D @ V), [1.0, 0.0, 0.0, 0.0], 88)
    version = over_the_wire(services.autopilot_version((1, 2, 3), b"abcdefghij", 0x1234))
    assert version.flight_sw_version.to_bytes(4, "big")[:3] == bytes((1, 2, 3))
    assert bytes(version.flight_custom_version) == b"abcdefgh"
    assert not version.capabilities & dialect.MAV_PROTOCOL_CAPABILITY_FTP


@pytest.mark.long
@given(st.floats(-7.0, 7.0) | st.sampled_from([0.0, 1e-5, -1e-5, np.pi, -np.pi, 2 * np.pi]))
def test_a_heading_is_the_yaw_clockwise_from_north_and_less_than_a_full_turn(yaw: float) -> None:
    north = np.degrees(-yaw)
    for message, name, unit in (
        (mavlink.hud(V, U, yaw), "heading", 1.0), (mavlink.global_position(1, V, U, yaw, 0.0), "hdg", 0.01),
    ):  # fmt: skip
        found = unit * getattr(over_the_wire(message), name)
        assert 0.0 <= found < 360.0 - unit / 2
        assert abs((found - north + 180.0) % 360.0 - 180.0) <= 0.5001 * unit


@pytest.mark.parametrize(
    ("state", "status"), list(enumerate(("CALIBRATING", "STANDBY", "ACTIVE", "CRITICAL")))
)
def test_heartbeat_tells_state_and_arming(state: int, status: str) -> None:
    for armed in (False, True):
        message = over_the_wire(services.heartbeat(armed, state))
        # With INVALID no client takes us for a vehicle.
        assert message.autopilot == dialect.MAV_AUTOPILOT_GENERIC
        assert message.custom_mode == Mode.HOLD
        assert services.read_heartbeat(message) == state
        assert message.system_status == getattr(dialect, f"MAV_STATE_{status}")
        assert bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED) == armed
        assert message.base_mode & dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        assert bool(message.base_mode & dialect.MAV_MODE_FLAG_GUIDED_ENABLED) == (state == State.FLYING)


def test_status_has_the_standards_units() -> None:
    message = over_the_wire(mavlink.sys_status(3900, 0.05, 70_000, 0.25))
    assert (message.voltage_battery, message.drop_rate_comm, message.load) == (3900, 500, 250)
    assert message.errors_comm == 65_535
    present = message.onboard_control_sensors_present
    assert present == message.onboard_control_sensors_enabled
    assert message.onboard_control_sensors_health == present | dialect.MAV_SYS_STATUS_GEOFENCE
    assert not present & dialect.MAV_SYS_STATUS_GEOFENCE
    assert present & dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
    stale = over_the_wire(mavlink.sys_status(3900, 0.05, 0, 0.25, imu_alive=False))
    failed = dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO | dialect.MAV_SYS_STATUS_SENSOR_3D_ACCEL
    assert stale.onboard_control_sensors_health == message.onboard_control_sensors_health & ~failed
    pulses, counts = [1499, 1500, 1500, 1501], (31_489, 31_490, 31_510, 31_511)  # 21 a microsecond
    raw = over_the_wire(mavlink.servo_outputs(7, counts))
    assert vector(raw, "servo1_raw servo2_raw servo3_raw servo4_raw") == pulses
    assert over_the_wire(mavlink.actuator_outputs(7, counts)).actuator[:5] == [*pulses, 0]


def test_estimator_tells_health_and_accuracy() -> None:
    message = over_the_wire(mavlink.estimator_status(9, True, 0.25, 0.5))
    assert message.flags & dialect.ESTIMATOR_POS_HORIZ_ABS
    assert not message.flags & dialect.ESTIMATOR_PRED_POS_HORIZ_REL
    assert (message.pos_horiz_accuracy, message.pos_vert_accuracy) == (0.25, 0.5)
    assert over_the_wire(mavlink.estimator_status(9, False, 0.25, 0.5)).flags == 0


def test_flight_array_carries_the_telemetry_blocks() -> None:
    values = tuple(float(i) for i in range(1, 29))
    message = over_the_wire(mavlink.flight_array(12_000, values))
    assert (message.name, message.time_usec, message.data[28:]) == ("floaty", 12_000, [0.0] * 30)
    samples = mavlink.read_flight_array(message)
    assert [(sample.block, sample.timestamp_ms) for sample in samples] == [(b, 12) for b in telemetry.BLOCKS]
    assert tuple(value for sample in samples for value in sample.values) == (*values, *4 * (0.0,))
    with pytest.raises(WireError, match="other"):
        mavlink.read_flight_array(
            over_the_wire(dialect.MAVLink_debug_float_array_message(0, b"other", 0, [0.0] * 58))
        )


def test_answers_are_addressed_to_the_sender() -> None:
    station = dialect.MAVLink(None, 255, 230)

    def from_station(message: Any) -> Any:
        return dialect.MAVLink(None).decode(bytearray(message.pack(station)))

    ping = over_the_wire(services.ping_answer(from_station(dialect.MAVLink_ping_message(123, 45, 0, 0))))
    assert vector(ping, "time_usec seq target_system target_component") == [123, 45, 255, 230]
    # sequence 0xFFFF, session 7, opcode 4 (open for reading), size, request opcode, burst, padding, offset
    asked = [0xFF, 0xFF, 7, 4, 12, 0, 0, 0, 1, 2, 3, 4, *b"@PARAM/param.pck"]
    asked += [0] * (251 - len(asked))
    nak = over_the_wire(
        services.ftp_nak(from_station(dialect.MAVLink_file_transfer_protocol_message(0, 1, 1, asked)))
    )
    assert (nak.target_system, nak.target_component) == (255, 230)
    assert nak.payload == [0, 0, 7, 129, 1, 4, 0, 0, 1, 2, 3, 4, 6] + [0] * 238
    ack = over_the_wire(services.command_ack(400, 3, 255, 230))
    assert vector(ack, "command result target_system target_component") == [400, 3, 255, 230]
    assert vector(over_the_wire(services.timesync(5, 6)), "tc1 ts1") == [5, 6]
    assert vector(over_the_wire(services.message_interval(30, -1)), "message_id interval_us") == [30, -1]


big = st.integers(-(1 << 70), 1 << 70)
real = st.floats(width=32)


@given(big, big, real, real, st.text(max_size=80))
def test_nothing_that_goes_down_raises(n: int, m: int, a: float, b: float, text: str) -> None:
    t = abs(n) % (1 << 64)
    v = (a, b, a)
    for message in (
        mavlink.sys_status(n, a, m, b),
        mavlink.battery(n),
        mavlink.attitude(n, *v, *v),
        mavlink.attitude_quaternion(n, (a, b, a, b), *v),
        mavlink.local_position(n, v, v),
        mavlink.servo_outputs(n, (n, m, n, m)),
        mavlink.estimator_status(t, a > b, a, b),
        mavlink.home_position(t, v),
        mavlink.flight_array(t, (a, b) * 14),
        services.named_value(n, text, a),
        *services.status_text(6, text),
        services.parameter(text, a, n, m),
        services.message_interval(n, m),
    ):
        FrameSender(1, 1).encode(0, message)


# Names


def test_parameter_names_are_unique_and_fit() -> None:
    names = list(CrtpClient().toc(PARAM))
    # The stock names behind it are for Crazyflie clients only.
    ours = names[: names.index("activeMarker.back")]
    names = [services.mavlink_name(name) for name in ours]
    assert len(set(names)) == len(ours) > 60
    for name in names:
        assert len(name) <= 16
        assert set(name) <= set("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_")
    assert services.mavlink_name("extCtrl.pitch_rate_P") == "EXT_PITCH_RATE_P"
    assert services.mavlink_name("sound.effect") == "SOUND_EFFECT"
