"""The errors that metrics are made of are those that the board flies on; metrics count from the release to the end."""

import json
from math import pi, radians

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.geometry import from_euler_zyx, in_goal_frame, to_euler_zyx, yaw_quaternion
from firmware_py.wire.supervisor import State
from hil.errors import LabError
from hil.laboratory.experiment import Experiment
from hil.laboratory.experiments import measures
from hil.laboratory.metric_pairs import MetricPair, differing, pairs_of, text_of
from hil.laboratory.metrics import (
    ALWAYS,
    METRICS,
    PHASES,
    Metric,
    _time_seen,
    attitude_error,
    judge,
    limits_of,
    measure,
    position_error,
    short_of,
    show,
)

length, angle, tilt = st.floats(-3.0, 3.0), st.floats(-pi, pi), st.floats(-1.2, 1.2)
place = st.tuples(length, length, length)
rows = st.tuples(place, st.tuples(tilt, tilt, angle).map(lambda euler: from_euler_zyx(*euler)), place, angle)


@pytest.mark.long
@given(st.lists(rows, min_size=1, max_size=5))
def test_errors_are_the_pose_in_the_goal_frame(flight) -> None:
    values = np.array([(*p_WB, *q_WB, *p_WG, yaw) for p_WB, q_WB, p_WG, yaw in flight]).T
    names = [f"truth.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    names += [f"goal.{name}" for name in ("x", "y", "z", "yaw")]
    table = pa.table(dict(zip(names, values, strict=True)))
    poses = [in_goal_frame(*row) for row in flight]
    assert position_error(table) == pytest.approx(np.array([p_GB for p_GB, _ in poses]), abs=1e-12)
    off = attitude_error(table) - np.array([to_euler_zyx(q_GB) for _, q_GB in poses])
    off[:, 2] = np.remainder(off[:, 2] + pi, 2 * pi) - pi  # half a turn is the same either way
    assert off == pytest.approx(np.zeros_like(off), abs=1e-9)


def test_metrics_count_from_the_release_to_the_end() -> None:
    """Held for 4 s, then free for 10 s: 2 s in failsafe, 3 s with a dead estimate; on the serial line, with a tracker."""
    free = [*4 * [0], *11 * [1]]
    log: dict[str, object] = {
        "t": [1_000_000 * second for second in range(15)],
        "flight.free": free,
        "truth.x": [*4 * [5.0], *10 * [0.05], 0.3],
        "truth.y": [*7 * [0.01], 0.2, *7 * [0.01]],
        "truth.z": [*9 * [0.0], -0.11, 0.0, 0.06, 0.1, 0.0, 0.0],
        "truth.qw": [*14 * [1.0], np.cos(0.1)],
        "truth.qy": [*14 * [0.0], -np.sin(0.1)],
        "supervisor.state": [2, 0, 2, 3, 3, 3, *9 * [2]],
        "serial.up_busy": [9 * 10**5 * second for second in range(4)]
        + [3_600_000 + 10**5 * n for n in range(11)],
        "serial.down_busy": [10**6 * second // 2 for second in range(15)],
        "serial.overrun": [*range(8), *7 * [7]],
        "estimator.refused": [*10 * [0], *5 * [2]],
        "estimator.too_old": [1] * 15,
        "estimator.invalid": range(15),
        "tracker.refused": range(0, 30, 2),
        "estimator.pose_age_us": [*4 * [0], *10 * [40_000], 51_000],
        "loop.delay": [*4 * [0], *11 * [2_000]],
        "loop.added": [*4 * [0], *11 * [5_000]],
        "loop.stood": [1_000_000 * second for second in range(15)],
    } | {f"loop.{name}": [*14 * [0], n] for n, name in enumerate(("held", "late", "lost", "doubled"), 1)}
    still = dict.fromkeys(("truth.qx", "truth.qz"), [0.0] * 15)
    rms_x, rms_y = (np.sqrt((10 * rest**2 + most**2) / 11) for rest, most in ((0.05, 0.3), (0.01, 0.2)))
    goal = {f"goal.{name}": [0.0] * 15 for name in ("x", "y", "z", "yaw")}
    estimate = {f"estimate.{name}": [*range(6), 5, 7, 8, 9, *3 * [10], 13, 14] for name in "xyzpqr"}
    table = pa.table(log | still | goal | estimate)
    values = measure(table, lost=False)
    told = {name: value for name, value in values.items() if not np.isnan(value)}
    assert told == pytest.approx(
        {
            "lost": 0.0, "flown": 10.0, "rms_x": rms_x, "rms_y": rms_y,
            "rms_z": np.sqrt((0.11**2 + 0.06**2 + 0.1**2) / 11), "max_x": 0.3, "max_y": 0.2, "max_z": 0.11,
            "within_6cm_x": 10 / 11, "within_6cm_y": 10 / 11, "within_6cm_z": 8 / 11, "in_box": 8 / 11,
            "attitude_max": 0.2, "y_over_x": rms_y / rms_x, "age_mean": 0.041, "failsafe": 10.0 * 2 / 11,
            "resets": 0.0, "uncontrolled": 10.0 * 5 / 11, "unseen": 0.0, "line_up": 0.1, "line_down": 0.5,
            "line_overrun": 7.0, "poses_refused": 2 + 1 + 14, "frames_refused": 28.0, "loop_delay": 0.002,
            "loop_added": 0.005, "loop_stood": 14.0, "samples_held": 1.0, "samples_late": 2.0,
            "samples_lost": 3.0, "samples_doubled": 4.0,
        }
    )  # fmt: skip
    assert told.keys() <= METRICS.keys()
    calibrates = [*5 * [2], *4 * [State.CALIBRATING], *3 * [2], *3 * [State.CALIBRATING]]
    booted = table.set_column(table.column_names.index("supervisor.state"), "supervisor.state", [calibrates])
    assert (measure(booted, lost=False)["resets"], measure(booted, False, resets=5)["resets"]) == (2.0, 5.0)
    assert Experiment("mine", "", 1.0, {}).metrics_of(booted, False, 5)["resets"] == 5.0
    own = Experiment(
        "mine",
        "",
        1.0,
        {},
        measure=lambda flight: {"rows": flight.num_rows},
        metrics={"rows": Metric("", "max", "rows")},
    )
    judged = [own.metrics_of(table.slice(0, count), False)["rows"] for count in (5, 6, 15)]
    assert judged == pytest.approx([np.nan, 2.0, 11.0], nan_ok=True)
    short = measure(table.slice(0, 5), lost=True)  # a single row is free
    assert {name: value for name, value in short.items() if not np.isnan(value)} == {
        "lost": 1.0,
        "flown": 0.0,
    }


def test_a_flight_from_floor_to_floor_is_judged_by_its_phases() -> None:
    """Rows every 0.1 s: on the floor, up to 1 m in 1 s, there until 3 s, down in 1 s; the goal is always 1 s ahead."""
    times = np.arange(51) * 100_000
    height = np.interp(times * 1e-6, [0.0, 1.0, 3.0, 4.0], [0.02, 1.0, 1.0, 0.02])
    goal = np.interp(times * 1e-6, [0.0, 1.0, 2.0, 3.0], [1.0, 1.0, 1.0, 0.0])
    log = {
        "t": times, "flight.free": np.ones(51), "truth.z": height, "goal.z": goal, "truth.qw": np.ones(51),
        "truth.vz": np.gradient(height, 0.1), "truth.y": 0.3 * (times == 500_000) + 0.04 * (times == 5_000_000),
        "supervisor.state": 2 * np.ones(51), **{f"estimate.{name}": times for name in "xyzpqr"},
    }  # fmt: skip
    log["truth.vz"][[29, 32]] = -2.0, -1.5  # 1.1 and 0.8 s before the feet touch
    log["truth.x"] = 0.01 * (times == 1_500_000) + 0.02 * (
        times == 2_000_000
    )  # first held row, first of the landing
    zero = ("goal.x", "goal.y", "goal.yaw", "truth.qx", "truth.qy", "truth.qz")
    table = pa.table({**log, **{name: np.zeros(51) for name in zero}})
    phases = {"take_off_us": 0, "begin_us": 1_500_000, "land_us": 2_000_000, "landed_us": 4_000_000}
    values = measure(table.replace_schema_metadata({PHASES: json.dumps(phases)}), lost=False)
    assert (values["max_z"], values["rms_z"], values["in_box"]) == (0.0, 0.0, 1.0)
    assert values["held"] == pytest.approx(0.5)
    assert values["reached_box"] == pytest.approx(0.9)
    assert values["touch_down_speed"] == pytest.approx(1.5), "of the last ten rows"
    for row in (30, 40):  # the first of them, and the one in which the feet touch
        descent = np.zeros(51)
        descent[[29, row, 41]] = -2.0, -1.5, -2.0
        other = pa.table(
            {name: descent if name == "truth.vz" else table[name] for name in table.column_names}
        )
        touched = measure(other.replace_schema_metadata({PHASES: json.dumps(phases)}), lost=False)
        assert touched["touch_down_speed"] == pytest.approx(1.5)
    assert values["max_x"] == pytest.approx(0.01)
    assert values["off_path"] == pytest.approx(0.3)
    assert values["landed_off_axis"] == pytest.approx(0.04)
    assert measure(table, lost=False)["max_z"] == pytest.approx(1.0), "all of a flight without phases"
    for damaged in ("[]", "{}", "nothing", '{"take_off_us": "soon"}'):
        with pytest.raises(LabError, match=r"^phases in the log's schema = .*: expected instants"):
            measure(table.replace_schema_metadata({PHASES: damaged}), lost=False)


@pytest.mark.parametrize(
    ("seen", "flown_s", "unseen_s"),
    [("1111", 3, 0), ("1011", 1, 2), ("1101", 1, 2), ("1010", 0, 2), ("0111", 2, 1)],
)
def test_a_second_counts_as_flown_when_both_its_ends_were_seen(
    seen: str, flown_s: float, unseen_s: float
) -> None:
    """A second that was not seen at the end of the log belongs to nobody, when the next pose may still be under way."""
    places = [0.0 if one == "1" else np.nan for one in seen]
    end_us = 3_000_000 if seen[-1] == "1" else 2_100_000
    log = {"t": [0, 1_000_000, 2_000_000, end_us], "flight.free": [1] * 4, "cameras.x": places}
    assert _time_seen(pa.table(log)) == (flown_s, unseen_s)


def test_a_profile_s_limits_replace_those_of_the_experiment_and_of_every_flight() -> None:
    assert limits_of({"rms_x": 1.0}) == {"rms_x": 1.0, **ALWAYS}
    assert limits_of({"rms_x": 1.0, "resets": 2.0}) == {"rms_x": 1.0, **ALWAYS, "resets": 2.0}
    assert limits_of({"resets": 2.0}, {"rms_y": 2.0}) == {"rms_y": 2.0, **ALWAYS, "resets": 2.0}
    assert limits_of({"rms_x": 1.0}, {"rms_y": 2.0, "unseen": 3.0}) == {"rms_y": 2.0, **ALWAYS, "unseen": 3.0}


def test_a_limit_on_an_unknown_metric_is_refused() -> None:
    with pytest.raises(LabError, match="no such metric; did you mean rms_"):
        judge({"lost": 0.0}, {"rms_q": 1.0}, {})


@pytest.mark.parametrize(("lost", "admitted", "applies"), [
    (0.0, None, True), (1.0, None, False), (1.0, 0.0, False), (1.0, 1.0, True), (0.0, 1.0, True),
])  # fmt: skip
def test_a_lost_flight_fails_all_limits_unless_the_loss_is_admitted(lost, admitted, applies) -> None:
    limits = {"rms_x": 0.5, "in_box": 0.9} | ({} if admitted is None else {"lost": admitted})
    good = judge({"lost": lost, "rms_x": 0.5, "in_box": 0.9}, limits, {})  # each at its bound
    assert [(one.metric, one.holds, one.applies) for one in good[:2]] == [
        ("rms_x", applies, applies),
        ("in_box", applies, applies),
    ]
    assert [one.holds for one in good[2:]] == ([] if admitted is None else [lost <= admitted])
    assert str(good[1]) == f"in_box = 90 %{'' if applies else ' until the robot was lost'} (limit >= 90 %)"
    bad = judge({"lost": lost, "rms_x": 0.5001, "in_box": np.nan}, limits, {})
    assert [one.mark for one in bad[:2]] == ["FAILS" if applies else "lost"] * 2


def test_a_share_names_its_time_where_that_is_more_than_a_tenth_of_a_second_short() -> None:
    share, values = METRICS["in_box"], {"flown": 7.9, "held": np.nan}
    assert [short_of(share, 1.0, values, duration_s) for duration_s in (7.9, 7.99, 8.1)] == [
        "",
        "",
        " of 7.9 s",
    ]
    assert short_of(share, 1.0, {"flown": 7.9, "held": 3.0}, 8.0) == " of 3 s"
    assert short_of(METRICS["rms_x"], 1.0, values, 60.0) == short_of(share, np.nan, values, 60.0) == ""


def test_two_flights_are_compared_in_every_metric_that_one_of_them_has() -> None:
    pairs = pairs_of(
        {"rms_x": 0.01, "in_box": 0.5, "lost": 0.0}, {"rms_x": 0.02, "in_box": 0.25, "rms_y": 0.5}, {}
    )
    named = {one.name: one for one in pairs}
    assert list(named) == ["lost", "rms_x", "rms_y", "in_box"]  # in the order of all metrics
    assert named["rms_x"].cells == ("rms_x", "1", "2", "1", "cm")
    assert named["in_box"].cells == ("in_box", "50", "25", "-25", "%")
    assert named["lost"].cells[1:4] == ("0", "–", "–")
    assert {one.name for one in differing(pairs)} == {"lost", "rms_x", "rms_y", "in_box"}
    assert differing(pairs_of({"rms_x": 0.01}, {"rms_x": 0.01}, {})) == []
    near = (("rms_x", 0.99), ("rms_x", 1.0), ("in_box", 0.5), ("in_box", 0.49))
    assert [named[name].within(rel) for name, rel in near] == [False, True, True, False]
    assert not named["rms_y"].within(10.0)
    assert MetricPair("never", "s", (np.inf, np.inf)).within(0.0)
    assert text_of([named["rms_x"]]) == [
        "metric  first  second  difference  unit",
        "rms_x       1       2           1  cm",
    ]


def test_what_never_happens_is_shown_as_never() -> None:
    assert (show(np.inf, "s"), show(0.123, "m"), show(-np.inf, "")) == ("never", "12.3 cm", "-inf")


ROWS = 400
TIMES = 10_000 * np.arange(ROWS)


def turned(yaw: np.ndarray, goal: np.ndarray) -> pa.Table:
    """Rows of a flight at home that looks along `yaw`, wanted is `goal` [rad]."""
    q = np.array([yaw_quaternion(angle) for angle in yaw.tolist()])
    zero = np.zeros(len(yaw))
    columns = {
        "t": TIMES[: len(yaw)],
        "flight.free": zero + 1,
        "goal.yaw": goal,
        "supervisor.state": zero + 2,
    }
    columns |= {f"truth.q{part}": q[:, index] for index, part in enumerate("wxyz")}
    columns |= dict.fromkeys(("truth.x", "truth.y", "truth.z", "goal.x", "goal.y", "goal.z", "truth.r"), zero)
    columns |= {f"estimate.{name}": zero for name in ("x", "y", "z", "p", "q", "r")}
    columns |= dict.fromkeys(("estimator.refused", "estimator.too_old", "estimator.invalid"), zero)
    return pa.table(columns | {"estimator.pose_age_us": zero + 40_000})


@pytest.mark.long
@pytest.mark.parametrize("facing", [0.0, 180.0, -180.0, 179.0, -179.0, 540.0])
@pytest.mark.parametrize("first", [0.01, -0.01])
def test_metrics_are_the_same_when_yaw_crosses_180_degrees(facing: float, first: float) -> None:
    goal = np.full(ROWS, radians(facing))
    error = first + 0.05 * np.sin(2 * pi * 0.5 * 1e-6 * TIMES)
    flight = turned(goal + error, goal)
    assert attitude_error(flight)[:, 2] == pytest.approx(error, abs=1e-9)
    assert measure(flight, lost=False)["attitude_max"] == pytest.approx(np.abs(error).max())
    yaw, wanted = measures.yaw_and_goal(flight)
    assert yaw - wanted == pytest.approx(error, abs=1e-9)
    assert measures.yaw_sine(0.5, flight)["rms_yaw"] == pytest.approx(np.sqrt((error**2).mean()))


@pytest.mark.parametrize("facing", [0.0, 100.0, 180.0, -100.0])
def test_a_step_across_180_degrees_settles_where_one_elsewhere_does(facing: float) -> None:
    seconds = 1e-6 * TIMES
    since = np.maximum(seconds - 1.0, 0.0)
    goal = radians(facing) + radians(110.0) * (seconds >= 1.0)
    yaw = radians(facing) + radians(110.0) * (1 - np.exp(-since / 0.2))
    found = measures.yaw_step(turned(yaw, goal))
    first_within = np.flatnonzero(since >= -0.2 * np.log(0.05))[0]
    assert found["settle"] == pytest.approx(seconds[first_within] - 1.0)
    assert found["overshoot"] == 0.0


def test_a_step_settles_at_the_first_row_from_which_it_stays_within_5_percent() -> None:
    times, goal = np.arange(6.0), np.array([0.0, 1, 1, 1, 1, 1])
    ((rise_s, settle_s, overshoot),) = measures.steps(times, np.array([0, 0.5, 1.2, 0.94, 0.96, 1.0]), goal)
    assert (rise_s, settle_s, overshoot) == (1.0, 3.0, pytest.approx(0.2))
    ((_, never_s, _),) = measures.steps(times, np.array([0, 0.5, 1.2, 0.94, 0.96, 0.9]), goal)
    assert np.isnan(never_s)
