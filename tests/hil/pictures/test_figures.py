"""Figures and curves: what they show of a log, in seconds from the release and in colours that can be told apart."""

import functools
import json
from itertools import combinations

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from ground_station.latency import STAGES
from hil.laboratory.experiments.overload import loads_that_hurt
from hil.laboratory.schedule import runs
from hil.pictures import curves, figures, pages
from hil.pictures.panels import Bar, Interval, Marks, Picture, Still, lanes

RELEASE_US = 1_000_000
# Machado, Oliveira, Fernandes 2009: what is seen without the red, without the green receptors; of linear RGB.
VISIONS = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
}
XYZ = np.array(  # of linear sRGB, IEC 61966-2-1
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
WHITE = np.array([0.95047, 1.0, 1.08883])
TOLD_APART = 15.0  # difference in CIELAB; 2.3 is just noticeable side by side


def lab(colour: str, vision: NDArray[np.float64]) -> NDArray[np.float64]:
    """CIELAB of a colour as somebody sees it."""
    rgb = np.array(to_rgb(colour))
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    scaled = XYZ @ np.clip(vision @ linear, 0, 1) / WHITE
    x, y, z = np.where(scaled > 0.008856, np.cbrt(scaled), 7.787 * scaled + 16 / 116)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def log(fused: list[int], **columns: list[float]) -> pa.Table:
    table = {
        "t": [RELEASE_US + 10_000 * row for row in range(len(fused))],
        "estimator.fused": fused,
        **columns,
    }
    return pa.table(table).replace_schema_metadata(
        {"release_us": str(RELEASE_US), "config": json.dumps({"flight": {"release_us": 5}})}
    )


@pytest.mark.parametrize("vision", VISIONS)
def test_any_two_tasks_have_colours_that_every_eye_tells_apart(vision: str) -> None:
    seen = {name: lab(colour, VISIONS[vision]) for name, colour in curves.TASK_COLOURS.items()}
    for a, b in combinations(seen, 2):
        assert np.linalg.norm(seen[a] - seen[b]) > TOLD_APART, (a, b)


def test_a_task_has_one_colour_in_every_figure_whatever_tasks_are_there() -> None:
    names = ["cpu.KALMAN", "cpu.STABILIZER", "cpu.IDLE", "cpu.MAV-RX"]
    for order in (names, names[::-1], names[:1]):
        load = curves.processor(order)
        assert load.colours == tuple(map(curves.task_colour, load.names))
    events = [(0, "IN", "KALMAN"), (100, "IN", "SENSORS"), (300, "IN", "KALMAN"), (400, "END", "-")]
    schedule = pa.table(
        {
            "us": [RELEASE_US + us for us, _, _ in events],
            "event": [event for _, event, _ in events],
            "who": [who for _, _, who in events],
            "a": [0] * 4,
            "b": [0] * 4,
        }
    )
    (processor,) = figures.schedule(schedule).panels
    drawn = [(bar.lane, round(1e6 * (bar.end_s - bar.begin_s)), bar.colour) for bar in processor.bars]
    kalman, sensors = map(curves.task_colour, ("KALMAN", "SENSORS"))
    assert drawn == [("SENSORS", 200, sensors), ("KALMAN", 100, kalman), ("KALMAN", 100, kalman)]


@pytest.mark.long
@given(
    st.lists(
        st.tuples(st.integers(0, 2), st.sampled_from("ABC"), st.sampled_from(["IN", "READY"])), max_size=20
    )
)
def test_turns_are_never_empty_and_cover_the_time_of_each_task(steps: list[tuple[int, str, str]]) -> None:
    us = np.cumsum([0, *(step for step, _, _ in steps), 2]).tolist()
    events = [("IN", "A"), *((event, who) for _, who, event in steps), ("END", "-")]
    had: list[str] = []  # the task of each microsecond
    task = ""
    for (event, who), begin, end in zip(events, us, [*us[1:], us[-1]], strict=True):
        task = who if event == "IN" else task
        had += [task] * (end - begin)
    table = pa.table({"us": us, "event": [event for event, _ in events], "who": [who for _, who in events]})
    turns = list(runs(table))
    assert all(turn.start_us < turn.end_us for turn in turns)
    assert [turn.task for turn in turns for _ in range(turn.start_us, turn.end_us)] == had


@pytest.mark.parametrize("cut", [1, 3, 5, 30])
def test_the_time_since_the_last_fused_pose_goes_on_over_batches(cut: int) -> None:
    rows = log([0, 0, 1, 1, 2, *60 * [2], 3])
    first = curves.row_of_last_fusion(rows.slice(0, cut))
    later = pa.concat_tables([first, rows.slice(cut)])
    expected = curves.since_fusion(rows)[cut:]
    np.testing.assert_array_equal(curves.since_fusion(later)[first.num_rows :], expected)


def test_curves_and_states_are_in_seconds_from_the_release() -> None:
    counts = {
        name: [0.0, 0.0, 0.0, 0.0]
        for name in ("cpu.KALMAN", "rtos.measurements_high_water", "rtos.measurements_dropped")
    }
    states = {"supervisor.state": [2, 2, 3, 3], "flight.free": [0, 1, 1, 1]}
    rows = log([0, 0, 0, 0], **counts, **states)
    (_, queue), lanes = figures.board(rows).panels, figures.lanes_of_states(rows)
    assert queue.series[0].times == pytest.approx([0.0, 0.01, 0.02, 0.03])
    assert queue.label == "queue [measurements]", "poses"
    shown = [(bar.lane, bar.name, bar.begin_s, bar.end_s) for bar in lanes.bars]
    second = functools.partial(pytest.approx, abs=1e-9)
    assert shown == [
        ("robot", "held", second(0.0), second(0.01)),
        ("robot", "free", second(0.01), second(0.03)),
        ("supervisor", "flying", second(0.0), second(0.02)),
        ("supervisor", "failsafe", second(0.02), second(0.03)),
    ]


def overloaded(shares: list[float], error: list[float], late: list[int]) -> pa.Table:
    """A flight with 50 rows per step of the thief's share."""
    rows = 50 * len(shares)
    zeros, spread = [0.0] * rows, lambda values: np.repeat(values, 50)
    taken = np.cumsum(10_000 * spread(shares))
    columns = {f"{kind}.{axis}": zeros for kind in ("truth", "goal") for axis in ("x", "y", "z")}
    return pa.table(
        columns
        | {
            "t": 10_000.0 * np.arange(rows), "goal.yaw": zeros, "truth.x": spread(error), "cpu.THIEF": taken,
            "late.KALMAN": spread(late), "late.STABILIZER": zeros,
        }
    )  # fmt: skip


def test_a_lane_s_states_have_their_colours_and_last_until_the_next_one() -> None:
    asked = [
        ("one", np.array([0.5, 2.0]), ["on", "off"], {"on": "red"}),
        ("other", np.array([1.0]), ["on"], {"on": "blue"}),
    ]
    assert lanes(asked, 5.0) == (
        Bar("one", "on", "red", 0.5, 2.0),
        Bar("one", "off", curves.GREY, 2.0, 5.0),
        Bar("other", "on", "blue", 1.0, 5.0),
    )


def test_an_overload_is_held_up_to_the_last_step_inside_the_box_and_never_late_is_not_late_at_100() -> None:
    at = loads_that_hurt(overloaded([0.0, 0.9, 0.95, 1.0], [0.0, 0.01, 0.2, 5.0], [0, 0, 3, 9]))
    assert at == {"estimator_late_from": 0.95, "controller_late_from": np.inf, "held_up_to": 0.9}
    assert loads_that_hurt(overloaded([0.0, 1.0], [0.0, 0.0], [0, 0]))["held_up_to"] == 1.0
    assert np.isnan(loads_that_hurt(overloaded([0.0, 1.0], [0.2, 0.2], [0, 0]))["held_up_to"])


def counted(**per_row: float) -> dict[str, NDArray[np.float64]]:
    return {name.replace("__", "."): rate * np.arange(201.0) for name, rate in per_row.items()}


def known_log() -> pa.Table:
    """Return a log of two seconds with a different value in every column; released after 1 s, counters grow by row."""
    values = {**{f"truth.{axis}": 0.01 * n for n, axis in enumerate("xyz", 1)}, "truth.qw": 1.0,
        **dict.fromkeys(("truth.qx", "truth.qy", "truth.qz"), 0.0), **{f"estimate.{name}": 0.1 * n for n,
        name in enumerate("xyz", 1)}, **{f"replay.{name}": 0.2 * n for n, name in enumerate("xyz", 1)},
        **{f"estimate.{name}": np.radians(n) for n, name in enumerate(("roll", "pitch", "yaw"), 1)},
        **{f"replay.{name}": np.radians(10 * n) for n, name in enumerate(("roll", "pitch", "yaw"), 1)},
        **{f"replay.{name}": float(n) for n, name in enumerate(("refused", "too_old", "invalid"), 1)},
        **{f"estimator.{name}": 10.0 * n for n, name in enumerate(("refused", "too_old", "invalid"), 1)},
        **dict.fromkeys(("goal.x", "goal.y", "goal.z", "goal.yaw"), 0.0), "estimator.pose_age_us": 31_000.0,
        "estimator.horizon": 4.0, "battery.voltage": 3.7, "board.load": 41.0, "flight.free": 1.0,
        "rtos.measurements_high_water": 7.0, "rtos.measurements_dropped": 2.0, "logic.seen": 5.0}  # fmt: skip
    for i in (1, 2, 3, 4):
        values |= {f"truth.flap_{i}": np.radians(i), f"control.flap_{i}": np.radians(10 * i), f"rotor.thrust_{i}": 0.01 * i,
                   f"motor.m{i}": 655.35 * i}  # fmt: skip
    counters = counted(link__up_latency_sum=3000, link__down_latency_sum=5000, link__up_delivered=1,
        link__down_delivered=2, link__up_dropped=0.1, link__down_dropped=0.2, link__retried=0.3,
        link__late=0.4, serial__up_busy=600, serial__down_busy=700, serial__overrun=1, serial__no_room=2,
        serial__up_bad=3, serial__down_bad=4, station__unusable=0.5, station__malformed=0.6, cpu__KALMAN=900,
        cpu__APP=1.0, cpu__MEM=2.0, cpu__IDLE=5000)  # fmt: skip
    counters["estimator.fused"] = np.minimum(np.arange(201) // 2, 95.0)  # the last in row 190
    constants = {name: np.full(201, value) for name, value in values.items()}
    times = {"t": 10_000.0 * np.arange(201), "supervisor.state": np.full(201, 2)}
    return pa.table(times | constants | counters).replace_schema_metadata({"release_us": "1000000"})


XYZ_CM, RPY_DEG = {"x": 1, "y": 2, "z": 3}, dict.fromkeys(("roll", "pitch", "yaw"), 0)
SHOWN = {  # the last values by hand: label, then name and value
    "Errors": {"position error [cm]": XYZ_CM, "attitude error [deg]": RPY_DEG},
    "Flaps": {f"flap {i} [deg]": {"command": 10 * i, "true": i} for i in (1, 2, 3, 4)},
    "Rotors": {"thrust [mN]": {f"M{i}": 10 * i for i in (1, 2, 3, 4)}, "command [%]": {f"M{i}": i for i in (1, 2, 3, 4)}},
    "States": {"states": {}},
    "Estimate": {"position [cm]": {"x": 9, "y": 18, "z": 27}, "attitude [deg]": {"roll": 1, "pitch": 2, "yaw": 3}},
    "Replay": {
        "position, replayed [cm]": {"x": 19, "y": 38, "z": 57}, "position, flown [cm]": {"x": 9, "y": 18, "z": 27},
        "attitude, replayed [deg]": {"roll": 10, "pitch": 20, "yaw": 30}, "attitude, flown [deg]": {"roll": 1,
        "pitch": 2, "yaw": 3},
        "poses refused [so far]": {f"{name}, {how}": n * (1 if how == "replayed" else 10)
                                   for n, name in enumerate(("refused", "too_old", "invalid"), 1) for how in ("replayed",
                                   "flown")},
    },
    "Age": {"age on board [ms]": {"age of the pose": 31, "horizon": 40},
    "without a pose [ms]": {"longest since a fused pose": 100}},
    "Radio": {"mean latency [ms]": {"up": 3, "down": 2.5}, "so far [packets]": {"lost up": 20, "lost down": 40,
    "sent again": 60}},
    "Serial line": {
        "load of the line [%]": {"up": 6, "down": 7}, "mean latency [ms]": {"up": 3, "down": 2.5},
        "bytes or frames [so far]": {"overrun": 200, "no room": 400, "bad up": 600, "bad down": 800},
    },
    "Station": {"not used [so far]": {"poses late": 80, "poses unusable": 100, "telemetry malformed": 120},
                "battery [V]": {"a cell": 3.7}, "processor [%]": {"all tasks": 41}},
    "Board": {"processor [%]": {"KALMAN": 9, "MEM": 0.02}, "queue [measurements]": {"longest so far": 7, "dropped": 2}},
}  # fmt: skip


@pytest.mark.parametrize("picture", figures.PICTURES, ids=lambda one: one.title)
def test_a_picture_shows_under_each_name_the_quantity_of_that_name_in_the_label_s_unit(
    picture: Picture,
) -> None:
    log = known_log()
    plot = picture.draw(log)
    shown = {
        one.label: {line.name: round(float(line.values[-1]), 9) for line in one.series} for one in plot.panels
    }
    expected = SHOWN[picture.title]
    assert list(shown) == list(expected)
    for label, lines in expected.items():
        assert shown[label] == pytest.approx(lines), label
        assert list(shown[label]) == list(lines)
    for one in plot.panels:
        assert all(len(line.times) == len(line.values) for line in one.series)
        assert all(line.times[-1] == pytest.approx(1.0) for line in one.series)
    if picture.title == "Age":
        assert plot.panels[1].series[0].values[-3:].tolist() == [10.0, 90.0,
            100.0], ("the longest of each tenth of a second")  # fmt: skip
    limits = {one.label: one.limits for one in plot.panels if one.limits}
    assert limits == ({"position error [cm]": (-6, 6), "attitude error [deg]": (-20,
        20)} if picture.title == "Errors" else {})  # fmt: skip
    assert {one.label for one in plot.panels if one.stacked} == (
        {"processor [%]"} if picture.title == "Board" else set()
    )
    assert picture.fits(log.column_names)
    assert picture.fits(["t"]) == (picture.needs == "t")


def test_a_course_has_place_and_yaw_beside_their_goals_from_the_first_goal_and_a_fault_s_time() -> None:
    log, moved = known_log(), np.where(np.arange(201) > 100, 0.5, 0.2)
    for name, values in (("goal.x", moved), ("goal.yaw", 2 * moved), ("flight.free", np.arange(201) > 50.0)):
        log = log.set_column(log.column_names.index(name), name, pa.array(np.asarray(values, float)))
    log = log.replace_schema_metadata(
        log.schema.metadata | {b"request": json.dumps({"faults": ["push.y@0.3:0.1=2"]}).encode()}
    )
    place, turn = figures.course(log).panels
    assert {line.name: (line.values[-1], line.dashed) for line in place.series} == {"x": (pytest.approx(-19),
        False), "goal x": (pytest.approx(30), True), "y": (pytest.approx(2), False), "goal y": (0.0, True),
        "z": (pytest.approx(3), False), "goal z": (0.0, True)}  # fmt: skip
    assert [(line.name, line.values[-1], line.dashed) for line in turn.series] == [("yaw", pytest.approx(0),
        False), ("goal", pytest.approx(np.degrees(1.0)), True)]  # fmt: skip
    course = figures.course_of(log)
    assert (course.box, len(course.flown)) == (10.0, 150)
    assert np.flatnonzero(course.troubled).tolist() == list(range(79,
        90)), ("0.3 to 0.4 s after row 100, from row 51 on")  # fmt: skip
    assert figures.goal_moves(log)
    assert not figures.goal_moves(log.slice(0, 52))


def test_a_latency_budget_stacks_the_stages_that_were_reported() -> None:
    ages = pa.table({"t": [1_020_000.0]} | {name: [float(n)] for n, name in enumerate(STAGES, 1)})
    ages = ages.replace_schema_metadata({"release_us": "1000000"})
    (panel,) = figures.latency_budget(ages).panels
    assert [(line.name, line.values.tolist(), line.times.tolist()) for line in panel.series] == [(name,
        [value], [pytest.approx(0.02)]) for name, value in (("camera", 1), ("processing", 2), ("network", 3),
        ("station", 5), ("link", 6))]  # fmt: skip
    assert (panel.label, panel.stacked, panel.least) == ("age [ms]", True, 0.0)


@pytest.mark.parametrize(
    ("about", "shaded", "folded"),
    [
        ((), [], False), (("radio",), [], True), (("radio",), [("fault", "radio.loss")], False),
        (("radio",), [("fault", "serial.cut"), ("fault", "mocap.dropout")], True),
        (("mocap", "radio"), [("fault", "push.x"), ("fault", "radio.cut")], False),
        (("radio",), [("failsafe", "radio.loss")], True), (("loss",), [("fault", "radio.loss")], True),
    ],
)  # fmt: skip
def test_a_figure_about_some_faults_is_folded_unless_one_of_their_group_acted(
    about: tuple[str, ...], shaded: list[tuple[str, str]], folded: bool
) -> None:
    marks = Marks(intervals=tuple(Interval(kind, 0.0, 1.0, text) for kind, text in shaded))
    picture = Picture("Two Words", "what it shows", lambda: Still(b"content", "gif"), about=about)
    figure = pages.draw(picture, marks)
    assert (figure.name, figure.title, figure.caption) == ("two-words", "Two Words", "what it shows")
    assert (figure.folded, figure.source) == (folded, "data:image/gif;base64,Y29udGVudA==")
