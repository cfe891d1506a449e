"""Frames in, corrections out, telemetry into the log."""

import csv
import time
from dataclasses import replace
from datetime import UTC, datetime
from math import inf, isnan, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from firmware_py.geometry import from_euler_zyx
from firmware_py.wire import crtp, telemetry
from ground_station.clock import clock_us, epoch_us, signing_start
from ground_station.config import GroundConfig, LinkSettings, StationConfig, TrackerConfig
from ground_station.corrections import correct
from ground_station.latency import LatencyBudget, LinkLatency
from ground_station.links.log_blocks import START_ORDER
from ground_station.links.loopback import LoopbackLink
from ground_station.mocap import MocapFrame
from ground_station.station import GroundStation, Slots
from ground_station.telemetry_log import AGE_COLUMNS, TelemetryLog
from ground_station.throttle import Throttle
from ground_station.tracker import Quality, Tracker
from ground_station.trajectory import Along, Goal, Hold, Offsets, Sine, Square, Step
from support.log_board import TABLE, LogBoard, data_packet

HOME = Goal((0.0, 0.0, 1.15), 0.0)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
metres = st.floats(-2.0, 2.0)
angle = st.floats(-pi, pi)


class StationWithPackets:
    """A ground station whose packets end in a list."""

    def __init__(self, corrections_hz=50.0, latency_us=1000, log=None, trajectory=None, tracker=None):
        self.sent = []  # corrections
        self.requests = []  # for telemetry, which the board grants when it is there
        self.board = LogBoard()
        self.link = LoopbackLink(self._transmit, latency_us, lambda: TABLE)
        self.station = GroundStation(
            self.link, trajectory or Hold(HOME), log, StationConfig(corrections_hz=corrections_hz), tracker
        )

    def _transmit(self, now_us, data):
        (self.sent if data[0] >> 4 == crtp.PORT_LOCALISATION else self.requests).append((now_us, data))

    def hear(self, now_us, data):
        """Take telemetry, for which the station has asked the board."""
        if not self.board.periods:
            self.link.start_telemetry(now_us)
            while self.requests:
                self.station.on_packet(now_us, self.board.answer(self.requests.pop()[1]))
        self.station.on_packet(now_us, data)

    def frames(
        self, count, valid=lambda number: True, p=lambda number: (0.001 * number, 0.0, 1.15), period_us=5000
    ):
        for number in range(count):
            frame = MocapFrame(round(period_us * number), p(number), UPRIGHT, valid(number))
            self.station.on_frame(frame, frame.t_us + 38_000)

    def numbers(self):
        """Which frames were sent, by their x."""
        return [round(crtp.decode_ext_pose(data[1:]).p_GB[0] * 1000) for _, data in self.sent]


@pytest.mark.long
@given(st.tuples(metres, metres, metres), st.tuples(metres, metres, metres), angle, angle, angle, angle)
def test_correction_is_scipys_pose_in_the_goal_frame(p, goal, goal_yaw, roll, pitch, yaw):
    correction = correct(MocapFrame(0, p, from_euler_zyx(roll, pitch, yaw), True), Goal(goal, goal_yaw), 0)
    R_GW = Rotation.from_euler("z", goal_yaw).inv()
    R_WB = Rotation.from_euler("ZYX", (yaw, pitch, roll))
    assert correction.p_GB == pytest.approx(R_GW.apply(np.subtract(p, goal)), abs=1e-9)
    ours = Rotation.from_quat(correction.q_GB, scalar_first=True)
    assert (ours.inv() * R_GW * R_WB).magnitude() < 1e-7


@pytest.mark.long
@pytest.mark.parametrize("camera_hz", [10, 25, 40, 45, 50, 60, 90, 100, 120, 180, 200, 240, 360, 1000])
def test_fifty_corrections_leave_per_second_or_as_many_as_slower_cameras_have(camera_hz):
    bench = StationWithPackets()
    bench.frames(10 * camera_hz, period_us=1e6 / camera_hz)
    assert len(bench.sent) == pytest.approx(min(500, 10 * camera_hz), abs=2 * (camera_hz >= 50))
    gaps_us = np.diff([now_us for now_us, _ in bench.sent])
    assert gaps_us.max() <= 20_000 + 1e6 / camera_hz


@pytest.mark.long
@given(
    st.lists(
        st.integers(-70_000, 70_000) | st.sampled_from((15_000, 17_499, 17_500, 20_000, -22_500, -22_501))
    )
)
def test_a_slot_begins_an_eighth_of_its_period_before_it_and_takes_one_frame(steps_us):
    """Also after a camera's clock was set back behind the slot that was filled last: there the slots begin anew."""
    slots, filled, phase_us, t_us = Slots(20_000), None, 0, 0
    for step_us in (0, *steps_us):
        t_us += step_us
        if filled is None or (t_us + 2_500 - phase_us) // 20_000 < filled:
            phase_us, filled = t_us, -1
        number = (t_us + 2_500 - phase_us) // 20_000
        assert slots.due(t_us) == (number > filled)
        if number > filled:
            slots.fill_slot(t_us)
            filled = number


def test_sent_age_is_that_on_arrival():
    bench = StationWithPackets(latency_us=2000)
    bench.frames(1)
    assert crtp.decode_ext_pose(bench.sent[0][1][1:]).age_us == 40_000


def test_untracked_frames_are_never_sent_and_the_slots_keep_their_phase():
    bench = StationWithPackets()
    bench.frames(20, valid=lambda number: number not in (4, 5, *range(8, 15)))
    assert bench.numbers() == [0, 6, 15, 16]
    assert bench.station.counters.invalid == 9


def test_refused_frames_are_not_sent_and_the_next_good_one_takes_their_place():
    """x grows by 1 mm per frame, 0.2 m/s; three frames are half a metre off. A track begins with the third frame."""
    bench = StationWithPackets(tracker=Tracker(TrackerConfig(), 5000))
    bench.frames(200, p=lambda number: (0.001 * number + 0.5 * (number in (99, 100, 101)), 0.0, 1.15))
    assert bench.numbers() == [2, *range(4, 100, 4), 102, *range(104, 200, 4)]
    assert bench.station.counters.invalid == 5
    assert bench.station.notices() == [
        "motion capture: 3 poses refused, up to 0.50 m and 0 deg from the prediction"
    ]


TURNED = (0.0, 0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda n: {"q_WB": TURNED if n % 2 else UPRIGHT}, "orientations alternate, 180 deg apart: two bodies?"),
        (lambda n: {"p_WB": (0.5 * (n % 2), 0.0, 1.15)}, "places alternate, 0.50 m and 0 deg apart: two bodies?"),
        (lambda n: {"p_WB": (100.0, -200.0, 1150.0 + n / 10)}, "at 100.00 -200.00 1152.00 m, outside 50 m: millimetres"),
        (lambda n: {"p_WB": (1.0, 0.0, 49.5)}, "at 1.00 0.00 49.50 m, outside 50 m: millimetres"),
        (lambda n: {"p_WB": (0.0, 70_000.0, 0.0)}, "at 0.00 70000.00 0.00 m, out of the volume of 50 m"),
        (lambda n: {"q_WB": (0.0, 2.0, 0.0, 0.0)}, "a quaternion of length 2.00, not 1"),
        (lambda n: {"p_WB": (0.0, float("nan"), 0.0)}, "a coordinate is not a number"),
        (lambda n: {"t_us": 12_345_000}, "exposed at 12.345 s like the one before: does the frames' clock stand?"),
        (lambda n: {"t_us": 400_000 - 5000 * n}, "ms behind a newer one"),
        (lambda n: {"p_WB": (0.24 * n, 0.0, 1.15)}, "up to 0.24 m and 0 deg from one to the next, too far for a track"),
        (lambda n: {"valid": False}, "missing: the body is not tracked"),
    ],
)  # fmt: skip
def test_the_line_on_unused_poses_has_the_reason_and_the_value(change, line):
    """Frames every 25 ms; all but the first two are unused for this reason."""
    bench = StationWithPackets(tracker=Tracker(TrackerConfig(), 25_000))
    lines = []
    for number in range(200):
        moved = {"t_us": 25_000 * number} | change(number)
        frame = replace(MocapFrame(0, (0.0, 0.0, 1.15), UPRIGHT, True), **moved)
        bench.station.on_frame(frame, 25_000 * number + 38_000)
        lines += bench.station.notices()
    assert len(bench.sent) == 0
    assert 1 <= len(lines) <= 2  # in 5 s
    assert all(line in one for one in lines), lines
    assert bench.station.unused.counts.total() == bench.station.counters.invalid == 200


@pytest.mark.parametrize(
    ("stray", "word"),
    [
        (lambda rng: (0.5, 0.0, 1.15), "places alternate"),
        (lambda rng: tuple(rng.uniform(-1, 1, 3).tolist()), "refused"),
    ],
)
def test_poses_that_alternate_in_flight_are_two_bodies_and_single_outliers_are_not(stray, word):
    rng, bench = np.random.default_rng(2), StationWithPackets(tracker=Tracker(TrackerConfig(), 5000))
    bench.frames(400, p=lambda n: HOME.p_WG if n < 100 or n % 2 else stray(rng))
    assert word in bench.station.notices()[0]


@pytest.mark.parametrize(("jump_s", "way"), [(-3600, "back by 3600.0"), (3600, "forward by 3600.0")])
def test_a_frame_clock_that_jumps_is_named_and_the_gap_is_the_true_one(jump_s, way):
    bench = StationWithPackets(tracker=Tracker(TrackerConfig(), 5000))
    lines = []
    for number in range(1000):
        t_us = 10_000_000_000 + 5000 * number + 1_000_000 * jump_s * (number >= 500)
        bench.station.on_frame(MocapFrame(t_us, HOME.p_WG, UPRIGHT, True), 5000 * number)
        lines += bench.station.notices()
    assert lines == [f"motion capture: track restarted after 0.0 s: the frames' clock jumped {way} s"]


def test_frames_of_unknown_bodies_that_are_seen_now_and_then_are_counted_without_a_line():
    bench = StationWithPackets(tracker=Tracker(TrackerConfig(), 5000))
    bench.frames(1000, valid=lambda number: number % 3 > 0)
    assert bench.station.notices() == []
    assert bench.station.unused.summary() == "336 unusable: 334 not tracked, 2 track begins"


def test_the_goal_of_the_moment_counts_not_that_of_the_exposure():
    bench = StationWithPackets(corrections_hz=200.0, trajectory=Offsets(HOME, 40_000, x=Step(0.5)))
    bench.frames(2, p=lambda number: HOME.p_WG)  # arrive at 38 and 43 ms
    assert bench.numbers() == [0, -500]


@pytest.mark.long
@given(st.binary(max_size=40))
def test_any_packet_is_counted_and_none_is_raised(data):
    bench = StationWithPackets()
    bench.station.on_packet(0, data)
    assert bench.station.counters.received == 1
    assert bench.station.counters.malformed <= 1


def test_unreadable_telemetry_is_counted_and_other_services_are_not():
    bench = StationWithPackets()
    bench.station.on_packet(0, b"\x5e\x63\0\0\0")
    assert bench.station.counters.malformed == 1
    bench.station.on_packet(0, b"\x0chello")  # console
    assert bench.station.counters.malformed == 1


def test_telemetry_is_asked_for_at_the_first_frame_and_after_half_a_second_without_it():
    bench = StationWithPackets()
    bench.frames(300)
    asked_us = [now_us for now_us, _ in bench.requests]
    assert asked_us[0] == 38_000
    assert np.diff(asked_us) == pytest.approx(100_000, abs=20_000)  # with a correction, while no answer comes
    assert {data for _, data in bench.requests} == {b"\x5d\x05"}  # reset: the first of many
    for now_us in range(1_540_000, 3_000_000, 400_000):
        bench.hear(now_us, next(telemetry_packets(now_us // 1000)))
        bench.station.on_frame(MocapFrame(now_us, HOME.p_WG, UPRIGHT, True), now_us + 399_000)
    assert bench.requests == []
    for late_us in (499_999, 500_000):
        assert bench.requests == []
        bench.station.on_frame(MocapFrame(now_us + late_us, HOME.p_WG, UPRIGHT, True), now_us + late_us)
    assert len(bench.requests) == 1


@pytest.mark.parametrize(
    ("period_us", "wanted_hz", "hz"), [(5000, 50, 50), (50_000, 50, 20), (50_000, 10, 10)]
)
def test_a_link_expects_as_many_poses_as_are_wanted_and_seen(period_us, wanted_hz, hz):
    settings = GroundConfig(
        station=StationConfig(corrections_hz=wanted_hz, link_latency_us=1300),
        frame_period_us=period_us,
        baud=57_600,
        signing_key="0f" * 32,
    ).links(note := lambda now_us, frame: None)
    assert settings == LinkSettings(hz, 1300, 57_600, b"\x0f" * 32, 0, note)


def telemetry_packets(timestamp_ms, blocks=START_ORDER):
    for block in blocks:
        shown = [(variable.scale or 1) * (0.5 + block.id) for variable in block.variables]
        kinds = [float if variable.type.is_float else int for variable in block.variables]
        yield data_packet(
            block, timestamp_ms, [kind(value) for kind, value in zip(kinds, shown, strict=True)]
        )


def rows(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_log_has_one_row_per_time_stamp_with_what_the_ground_knew(tmp_path):
    log = TelemetryLog(tmp_path / "telemetry.csv")
    bench = StationWithPackets(log=log.write)
    bench.frames(1, p=lambda number: (0.25, 0.0, 1.15))
    for timestamp_ms in (0, 20):  # a board that has just booted, too
        for data in telemetry_packets(timestamp_ms):
            bench.hear(timestamp_ms * 1000 + 900, data)
    log.close()
    log.close()
    first, second = rows(tmp_path / "telemetry.csv")
    assert (first["board.t [ms]"], second["board.t [ms]"]) == ("0", "20")
    assert float(first["ground.t [s]"]) == 0.0009
    assert float(first["goal.z [m]"]) == 1.15
    assert float(first["mocap.x [m]"]) == 0.25
    for block in telemetry.BLOCKS:
        for variable in block.variables:
            expected = 0.5 + block.id if variable.type.is_float else block.id
            assert float(first[f"{variable.name} [{variable.unit}]"]) == expected


def test_ages_count_to_the_sending_and_the_logged_goal_is_that_of_the_packet_s_arrival(tmp_path):
    log = TelemetryLog(tmp_path / "telemetry.csv")
    bench = StationWithPackets(latency_us=700, log=log.write, trajectory=Offsets(HOME, 45_000, x=Step(0.5)))
    seen = MocapFrame(
        1_000, HOME.p_WG, UPRIGHT, True, arrived_us=21_000, received_us=5_000, transmitted_us=11_000
    )
    bench.station.on_frame(seen, 33_000)
    assert bench.station.budget.last() == (4_000, 6_000, 10_000, 20_000, 12_000, 700)
    for data in telemetry_packets(20):
        bench.hear(50_000, data)
    log.close()
    (row,) = rows(tmp_path / "telemetry.csv")
    assert float(row["goal.x [m]"]) == 0.5
    assert [float(row[title]) for title in AGE_COLUMNS] == pytest.approx(
        [1e-6 * us for us in bench.station.budget.last()]
    )


def test_times_are_to_the_microsecond_on_a_computer_that_has_run_for_days(tmp_path):
    log = TelemetryLog(tmp_path / "telemetry.csv")
    bench = StationWithPackets(log=log.write)
    now_us = 1_000_000_123_457
    bench.station.on_frame(MocapFrame(now_us - 38_001, (0.0, 0.0, 1.15), UPRIGHT, True), now_us)
    for data in telemetry_packets(20):
        bench.hear(now_us, data)
    log.close()
    (row,) = rows(tmp_path / "telemetry.csv")
    times_us = [round(float(row[title]) * 1e6) for title in ("ground.t [s]", "mocap.t [s]")]
    assert times_us == [now_us, now_us - 38_001]


def test_a_lost_block_leaves_nan_in_its_own_row_only(tmp_path):
    log = TelemetryLog(tmp_path / "telemetry.csv")
    bench = StationWithPackets(log=log.write)
    for timestamp_ms, blocks in (
        (20, START_ORDER),
        (40, [b for b in START_ORDER if b is not telemetry.MOTION]),
    ):
        for data in telemetry_packets(timestamp_ms, blocks):
            bench.hear(0, data)
    log.close()
    first, second = rows(tmp_path / "telemetry.csv")
    assert float(first["stateEstimate.x [m]"]) == 0.5 + telemetry.BLOCKS[0].id
    assert isnan(float(second["stateEstimate.x [m]"]))
    assert float(second["stateEstimate.roll [rad]"]) == 0.5 + telemetry.BLOCKS[1].id
    assert isnan(float(second["mocap.x [m]"]))


def test_log_knows_velocity_and_quality_of_the_track_and_the_last_usable_pose(tmp_path):
    log = TelemetryLog(tmp_path / "telemetry.csv")
    bench = StationWithPackets(log=log.write, tracker=Tracker(TrackerConfig(), 5000))
    packet = next(telemetry_packets(20))
    bench.frames(100)
    bench.hear(500_000, packet)
    bench.station.on_frame(MocapFrame(500_000, (0.5, 0.0, 1.15), UPRIGHT, True), 538_000)
    bench.hear(540_000, next(telemetry_packets(40)))
    log.close()
    good, refused = rows(tmp_path / "telemetry.csv")
    assert (float(good["mocap.quality []"]), float(refused["mocap.quality []"])) == (
        Quality.TRACKED,
        Quality.REFUSED,
    )
    for row in (good, refused):
        assert float(row["mocap.vx [m/s]"]) == pytest.approx(0.2, abs=1e-3)
        assert float(row["mocap.r [rad/s]"]) == pytest.approx(0.0, abs=1e-6)
        assert float(row["mocap.x [m]"]) == pytest.approx(0.099)


def test_log_on_disk_is_never_much_more_than_a_second_old(tmp_path):
    log = TelemetryLog(tmp_path / "telemetry.csv")
    bench = StationWithPackets(log=log.write)
    for timestamp_ms in range(0, 10_000, 500):  # few bytes: no buffer is ever full
        for data in telemetry_packets(timestamp_ms):
            bench.hear(timestamp_ms * 1000, data)
        # not closed, as after a crash
        written = [int(row["board.t [ms]"]) for row in rows(tmp_path / "telemetry.csv")]
        assert timestamp_ms - max(written, default=0) <= 1500
    log.close()


def test_hold_holds_and_offsets_begin_at_their_start():
    assert Hold(HOME).at(0) == Hold(HOME).at(10**9) == HOME
    home = Goal((0.25, 0.0, 1.15), 0.5)
    trajectory = Offsets(home, 1_000_000, y=Square(0.05, -0.05, 0.1), z=Sine(0.2, 0.05), yaw=Step(1.5))
    assert trajectory.at(999_999) == home
    assert trajectory.at(1_000_000) == Goal((0.25, 0.05, 1.15), 2.0)
    assert trajectory.at(5_999_999).p_WG[1] == 0.05
    assert trajectory.at(6_000_000).p_WG[1] == -0.05
    assert trajectory.at(6_000_000).p_WG[2] == pytest.approx(1.35)
    assert trajectory.at(11_000_000).p_WG == pytest.approx((0.25, 0.05, 1.15))
    course = Along(lambda t: (1.0, t, 0.0))(home, 1_000_000)
    assert course.at(999_999) == home
    assert course.at(1_000_000) == Goal((1.25, 0.0, 1.15), 0.5)
    assert course.at(1_500_000) == Goal((1.25, 0.5, 1.15), 0.5)


@pytest.mark.parametrize("offset", [(1.0, 2.0), (1.0, 2.0, 3.0, 4.0, 5.0), (1.0, 2.0, inf), "xyz"])
def test_a_path_returns_three_finite_numbers_or_four(offset):
    with pytest.raises(ValueError, match="expected"):
        Along(lambda t: offset)(HOME, 0).at(0)


def test_the_last_row_of_the_budget_is_of_the_newest_pose():
    budget = LatencyBudget()
    for late_us in (10_000, 45_000):
        budget.add(MocapFrame(7, HOME.p_WG, UPRIGHT, True), 7 + late_us, LinkLatency("air", 0, measured=True))
    assert sum(part for part in budget.last() if not isnan(part)) == 45_000


def test_a_line_of_a_kind_is_due_again_after_five_seconds():
    throttle = Throttle()
    due = [t_us for t_us in (0, 1, 4_999_999, 5_000_000, 9_999_999, 10_000_001) if throttle.admits("a", t_us)]
    assert due == [0, 5_000_000, 10_000_001]
    assert throttle.admits("b", 4)


def test_both_epochs_count_from_the_clock_s_zero():
    now_us, unix_s = clock_us(), time.time()
    assert (epoch_us() + now_us) * 1e-6 == pytest.approx(unix_s, abs=1.0)
    signed_s = unix_s - datetime(2015, 1, 1, tzinfo=UTC).timestamp()
    assert signing_start() * 1e-5 + now_us * 1e-6 == pytest.approx(signed_s, abs=1.0)
