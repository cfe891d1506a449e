"""What goes out seldom or on request: odometry, IMU, landing, home, heading; against scipy, in the standard's axes."""

import math
from typing import Any

import numpy as np
import pymavlink.dialects.v20.development as dialect
import pytest
from scipy.spatial.transform import Rotation

from support.mavlink_client import GYRO_ZERO_US, MavlinkClient

ON_REQUEST = {
    33: "GLOBAL_POSITION_INT", 105: "HIGHRES_IMU", 148: "AUTOPILOT_VERSION", 245: "EXTENDED_SYS_STATE",
}  # fmt: skip
SELDOM = (
    "SYSTEM_TIME", "POSITION_TARGET_LOCAL_NED", "VFR_HUD", "ACTUATOR_OUTPUT_STATUS", "HOME_POSITION", "ODOMETRY",
)  # fmt: skip
R_WB = Rotation.from_euler("ZYX", (0.6, 0.1, -0.2))
TURN = Rotation.from_euler("x", math.pi)  # W to NED, B to FRD
START, V_W = np.array((-0.3, -0.2, 1.25)), np.array((0.3, 0.2, -0.1))


@pytest.fixture(scope="module")
def moving() -> MavlinkClient:
    """A board that was carried through the tunnel, turned, with a goal that has a yaw."""
    client = MavlinkClient("box.radius=1")
    client.command(400, 0)  # disarmed: no flap moves the model elsewhere than the poses go
    client.send(
        "set_position_target_local_ned", 0, 1, 1, 1, 0x9F8, 0.1, -0.2, -1.3, 0, 0, 0, 0, 0, 0, -0.4, 0
    )
    x, y, z, w = R_WB.as_quat()
    for at_us in range(100_000, 2_000_000, 20_000):
        p_WB = tuple(START + V_W * (at_us * 1e-6))
        client.events.at(at_us, lambda now_us, p=p_WB: client.pose((p, (w, x, y, z)), now_us))
    client.run(2_000_000)
    return client


def once(client: MavlinkClient, number: int) -> Any:
    ack, *answers = client.command(512, number)
    assert ack.result == 0
    (answer,) = [answer for answer in answers if answer.get_type() == dialect.mavlink_map[number].msgname]
    return answer


def velocity(client: MavlinkClient) -> tuple[float, float, float]:
    """In NED [m/s]."""
    found = once(client, 32)
    return found.vx, found.vy, found.vz


@pytest.mark.long
@pytest.mark.parametrize("number", ON_REQUEST)
def test_rare_messages_are_sent_only_on_request_at_the_requested_rate(number: int) -> None:
    client = MavlinkClient()
    client.run(1_500_000)
    assert client.of(ON_REQUEST[number]) == []
    assert client.command(511, number, 50_000)[0].result == 0
    client.messages.clear()
    client.run(client.now_us + 1_000_000)
    assert len(client.of(ON_REQUEST[number])) == 20
    client.command(511, number, 0)  # the default is off
    client.messages.clear()
    client.run(client.now_us + 1_000_000)
    assert client.of(ON_REQUEST[number]) == []


def test_odometry_is_pose_and_motion_of_the_body_in_the_standards_axes(moving: MavlinkClient) -> None:
    found = once(moving, 331)
    assert (found.frame_id, found.child_frame_id) == (dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_FRD)
    t_s = found.time_usec * 1e-6
    assert (found.x, found.y, found.z) == pytest.approx(TURN.apply(START + V_W * t_s), abs=0.02)
    w, x, y, z = found.q
    q = Rotation.from_quat((x, y, z, w))
    assert ((TURN * R_WB * TURN.inv()).inv() * q).magnitude() < 0.08
    expected = q.inv().apply(velocity(moving))
    assert np.linalg.norm(expected) > 0.2
    assert (found.vx, found.vy, found.vz) == pytest.approx(expected, abs=0.02)
    rates = once(moving, 30)
    expected = (rates.rollspeed, rates.pitchspeed, rates.yawspeed)
    assert (found.rollspeed, found.pitchspeed, found.yawspeed) == pytest.approx(expected, abs=0.05)
    assert math.isnan(found.pose_covariance[0])
    assert math.isnan(found.velocity_covariance[0])
    assert found.estimator_type == dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT


def test_height_velocity_and_heading_have_the_standards_units(moving: MavlinkClient) -> None:
    found = once(moving, 33)
    z = (START + V_W * (found.time_boot_ms * 1e-3))[2]
    assert (found.lat, found.lon) == (0, 0)
    assert found.alt == pytest.approx(1000 * z, abs=20)
    assert found.relative_alt == pytest.approx(1000 * (z - 1.15), abs=20)
    assert (found.vx, found.vy, found.vz) == pytest.approx(100 * np.array(velocity(moving)), abs=2)
    assert found.hdg / 100 == pytest.approx(360 - math.degrees(0.6), abs=2)  # clockwise from above


def test_the_imu_measures_in_si_in_the_bodys_axes() -> None:
    client = MavlinkClient()
    client.run(GYRO_ZERO_US)  # three counts of rest are zero from now on
    client.imu[:] = (3 + 1000, -2 + 2000, 1 - 3000, 100, 200, 1365)
    found = once(client, 105)
    to_B = Rotation.from_euler("z", -45, degrees=True)  # x of the sensor lies 45 deg to the right
    rates = TURN.apply(to_B.apply(np.radians(np.array((1000, 2000, -3000)) * 2000 / 32768)))
    force = TURN.apply(to_B.apply(np.array((100, 200, 1365)) * 24 / 32768 * 9.80665))
    assert (found.xgyro, found.ygyro, found.zgyro) == pytest.approx(rates, abs=1e-3)
    assert (found.xacc, found.yacc, found.zacc) == pytest.approx(force, abs=1e-3)
    assert found.zacc == pytest.approx(-9.80, abs=0.01)  # at rest, down is positive
    assert found.fields_updated == 0b111111
    assert 0 <= client.now_us - found.time_usec <= 3000


def test_the_board_reports_whether_it_is_in_the_air() -> None:
    client = MavlinkClient()

    def landed(end_us: int) -> int:
        client.run(end_us)
        return int(once(client, 245).landed_state)

    assert landed(300_000) == dialect.MAV_LANDED_STATE_ON_GROUND  # calibrating
    assert landed(700_000) == dialect.MAV_LANDED_STATE_ON_GROUND  # waiting
    client.poses(710_000, 1_400_000)
    assert landed(1_300_000) == dialect.MAV_LANDED_STATE_IN_AIR
    assert landed(2_100_000) == dialect.MAV_LANDED_STATE_UNDEFINED  # silence


@pytest.mark.long
def test_slow_streams_come_within_five_seconds_with_right_values(moving: MavlinkClient) -> None:
    moving.messages.clear()
    moving.run(moving.now_us + 5_100_000)
    heard = {name: moving.of(name)[-1] for name in SELDOM}
    assert heard["SYSTEM_TIME"].time_unix_usec == 0  # nobody has said what time of day it is
    assert heard["SYSTEM_TIME"].time_boot_ms % 5000 == 0
    target = heard["POSITION_TARGET_LOCAL_NED"]
    assert (target.x, target.y, target.z, target.yaw) == pytest.approx((0.1, -0.2, -1.3, -0.4))
    assert (target.coordinate_frame, target.type_mask) == (dialect.MAV_FRAME_LOCAL_NED, 0x9F8)
    outputs, servos = heard["ACTUATOR_OUTPUT_STATUS"], moving.of("SERVO_OUTPUT_RAW")[-1]
    assert outputs.active == 0b1111
    assert outputs.actuator[:5] == [
        servos.servo1_raw,
        servos.servo2_raw,
        servos.servo3_raw,
        servos.servo4_raw,
        0,
    ]
    assert heard["HOME_POSITION"].z == pytest.approx(-1.15)
    assert heard["ODOMETRY"].estimator_type == dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT


def test_the_hud_shows_speed_over_ground_heading_height_and_climb(moving: MavlinkClient) -> None:
    hud, place = once(moving, 74), once(moving, 32)
    assert hud.groundspeed == pytest.approx(math.hypot(place.vx, place.vy), abs=0.02)
    assert (hud.alt, hud.climb) == pytest.approx((-place.z, -place.vz), abs=0.02)
    assert hud.heading == pytest.approx(360 - math.degrees(0.6), abs=2)
    assert math.isnan(hud.airspeed)


def test_the_time_of_day_is_that_of_a_station_which_knows_it(moving: MavlinkClient) -> None:
    unix_us = 1_700_000_000_000_000
    moving.send(
        "system_time", unix_us - 3_600_000_000, 76
    )  # another one's, or the same before its clock was set
    moving.send("system_time", unix_us, 77)
    sent_us = moving.now_us
    moving.send("system_time", 0, 78)  # this one does not
    moving.run(sent_us + 2_000_000)
    found = once(moving, 2)
    assert found.time_unix_usec - unix_us == pytest.approx(2_000_000, abs=5_000)
    assert found.time_boot_ms == pytest.approx(moving.now_us / 1000, abs=5)
