"""The tracker: velocity, the gate, gaps, new beginnings, and that it is filterpy's plain filter only faster."""

from dataclasses import replace
from math import inf, isnan, nan, pi

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ground_station.config import TrackerConfig
from ground_station.mocap import MocapFrame, judged
from ground_station.pose_filter import PoseFilter
from ground_station.tracker import FIT_US, Quality, Tracker, tracker_of
from ground_station.unused import Event, Reason, UnusedPoses

PERIOD_US = 5000
CONFIG = TrackerConfig()
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
HALF_TURN = (0.0, 0.0, 0.0, 1.0)
NOT_YET, YES = Quality.NONE, Quality.TRACKED


def frame(number: float, p=(0.1, -0.2, 1.15), q=UPRIGHT, valid: bool = True) -> MocapFrame:
    return judged(MocapFrame(round(number * PERIOD_US), tuple(map(float, p)), tuple(map(float, q)), valid))


def noisy(rng: np.random.Generator, number: float, p=(0.1, -0.2, 1.15), q=UPRIGHT) -> MocapFrame:
    turn = Rotation.from_rotvec(rng.normal(0.0, CONFIG.rotation_noise, 3))
    q = (Rotation.from_quat(q, scalar_first=True) * turn).as_quat(scalar_first=True)
    return frame(number, p + rng.normal(0.0, CONFIG.position_noise, 3), q)


def tracking(config: TrackerConfig = CONFIG, count: int = 100, seed: int = 1) -> Tracker:
    """A tracker that has seen a robot that stands still."""
    tracker = Tracker(config, PERIOD_US)
    rng = np.random.default_rng(seed)
    for number in range(count):
        tracker.track_frame(noisy(rng, number))
    assert tracker.quality is Quality.TRACKED
    return tracker


# Velocity


def motion(t: float) -> tuple[NDArray[np.float64], NDArray[np.float64], Rotation, NDArray[np.float64]]:
    """Position, velocity, attitude and body rate on a swinging way; the rate is exact for a fixed axis."""
    phase = 2 * pi * np.array([0.4, 0.7, 1.1])
    size, axis = np.array([0.3, 0.2, 0.1]), np.array([1.0, 2.0, -2.0]) / 3
    angle, rate = 1.5 * np.sin(2 * pi * 0.5 * t), 1.5 * pi * np.cos(2 * pi * 0.5 * t)
    return (
        size * np.sin(phase * t),
        size * phase * np.cos(phase * t),
        Rotation.from_rotvec(angle * axis),
        rate * axis,
    )


# The same as a plain filter


class Plain:
    """The same model with filterpy's full steps only; attitude as scipy's rotations."""

    def __init__(self, step_s: float) -> None:
        block = np.array([[1, 0, 0, step_s, 0, 0], [0, 1, 0, 0, step_s, 0], [0, 0, 1, 0, 0, step_s],
                          [0, 0, 0, 1, 0, 0], [0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 1]])  # fmt: skip
        one = np.array([[step_s**4 / 4, step_s**3 / 2], [step_s**3 / 2, step_s**2]])
        noise = [np.kron(one, np.eye(3)) * s**2 for s in (CONFIG.acceleration, CONFIG.angular_acceleration)]
        self.kf = KalmanFilter(12, 6)
        self.kf.x = np.zeros(12)
        self.kf.F, self.kf.Q = block_diag(block, block), block_diag(*noise)
        self.kf.H = np.zeros((6, 12))
        self.kf.H[range(6), [0, 1, 2, 6, 7, 8]] = 1.0
        self.kf.R = np.diag([CONFIG.position_noise**2] * 3 + [CONFIG.rotation_noise**2] * 3)
        self.kf.P = np.diag(
            [*[CONFIG.position_noise**2] * 3, 1, 1, 1, *[CONFIG.rotation_noise**2] * 3, *[25] * 3]
        )
        self.R = Rotation.identity()

    def step(self, seen: MocapFrame | None) -> None:
        self.kf.predict()
        if seen is not None:
            w, *xyz = (self.R.inv() * Rotation.from_quat(seen.q_WB, scalar_first=True)).as_quat(
                scalar_first=True
            )
            self.kf.update(np.array([*seen.p_WB, *(2.0 * np.array(xyz) / w)]))
        self.R *= Rotation.from_quat([1.0, *(0.5 * self.kf.x[6:9])], scalar_first=True)
        self.kf.x[6:9] = 0.0


@pytest.mark.long
def test_it_is_the_plain_kalman_filter_over_random_gaps() -> None:
    """Frames missing, or there without a pose, for up to 30 periods."""
    rng = np.random.default_rng(7)
    tracker, plain = Tracker(CONFIG, PERIOD_US), Plain(PERIOD_US * 1e-6)
    number = 0
    while number < 1500:
        if number > 1 and rng.random() < 0.02:
            gap = int(rng.integers(1, 30))
            silent = rng.random() < 0.5
            for _ in range(gap):
                if not silent:
                    tracker.track_frame(frame(number, valid=False))
                plain.step(None)
                number += 1
        p, _, R, _ = motion(number * PERIOD_US * 1e-6)
        seen = noisy(rng, number, p, R.as_quat(scalar_first=True))
        if number == 0:
            plain.kf.x[:3] = seen.p_WB
            plain.R = Rotation.from_quat(seen.q_WB, scalar_first=True)
            tracker.track_frame(seen)
        else:
            plain.step(seen)
            track = tracker.track_frame(seen)
            if number > 1:
                assert track.quality is YES
                assert track.v_WB == pytest.approx(plain.kf.x[3:6], abs=1e-9)
                assert track.w_B == pytest.approx(plain.kf.x[9:12], abs=1e-9)
        number += 1


def test_variances_are_those_of_the_plain_filter_before_the_pose() -> None:
    one, plain = (
        PoseFilter(0.005, 0.0005, 0.004, CONFIG.acceleration, CONFIG.angular_acceleration),
        Plain(0.005),
    )
    one.begin((0.0, 0.0, 0.0), UPRIGHT)
    for number in range(60):
        seen = None if 30 <= number < 36 else frame(number, (0.0, 0.0, 0.0))
        one.predict(1, widen=True)
        kf = plain.kf
        before = kf.F @ kf.P @ kf.F.T + kf.Q
        expected = (kf.H @ before @ kf.H.T + kf.R)[[0, 3], [0, 3]]
        plain.step(seen)
        assert one.variances == pytest.approx(expected, rel=1e-12)
        if seen is None:
            one.leave_out()
        else:
            one.update(seen.p_WB, (0.0, 0.0, 0.0))


def test_a_deviation_is_the_distance_and_twice_the_tangents_of_the_half_turn_from_the_prediction() -> None:
    """In the body's axes: from the reference, and squared from where the rate has turned it since."""
    rng = np.random.default_rng(3)
    one = PoseFilter(0.005, 0.0005, 0.004, CONFIG.acceleration, CONFIG.angular_acceleration)
    for _ in range(20):
        start, turn, p = Rotation.random(rng=rng), 0.3 * rng.normal(size=3), rng.normal(size=3)
        one.begin(tuple(rng.normal(size=3)), tuple(start.as_quat(scalar_first=True)))
        one.predict(1, widen=True)
        _, w = one.update(tuple(rng.normal(size=3)), tuple(0.1 * rng.normal(size=3)))
        one.predict(1, widen=True)
        place, q = one.pose
        seen = Rotation.from_quat(q, scalar_first=True) * Rotation.from_rotvec(turn)
        distance2, angle2, theta = one.deviation(tuple(p), tuple(seen.as_quat(scalar_first=True)))
        angle = np.linalg.norm(turn)
        assert theta == pytest.approx(2 * np.tan(angle / 2) * turn / angle, rel=1e-9)
        assert distance2 == pytest.approx(((p - place) ** 2).sum(), rel=1e-9)
        assert angle2 == pytest.approx(((np.array(theta) - 0.005 * np.array(w)) ** 2).sum(), rel=1e-9)


def test_a_filter_that_begins_again_is_a_new_one() -> None:
    noise = 0.005, 0.0005, 0.004, CONFIG.acceleration, CONFIG.angular_acceleration
    used, new = PoseFilter(*noise), PoseFilter(*noise)
    used.begin((0.0, 0.0, 0.0), UPRIGHT)
    for number in range(1, 20):
        used.predict(1, widen=True)
        used.update((0.01 * number, 0.02, -0.01 * number), (0.02, 0.01, -0.03))
    used.predict(3, widen=True)  # and no pose after it
    found = []
    for one in (used, new):
        one.begin((1.0, 2.0, 3.0), HALF_TURN)
        one.predict(2, widen=True)
        deviation = one.deviation((1.01, 2.0, 3.0), HALF_TURN)
        found.append((one.variances, one.pose, deviation, one.update((1.01, 2.0, 3.0), deviation[2])))
    assert found[0] == found[1]


@pytest.mark.long
def test_the_attitude_is_of_unit_length_from_the_first_pose_on_and_however_long_the_robot_turns() -> None:
    one = PoseFilter(0.005, 0.0005, 0.004, CONFIG.acceleration, CONFIG.angular_acceleration)
    one.begin((0.0, 0.0, 0.0), (0.95, 0.0, 0.0, 0.0))
    for number in range(1, 1000):
        assert np.linalg.norm(one.pose[1]) == pytest.approx(1.0, abs=1e-12)
        q = Rotation.from_euler("z", 0.02 * number).as_quat(scalar_first=True)
        one.predict(1, widen=True)
        _, _, theta = one.deviation((0.0, 0.0, 0.0), tuple(q))
        one.update((0.0, 0.0, 0.0), theta)


# The gate


@pytest.mark.long
def test_distances_are_distributed_as_chi2_when_the_robot_moves_as_assumed() -> None:
    one = PoseFilter(0.005, 0.0005, 0.004, CONFIG.acceleration, CONFIG.angular_acceleration)
    rng, p, v = np.random.default_rng(5), np.zeros(3), np.zeros(3)
    one.begin((0.0, 0.0, 0.0), UPRIGHT)
    distances = []
    for number in range(5000):
        seen = noisy(rng, number, p)
        one.predict(1, widen=True)
        distance2, _, theta = one.deviation(seen.p_WB, seen.q_WB)
        distances.append(distance2 / one.variances[0])
        one.update(seen.p_WB, theta)
        a = rng.normal(0.0, CONFIG.acceleration, 3)
        p, v = p + v * 0.005 + 0.5 * a * 0.005**2, v + a * 0.005
    for share in (0.5, 0.9, 0.99):
        assert np.mean(distances < chi2.ppf(share, 3)) == pytest.approx(
            share, abs=4 * np.sqrt(share * (1 - share) / 5000)
        )


@pytest.mark.parametrize("count", [1, 3, 20, 60, 78])
@pytest.mark.parametrize(
    ("p", "q"),
    [
        ((0.2, -0.2, 1.15), UPRIGHT),
        ((0.1, -0.7, 1.15), UPRIGHT),
        ((0.1, -0.2, 1.15), HALF_TURN),
        ((0.1, -0.2, 1.15), (0.0, 1.0, 0.0, 0.0)),
        ((0.2, -0.2, 1.15), HALF_TURN),
    ],
)
def test_wrong_poses_that_agree_are_refused_for_less_than_the_time_to_reacquire(p, q, count: int) -> None:
    tracker, rng = tracking(), np.random.default_rng(2)
    for number in range(100, 100 + count):
        track = tracker.track_frame(noisy(rng, number, p, q))
        assert (track.quality, track.frame.valid) == (Quality.REFUSED, False)
    assert tracker.counters.refused == count


def test_wrong_poses_each_in_a_direction_of_its_own_never_pass() -> None:
    tracker, rng = tracking(), np.random.default_rng(4)
    for number in range(100, 400):
        offset = rng.normal(size=3)
        track = tracker.track_frame(
            noisy(rng, number, (0.1, -0.2, 1.15) + 0.5 * offset / np.linalg.norm(offset))
        )
        assert track.quality is not Quality.TRACKED


def test_the_robot_is_found_again_after_outliers_of_a_tenth_of_a_second_however_often() -> None:
    tracker, rng = tracking(), np.random.default_rng(2)
    for start in range(100, 400, 100):
        for number in range(start, start + 20):
            assert tracker.track_frame(noisy(rng, number, (0.6, -0.2, 1.15))).quality is Quality.REFUSED
        here = (0.1 + 2e-4 * start, -0.2, 1.15)  # 2 cm further every time: the gate has widened
        for number in range(start + 20, start + 100):
            assert tracker.track_frame(noisy(rng, number, here)).quality is YES
    assert tracker.counters.restarts == 0


@pytest.mark.parametrize("w", [0.0, 5e-324, -1e-300, 1e-17])
def test_the_exact_opposite_attitude_is_refused(w: float) -> None:
    tracker = Tracker(CONFIG, PERIOD_US)
    for number in range(3):
        tracker.track_frame(frame(number))
    assert tracker._filter.pose[1] == UPRIGHT
    wrong, after = frame(3, q=(w, 1.0, 0.0, 0.0)), [frame(number) for number in range(4, 110)]
    assert [line for _, line in told(tracker, [wrong, *after])] == [
        "motion capture: 1 pose refused, up to 0.00 m and 180 deg from the prediction"
    ]


@pytest.mark.long
@pytest.mark.parametrize(
    ("p", "q"),
    [
        ((nan, 0.0, 0.0), UPRIGHT),
        ((0.0, inf, 0.0), UPRIGHT),
        ((0.0, 0.0, -1e308), UPRIGHT),
        ((0.1, -0.2, 1.15), (0.0, 0.0, 0.0, 0.0)),
        ((0.1, -0.2, 1.15), (nan, 0.0, 0.0, 1.0)),
        ((0.1, -0.2, 1.15), (1.02, 0.0, 0.0, 0.0)),
    ],
)
def test_an_invalid_pose_counts_as_not_seen(p, q) -> None:
    tracker = tracking()
    track = tracker.track_frame(frame(100, p, q))
    assert (track.quality, track.frame.valid) == (NOT_YET, False)
    assert tracker.track_frame(noisy(np.random.default_rng(2), 101)).quality is YES
    assert tracker.counters.refused == 0
    assert qualities(*[frame(n, p, q) for n in range(5)]) == [NOT_YET] * 5


@pytest.mark.long
def test_a_push_of_20_newton_is_accepted() -> None:
    """59 m/s^2 for 0.1 s on each axis and its opposite, and 0.2 N m (154 rad/s^2) at the same time."""
    for axis in np.vstack((np.eye(3), -np.eye(3))):
        tracker, rng = tracking(), np.random.default_rng(6)
        for number in range(100, 140):
            t = (number - 100.3) * PERIOD_US * 1e-6
            pushed, after = max(0.0, min(t, 0.1)), max(0.0, t - 0.1)
            way = 0.5 * pushed**2 + pushed * after
            turn = Rotation.from_rotvec(154.0 * way * axis).as_quat(scalar_first=True)
            seen = noisy(rng, number, (0.1, -0.2, 1.15) + 20.0 / 0.34 * way * axis, turn)
            assert tracker.track_frame(seen).quality is Quality.TRACKED, f"{axis} {number}"


# Gaps


def test_in_a_gap_no_pose_goes_out_and_the_velocity_is_that_before_it() -> None:
    tracker, rng = Tracker(CONFIG, PERIOD_US), np.random.default_rng(8)
    v = np.array([0.5, -0.3, 0.2])
    for number in range(140):
        seen = noisy(rng, number, v * number * PERIOD_US * 1e-6)
        track = tracker.track_frame(seen if number <= 120 else replace(seen, valid=False))
        if number > 120:
            assert (track.frame.valid, track.quality) == (False, Quality.NONE)
            assert track.v_WB == pytest.approx(v, abs=0.1)


# New beginnings


def qualities(*frames: MocapFrame) -> list[Quality]:
    tracker = Tracker(CONFIG, PERIOD_US)
    return [tracker.track_frame(seen).quality for seen in frames]


def test_a_track_begins_with_three_poses_that_fit() -> None:
    tracker = Tracker(CONFIG, PERIOD_US)
    for number in (0, 1):
        track = tracker.track_frame(frame(number))
        assert (track.quality, track.frame.valid) == (NOT_YET, False)
        assert isnan(track.v_WB[0])
    assert tracker.track_frame(frame(2)).quality is YES


def test_poses_before_the_first_track_make_it_no_restart() -> None:
    tracker = Tracker(CONFIG, PERIOD_US)
    for number in (0, 1, 500, 501, 502):
        track = tracker.track_frame(frame(number))
    assert (track.quality, track.event, tracker.counters.restarts) == (YES, Event.NONE, 0)


def test_a_stray_first_pose_does_not_lock_the_gate() -> None:
    stray = (1.0, 1.0, 1.0)
    assert qualities(frame(0, stray), frame(1), frame(2), frame(3), frame(4)) == [NOT_YET] * 3 + [YES] * 2
    assert qualities(frame(0), frame(1, stray), frame(2), frame(3), frame(4)) == [NOT_YET] * 4 + [YES]


def test_between_the_first_poses_frames_may_be_missing_but_not_for_long() -> None:
    late = FIT_US // PERIOD_US
    assert qualities(frame(0), frame(2), frame(3, valid=False), frame(5)) == [NOT_YET] * 3 + [YES]
    assert qualities(frame(0), frame(1), frame(1 + late), frame(2 + late)) == [NOT_YET] * 4


@pytest.mark.parametrize("every", [10, 12, 20, 40])  # frames of the profile's period: 20 to 5 Hz
def test_a_track_begins_with_cameras_that_are_slower_than_the_profile_has_it(every: int) -> None:
    numbers = [every * k for k in range(5)]
    assert qualities(*map(frame, numbers)) == [NOT_YET] * 2 + [YES] * 3
    assert qualities(*map(frame, (*numbers[:2], *(every * k for k in (5, 6, 7))))) == [NOT_YET] * 4 + [YES]


def test_a_robot_that_falls_is_tracked_from_the_third_pose_on() -> None:
    falls = [frame(n, (0.0, 0.0, 1.0 - 6.0 * 0.005 * n)) for n in range(3)]
    assert qualities(*falls) == [NOT_YET, NOT_YET, YES]


def test_after_the_time_to_reacquire_the_track_restarts_at_the_newest_pose() -> None:
    tracker, rng = tracking(), np.random.default_rng(2)
    tracked = [
        tracker.track_frame(noisy(rng, n, (0.6, -0.2, 1.15))).quality is Quality.TRACKED
        for n in range(100, 200)
    ]
    assert tracked.index(True) == 81  # 99 was the last good one, 179 is 400 ms later, 180 and 181 fit it
    assert all(tracked[81:])
    assert tracker.counters.refused == 79
    assert tracker.counters.restarts == 1


@pytest.mark.long
@pytest.mark.parametrize("jump_us", [-(10**15), -3_600_000_000, -400_000, 400_000, 10**15])
def test_a_clock_that_jumps_costs_two_frames(jump_us: int) -> None:
    tracker, rng = tracking(), np.random.default_rng(2)
    jumped = [replace(seen, t_us=seen.t_us + jump_us) for seen in (noisy(rng, n) for n in range(99, 103))]
    assert [tracker.track_frame(seen).quality for seen in jumped] == [NOT_YET, NOT_YET, YES, YES]


def test_a_clock_that_jumps_before_the_track_begins_costs_two_frames() -> None:
    far = [frame(n) for n in (10**9, 3 * 10**9, 5 * 10**9)]
    assert qualities(*far, *(frame(n) for n in range(1000, 1004)))[-4:] == [NOT_YET, NOT_YET, YES, YES]


def test_late_and_repeated_frames_are_refused_and_change_nothing() -> None:
    first, second, rng = tracking(), tracking(), np.random.default_rng(2)
    for number in range(100, 130):
        seen = noisy(rng, number)
        track = first.track_frame(seen)
        again = first.track_frame(seen)
        assert (again.quality, again.frame.valid) == (Quality.REFUSED, False)
        assert first.track_frame(frame(number - 7.5, (9.0, 9.0, 9.0))).quality is Quality.REFUSED
        assert track == second.track_frame(seen)
    assert first.counters.refused == 60


# What it tells


def told(tracker: Tracker, frames: list[MocapFrame]) -> list[tuple[int, str]]:
    """Frame times and lines."""
    unused, lines = UnusedPoses(), []
    unused.note(frames[0].t_us - PERIOD_US, frames[0].t_us - PERIOD_US, None)
    for seen in frames:
        track = tracker.track_frame(seen)
        unused.note(seen.t_us, seen.t_us, None if track.frame.valid else track.frame.unused, track.event)
        lines += [(seen.t_us, line) for line in unused.due()]
    return lines


@pytest.mark.long
@pytest.mark.parametrize(("after", "periods"), [(0.6, 1), (1.4, 1), (1.6, 2), (2.4, 2), (2.6, 3)])
def test_a_frame_between_two_periods_counts_as_the_nearer_one(after: float, periods: int) -> None:
    tracks = [tracking().track_frame(frame(99 + shift, (0.101, -0.2, 1.15))) for shift in (after, periods)]
    assert tracks[0].v_WB == tracks[1].v_WB


@pytest.mark.long
@given(st.integers(0, 2**32), st.integers(0, 9))
@settings(max_examples=20, deadline=None)
def test_a_track_after_a_loss_is_that_of_a_new_tracker(seed: int, missing: int) -> None:
    lost, fresh = tracking(), Tracker(CONFIG, PERIOD_US)
    for number in range(100, 150):  # poses that are refused for long, and then none
        lost.track_frame(frame(number, (0.6, 0.6, 0.6)))
    lost.track_frame(frame(1000, valid=False))
    rng = np.random.default_rng(seed)
    v = rng.uniform(-2.0, 2.0, 3)
    for number in [0, *range(1 + missing, 30)]:
        seen = noisy(rng, 1100 + number, v * number * PERIOD_US * 1e-6)
        one, other = lost.track_frame(seen), fresh.track_frame(seen)
        assert (one.quality, one.frame) == (other.quality, other.frame)
        assert np.array_equal([*one.v_WB, *one.w_B], [*other.v_WB, *other.w_B], equal_nan=True)


def test_poses_alternate_from_the_third_return_on_and_poses_of_one_place_never_do() -> None:
    def reasons(numbers: range, every: int) -> list[Reason]:
        tracker = tracking()
        tracks = [
            (
                number,
                tracker.track_frame(
                    frame(number, (0.6, 0.6, 1.15)) if number % every == 0 else frame(number)
                ),
            )
            for number in numbers
        ]
        return [track.frame.unused[0] for number, track in tracks if number % every == 0]

    assert reasons(range(100, 112), 2) == [Reason.DEVIATES] * 3 + [Reason.PLACES] * 3
    assert reasons(range(100, 112), 1) == [Reason.DEVIATES] * 12


def test_one_line_reports_refused_poses() -> None:
    rng = np.random.default_rng(2)
    wrong = {120, 121, 122}
    frames = [
        noisy(
            rng,
            n,
            (0.6, -0.2, 1.15) if n in wrong else (0.1, -0.2, 1.15),
            HALF_TURN if n in wrong else UPRIGHT,
        )
        for n in range(100, 400)
    ]
    lines = told(tracking(), frames)
    assert lines == [
        (
            120 * PERIOD_US + 500_000,
            "motion capture: 3 poses refused, up to 0.50 m and 180 deg from the prediction",
        )
    ]


@pytest.mark.long
def test_a_track_that_is_lost_and_restarted_is_reported() -> None:
    rng = np.random.default_rng(2)
    blind = [replace(noisy(rng, n), valid=False) for n in range(100, 400)]
    back = [noisy(rng, n) for n in range(400, 600)]
    lines = told(tracking(), blind + back)
    assert [line for _, line in lines] == [
        "motion capture: 101 poses missing: the body is not tracked; track lost",
        "motion capture: track restarted after 1.5 s",
    ]


@pytest.mark.long
def test_occasional_outliers_are_reported_at_most_twice_a_second() -> None:
    rng = np.random.default_rng(2)
    frames = [noisy(rng, n) if n % 10 else frame(n, rng.uniform(-1, 1, 3)) for n in range(100, 2100)]
    assert 10 <= len(told(tracking(), frames)) <= 20


def test_the_summary_counts() -> None:
    tracker = tracking()
    tracker.track_frame(frame(100, (0.0, 0.0, 0.0)))
    assert tracker.summary() == "refused (1 refused, 0 restarts)"


# Whatever comes

number = st.floats(allow_nan=True, allow_infinity=True) | st.sampled_from([nan, inf, 0.0, 1e308, 1.15])
moment = st.integers(-(2**63), 2**63) | st.integers(0, 400).map(lambda n: n * PERIOD_US)
wild = st.builds(
    MocapFrame, moment, st.tuples(number, number, number), st.tuples(*[number] * 4), st.booleans()
).map(judged)
tame = st.builds(
    MocapFrame,
    st.integers(0, 400).map(lambda n: n * PERIOD_US),
    st.tuples(*[st.floats(-2.0, 2.0)] * 3) | st.tuples(number, number, number),
    st.sampled_from([UPRIGHT, HALF_TURN, (0.6, 0.8, 0.0, 0.0), (-1.0, 0.0, 0.0, 0.0)]),
    st.booleans(),
).map(judged)


@settings(max_examples=150, deadline=None)
@given(st.lists(wild | tame, max_size=40))
@pytest.mark.long
def test_anything_may_come_and_the_tracker_recovers(frames: list[MocapFrame]) -> None:
    tracker = Tracker(CONFIG, PERIOD_US)
    for seen in frames:
        track = tracker.track_frame(seen)
        assert track.frame.valid is (track.quality is Quality.TRACKED)
        assert track.frame is seen or not track.frame.valid
    after = [tracker.track_frame(frame(1000 + n)).quality for n in range(100)]
    assert after[82:] == [YES] * 18


def test_a_profile_may_do_without() -> None:
    assert tracker_of(TrackerConfig(enabled=False), PERIOD_US) is None


@pytest.mark.parametrize(("few", "parts"), [(10, 2), (9, 1)])
def test_a_line_has_the_reasons_of_a_tenth_of_the_poses_and_none_of_fewer(few: int, parts: int) -> None:
    unused = UnusedPoses()
    for number in range(100):
        reason = Reason.FROZEN if number >= few else Reason.NOT_A_NUMBER
        unused.note(5000 * number, 5000 * number, (reason, ()))
    unused.note(500_000, 500_000, None)
    (line,) = unused.due()
    assert line.count("unusable") == parts
    assert unused.counts == {Reason.FROZEN: 100 - few, Reason.NOT_A_NUMBER: few}


def test_a_line_has_the_largest_deviations_and_the_latest_of_other_values() -> None:
    unused = UnusedPoses()
    for number, (distance, angle) in enumerate(((0.1, 5.0), (0.3, 2.0), (0.2, 9.0))):
        unused.note(1000 * number, 0, (Reason.DEVIATES, (distance, angle)))
        unused.note(1000 * number, 0, (Reason.QUATERNION, (distance,)))
    unused.note(500_000, 0, None)
    assert unused.due() == [
        "motion capture: 3 poses refused, up to 0.30 m and 9 deg from the prediction; "
        "3 poses unusable: a quaternion of length 0.20, not 1"
    ]


def test_a_reason_is_reported_again_after_five_seconds_each_time_and_a_lost_track_each_time():
    unused, lines = UnusedPoses(), []
    for now_us in range(0, 18_000_000, 100_000):
        event = Event.LOST if now_us in (2_000_000, 3_000_000) else Event.NONE
        unused.note(now_us, now_us, (Reason.FROZEN, ()), event)
        lines += [(now_us, line) for line in unused.due()]
    frozen = [now_us for now_us, line in lines if "repeats one pose" in line]
    assert frozen[0] == 500_000
    assert all(5_000_000 <= gap <= 5_600_000 for gap in np.diff(frozen))
    assert len(frozen) == 4
    assert [line for _, line in lines if "pose" not in line] == ["motion capture: track lost"] * 2
