"""What the report says about a fault: the robot, the board's belief, its poses and its flaps, as the log has them."""

import json
import re
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.faults import parse
from hil.laboratory.files.recorder import load_log, stored_in
from hil.laboratory.files.result import read_result
from hil.laboratory.metrics import column, free_flight, position_error
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.pictures.curves import BLUE, since_release
from hil.pictures.figures import course_of, goal_moves
from hil.pictures.panels import saturated
from hil.pictures.path import FlownPath, path_of
from hil.pictures.timeline import _before, _rotors, evidence, failures_of, story_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evidence") / "run"
    faults = tuple(map(parse, ("mocap.dropout@0.5:0.4", "servo.stuck.2@1.2", "push.y@1.5=3")))
    fly(Request.of(EXPERIMENTS["hover"], duration_s=3.0, faults=faults), folder)
    return folder


def numbers(sentence: str) -> list[float]:
    return [float(number) for number in re.findall(r"-?\d+(?:\.\d+)?", sentence)]


def test_the_robot_and_the_time_without_a_pose_are_those_of_the_log(folder: Path) -> None:
    log = load_log(folder)
    rows = log.filter((since_release(log) >= 0.5) & (since_release(log) <= 1.1))
    robot, belief, supervisor, poses, *_ = evidence(rows)
    error = 100 * np.abs(position_error(rows))
    speed = np.linalg.norm(column(rows, "truth.vx", "truth.vy", "truth.vz"), axis=1)
    assert numbers(robot)[4] == pytest.approx(speed.max(), abs=0.006)
    assert numbers(robot)[0] == pytest.approx(error.max(), abs=0.06)
    assert f"({'xyz'[int(np.argmax(error.max(axis=0)))]}, at" in robot
    assert belief.startswith("The board's estimate was up to")
    assert supervisor == "Its supervisor: flying all the time."
    longest_ms, from_s = numbers(poses)
    assert 400 < longest_ms < 460, "the dropout, and what was under way"
    assert from_s == pytest.approx(0.5, abs=0.06)


def test_a_stuck_flap_is_named_with_what_the_board_believed(folder: Path) -> None:
    log = load_log(folder)
    rows = log.filter(since_release(log) >= 1.2)
    (stuck,) = [sentence for sentence in evidence(rows) if sentence.startswith("Flap 2")]
    away, at_s, stood, believed = numbers(stuck)[1:]
    truth = np.degrees(column(rows, "truth.flap_2"))
    assert away > 10
    assert stood == pytest.approx(truth[np.argmin(np.abs(since_release(rows) - at_s))], abs=0.6)
    assert -53 < believed < 1, "the range of an even flap"
    assert evidence(log.slice(0, 1)) == []


def test_a_flap_that_lags_as_the_board_knows_is_not_named(folder: Path) -> None:
    log = load_log(folder)
    rows = log.filter(since_release(log) >= 1.2)
    lagging = rows.set_column(rows.column_names.index("estimate.flap_2"), "estimate.flap_2", known_flap(rows))
    assert not any(sentence.startswith("Flap 2") for sentence in evidence(lagging))


def known_flap(rows: pa.Table) -> pa.Array:
    """What the board's estimate of flap 2 is when it believes the truth."""
    hover = stored_in(rows.schema.metadata, "config")["allocation"]["hover_angle"]
    return pa.array(column(rows, "truth.flap_2") + hover)


def test_the_largest_error_and_the_settling_are_reported(folder: Path) -> None:
    log, result = load_log(folder), read_result(folder)
    told = {moment.text.partition(":")[0]: moment for moment in story_of(log, result)}
    free = free_flight(log)
    error, times = np.abs(position_error(free)), since_release(free)
    farthest = told["farthest from the goal"]
    assert farthest.t_s == times[np.argmax(error.max(axis=1))]
    assert numbers(farthest.text) == [pytest.approx(100 * error.max(), abs=0.06)]
    near = told.get("within 6 cm of the goal from here to the end")
    assert (near is None) == (error[-1].max() > 0.06)
    calm = log.set_column(log.column_names.index("truth.y"), "truth.y", pa.array(np.zeros(log.num_rows)))
    calm = calm.set_column(log.column_names.index("truth.z"), "truth.z", log.column("goal.z"))
    away = np.where((since_release(log) > 1.0) & (since_release(log) < 2.0), 0.3, 0.0)
    calm = calm.set_column(log.column_names.index("truth.x"), "truth.x", pa.array(away))
    (back,) = [one for one in story_of(calm, result) if one.text.startswith("within 6 cm")]
    assert back.t_s == pytest.approx(2.0, abs=0.011)


def test_commands_at_their_limits_are_named_with_their_duration(folder: Path) -> None:
    log = load_log(folder)
    rows = log.filter(since_release(log) >= 1.5)
    (limits,) = [sentence for sentence in evidence(rows) if sentence.startswith("Commands at their limits: ")]
    for name, at_limit in saturated(rows):
        (told,) = [part for part in limits.split(": ")[1].split("; ") if part.startswith(f"{name} ")]
        _, stood_s, from_s = numbers(told.rstrip("."))
        assert stood_s == pytest.approx(0.01 * at_limit.sum(), abs=0.02)
        assert from_s == pytest.approx(since_release(rows)[np.argmax(at_limit)], abs=0.006)


def test_a_limit_that_failed_names_the_fault_that_began_last(folder: Path) -> None:
    log, result = load_log(folder), read_result(folder)
    failures = failures_of(log, result)
    assert {failure.text for failure in failures} == set(map(str, result.failed))
    first = failures[0]
    assert first.at_s is not None
    assert first.at_s > 1.5
    assert (
        first.cause == f"{first.at_s - 1.5:.2f} s after the begin of push.y@1.5=3 (3 N: force along y of W)"
    )


@pytest.mark.parametrize(
    ("at_s", "named"),
    [(0.99, None), (1.0, 0), (2.99, 0), (3.0, 1), (3.5, 1), (6.3, 1), (6.31, 0), (10.0, 0), (10.01, None)],
)
def test_a_fault_is_a_cause_from_its_begin_to_three_seconds_after_its_end(
    at_s: float, named: int | None
) -> None:
    faults = ["wind.fan@1:6=0.9", "push.y@3:0.3=1"]
    about = {b"release_us": b"0", b"request": json.dumps({"faults": faults}).encode()}
    cause = _before(pa.table({"t": []}).replace_schema_metadata(about), at_s)
    assert (faults[named] if named is not None else "no fault was in force") in cause


def test_the_course_is_the_flight_from_the_first_goal_red_while_a_fault_is_in_force(folder: Path) -> None:
    log = load_log(folder)
    course, free = course_of(log), free_flight(log)
    assert course.holds
    assert not goal_moves(log)
    assert course.flown == pytest.approx(100 * position_error(free)), "a goal that holds at yaw 0"
    times = since_release(free)
    within = ((times >= 0.5) & (times <= 0.9)) | (times >= 1.2)
    assert (course.troubled == within).mean() > 0.98


def test_a_path_begins_with_a_ring_and_ends_with_a_dot() -> None:
    places = np.array([(0.0, 0.0, 0.0), (8.0, 4.0, 0.0), (5.0, 5.0, 5.0)])
    still = path_of(FlownPath(places, np.zeros((3, 3)), np.zeros(3, bool), 10.0))
    ends = re.findall(r'<circle cx="(-?[\d.]+)" cy="(-?[\d.]+)"[^>]* fill="([^"]+)"', still.content.decode())
    assert ends[2::2] == [("0.0", "0.0", "white")] * 2, "from above and from the side"
    assert ends[3::2] == [(f"{50 / 1.1:.1f}", f"{-50 / 1.1:.1f}", BLUE)] * 2


def rotors(count: int, *given_mN: float) -> pa.Table:
    """A log of rotors that all should give 70 mN."""
    columns = {f"rotor.thrust_{i + 1}": [1e-3 * given] * count for i, given in enumerate(given_mN)}
    columns |= {f"rotor.command_{i}": [0.07] * count for i in (1, 2, 3, 4)}
    return pa.table({"t": [10_000 * row for row in range(count)]} | columns)


def test_a_rotor_that_gives_less_than_commanded_is_named_and_the_ground_under_all_is_not() -> None:
    assert list(_rotors(rotors(5, 70.0, 13.0, 68.0, 71.0))) == [
        "M2 gave 13 mN on average where 70 mN were commanded."
    ]
    assert list(_rotors(rotors(5, 90.0, 91.0, 90.0, 92.0))) == []
    assert list(_rotors(rotors(5, 70.0, 13.0, 68.0, 71.0).drop_columns("rotor.command_1"))) == []


def test_a_motor_whose_command_is_at_the_top_is_named() -> None:
    words = {f"motor.m{i}": [65535, 40000] if i == 2 else [40000, 40000] for i in (1, 2, 3, 4)}
    found = {name: at.tolist() for name, at in saturated(pa.table({**words, "rotor.thrust_1": [0.0, 0.0]}))}
    assert found == {"M2": [True, False]}
