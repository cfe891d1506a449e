"""The ground station's MAVLink link without a line: what pymavlink's codec reads of it, and what it makes of pymavlink's."""

import csv
import hashlib
import io
import os
import select
import tty
from contextlib import suppress
from math import pi
from types import SimpleNamespace

import numpy as np
import pymavlink.dialects.v20.development as dialect
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from firmware_py.geometry import from_euler_zyx
from firmware_py.wire import mavlink_services as services
from firmware_py.wire.telemetry import BLOCKS
from ground_station.clock import clock_us
from ground_station.config import LinkSettings, StationConfig
from ground_station.controls import REPEAT_US, Answer, ControlAction, ControlRequest
from ground_station.errors import LinkError
from ground_station.links.mavlink import TEXTS, MavlinkLink
from ground_station.links.mavlink_budget import TELEMETRY_HZ, link_budget
from ground_station.links.mavlink_controls import REASON_US, MavlinkControls
from ground_station.links.mavlink_serial import MavlinkSerialLink, named, parse_uri
from ground_station.mocap import MocapFrame
from ground_station.station import GroundStation
from ground_station.telemetry_log import TelemetryLog
from ground_station.trajectory import Goal, Hold
from hil.api import request_of
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import MAVLINK

UPRIGHT = (1.0, 0.0, 0.0, 0.0)
HOME = Goal((0.0, 0.0, 1.15), 0.0)
KEY = hashlib.sha256(b"floaty").digest()
POSE, TARGET, COMMAND, HEARTBEAT = (
    dialect.MAVLINK_MSG_ID_ATT_POS_MOCAP,
    dialect.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED,
    dialect.MAVLINK_MSG_ID_COMMAND_LONG,
    dialect.MAVLINK_MSG_ID_HEARTBEAT,
)
ARRAY = dialect.MAVLINK_MSG_ID_DEBUG_FLOAT_ARRAY


class LinkWithCodec:
    """A link whose frames are read by pymavlink, and a board that is pymavlink, too."""

    def __init__(self, baud=921_600, pose_hz=50.0, key=b"", board=1):
        self.codec = dialect.MAVLink(io.BytesIO(), srcSystem=board, srcComponent=1)
        if key:
            self.codec.signing.secret_key = key
            self.codec.signing.sign_outgoing = True
        self.sent = []  # (now_us, message)
        self.bytes = 0
        self.link = MavlinkLink(self._transmit, LinkSettings(pose_hz, 900, baud, key))

    def _transmit(self, now_us, data):
        self.bytes += len(data)
        self.sent += [(now_us, message) for message in self.codec.parse_buffer(data)]

    def of(self, number):
        return [(now_us, message) for now_us, message in self.sent if message.get_msgId() == number]

    def hear(self, now_us, *messages):
        return list(self.link.receive(now_us, b"".join(message.pack(self.codec) for message in messages)))

    def pose(self, now_us, goal=HOME, p=(0.0, 0.0, 1.15), q=UPRIGHT):
        self.link.send(now_us, MocapFrame(now_us - 40_000, p, q, True), goal)


def heartbeat(state=2):
    return dialect.MAVLink_heartbeat_message(0, 0, 1, state, 4, 3)


# Uplink


def test_pose_one_two_three_goes_up_in_ned_with_the_time_of_its_exposure():
    bench = LinkWithCodec()
    bench.pose(1_040_000, p=(1.0, 2.0, 3.0), q=from_euler_zyx(0.1, 0.2, 0.3))
    ((_, message),) = bench.of(POSE)
    assert message.time_usec == 1_000_000
    assert (message.x, message.y, message.z) == (1.0, -2.0, -3.0)
    R_NED = np.diag((1.0, -1.0, -1.0))
    expected = R_NED @ Rotation.from_euler("ZYX", (0.3, 0.2, 0.1)).as_matrix() @ R_NED
    assert Rotation.from_quat(message.q, scalar_first=True).as_matrix() == pytest.approx(expected, abs=1e-6)


def test_goal_goes_up_before_the_first_pose_in_ned_and_turned():
    bench = LinkWithCodec()
    bench.pose(40_000, Goal((1.0, 2.0, 3.0), 0.5))
    kinds = [message.get_msgId() for _, message in bench.sent]
    assert kinds.index(TARGET) < kinds.index(POSE)
    ((_, message),) = bench.of(TARGET)
    assert (message.x, message.y, message.z, message.yaw) == (1.0, -2.0, -3.0, -0.5)
    assert message.coordinate_frame == dialect.MAV_FRAME_LOCAL_NED
    assert message.type_mask == 0b1001_1111_1000  # only position and yaw are meant
    assert message.target_system == 0


def test_a_standing_goal_is_repeated_every_half_second_and_a_new_one_goes_up_at_once():
    bench = LinkWithCodec()
    for now_us in range(0, 2_000_000, 20_000):
        bench.pose(now_us, HOME if now_us < 1_100_000 else Goal((0.5, 0.0, 1.15), 0.0))
    assert [now_us for now_us, _ in bench.of(TARGET)] == [0, 500_000, 1_000_000, 1_100_000, 1_600_000]
    assert bench.of(TARGET)[3][1].x == 0.5


def test_a_moving_goal_goes_up_with_every_pose_as_far_as_the_line_can_carry_it():
    for baud, goals in ((115_200, 100), (57_600, 50)):
        bench = LinkWithCodec(baud)
        for k in range(100):
            bench.pose(20_000 * k, Goal((0.001 * k, 0.0, 1.15), 0.0))
        assert len(bench.of(POSE)) == 100
        assert len(bench.of(TARGET)) == goals
        assert bench.bytes / 2.0 <= 0.9 * baud / 10


def test_a_heartbeat_goes_up_every_second():
    bench = LinkWithCodec()
    for now_us in range(0, 5_000_000, 20_000):
        bench.pose(now_us)
    beats = bench.of(HEARTBEAT)
    assert [now_us for now_us, _ in beats] == [0, 1_000_000, 2_000_000, 3_000_000, 4_000_000]
    assert {message.type for _, message in beats} == {dialect.MAV_TYPE_GCS}
    assert beats[0][1].get_srcSystem() == 255


# Telemetry


def asked(bench):
    wanted = [message for _, message in bench.of(COMMAND)]
    assert {message.command for message in wanted} <= {dialect.MAV_CMD_SET_MESSAGE_INTERVAL}
    return [(round(message.param1), round(message.param2)) for message in wanted]


def telemetry(t_ms):
    """The board's array, and what it sends to ground stations of others."""
    data = [float(k) for k in range(1, 29)] + [0.0] * 30
    return (
        dialect.MAVLink_attitude_message(t_ms, 0.1, -0.2, -0.3, 1.0, -2.0, -3.0),
        dialect.MAVLink_local_position_ned_message(t_ms, 1.0, -2.0, -3.0, 1.0, -2.0, -3.0),
        dialect.MAVLink_debug_float_array_message(1000 * t_ms, b"floaty", 0, data),
    )


@pytest.mark.parametrize(("baud", "hz"), [(921_600, 50), (115_200, 50), (57_600, 25)])
def test_telemetry_is_asked_for_at_the_rate_of_the_budget(baud, hz):
    bench = LinkWithCodec(baud)
    bench.link.start_telemetry(0)
    assert asked(bench) == [(ARRAY, 1_000_000 // hz)]


def test_telemetry_is_asked_for_at_once_whatever_came_before():
    bench = LinkWithCodec()
    for start_us in (0, 900_000):
        bench.sent.clear()
        bench.link.start_telemetry(start_us)
        assert asked(bench) == [(ARRAY, 20_000)]
        for t_ms in range(0, 800, 20):
            bench.hear(start_us + 1000 * t_ms, *telemetry(t_ms))


@pytest.mark.parametrize(("period_ms", "again"), [(20, []), (260, [(ARRAY, 20_000)])])
def test_only_telemetry_that_is_too_slow_is_asked_for_again(period_ms, again):
    bench = LinkWithCodec()
    bench.hear(0, heartbeat())
    bench.link.start_telemetry(0)
    bench.sent.clear()
    for t_ms in range(0, 2000, 20):  # in the first second there is enough
        bench.pose(1000 * t_ms)
        attitude, position, array = telemetry(t_ms)
        bench.hear(1000 * t_ms, attitude, position, *[array] * (t_ms < 1000 or t_ms % period_ms == 0))
    assert bench.of(COMMAND) == []
    bench.pose(2_000_000)
    assert asked(bench) == again
    assert [message.target_system for _, message in bench.of(COMMAND)] == [1] * len(again)


@pytest.mark.parametrize("goal", [HOME, Goal((5.0, -3.0, 1.0), pi / 2)])
def test_telemetry_is_what_the_board_knows_whatever_goal_was_sent(goal):
    bench = LinkWithCodec()
    bench.pose(0, goal)
    samples = bench.hear(0, *telemetry((1 << 24) + 1234))
    assert [sample.block for sample in samples] == list(BLOCKS)
    assert {sample.timestamp_ms for sample in samples} == {1234}
    assert [value for sample in samples for value in sample.values] == [*range(1, 29), *4 * (0,)]
    assert bench.link.supervisor_state == 21


def status(millivolts, per_mille):
    return dialect.MAVLink_sys_status_message(0, 0, 0, per_mille, millivolts, -1, -1, 0, 0, 0, 0, 0, 0)


def test_battery_and_load_belong_to_the_preceding_row(tmp_path):
    bench = LinkWithCodec()
    assert bench.hear(0, status(3_900, 250)) == []  # there is no row yet
    log = TelemetryLog(tmp_path / "telemetry.csv")
    station = GroundStation(bench.link, Hold(HOME), log.write, StationConfig())
    for message in (*telemetry(20), status(3_900, 250), *telemetry(40), status(0xFFFF, 500), *telemetry(60)):
        station.on_packet(0, message.pack(bench.codec))
    log.close()
    with (tmp_path / "telemetry.csv").open(newline="") as file:
        rows = [(row["pm.vbat [V]"], row["system.load [%]"]) for row in csv.DictReader(file)]
    assert rows == [("3.9", "25"), ("nan", "50"), ("nan", "nan")]


def test_a_status_does_not_put_off_that_missing_telemetry_is_asked_for():
    bench = LinkWithCodec()
    station = GroundStation(bench.link, Hold(HOME), None, StationConfig())
    for message in telemetry(20):
        station.on_packet(20_000, message.pack(bench.codec))
    station.on_packet(400_000, status(3_900, 250).pack(bench.codec))
    bench.sent.clear()
    station.on_frame(MocapFrame(500_000, HOME.p_WG, UPRIGHT, True), 540_000)
    station.on_frame(MocapFrame(520_000, HOME.p_WG, UPRIGHT, True), 560_000)  # not with every frame
    assert [message.param1 for _, message in bench.of(COMMAND)] == [ARRAY]


def test_other_systems_are_ignored():
    bench = LinkWithCodec()
    bench.pose(0)
    bench.hear(0, heartbeat())
    for system, component in ((2, 1), (1, 2), (255, 190)):
        other = dialect.MAVLink(io.BytesIO(), srcSystem=system, srcComponent=component)
        data = b"".join(message.pack(other) for message in (*telemetry(20), heartbeat(3)))
        assert bench.link.receive(20_000, data) == []
    assert bench.link.supervisor_state == 2
    assert bench.link.board == 1


def test_a_board_that_is_forgotten_has_no_state_until_its_next_heartbeat():
    bench = LinkWithCodec()
    for bench.codec.seq in range(2):
        bench.hear(0, heartbeat())
        assert bench.link.supervisor_state == 2
        bench.link.forget()
        assert bench.link.supervisor_state is None


def test_the_senders_of_frames_are_named_those_that_sent_most_first():
    bench = LinkWithCodec()
    for system, count in ((255, 5), (1, 3), (7, 2), (8, 1), (9, 1)):
        other = dialect.MAVLink(io.BytesIO(), srcSystem=system, srcComponent=190)
        for _ in range(count):
            bench.link.receive(1000, dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(other))
    assert named(bench.link.senders) == (
        "5 frames of system 255 component 190, 3 frames of system 1 component 190, 2 frames of system 7 component 190, "
        "2 of 2 others"
    )


def test_the_summary_names_each_figure_and_texts_are_notices_once():
    link, codec, now_us = (
        MavlinkSerialLink("mavlink:COM3", LinkSettings(50.0, 900, 921_600)),
        LinkWithCodec().codec,
        clock_us(),
    )
    link.start_telemetry(now_us)
    link.receive(now_us + 4_200, dialect.MAVLink_timesync_message(5, 1000 * now_us).pack(codec))
    codec.seq = 3  # two are lost
    text = dialect.MAVLink_statustext_message(6, b"hello").pack(codec)
    link.receive(now_us + 5_000, text + heartbeat().pack(codec)[:-1] + b"x")
    link.receive(now_us + 6_000, heartbeat().pack(codec))
    assert link.summary() == "0 sent, 0 late  frames 3, 2 lost, 1 bad  round trip 4.2 ms"
    assert (link.received_us, link.latency.us, link.supervisor_state) == (now_us + 6_000, 2_100, 2)
    assert (link.notices(), link.notices()) == (["board: hello"], [])


class Line:
    """A board at the other end of a pseudo terminal, which acknowledges at once; `heard` are the frames that it has read."""

    def __init__(self):
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.uri, self.bench = f"mavlink:{os.ttyname(self.slave)}", LinkWithCodec()

    def link(self):
        return MavlinkSerialLink(self.uri, LinkSettings(50.0, 900, 921_600))

    def put(self, *messages):
        os.write(self.master, b"".join(message.pack(self.bench.codec) for message in messages))

    def acknowledge(self):
        self.put(heartbeat(), dialect.MAVLink_command_ack_message(511, 0))
        return False

    def open(self):
        link = self.link()
        link.open(self.acknowledge)
        return link

    def wait_for(self, number):
        """Read frames until one with the number of a message has come; return that."""
        while True:
            for _, message in self.bench.sent:
                if message.get_msgId() == number:
                    self.bench.sent.clear()
                    return message
            assert select.select((self.master,), (), (), 10.0)[0], "nothing is sent"
            self.bench._transmit(0, os.read(self.master, 4096))

    def close(self):
        for end in (self.master, self.slave):
            with suppress(OSError):
                os.close(end)


@pytest.fixture
def line():
    line = Line()
    yield line
    line.close()


def test_a_line_that_is_opened_again_has_forgotten_the_board(line):
    """Telemetry is requested in each connection, which is none before the board's heartbeat and its answer."""
    link = line.link()
    for _ in range(2):
        with pytest.raises(LinkError, match="stopped while connecting"):
            link.open(lambda: True)
        link.open(line.acknowledge)
        line.wait_for(COMMAND)
        link.close()


def test_poses_and_requests_leave_by_the_line_and_its_end_is_reported_once(line):
    link = line.open()
    line.wait_for(COMMAND)  # for telemetry
    now_us = clock_us()
    link.send(now_us, MocapFrame(now_us, (0.5, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), True), HOME)
    assert line.wait_for(POSE).x == 0.5
    link.ask(now_us, ControlRequest(ControlAction.STOP))
    assert link.answer(now_us) is None
    assert line.wait_for(COMMAND).command == dialect.MAV_CMD_DO_FLIGHTTERMINATION
    acknowledged = dialect.MAVLink_command_ack_message(dialect.MAV_CMD_DO_FLIGHTTERMINATION, 0)
    link.receive(now_us, acknowledged.pack(line.bench.codec))
    assert link.answer(now_us) == Answer(())
    link.check()
    with pytest.raises(LinkError, match=f"^{line.uri}: Resource temporarily unavailable$"):
        line.link().open(lambda: False)  # a line has one user
    reader = link._port._reader
    line.close()
    reader.join(30.0)
    link._port.write(b"late")
    with pytest.raises(LinkError, match=f"^{line.uri}: lost: "):
        link.check()
    assert not reader.is_alive()
    link.close()
    with pytest.raises(LinkError, match=f"^{line.uri}: lost: closed$"):
        link.check()


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("mavlink:/dev/ttyUSB0", ("/dev/ttyUSB0", 921_600)),
        ("mavlink:/dev/ttyUSB0,57600", ("/dev/ttyUSB0", 57_600)),
        ("mavlink:COM3,9600", ("COM3", 9600)),
        ("mavlink:COM3,3000000", ("COM3", 3_000_000)),
        ("mavlink:socket://127.0.0.1:65535", ("socket://127.0.0.1:65535", 921_600)),
        ("mavlink:rfc2217://[::1]:4000,9600", ("rfc2217://[::1]:4000", 9600)),
        ("mavlink:rfc2217://host:4000?logging=debug", ("rfc2217://host:4000?logging=debug", 921_600)),
    ],
)
def test_a_uri_names_device_and_baud_rate(uri: str, expected: tuple[str, int]) -> None:
    assert parse_uri(uri, 921_600) == expected


@pytest.mark.parametrize("text", ["9599", "3000001", "", "1e6", "12345678"])
def test_a_baud_rate_outside_its_range_is_refused(text):
    with pytest.raises(
        LinkError, match=rf"^mavlink:COM3,{text}: baud rate '{text}': expected 9600..3000000$"
    ):
        parse_uri(f"mavlink:COM3,{text}", 57_600)
    for uri in (
        "mavlink:",
        "mavlink:socket://host",
        "mavlink:socket://host:0",
        "mavlink:socket://host:65536",
        "COM3",
    ):
        with pytest.raises(LinkError, match=r": expected mavlink:DEVICE\[,BAUD\] with a DEVICE like"):
            parse_uri(uri, 57_600)


BROKEN = heartbeat().pack(LinkWithCodec().codec)[:-1] + b"x"


def of_a_station():
    return dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GCS, 8, 0, 0, 4, 3)


@pytest.mark.parametrize(
    ("key", "board_key", "message", "why"),
    [
        (b"", b"", None, "no heartbeat within 1 s: no bytes arrive"),
        (b"", b"", "noise", "no heartbeat within 1 s: 61 bytes, not one frame: wrong baud rate?"),
        (b"", b"", heartbeat(), "system 1 answers no command within 1 s: does it want signed frames (mavlink.signing_key)?"),
        (KEY, KEY, heartbeat(), "system 1 answers no command within 1 s"),
        (KEY, b"", heartbeat(), "no heartbeat within 1 s: 1 frames not signed with mavlink.signing_key"),
        (KEY, KEY[::-1], heartbeat(), "no heartbeat within 1 s: 1 frames not signed with mavlink.signing_key"),
        (b"", b"", of_a_station(), "no heartbeat of an autopilot within 1 s: 1 frames of system 1 component 1"),
    ],
)  # fmt: skip
def test_a_connection_that_fails_names_what_was_heard(key, board_key, message, why):
    link, board = (
        MavlinkSerialLink("mavlink:COM3", LinkSettings(50.0, 900, 921_600, key)),
        LinkWithCodec(key=board_key),
    )
    board.codec.signing.timestamp = link._settings.signing_start + clock_us() // 10
    data = (message or heartbeat()).pack(board.codec) if message != "noise" else bytes(40) + BROKEN
    data = b"" if message is None else data
    link.receive(clock_us(), data)
    link._port = SimpleNamespace(bytes=len(data))
    assert link._why_no_connection(clock_us(), "within 1 s") == why


def test_texts_and_refusals_are_collected():
    bench = LinkWithCodec()
    text = dialect.MAVLink_statustext_message(4, b"supervisor: failsafe, silence")
    bench.hear(
        0, text, dialect.MAVLink_command_ack_message(511, 0), dialect.MAVLink_command_ack_message(511, 4)
    )
    assert list(bench.link.texts) == [
        "board: supervisor: failsafe, silence",
        "the board refuses SET_MESSAGE_INTERVAL: failed",
    ]
    assert bench.link.answered


def test_a_text_in_pieces_is_one_line_unless_its_beginning_was_lost():
    bench = LinkWithCodec()
    line = "0123456789" * 11
    first, second, last = services.status_text(6, line, 9)
    bench.hear(0, first, second)
    assert list(bench.link.texts) == []
    bench.hear(10, last, *services.status_text(6, "short"), *services.status_text(6, line[:60], 10))
    assert list(bench.link.texts) == [f"board: {line}", "board: short", f"board: {line[:60]}"]
    for length in (50, 51, 100, 101):
        pieces = services.status_text(6, line[:length], length)
        assert (len(pieces) == 1) == (length == 50)
        bench.hear(20, *pieces)
        assert bench.link.texts[-1] == f"board: {line[:length]}"
    bench.hear(30, *(services.status_text(6, f"line {number}")[0] for number in range(TEXTS + 3)))
    assert list(bench.link.texts) == [f"board: line {number}" for number in range(3, TEXTS + 3)]


@pytest.mark.parametrize(("result", "word"), [(2, "denied"), (5, "in progress"), (77, "77")])
def test_a_refusal_without_reason_has_the_standard_s_word(result, word):
    bench = LinkWithCodec()
    controls, told = bench.link.controls, dialect.MAVLink_statustext_message(6, b"written by somebody")
    controls.ask(0, ControlRequest(ControlAction.SAVE))
    bench.hear(500, dialect.MAVLink_command_ack_message(511, 0))  # of another command
    assert controls.answer(500) is None
    bench.hear(1_000, dialect.MAVLink_command_ack_message(245, result), told)
    assert controls.answer(1_000 + REPEAT_US) is None
    assert controls.answer(1_000 + REASON_US).error == f"the board refuses PREFLIGHT_STORAGE: {word}"
    assert list(bench.link.texts) == ["board: written by somebody"]


@given(st.lists(st.sampled_from((0, 1, 2, 3, 4, 5, 0xFFFF)), max_size=12))
def test_a_list_is_whole_and_in_the_board_s_order_whatever_arrives_and_is_lost(arriving):
    """Of five parameters; a value with a number beyond them is no part of the list."""
    asked, now_us = [], 0
    controls = MavlinkControls(lambda now_us, message: asked.append(message), lambda: 1)

    def arrive(number):
        controls.receive(now_us, services.parameter(f"P{number}", float(number), number, 5))

    controls.ask(now_us, ControlRequest(ControlAction.LIST))
    for number in arriving:
        arrive(number)
    del asked[: bool({*arriving} & {*range(5)})]  # of a list that begins
    while (answer := controls.answer(now_us)) is None:
        now_us += REPEAT_US
        while asked:
            arrive(getattr(asked.pop(), "param_index", 0))
    assert answer == Answer(tuple((f"P{number}", float(number)) for number in range(5)))


# Time


def test_the_round_trip_is_that_of_the_own_request_only():
    bench = LinkWithCodec()
    bench.pose(1_000_000)
    ((_, request),) = bench.of(dialect.MAVLINK_MSG_ID_TIMESYNC)
    assert (request.tc1, request.ts1) == (0, 1_000_000_000)
    bench.hear(1_001_000, dialect.MAVLink_timesync_message(5, 999_000_000))
    assert bench.link.round_trip_us is None
    bench.hear(1_004_200, dialect.MAVLink_timesync_message(5, request.ts1))
    assert bench.link.round_trip_us == 4200


def test_late_reads_count_from_their_arrival():
    """The board's request is answered with the middle between arrival and answer, as NTP has it."""
    bench = LinkWithCodec()
    bench.pose(1_000_000)
    request = bench.of(dialect.MAVLINK_MSG_ID_TIMESYNC)[0][1]
    messages = (dialect.MAVLink_timesync_message(5, request.ts1), dialect.MAVLink_timesync_message(0, 777))
    bench.link.receive(1_004_200, b"".join(message.pack(bench.codec) for message in messages), 1_010_200)
    assert bench.link.latency.us == 2100
    answered_us, answer = bench.of(dialect.MAVLINK_MSG_ID_TIMESYNC)[1]
    assert (answered_us, answer.tc1, answer.ts1) == (1_010_200, 1_007_200_000, 777)


def test_after_a_late_read_a_request_goes_on_at_the_present_instant():
    bench = LinkWithCodec()
    stopped = services.parameter(services.mavlink_name("floaty.stop"), 0.0, 0, 1)
    refused = dialect.MAVLink_command_ack_message(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 2)
    bench.link.controls.ask(1_000, ControlRequest(ControlAction.ARM))
    for arrived_us, reply in ((2_000, stopped), (12_000, stopped), (22_000, refused)):
        assert bench.link.controls.answer(arrived_us) is None
        bench.link.receive(arrived_us, reply.pack(bench.codec), arrived_us + 8_000)
    went_on = [at_us for at_us, one in bench.sent if one.get_type() in ("PARAM_SET", "COMMAND_LONG")]
    assert went_on == [10_000, 20_000]
    assert bench.link.controls.answer(22_000 + REASON_US) is None
    assert bench.link.controls.answer(22_000 + REASON_US + REPEAT_US).error.endswith("denied")


# What goes wrong


def test_with_a_key_everything_is_signed_and_nothing_unsigned_is_believed():
    bench, stranger = LinkWithCodec(key=KEY), LinkWithCodec()
    bench.codec.signing.timestamp = 1
    bench.pose(0)
    assert bench.of(POSE)[0][1].get_signed()  # pymavlink has checked it
    assert stranger.link.receive(0, heartbeat().pack(stranger.codec)) == []
    assert bench.link.receive(0, heartbeat().pack(stranger.codec)) == []
    assert (bench.link.board, bench.link.counters.bad) == (None, 1)
    bench.hear(0, heartbeat())
    assert bench.link.board == 1


# Budget


def test_the_budget_of_the_uplink_is_what_the_link_sends():
    for key in (b"", KEY):
        bench = LinkWithCodec(key=key)
        for now_us in range(0, 10_000_000, 20_000):
            bench.pose(now_us, p=(0.1, 0.2, 1.3), q=from_euler_zyx(0.1, 0.2, 0.3))
            if now_us % 500_000 == 0:
                bench.hear(now_us, dialect.MAVLink_timesync_message(0, 10**15 + now_us))
        assert bench.bytes / 10 == pytest.approx(bench.link.budget.up_load * 92_160, rel=0.01)


@pytest.mark.long
@pytest.mark.parametrize("baud", [57_600, 921_600])
def test_the_budget_of_the_downlink_is_what_the_board_sends(baud):
    flight = lockstep_flight(
        request_of("hover", overrides=(f"serial.baud={baud}",), duration_s=6.0, link=MAVLINK)
    )
    begun = []
    flight.events.at(2_000_000, lambda now_us: begun.append(flight.robot.uart.down.sent_bytes))
    assert flight.run().lost is None
    sent = flight.robot.uart.down.sent_bytes - begun[0]
    assert sent / 5.0 == pytest.approx(link_budget(baud, 50.0).down_load * baud / 10, rel=0.04)


@pytest.mark.long
@given(st.integers(9600, 1_000_000), st.floats(1.0, 200.0), st.booleans())
def test_the_budget_allows_exactly_what_fits(baud, pose_hz, signed):
    """Frames as measured with pymavlink: pose 48, goal 65, heartbeat 21, time 30, array 144 bytes; 986.8 bytes/s unasked."""
    line, more = baud / 10, 13 * signed
    up = pose_hz * (48 + more) + 2 * (65 + more) + (21 + more) + 3 * (30 + more)
    down = {hz: 986.8 + 25.4 * more + hz * (144 + more) for hz in TELEMETRY_HZ}
    fitting = [hz for hz in TELEMETRY_HZ if down[hz] <= 0.8 * line]
    if up > 0.9 * line or not fitting:
        with pytest.raises(LinkError, match="poses/s need" if up > 0.9 * line else "of telemetry need"):
            link_budget(baud, pose_hz, signed)
        return
    budget = link_budget(baud, pose_hz, signed)
    assert budget.telemetry_hz == fitting[0]
    assert (
        link_budget(57_600, 50.0).text == "57600 baud: uplink 2.6 kB/s, 46 %; telemetry 25 Hz, 4.6 kB/s, 80 %"
    )
    assert (budget.up_load, budget.down_load) == pytest.approx((up / line, down[fitting[0]] / line))
    goal_hz = 2 + (0.9 * line - up) / (65 + more)
    assert budget.goal_period_us == (0 if goal_hz >= pose_hz else pytest.approx(1e6 / goal_hz, abs=1))


@pytest.mark.parametrize(
    ("baud", "pose_hz", "message"),
    [
        (
            9600,
            50.0,
            "9600 baud: 50 poses/s need 2.64 kB/s, 90 % of the line are 0.86: lower station.corrections_hz",
        ),
        (
            9600,
            5.0,
            "9600 baud: 4 Hz of telemetry need 1.56 kB/s, 80 % of the line are 0.77: raise serial.baud",
        ),
    ],
)
def test_a_line_that_cannot_carry_a_flight_is_refused_in_one_line(baud, pose_hz, message):
    with pytest.raises(LinkError) as refusal:
        LinkWithCodec(baud, pose_hz)
    assert str(refusal.value).startswith(message)
