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

from hil.laboratory.experiments.overload import loads_that_hurt
from hil.laboratory.schedule import runs
from hil.pictures import curves, figures

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


def test_the_directions_of_a_link_have_each_their_own_line() -> None:
    count, zeros = np.arange(301.0), np.zeros(301)
    lost = ("up_dropped", "down_dropped", "retried", "overrun", "no_room", "up_bad", "down_bad")
    columns = {f"{group}.{name}": zeros for group in ("link", "serial") for name in lost}
    for name, value in (("up", 1.0), ("down", 3.0)):
        columns[f"link.{name}_delivered"] = count
        columns[f"link.{name}_latency_sum"] = 1000 * value * count
        columns[f"serial.{name}_busy"] = 100 * value * count
    rows = log([0] * 301, **columns)  # type: ignore[arg-type]
    for panel in (*figures.radio(rows).panels[:1], *figures.serial_line(rows).panels[:2]):
        assert {line.name: set(line.values.round(6)) for line in panel.series} == {"up": {1.0}, "down": {3.0}}


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


def test_an_overload_is_held_up_to_the_last_step_inside_the_box_and_never_late_is_not_late_at_100() -> None:
    at = loads_that_hurt(overloaded([0.0, 0.9, 0.95, 1.0], [0.0, 0.01, 0.2, 5.0], [0, 0, 3, 9]))
    assert at == {"estimator_late_from": 0.95, "controller_late_from": np.inf, "held_up_to": 0.9}
    assert loads_that_hurt(overloaded([0.0, 1.0], [0.0, 0.0], [0, 0]))["held_up_to"] == 1.0
    assert np.isnan(loads_that_hurt(overloaded([0.0, 1.0], [0.2, 0.2], [0, 0]))["held_up_to"])
