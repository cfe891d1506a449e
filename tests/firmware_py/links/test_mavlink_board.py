"""The board's MAVLink services, asked by pymavlink's own codec."""

import math
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pymavlink.dialects.v20.development as dialect
import pytest
from scipy.spatial.transform import Rotation

from firmware_py.config import StreamRates
from firmware_py.core.structs import ATTITUDE, POSITION, RATE, VELOCITY
from firmware_py.links.mavlink_streams import GROUPS as SERVED
from firmware_py.links.mavlink_telemetry import PoseInWorld
from firmware_py.links.parameters import Parameter, ParameterStorage
from firmware_py.signals import COUNTERS
from firmware_py.wire import crtp, telemetry
from firmware_py.wire.mavlink import POSES
from firmware_py.wire.mavlink_dialect import NUMBERS
from firmware_py.wire.mavlink_numbers import Mode
from firmware_py.wire.mavlink_services import mavlink_name
from firmware_py.wire.supervisor import Cause, State
from support.firmware_bench import LEVEL, FirmwareBench
from support.mavlink_client import GYRO_ZERO_US, HOME, MavlinkClient, codec, count, lines

DENIED, UNSUPPORTED, TEMPORARILY_REJECTED = 2, 3, 1
IGNORE_POSITION, IGNORE_YAW, IGNORE_REST = 0x7, 0x400, 0x9F8


WIDE = ("box.radius=5", "box.above=5")  # goals at (1, 2, 3)


@pytest.fixture
def client() -> MavlinkClient:
    made = MavlinkClient(*WIDE)
    made.run(20_000)
    return made


def target(
    client: MavlinkClient, p_NED: tuple[float, float, float], yaw_NED: float, mask: int = IGNORE_REST
) -> None:
    client.send("set_position_target_local_ned", 0, 1, 1, 1, mask, *p_NED, 0, 0, 0, 0, 0, 0, yaw_NED, 0)
    client.run(client.now_us + 2000)


def last_pose(client: MavlinkClient) -> tuple[Any, Any, int | None]:
    """Position and quaternion of the last pose as the core files it, and its age as the log variable shows it."""
    values = {variable.name: variable.read for variable in client.firmware.variables}
    data = client.firmware._core.data.fields
    return data.pose_position, Rotation.from_quat(np.roll(data.pose_quaternion, -1)), values["locSrv.age"]()


# Poses and goals


def test_the_correction_is_the_pose_as_seen_from_the_goal(client: MavlinkClient) -> None:
    target(client, (1.0, -2.0, -3.0), -0.5)  # that is (1, 2, 3) with z up, 0.5 rad to the left
    R_WB = Rotation.from_euler("ZYX", (0.8, 0.2, 0.1))
    x, y, z, w = R_WB.as_quat()
    client.pose(((1.1, 2.3, 3.6), (w, x, y, z)))
    client.run(client.now_us + 2000)
    p_GB, R_GB, _ = last_pose(client)
    R_GW = Rotation.from_euler("z", 0.5).inv()
    assert p_GB == pytest.approx(R_GW.apply((0.1, 0.3, 0.6)), abs=1e-6)
    assert (R_GB.inv() * (R_GW * R_WB)).magnitude() < 1e-6


def test_masked_parts_of_a_goal_stay_unchanged(client: MavlinkClient) -> None:
    target(client, (1.0, -2.0, -3.0), -math.pi / 2)
    target(client, (0.0, 0.0, 0.0), math.pi / 2, IGNORE_REST | IGNORE_POSITION)
    client.pose(((2.0, 2.0, 3.0), LEVEL))
    client.run(client.now_us + 2000)
    assert last_pose(client)[0] == pytest.approx((0.0, 1.0, 0.0), abs=1e-6)
    target(client, (2.0, -2.0, -3.0), 1.0, IGNORE_REST | IGNORE_YAW)
    client.pose(((2.0, 2.5, 3.0), LEVEL))
    client.run(client.now_us + 2000)
    assert last_pose(client)[0] == pytest.approx((-0.5, 0.0, 0.0), abs=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(
    ("estimator", "expected"),
    [(dialect.MAV_ESTIMATOR_TYPE_MOCAP, State.FLYING), (dialect.MAV_ESTIMATOR_TYPE_AUTOPILOT, State.WAITING)],
)
def test_odometry_closes_the_loop_unless_it_is_an_autopilots(estimator: int, expected: State) -> None:
    client, unknown = MavlinkClient(), [math.nan] + [0.0] * 20
    fields = (1, 12, 0, 0, -1.15, LEVEL, 0, 0, 0, 0, 0, 0, unknown, unknown, 0, estimator)
    for at_us in range(GYRO_ZERO_US, 1_000_000, 20_000):
        client.events.at(at_us, lambda now_us: client.send("odometry", now_us, *fields))
    client.run(1_000_000)
    assert client.firmware.signals.supervisor.state is expected


def test_poses_close_the_loop_and_silence_opens_it() -> None:
    client = MavlinkClient()
    client.poses(GYRO_ZERO_US, 1_000_000)
    client.run(1_000_000)
    assert client.firmware.signals.supervisor.state is State.FLYING
    client.run(1_600_000)
    assert client.firmware.signals.supervisor.cause is Cause.SILENCE
    assert [text for text in client.texts() if text.startswith("supervisor")] == [
        "supervisor: waiting",
        "supervisor: flying",
        "supervisor: failsafe, silence",
    ]
    assert [message.severity for message in client.of("STATUSTEXT")][-1] == dialect.MAV_SEVERITY_WARNING


# Ages


@pytest.mark.parametrize("ahead_us", [0, 1_700_000_000_000_000, -90_000])
def test_the_age_of_a_pose_is_true_whatever_the_stations_clock_shows(ahead_us: int) -> None:
    client = MavlinkClient()
    client.clock_ahead_us = ahead_us
    client.poses(200_000, 4_500_000, lag_us=35_000)
    client.run(4_500_000)
    assert len(client.of("TIMESYNC")) >= 12
    # At the estimator's tick.
    assert client.firmware.signals.counters[-1] == pytest.approx(35_000, abs=20_000)
    _, *ages_ms = [m.value for m in client.of("NAMED_VALUE_FLOAT") if m.name == "age_ms"]
    assert ages_ms == pytest.approx([35.0] * 3, abs=1.0)  # the clocks that agree are found to agree at last


@pytest.mark.parametrize(
    ("lag_us", "age_us"), [(-5_020, None), (-4_980, 0), (-200, 0), (499_980, 499_980), (500_020, None)]
)
def test_ages_within_the_clock_error_are_zero_else_unknown(lag_us: int, age_us: int | None) -> None:
    client = MavlinkClient()
    client.clock_ahead_us = 0
    client.send("heartbeat", 6, 8, 0, 0, 4, 3)
    client.run(2_000_000)
    service: Any = client.stack._handlers[NUMBERS[POSES[0]]].__self__  # type: ignore[attr-defined]

    def age_of(lag_us: int) -> int | None:
        client.pose(t_us=client.now_us - lag_us)
        client.run(client.now_us + 5_000)
        return service.age_us

    usual = age_of(100_000)
    assert usual is not None
    found = age_of(lag_us - (usual - 100_000))  # on its arrival, whatever the line takes
    assert found == (age_us if not age_us else pytest.approx(age_us, abs=100))
    client.command(512, NUMBERS["NAMED_VALUE_FLOAT"])
    (age_ms,) = [m.value for m in client.of("NAMED_VALUE_FLOAT") if m.name == "age_ms"][-1:]
    assert age_ms == pytest.approx(-1.0 if found is None else 1e-3 * found)


@pytest.mark.long
@pytest.mark.parametrize(
    ("clock_us", "asked_ms"),
    [
        (0, [97, 194, 291, 388, 485, 582, 1069, 1556, 2043, 2530]),
        (None, [*range(97, 50 * 97 + 1, 97), 50 * 97 + 487, 50 * 97 + 2 * 487]),
    ],
)
def test_the_clock_is_asked_ten_times_a_second_until_five_answers_or_five_seconds_then_twice(
    clock_us: int | None, asked_ms: list[int]
) -> None:
    client = MavlinkClient()
    client.clock_ahead_us = clock_us
    client.send("heartbeat", 6, 8, 0, 0, 4, 3)
    client.run(asked_ms[-1] * 1000 + 450_000)
    times = [t_us // 1000 for t_us, message in client.messages if message.get_type() == "TIMESYNC"]
    assert times == asked_ms


def test_poses_that_are_too_old_are_counted_and_named() -> None:
    client = MavlinkClient()
    client.clock_ahead_us = 5_000_000
    client.poses(1_000_000, 2_000_000, lag_us=222_000)
    client.run(2_600_000)
    (line,) = [text for text in client.texts() if text.startswith("poses")]
    age_ms, limit = re.fullmatch(r"poses (\d+) ms old: at most (\d+) ms", line).groups()  # type: ignore[union-attr]
    assert (int(age_ms), limit) == (pytest.approx(228, abs=8), "120")  # at the estimator's tick
    assert [m.value for m in client.of("NAMED_VALUE_FLOAT") if m.name == "refused"][-1] >= 45


@pytest.mark.parametrize(
    ("back_us", "said"),
    [(980_000, ["poses of 255/190 and 255/200 in turn: their age stays unknown"]), (1_020_000, [])],
)
def test_two_senders_of_poses_within_a_second_are_named_and_one_that_takes_over_is_not(
    back_us: int, said: list[str]
) -> None:
    client, other = MavlinkClient(), codec(255, 200)

    def pose(now_us: int) -> None:
        message = other.att_pos_mocap_encode(now_us, [1.0, 0.0, 0.0, 0.0], 0.0, 0.0, -1.15)
        client.receive(message.pack(other))

    client.poses(100_000, 500_001)
    for at_us in range(520_000, 500_000 + back_us, 20_000):
        client.events.at(at_us, pose)
    client.poses(500_000 + back_us, 500_000 + back_us + 1)
    client.run(1_600_000)
    assert [text for text in client.texts() if "in turn" in text] == said


VISION = "vision_position_estimate", "global_vision_position_estimate"


@pytest.mark.parametrize("kind", [*VISION, "odometry"])
@pytest.mark.parametrize("counted", [False, True])
def test_the_goal_moves_with_the_frame_of_the_poses_so_the_robot_does_not(kind: str, counted: bool) -> None:
    client, unknown = MavlinkClient(), [math.nan] + [0.0] * 20

    def pose(now_us: int) -> None:
        late = now_us >= 1_500_000
        x, y, z, yaw = (0.3, -0.2, -1.3, -1.7) if late else (0.05, 0.02, -1.2, 1.7)  # NED
        resets = 255 if late and counted else 7
        if kind in VISION:
            client.send(kind, now_us, x, y, z, 0.0, 0.0, yaw, unknown, resets)
            return
        frames = dialect.MAV_FRAME_LOCAL_NED, dialect.MAV_FRAME_BODY_FRD
        turned = math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)
        client.send(kind, now_us, *frames, x, y, z, turned, *(0.0,) * 6, unknown, unknown, resets)

    for at_us in range(GYRO_ZERO_US, 2_000_000, 20_000):
        client.events.at(at_us, pose)
    client.run(1_490_000)
    before = client.firmware.signals.estimate[:9].copy()
    client.run(2_000_000)
    counters = dict(zip(COUNTERS, client.firmware.signals.counters.tolist(), strict=True))
    assert (counters["refused"], counters["jumps"]) == ((0, 0) if counted else (1, 1))
    assert (client.firmware.signals.estimate[:9] == pytest.approx(before, abs=0.02)) == counted
    report = client.of("LOCAL_POSITION_NED")[-1]
    assert (report.x, report.y, report.z) == pytest.approx((0.3, -0.2, -1.3), abs=0.03)
    said = ["poses: their frame has moved by 0.35 m, and the goal with it"] if counted else []
    assert [text for text in client.texts() if "frame" in text] == said
    client.command(512, NUMBERS["POSITION_TARGET_LOCAL_NED"])
    assert client.of("POSITION_TARGET_LOCAL_NED")[-1].yaw == pytest.approx(math.tau - 3.4 if counted else 0.0)


def test_another_sender_is_no_relocalisation() -> None:
    client, other = MavlinkClient(), codec(7, 8)

    def pose(now_us: int) -> None:
        sender, resets = (client.codec, 3) if now_us < 1_000_000 else (other, 4)
        message = sender.vision_position_estimate_encode(
            now_us, 0.0, 0.0, -1.15, 0.0, 0.0, 0.0, [math.nan] + [0.0] * 20, resets
        )
        client.receive(message.pack(sender))

    for at_us in range(GYRO_ZERO_US, 1_500_000, 20_000):
        client.events.at(at_us, pose)
    client.run(1_600_000)
    assert dict(zip(COUNTERS, client.firmware.signals.counters.tolist(), strict=True))["jumps"] == 0
    assert not any("frame" in text for text in client.texts())


@pytest.mark.long
def test_only_the_clock_of_the_sender_of_poses_counts() -> None:
    client = MavlinkClient()
    client.clock_ahead_us = 5_000_000
    client.poses(100_000, 1_500_000, lag_us=30_000)
    other = codec(7, 7)

    def lie(now_us: int) -> None:  # just when the next request leaves, and in time for the answer
        requests = [message for message in client.of("TIMESYNC") if message.tc1 == 0]
        if requests:
            client.receive(other.timesync_encode(1, requests[-1].ts1).pack(other))
        if now_us % 10_000 == 0:
            client.receive(other.heartbeat_encode(6, 8, 0, 0, 4).pack(other))

    for at_us in range(100_000, 1_500_000, 1000):
        client.events.at(at_us, lie)
    client.run(1_500_000)
    (age_ms,) = [m.value for m in client.of("NAMED_VALUE_FLOAT") if m.name == "age_ms"][-1:]
    assert age_ms == pytest.approx(30.0, abs=1.0)


# Streams


@pytest.mark.long
def test_after_boot_every_stream_keeps_its_rate() -> None:
    client = MavlinkClient()
    client.run(5_100_000)
    counts = count(message for _, message in client.messages)
    counts.pop("STATUSTEXT")
    assert counts == {
        "HEARTBEAT": 5, "SYS_STATUS": 5, "BATTERY_STATUS": 5, "ATTITUDE": 20, "ATTITUDE_QUATERNION": 20,
        "LOCAL_POSITION_NED": 20, "SERVO_OUTPUT_RAW": 10, "ESTIMATOR_STATUS": 5, "NAMED_VALUE_FLOAT": 25,
        "SYSTEM_TIME": 1, "CURRENT_MODE": 1, "POSITION_TARGET_LOCAL_NED": 1, "VFR_HUD": 1,
        "ACTUATOR_OUTPUT_STATUS": 1, "HOME_POSITION": 1, "ODOMETRY": 1,
    }  # fmt: skip
    assert client.of("HEARTBEAT")[0].autopilot == dialect.MAV_AUTOPILOT_GENERIC
    assert client.of("HEARTBEAT")[0].get_srcComponent() == 1


def test_an_interval_is_set_read_switched_off_and_reset(client: MavlinkClient) -> None:
    def interval() -> int:
        answers = []
        for request in ((510, 30), (512, 244, 30)):  # the older way and the present one
            ack, answer = [a for a in client.command(*request) if a.get_type() != "ATTITUDE"]
            assert (ack.command, ack.result) == (request[0], 0)
            assert answer.message_id == 30
            answers.append(int(answer.interval_us))
        assert answers[0] == answers[1]
        return answers[0]

    def attitudes() -> int:
        client.messages.clear()
        client.run(client.now_us + 1_000_000)
        return len(client.of("ATTITUDE"))

    assert interval() == 250_000
    assert client.command(511, 30, 20_000)[0].result == 0
    assert (interval(), attitudes()) == (20_000, 50)
    assert client.command(511, 30, -1)[0].result == 0
    assert (interval(), attitudes()) == (-1, 0)
    assert client.command(511, 30, 0)[0].result == 0
    assert (interval(), attitudes()) == (250_000, 4)
    for wish_us, given_us in ((1, 1000), (1400, 1000), (1600, 2000)):  # whole ticks
        assert client.command(511, 30, wish_us)[0].result == 0
        assert interval() == given_us
    assert client.command(511, 30, 4e9)[0].result == 0  # longer than the report's field can state
    assert interval() == 1_000_000_000
    assert (
        client.command(510, 3)[1].interval_us == client.command(510, 65_535)[1].interval_us == 0
    )  # never sent
    assert client.command(510, 0)[1].interval_us == 1_000_000  # of heartbeats
    assert client.command(510, 65_536)[0].result == DENIED
    assert client.command(511, 0, 0)[0].result == 0  # of heartbeats the default alone may be asked for


@pytest.mark.long
@pytest.mark.parametrize(
    "params",
    [
        *((511, *interval) for interval in ((30, math.nan), (30, -2), (30, 0.5), (math.nan, 1000), (1e30, 1000))),
        *((511, *interval) for interval in ((3, 1000), (0, -1), (0, 60_000_000))),  # heartbeats are a board's life
        (400, 2), (400, math.nan), (185, 0), (185, 2), (245, 0), (245, 2), (246, 0), (246, 2), (246, math.nan),
    ],
)  # fmt: skip
def test_impossible_command_parameters_are_denied(client: MavlinkClient, params: tuple[float, ...]) -> None:
    assert client.command(*params)[0].result == DENIED  # type: ignore[arg-type]
    assert client.firmware.signals.supervisor.armed
    client.messages.clear()
    client.run(client.now_us + 2_000_000)
    assert len(client.of("HEARTBEAT")) == 2


def test_unused_fields_may_be_nan(client: MavlinkClient) -> None:
    assert client.command(176, 1, 6, math.nan)[0].result == 0
    assert any("mode: offboard" in text for text in client.texts())
    unused = client.command(420, 0, 1, math.nan)[0].result
    assert unused == client.command(420, 0, 1, 0)[0].result


@pytest.mark.parametrize(
    ("unix_us", "refused"), [(2**64 - 1, True), (7_258_118_400_000_001, True), (7_258_118_400_000_000, False)]
)
def test_a_time_of_day_after_the_year_2200_is_refused(
    client: MavlinkClient, unix_us: int, refused: bool
) -> None:
    client.send("system_time", unix_us, 5)
    client.run(client.now_us + 3000)
    assert any("after the year 2200" in text for text in client.texts()) == refused
    client.command(512, 2)
    assert (client.of("SYSTEM_TIME")[-1].time_unix_usec == 0) == refused


def test_headings_of_goal_and_robot_are_reported_within_half_a_turn(client: MavlinkClient) -> None:
    target(client, (0.0, 0.0, -1.15), math.radians(530))
    north_to_back = (
        math.cos(math.radians(85)),
        0.0,
        0.0,
        math.sin(math.radians(85)),
    )  # 20 deg beyond the goal
    for at_us in range(GYRO_ZERO_US, 1_000_000, 20_000):
        client.events.at(at_us, lambda now_us: client.pose((HOME[0], north_to_back), now_us))
    client.run(1_000_000)
    for kind, heading in (("POSITION_TARGET_LOCAL_NED", 170), ("ATTITUDE", -170)):
        client.command(512, NUMBERS[kind])
        assert client.of(kind)[-1].yaw == pytest.approx(math.radians(heading), abs=0.02)


@pytest.mark.long
@pytest.mark.parametrize(
    ("addressee", "answered"),
    [((0, 0), True), ((1, 1), True), ((1, 0), True), ((7, 1), False), ((1, 99), False)],
)
def test_a_timesync_is_answered_to_its_sender_alone(
    client: MavlinkClient, addressee: tuple[int, int], answered: bool
) -> None:
    """In bytes, because pymavlink's message has no addressee."""
    request = bytearray(client.codec.timesync_encode(0, 2**40 + 77).pack(client.codec))
    request[1] = 18
    request[10:-2] = struct.pack("<qqBB", 0, 2**40 + 77, *addressee)
    request[-2:] = dialect.x25crc(bytes(request[1:-2]) + bytes((34,))).crc.to_bytes(2, "little")
    client.messages.clear()
    client.receive(bytes(request))
    client.run(client.now_us + 3000)
    found = [
        bytes(answer.get_msgbuf())[10:-2] for answer in client.of("TIMESYNC") if answer.ts1 == 2**40 + 77
    ]
    assert [payload[16:18] for payload in found] == ([bytes((255, 190))] if answered else [])


@pytest.mark.long
def test_streams_go_on_after_the_processor_was_taken_from_them(client: MavlinkClient) -> None:
    taken_us = 0
    client.firmware.kernel.occupy("LOAD", lambda: taken_us)
    for number in (30, 31, 32):
        client.command(511, number, 1000)
    for taken_us in (700, 750, 800, 850):  # now and then their messages take longer than their interval
        client.run(client.now_us + 300_000)
        taken_us = 0
        client.run(client.now_us + 20_000)
        client.messages.clear()
        client.run(client.now_us + 100_000)
        assert len(client.of("ATTITUDE")) == 100


def test_messages_of_one_period_carry_one_time_stamp(client: MavlinkClient) -> None:
    for number in (30, 32, 350):
        client.command(511, number, 20_000)
    client.firmware.kernel.occupy("LOAD", lambda: 300)
    client.messages.clear()
    client.run(1_000_000)
    stamps_ms = [m.time_boot_ms for m in client.of("ATTITUDE")]
    assert stamps_ms == list(range(stamps_ms[0], 1000, 20))
    assert stamps_ms[0] % 20 == 0
    assert [m.time_boot_ms for m in client.of("LOCAL_POSITION_NED")] == stamps_ms
    assert [m.time_usec for m in client.of("DEBUG_FLOAT_ARRAY")] == [1000 * stamp for stamp in stamps_ms]


@pytest.mark.long
@pytest.mark.parametrize("goal_yaw", [-0.5, 2.0])
def test_the_reported_velocity_is_the_derivative_of_the_reported_position(goal_yaw: float) -> None:
    client = MavlinkClient()
    client.command(511, 32, 20_000)
    client.command(400, 0)  # disarmed: no flap moves the model elsewhere than the poses go
    target(client, (0.1, -0.2, -1.15), goal_yaw)
    start, v_WB = np.array((-0.3, -0.2, 1.25)), np.array((0.3, 0.2, -0.1))
    x, y, z, w = Rotation.from_euler("z", -goal_yaw).as_quat()
    for at_us in range(100_000, 2_000_000, 20_000):
        p_WB = tuple(start + v_WB * (at_us * 1e-6))
        client.events.at(at_us, lambda now_us, p=p_WB: client.pose((p, (w, x, y, z)), now_us))
    client.run(2_000_000)
    late = [message for message in client.of("LOCAL_POSITION_NED") if message.time_boot_ms > 1000]
    p = np.array([(message.x, message.y, message.z) for message in late])
    derivative = (p[-1] - p[0]) / (1e-3 * (late[-1].time_boot_ms - late[0].time_boot_ms))
    assert derivative == pytest.approx((0.3, -0.2, 0.1), abs=0.01)
    assert np.mean([(message.vx, message.vy, message.vz) for message in late], 0) == pytest.approx(
        derivative, abs=0.06
    )


@pytest.mark.parametrize("absolute", [False, True])
def test_place_and_goal_are_those_in_the_world_whatever_the_poses_over_crtp_are(absolute: bool) -> None:
    home, away = np.array((0.2, -0.1, 1.15)), np.array((0.06, 0.03, -0.04))
    client = MavlinkClient(*WIDE, f"mavlink.home={home.tolist()}")
    client.ask("param_set", 1, 1, b"EXTPOSE_ABSOLUTE", float(absolute), 9)
    data = crtp.encode_ext_pose(tuple(away + home * absolute), LEVEL, 20_000)
    for at_us in range(GYRO_ZERO_US, 2_000_000, 20_000):
        client.events.at(at_us, lambda now_us: client.firmware.radio_received(data))

    def reported(kind: str) -> Any:
        client.command(512, NUMBERS[kind])
        found = client.of(kind)[-1]
        return pytest.approx((found.x, -found.y, -found.z), abs=0.01)

    client.run(1_000_000)
    assert tuple(home + away) == reported("LOCAL_POSITION_NED")
    target(client, (0.25, 0.3, -1.3), -0.5)
    client.run(1_500_000)
    assert reported("POSITION_TARGET_LOCAL_NED") == (0.25, -0.3, 1.3)
    assert client.of("POSITION_TARGET_LOCAL_NED")[-1].yaw == pytest.approx(-0.5)
    assert tuple(home + away) == reported("LOCAL_POSITION_NED")


def test_place_and_velocity_in_the_world_turn_with_the_frame_of_the_estimate() -> None:
    now = np.arange(1.0, 17.0) / 10
    seen: Any = SimpleNamespace(now=now)
    place, yaw = (1.0, 2.0, 3.0), 0.7
    world = PoseInWorld(seen, seen, SimpleNamespace(frame=(place, yaw)))  # type: ignore[arg-type]
    turn = Rotation.from_euler("z", yaw)
    p_WB, v_W = world.motion()
    assert p_WB == pytest.approx(place + turn.apply(now[POSITION : POSITION + 3]))
    assert v_W == pytest.approx(turn.apply(now[VELOCITY : VELOCITY + 3]))
    assert world.rates() == pytest.approx(now[RATE : RATE + 3])
    roll, pitch, heading = now[ATTITUDE : ATTITUDE + 3]
    assert world.angles() == pytest.approx((roll, pitch, heading + yaw))


def test_the_flight_array_holds_the_telemetry_blocks() -> None:
    client = MavlinkClient()
    client.command(511, 350, 20_000)
    client.poses(GYRO_ZERO_US, 1_000_000, (0.02, -0.03, 1.2))
    client.run(1_000_000)
    values = client.of("DEBUG_FLOAT_ARRAY")[-1].data[:28]
    now = {variable.name: variable.read() for variable in client.firmware.variables}
    names = [variable.name for block in telemetry.BLOCKS for variable in block.variables]
    assert [name for name in names[28:] if not name.startswith("excite.")] == []
    told, estimate = dict(zip(names, values, strict=False)), client.firmware.signals.estimate.tolist()
    assert values[:9] == pytest.approx(estimate[:9], abs=2e-3)  # SI, in G
    rates = [told[f"stateEstimate.{name}_rate"] for name in ("roll", "pitch", "yaw")]
    assert rates == pytest.approx(estimate[9:12], abs=2e-3)
    for group, tolerance in (("stateEstimate.flap_", 0.3), ("motor.", 2000)):
        shown = {name: value for name, value in told.items() if name.startswith(group)}
        assert shown == pytest.approx({name: now[name] for name in shown}, abs=tolerance)
    assert told["supervisor.state"] == State.FLYING
    assert told["locSrv.poses"] == pytest.approx(now["locSrv.poses"], abs=2)


def test_counters_in_the_flight_array_wrap_as_those_of_the_log_do(client: MavlinkClient) -> None:
    client.firmware.signals.counters[0] = (1 << 16) + 7  # poses that were fused
    client.run(client.now_us + 20_000)
    (array,) = client.command(512, 350)[1:]
    names = [variable.name for block in telemetry.BLOCKS for variable in block.variables]
    assert array.data[names.index("locSrv.poses")] == 7


STATUS = ("SYS_STATUS", "BATTERY_STATUS", "ESTIMATOR_STATUS")
GROUPS = {  # of MAV_DATA_STREAM
    "EXTENDED_STATUS": STATUS, "RC_CHANNELS": ("SERVO_OUTPUT_RAW",), "POSITION": ("LOCAL_POSITION_NED",),
    "EXTRA1": ("ATTITUDE", "ATTITUDE_QUATERNION"), "EXTRA3": 5 * ("NAMED_VALUE_FLOAT",), "RAW_SENSORS": (),
}  # fmt: skip
GROUPS["ALL"] = tuple(name for group in GROUPS.values() for name in group)


def test_the_groups_of_the_older_request_have_the_standard_s_numbers() -> None:
    numbers = {
        getattr(dialect, f"MAV_DATA_STREAM_{name}"): set(kinds) for name, kinds in GROUPS.items() if kinds
    }
    assert {number: set(kinds) for number, kinds in SERVED.items()} == numbers


@pytest.mark.long
@pytest.mark.parametrize("group", GROUPS)
def test_the_older_request_sets_groups_of_streams(client: MavlinkClient, group: str) -> None:
    for start, times in ((1, 10), (0, 0)):
        client.send("request_data_stream", 1, 1, getattr(dialect, f"MAV_DATA_STREAM_{group}"), 10, start)
        client.run(client.now_us + 2000)
        client.messages.clear()
        client.run(client.now_us + 1_000_000)
        counts = count(message for _, message in client.messages)
        for name in GROUPS["ALL"]:
            expected = times * GROUPS[group].count(name)
            assert (counts.get(name, 0) == expected) == (name in GROUPS[group]), (name, counts)
    client.send("request_data_stream", 1, 1, getattr(dialect, f"MAV_DATA_STREAM_{group}"), 60, 1)
    for name in GROUPS[group][:1]:
        assert client.command(510, NUMBERS[name])[1].interval_us == 17_000


def test_a_mode_is_described_by_its_index_or_all_are(client: MavlinkClient) -> None:
    modes = [client.command(512, NUMBERS["AVAILABLE_MODES"], index) for index in range(len(Mode) + 2)]
    assert [[answer.mode_index for answer in answers[1:]] for answers in modes] == [
        [*range(1, len(Mode) + 1)], *([index] for index in range(1, len(Mode) + 1)), [],
    ]  # fmt: skip


@pytest.mark.long
def test_manual_control_of_this_board_is_refused_and_long_texts_are_numbered_from_1(
    client: MavlinkClient,
) -> None:
    for target in (0, 1, 2):
        client.codec.srcSystem = 100 + target
        client.send("manual_control", target, 0, 0, 0, 0, 0)
        client.run(client.now_us + 3000)
    assert [message.text for message in client.of("STATUSTEXT")] == ["MANUAL_CONTROL is not served"] * 2
    client.stack._texts = 0xFFFE
    texts = [
        client.ask("param_set", 1, 1, name, 1.0, 4) for name in (b"RND_FLAPHOVERANG", b"RND_FLAPTIMECONS")
    ]
    ids = [text.id for answers in texts for text in answers if text.get_type() == "STATUSTEXT"]
    assert ids == [0xFFFF, 0xFFFF, 1, 1]  # 0 is the number of a text of one piece


@pytest.mark.parametrize(("rate_hz", "interval_us"), [(60, 17_000), (70, 14_000)])
def test_the_interval_of_a_rate_is_the_nearest_whole_tick(rate_hz: int, interval_us: int) -> None:
    client = MavlinkClient(f"mavlink.rates.attitude={rate_hz}")
    assert client.command(510, NUMBERS["ATTITUDE"])[1].interval_us == interval_us


def test_each_message_has_the_rate_of_its_own_setting() -> None:
    settings = StreamRates.model_fields.items()
    messages = {name: re.split("[ ,;]", field.description or "")[0] for name, field in settings}
    rates = {name: 1 + number for number, name in enumerate(messages)}
    client = MavlinkClient(*(f"mavlink.rates.{name}={rate}" for name, rate in rates.items()))
    told = {name: client.command(510, NUMBERS[message])[1].interval_us for name, message in messages.items()}
    assert told == {name: 1000 * round(1000 / rate) for name, rate in rates.items()}


def test_on_a_full_line_replies_wait_and_streams_are_dropped(client: MavlinkClient) -> None:
    client.uart_room = 0
    client.command(511, 30, 1000)
    client.run(client.now_us + 1_000_000)
    dropped = client.stack.dropped
    assert dropped > 900
    assert client.ask("param_request_read", 1, 1, b"EXT_Z_P", -1) == []
    client.uart_room = 1 << 30
    client.run(client.now_us + 20_000)
    (answer,) = client.of("PARAM_VALUE")
    assert answer.param_id == "EXT_Z_P"
    attitudes = [message.time_boot_ms for message in client.of("ATTITUDE")]
    assert attitudes == sorted(attitudes)
    sequence = [message.get_seq() for _, message in client.messages]
    assert all((b - a) % 256 == 1 for a, b in pairwise(sequence))


@pytest.mark.parametrize(("interval_us", "first_ms"), [(-1, None), (100_000, 200), (250_000, 250)])
def test_a_stream_that_is_set_while_its_message_waits_begins_anew(
    client: MavlinkClient, interval_us: int, first_ms: int | None
) -> None:
    """The message that waits for a full line is not sent; intervals count from boot."""
    client.run(30_000)
    client.command(511, 30, 10_000)
    client.uart_room = 0
    client.run(130_000)
    client.command(511, 30, interval_us)
    set_ms = client.now_us // 1000
    client.uart_room = 1 << 30
    client.run(301_000)
    stamps = [stamp for message in client.of("ATTITUDE") if (stamp := message.time_boot_ms) >= set_ms]
    assert stamps == ([] if first_ms is None else list(range(first_ms, 301, interval_us // 1000)))


@pytest.mark.long
def test_more_streams_than_the_queue_takes_have_their_turns_too(client: MavlinkClient) -> None:
    slow_line(client, bytes_per_ms=1)
    numbers = (
        *range(3), *range(30, 34), 36, 74, 85, 105, 147, 148, 230, 242, 245, 251, 300, 331, 350, 375, 436,
    )  # fmt: skip
    for number in numbers:
        client.command(511, number, 10_000)
    client.run(client.now_us + 3_000_000)
    client.messages.clear()
    client.run(client.now_us + 15_000_000)
    counts = count(message for _, message in client.messages)
    assert counts.pop("NAMED_VALUE_FLOAT") >= 3
    assert len(counts) == len(numbers) - 1
    assert 2 * min(counts.values()) >= max(counts.values()) - 2


@pytest.mark.long
def test_waiting_messages_leave_within_a_tick_of_room(client: MavlinkClient) -> None:
    for wait_us in range(1_000_000, 1_020_000, 2_000):
        client.uart_room = 0
        client.run(client.now_us + wait_us)
        client.uart_room, begin_us = 1 << 30, client.now_us
        client.messages.clear()
        client.run(begin_us + 20_000)
        assert client.messages[0][0] - begin_us <= 1000


# Parameters


def own_parameters(client: MavlinkClient) -> Sequence[Parameter]:
    """Those before the stock names."""
    parameters = client.firmware.parameters
    return parameters[: [one.name for one in parameters].index("activeMarker.back")]


def parameter_list(client: MavlinkClient) -> dict[str, Any]:
    answers = client.ask("param_request_list", 1, 1, wait_us=200_000)
    return {answer.param_id: answer for answer in answers if answer.get_type() == "PARAM_VALUE"}


def test_the_list_is_complete_and_each_value_is_real32_by_index_and_by_name(client: MavlinkClient) -> None:
    table = parameter_list(client)
    writable = [parameter for parameter in own_parameters(client) if parameter.write is not None]
    assert len(table) == len(writable) > 40
    assert {answer.param_index for answer in table.values()} == set(range(len(writable)))
    assert {answer.param_count for answer in table.values()} == {len(writable)}
    assert {answer.param_type for answer in table.values()} == {dialect.MAV_PARAM_TYPE_REAL32}
    for parameter, answer in zip(writable, sorted(table.values(), key=lambda a: a.param_index), strict=True):
        assert answer.param_value == pytest.approx(float(parameter.read()), rel=1e-6)
    for name, listed in list(table.items())[::7]:
        by_name = client.one("param_request_read", 1, 1, name.encode(), -1)
        by_index = client.one("param_request_read", 1, 1, b"", listed.param_index)
        assert by_name.to_dict() == by_index.to_dict() == listed.to_dict()


MISSING, OUTSIDE, FLOAT_NEEDED, UNKNOWN_TYPE = 1, dialect.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE, 7, 6
assert dialect.MAV_PARAM_ERROR_DOES_NOT_EXIST == MISSING


@pytest.mark.parametrize(
    ("asked", "error", "text"),
    [
        *((("param_set", b"EXT_Z_P", value, 9), OUTSIDE, f"EXT_Z_P: {value:g} refused, -20..20")
          for value in (math.nan, -math.inf, 1e9)),
        *((("param_set", b"DLY_ACTIVATE", value, 9), OUTSIDE, f"DLY_ACTIVATE: {value:g} refused, 0..1")
          for value in (2.0, 0.5, math.nan)),
        *((("param_set", b"EXT_Z_P", 2.0, kind), error, f"EXT_Z_P: type {name} refused, REAL32 is needed")
          for kind, error, name in ((6, FLOAT_NEEDED, "INT32"), (1, FLOAT_NEEDED, "UINT8"), (10, UNKNOWN_TYPE, "REAL64"),
                                    (99, UNKNOWN_TYPE, "99"))),
        (("param_set", b"NONE", 1.0, 9), MISSING, ""),
        (("param_request_read", b"NONE", -1), MISSING, ""),
        (("param_request_read", b"", 10_000), MISSING, ""),
        (("param_request_read", b"", "count"), MISSING, ""),
    ],
)  # fmt: skip
def test_an_impossible_parameter_request_is_answered_with_the_reason_and_in_text_once(
    client: MavlinkClient, asked: tuple[Any, ...], error: int, text: str
) -> None:
    kind, name, *values = asked
    if "count" in values:
        values = [sum(one.write is not None for one in own_parameters(client))]
    before = [one.read() for one in client.firmware.parameters if mavlink_name(one.name).encode() == name]
    texts: list[str] = []
    for _ in range(2):
        answers = client.ask(kind, 1, 1, name, *values)
        (refusal,) = [a for a in answers if a.get_type() == "PARAM_ERROR"]
        assert (refusal.target_system, refusal.target_component) == (255, 190)
        index = values[0] if not name else -1
        assert (refusal.param_id, refusal.param_index, refusal.error) == (name.decode(), index, error)
        assert [a.param_value for a in answers if a.get_type() == "PARAM_VALUE"] == (
            before if kind == "param_set" and error != MISSING else []
        )
        texts += lines(a for a in answers if a.get_type() == "STATUSTEXT")
    assert client.stack.refused == 2
    assert len(texts) == 1
    assert text in texts[0]


def test_a_name_that_is_no_text_is_refused(client: MavlinkClient) -> None:
    assert client.ask("param_request_read", 1, 1, b"\xff\xfe", -1)[-1].get_type() == "STATUSTEXT"


def test_the_hash_changes_with_any_value_and_back(client: MavlinkClient) -> None:
    def digest() -> float:
        answer = client.one("param_request_read", 1, 1, b"_HASH_CHECK", -1)
        assert answer.param_index == 0xFFFF
        return float(answer.param_value)

    first = digest()
    client.one("param_set", 1, 1, b"EXT_Z_P", 2.5, 9)
    second = digest()
    client.one("param_set", 1, 1, b"EXT_Z_P", 3.0, 9)
    assert digest() == first != second
    written = [one for one in own_parameters(client) if one.write is not None]
    content = b"".join(mavlink_name(one.name).encode() + one.value() for one in written)
    assert first == zlib.crc32(content) >> 8


def slow_line(client: MavlinkClient, bytes_per_ms: int = 6) -> None:
    """From now on 57600 baud, or as many bytes, with a buffer of 300 bytes."""

    def fill(now_us: int) -> None:
        client.uart_room = min(300, client.uart_room + bytes_per_ms)
        client.events.at(now_us + 1000, fill)

    client.uart_room = 0
    fill(client.now_us)


def test_a_list_takes_what_the_line_has_left_and_starts_again_when_asked(client: MavlinkClient) -> None:
    slow_line(client)
    client.send("param_request_list", 1, 1)
    client.run(client.now_us + 100_000)
    assert 0 < len(client.of("PARAM_VALUE")) < 30
    client.send("param_request_list", 1, 1)
    client.run(client.now_us + 2_000_000)
    indices = [message.param_index for message in client.of("PARAM_VALUE")]
    assert indices[-1] == max(indices)
    assert indices.count(0) == 2
    assert set(indices) == set(range(client.of("PARAM_VALUE")[0].param_count))
    assert client.stack.dropped == 0


# Commands


@pytest.mark.parametrize("kind", ["command_long", "command_int"])
def test_every_command_is_acknowledged_to_its_sender(client: MavlinkClient, kind: str) -> None:
    for number in (400, 185, 245, 246, 410, 420, 510, 511, 512, 520, 16, 22, 179, 1, 0, 65535):
        fields = (number, 0) if kind == "command_long" else (0, number, 0, 0)
        answers = client.ask(
            kind, 1, 1, *fields, *(math.nan,) * 4, *((0, 0, 0) if kind == "command_int" else (0.0,) * 3)
        )
        (ack,) = [answer for answer in answers if answer.get_type() == "COMMAND_ACK"]
        assert (ack.command, ack.target_system, ack.target_component) == (number, 255, 190)
        assert (ack.result == UNSUPPORTED) == (number in (420, 16, 22, 179, 1, 0, 65535))
        refused, client.stack.refused = client.stack.refused, 0
        assert refused == (ack.result != 0)


@pytest.mark.parametrize(
    ("address", "target", "obeyed"),
    [
        *(((1, 1), target, True) for target in ((1, 1), (1, 0), (0, 1), (0, 0))),
        *(((1, 1), target, False) for target in ((2, 1), (1, 2), (7, 0))),
        *(((3, 25), target, target[0] == 3) for target in ((3, 25), (3, 0))),
        *(((3, 25), target, False) for target in ((3, 1), (1, 25))),
    ],
)
def test_a_command_for_the_board_s_own_address_or_for_all_is_obeyed(
    address: tuple[int, int], target: tuple[int, int], obeyed: bool
) -> None:
    client = MavlinkClient(f"mavlink.system={address[0]}", f"mavlink.component={address[1]}")
    client.run(20_000)
    answers = client.command(400, 0, target=target)
    assert [answer.result for answer in answers] == [0] * obeyed
    assert client.stack.unserved == (not obeyed)
    assert client.firmware.signals.supervisor.armed is not obeyed


def test_a_forced_start_is_no_stop(client: MavlinkClient) -> None:
    assert client.command(400, 1, 21196)[0].result == 0
    assert client.firmware.signals.supervisor.armed
    assert not client.firmware.signals.supervisor.stopped


def stopped_by(*params: float) -> Callable[[MavlinkClient], None]:
    """Return an emergency stop by a command."""

    def stop(client: MavlinkClient) -> None:
        assert client.command(*params)[0].result == 0  # type: ignore[arg-type]
        client.run(client.now_us + 20_000)
        assert client.firmware.signals.supervisor.cause is Cause.EMERGENCY_STOP

    return stop


def stopped_by_parameter(client: MavlinkClient) -> None:
    client.ask("param_set", 1, 1, b"FLOATY_STOP", 1, 9)


def with_an_empty_battery(client: MavlinkClient) -> None:
    client.battery_mv = 3000
    client.run(6_020_000)


@pytest.mark.parametrize(
    ("prevent", "reason"),
    [
        (stopped_by(185, 1), "emergency stop; reboot first"),
        (stopped_by(400, 0, 21196), "emergency stop; reboot first"),
        (stopped_by_parameter, "stopped; set FLOATY_STOP 0"),
        (with_an_empty_battery, "battery low"),
    ],
)
def test_arming_is_refused_with_the_reason(
    client: MavlinkClient, prevent: Callable[[MavlinkClient], None], reason: str
) -> None:
    prevent(client)
    ack, why = client.command(400, 1)
    assert (ack.result, why.text) == (TEMPORARILY_REJECTED, f"not armed: {reason}")
    assert why.severity == dialect.MAV_SEVERITY_WARNING
    client.ask("param_set", 1, 1, b"FLOATY_STOP", 0, 9)
    assert (client.command(400, 1)[0].result == 0) == (prevent is stopped_by_parameter)


@pytest.mark.parametrize("kind", ["command_long", "command_int"])
def test_a_grounded_board_resets_after_its_last_bytes(client: MavlinkClient, kind: str) -> None:
    fields = (246, 0, 1, 0, 0, 0, 0, 0, 0) if kind == "command_long" else (0, 246, 0, 0, 1, 0, 0, 0, 0, 0, 0)
    for _ in range(2):  # the second because the first acknowledgement was lost
        assert [answer.result for answer in client.ask(kind, 1, 1, *fields)] == [0]
    asked_us = client.now_us
    client.run(asked_us + 300_000)
    (reset_us,) = client.resets_us
    assert 190_000 < reset_us - asked_us < 200_000


@pytest.mark.parametrize("kind", ["command_long", "command_int"])
def test_in_flight_only_a_forced_reset_is_obeyed(kind: str) -> None:
    client = MavlinkClient()
    client.poses(GYRO_ZERO_US, 2_000_000)
    client.run(1_000_000)

    def reboot(condition: int) -> list[Any]:
        params = (1, 0, 0, 0, 0, condition, 0)
        fields = (246, 0, *params) if kind == "command_long" else (0, 246, 0, 0, *params)
        return [a for a in client.ask(kind, 1, 1, *fields) if a.get_type() in ("COMMAND_ACK", "STATUSTEXT")]

    ack, why = reboot(0)
    assert (ack.result, why.text) == (TEMPORARILY_REJECTED, "not rebooted: the flaps are under control")
    client.run(1_400_000)
    assert client.resets_us == []
    (ack,) = reboot(20190226)
    assert ack.result == 0
    client.run(1_700_000)
    assert len(client.resets_us) == 1


def test_exactly_the_persistent_parameters_are_stored(client: MavlinkClient) -> None:
    assert client.command(245, 1)[0].result == 0
    expected = {one.name: one.value() for one in own_parameters(client) if one.persistent}
    assert ParameterStorage(client.eeprom).load() == expected
    assert len(expected) < sum(one.write is not None for one in own_parameters(client))


def test_a_board_speaks_as_the_system_and_component_of_its_profile() -> None:
    client = MavlinkClient("mavlink.system=9", "mavlink.component=7")
    client.run(1_500_000)
    assert {(one.get_srcSystem(), one.get_srcComponent()) for _, one in client.messages} == {(9, 7)}


def test_the_heartbeat_is_armed_only_while_the_flaps_are_controlled() -> None:
    client = MavlinkClient("mavlink.rates.heartbeat=20")

    def armed_at(end_us: int) -> bool:
        client.run(end_us)
        return bool(client.of("HEARTBEAT")[-1].base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)

    supervisor = client.firmware.signals.supervisor
    assert supervisor.armed
    assert not armed_at(300_000)  # calibrating
    assert not armed_at(700_000)  # waiting for poses
    client.poses(700_000, 1_400_000)
    assert armed_at(1_300_000)
    assert not armed_at(2_100_000)  # silence
    client.one("param_set", 1, 1, b"EXT_MANUAL", 1.0, 9)
    assert armed_at(2_300_000)  # angles from outside
    client.one("param_set", 1, 1, b"EXT_MANUAL", 2.0, 9)
    assert not armed_at(2_500_000)  # at hover
    client.one("param_set", 1, 1, b"EXT_MANUAL", 1.0, 9)
    client.command(185, 1)
    assert not armed_at(2_700_000)


@pytest.mark.parametrize("older", [True, False])
def test_home_and_versions_are_reported_by_the_older_request_and_the_present_one(
    client: MavlinkClient, older: bool
) -> None:
    def found(request: tuple[float, ...], number: int) -> Any:
        ack, *answers = client.command(*(request if older else (512, number)))  # type: ignore[arg-type]
        assert (ack.command, ack.result) == (request[0] if older else 512, 0)
        (answer,) = (one for one in answers if int.from_bytes(one.get_msgbuf()[7:10], "little") == number)
        return answer

    home = found((410,), 242)
    assert (home.x, home.y, home.z) == pytest.approx((0.0, 0.0, -1.15))
    version = found((520, 1), 148)
    assert version.flight_sw_version.to_bytes(4, "big")[:2] == bytes((26, 11))
    assert version.uid == 0x00F10A71
    assert version.capabilities & dialect.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST
    frame = bytes(found((519, 1), 300).get_msgbuf())  # in bytes, because pymavlink does not have the message
    assert struct.unpack("<HHH16s", frame[10:-2].ljust(22, b"\0")) == (200, 100, 200, bytes(16))
    assert dialect.x25crc(frame[1:-2] + bytes((217,))).crc == int.from_bytes(frame[-2:], "little")


# The rest


def test_ping_timesync_and_file_transfer_are_answered(client: MavlinkClient) -> None:
    ping = client.one("ping", 1234, 5, 0, 0)
    assert (ping.time_usec, ping.seq, ping.target_system, ping.target_component) == (1234, 5, 255, 190)
    for target in ((1, 1), (1, 0)):
        assert client.ask("ping", 1234, 5, *target) == []  # an answer
    sync = client.one("timesync", 0, 77)
    assert (sync.ts1, sync.tc1 // 1_000_000_000) == (77, 0)
    assert sync.tc1 > 20_000_000
    nak = client.one("file_transfer_protocol", 0, 1, 1, [9, 0, 0, 4] + [0] * 247)
    assert (nak.payload[0], nak.payload[3], nak.payload[12]) == (10, 129, 6)
    assert (nak.target_system, nak.target_component) == (255, 190)


def test_the_boards_own_frames_are_ignored_when_they_come_back(client: MavlinkClient) -> None:
    echo = codec(1, 1)
    client.messages.clear()
    client.receive(echo.command_long_encode(0, 0, 400, 0, 0, 0, 0, 0, 0, 0, 0).pack(echo))
    client.run(client.now_us + 3000)
    assert client.messages == []
    assert client.firmware.signals.supervisor.armed


@pytest.mark.parametrize("radio", [False, True])
@pytest.mark.parametrize("serial", [False, True])
def test_a_client_on_either_line_is_one_for_the_core(
    client: MavlinkClient, radio: bool, serial: bool
) -> None:
    client.polling = False
    client.firmware.link._heard_us = client.now_us - (0 if radio else 1_000_000)
    client.stack._heard_us = client.now_us - (0 if serial else 3_000_000)
    client.run(client.now_us + 11_000)
    assert bool(client.firmware._core.data.fields.connected) is (radio or serial)


def test_while_interrupts_are_off_nothing_arrives_and_bytes_wait_in_the_uart(client: MavlinkClient) -> None:
    firmware, link = client.firmware, client.firmware.link
    client.run(client.now_us + 500)
    for off in (1, 0):
        firmware.kernel._interrupts_off[0] = off
        for tell in (firmware.radio_polled, lambda: firmware.radio_received(b"\xf0")):
            link._heard_us = -1
            tell()
            assert (link._heard_us == -1) == off
        client.send("ping", 1234, 5, 0, 0)
        firmware.imu_ready()
        given = len(firmware.flight_tasks.imu_ready), len(client.stack._received), len(link._syslink)
        assert (sum(given) == 0) == off
    assert given == (1, 1, 1)
    assert len(client.uplink) > 0


@pytest.mark.long
def test_a_client_is_there_for_three_seconds_after_its_last_message(client: MavlinkClient) -> None:
    client.run(10_000_000)
    assert not client.stack.connected
    client.send("heartbeat", 6, 8, 0, 0, 4, 3)
    for at_us, connected in ((10_010_000, True), (12_990_000, True), (13_010_000, False)):
        client.run(at_us)
        assert client.stack.connected == connected


def test_half_a_frame_does_not_hold_back_the_last_command(client: MavlinkClient) -> None:
    # So a DEBUG_FLOAT_ARRAY of 264 bytes begins.
    client.receive(bytes.fromhex("fd fc 00 00 00 ff be 5e 01 00"))
    assert client.command(400, 0) == []
    client.run(client.now_us + 160_000)
    assert [message.command for message in client.of("COMMAND_ACK")] == [400]


KEY = bytes(range(32))


def signed(client: MavlinkClient) -> None:
    """Give the station and what reads for it the key."""
    for made in (client.codec, client.parser):
        made.signing.secret_key = KEY
        made.signing.sign_outgoing = True
        made.signing.timestamp = 1000


def test_with_a_key_nothing_unsigned_is_accepted_and_everything_sent_is_signed() -> None:
    client = MavlinkClient(f'mavlink.signing_key="{KEY.hex()}"')
    client.parser.signing.secret_key = KEY
    client.run(20_000)
    assert client.command(400, 0) == []
    assert client.stack.counters.unsigned == 1
    signed(client)
    assert [answer.command for answer in client.command(400, 0)] == [400]
    client.codec.signing.secret_key = bytes(32)
    assert client.command(400, 1) == []
    assert client.stack.counters.bad == 2
    client.run(2_100_000)
    assert len(client.of("HEARTBEAT")) == 2
    assert all(message.get_signed() for _, message in client.messages)
    assert not client.firmware.signals.supervisor.armed


@pytest.mark.long
def test_the_trace_names_no_interrupt_that_the_hardware_did_not_raise() -> None:
    client = MavlinkClient()
    raised: list[None] = []
    traced: list[tuple[int, str, str, int, int]] = []
    for name in ("imu_ready", "uart_ready", "radio_received"):
        interrupt = getattr(client.firmware, name)
        setattr(client.firmware, name, lambda *data, _raise=interrupt: raised.append(_raise(*data)))
    client.firmware.kernel.set_trace(lambda *line: traced.append(line))
    client.poses(100_000, 900_000)
    client.stream(200_000)  # the telemetry of another station, over the radio
    client.run(700_000)  # the gyro's zero is found, the loop closes: lines on the console
    assert len(client.texts()) == len(client.console) == 2
    client.ask("param_request_list", 1, 1)
    client.command(511, 30, 10_000)
    client.run(900_000)
    interrupts = [event for _, event, *_ in traced if "_ISR" in event]
    assert len(interrupts) == len(raised)


def test_counters_are_log_variables(client: MavlinkClient) -> None:
    client.receive(b"\xfd\x01\x00\x00\x00\x01\x01\x00\x00\x00\x00\x12\x34" + bytes(300))
    client.ask("ping", 1, 1, 0, 0)
    client.uart_overruns = 3
    values = {v.name: v.read() for v in client.firmware.variables if v.name.startswith("mavlink.")}
    assert set(values) == {
        f"mavlink.{name}" for name in ("frames", "lost", "bad", "refused", "dropped", "overruns")
    }
    assert (values["mavlink.frames"], values["mavlink.bad"], values["mavlink.overruns"]) == (1, 1, 3)


def test_each_counter_and_deviation_has_its_own_place_in_the_messages(client: MavlinkClient) -> None:
    counters, estimator = client.stack.counters, client.firmware._core.estimator.fields
    counters.frames, counters.lost, counters.bad_crc = 80, 20, 7
    client.stack.refused, client.stack._transmit.dropped, client.uart_overruns = 50, 40, 3
    estimator.refused, estimator.too_old, estimator.invalid = 100, 200, 400
    for frozen, deviations in ((0, (0.2, 0.3, 0.4)), (1, (0.3, 0.2, 0.1))):
        client.firmware._core.sampling.fields.recovering = 1000 * frozen
        estimator.P[range(3), range(3)] = np.square(deviations)
        client.messages.clear()
        for number in ("NAMED_VALUE_FLOAT", "SYS_STATUS", "ESTIMATOR_STATUS"):
            client.command(512, NUMBERS[number])
            found = client.of(number)
            if number == "NAMED_VALUE_FLOAT":
                named = {one.name: one.value for one in found if one.name != "age_ms"}
                assert named == {"refused": 700, "up_lost": 20, "tx_dropped": 40, "overruns": 3}
            elif number == "SYS_STATUS":
                assert found[-1].errors_comm == 7 + 50 + 3
                gyro = found[-1].onboard_control_sensors_health & dialect.MAV_SYS_STATUS_SENSOR_3D_GYRO
                assert bool(gyro) == (not frozen)
                assert 1800 < found[-1].drop_rate_comm <= 2000, "20 of 100, and the requests that came since"
            else:
                seen = found[-1].pos_horiz_accuracy, found[-1].pos_vert_accuracy
                assert seen == pytest.approx((0.3, deviations[2]), abs=0.02)


def test_the_estimate_is_healthy_while_poses_are_recent() -> None:
    client, found = MavlinkClient(), []
    client.poses(1_000_000, 1_500_000)
    for at_us in (20_000, 900_000, 1_100_000, 1_600_000, 2_200_000):
        client.run(at_us)
        client.command(512, NUMBERS["ESTIMATOR_STATUS"])
        found.append(client.of("ESTIMATOR_STATUS")[-1].flags != 0)
    assert found == [False, False, True, True, False]


def test_without_mavlink_there_is_no_task_and_no_variable_of_it() -> None:
    firmware = FirmwareBench().firmware
    assert firmware.mavlink is None
    assert not [task.name for task in firmware.kernel.tasks if task.name.startswith("MAV")]
    assert not [variable.name for variable in firmware.variables if variable.name.startswith("mavlink")]
    firmware.uart_ready()  # an interrupt that nobody waits for


def test_a_message_that_fits_no_frame_is_dropped_and_the_next_one_sent(client: MavlinkClient) -> None:
    dropped = client.stack.dropped
    client.messages.clear()

    def answer(_: object) -> None:
        client.stack.reply(dialect.MAVLink_heartbeat_message(999, 0, 0, 0, 0, 3))  # a byte of 999
        client.stack.reply(dialect.MAVLink_ping_message(1, 77, 255, 190))

    client.stack.handle("PING", answer)
    client.send("ping", 1, 76, 0, 0)
    client.run(client.now_us + 3000)
    assert client.stack.dropped == dropped + 1
    assert [message.seq for _, message in client.messages if message.get_type() == "PING"] == [77]
