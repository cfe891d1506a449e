"""What the report says about a fault: the robot, the board's belief, its poses and its flaps, as the log has them."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from hil.laboratory import metrics
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import spans_of
from hil.laboratory.metrics import METRICS, judge
from hil.pictures import curves
from hil.pictures.panels import Instant, Interval, Marks, saturated
from hil.pictures.report import FaultRow, fault_rows, metric_rows, not_executed
from hil.pictures.timeline import _before, _plot, _rotors, _windows, evidence, failures_of, story_of


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


def flown_log() -> pa.Table:
    """Return a log of two seconds in a wind, released at 1 s; each fault below has a different effect in it."""
    count, row = 301, np.arange(301)
    values: dict[str, np.ndarray] = {"t": 10_000.0 * row, "flight.free": (row >= 100).astype(float)}
    values |= dict.fromkeys([f"{group}.{name}" for group in ("truth", "goal", "estimate") for name in ("x",
        "y", "z")] + ["truth.qx", "truth.qy", "truth.vx", "truth.vy", "truth.vz", "goal.yaw", "estimate.roll",
        "estimate.pitch", "estimate.yaw", "tracker.refused", "link.late", "estimator.too_old"],
        np.zeros(count))  # fmt: skip
    turned = np.where(row == 180, np.radians(30.0), 0.0)
    values |= {"truth.qw": np.cos(turned / 2), "truth.qz": np.sin(turned / 2)}
    values["truth.x"], values["truth.y"] = np.where(row == 150, 0.04, 0.0), np.where(row == 160, -0.123, 0.0)
    values["estimate.z"], values["estimate.pitch"] = (np.where(row == 170, 0.05, 0.0),
        np.where(row == 175, np.radians(-7), 0.0))  # fmt: skip
    values["truth.vx"], values["truth.vz"] = np.where(row == 155, 0.3, 0.0), np.where(row == 155, -0.4, 0.0)
    values["supervisor.state"] = np.select([row < 190, row < 210], [2, 3], 2)
    values["estimator.fused"] = np.where(row < 200, row, np.where(row < 225, 199, row))
    values["estimator.refused"], values["tracker.refused"] = (np.minimum(row // 100, 1),
        1.0 * (row >= 120) + 2.0 * (row >= 130))  # fmt: skip
    for i, sign in enumerate((1, -1, 1, -1), 1):
        flap, command = np.full(count, 0.6 * sign), np.full(count, 0.6 * sign)
        if i == 2:
            command = np.where((row >= 220) & (row < 240), -0.9, command)  # the end of its range
            flap = np.where((row >= 220) & (row < 240), -0.3, flap)
        values |= {f"truth.flap_{i}": flap, f"control.flap_{i}": command,
                   f"estimate.flap_{i}": np.where((row >= 225) & (i == 2), -0.2, 0.0)}  # fmt: skip
    about = {"config": json.dumps({"allocation": {"opening_min": 0.0, "opening_max": 0.9, "hover_angle": 0.6}}),
             "release_us": "1000000", "request": json.dumps({"faults": ["push.y@0.5:0.2=1",
             "servo.stuck.2@1.2"]})}  # fmt: skip
    return pa.table(values).replace_schema_metadata(about)


def test_evidence_tells_the_largest_and_its_instant_of_everything() -> None:
    """The flap is 20 rows of 0.01 s away from its command; the board believes -46 deg in the last 15 of them."""
    log = flown_log()
    assert evidence(log.slice(100)) == [
        "In truth the robot was up to 12.3 cm (y, at 0.60 s) away from its goal, and 30.0 deg (yaw, at 0.80 s) from its "
        "attitude; it moved at up to 0.50 m/s (at 0.55 s).",
        "The board's estimate was up to 12.3 cm (y, at 0.60 s) and 30.0 deg (yaw, at 0.80 s) wrong.",
        "Its supervisor: flying from 0.00 s, failsafe from 0.90 s, flying from 1.10 s.",
        "It fused no pose for 250 ms, from 0.99 s on.",
        "Pose refused by the tracker: 3 times.",
        "Commands at their limits: flap 2 for 0.20 s, from 1.20 s on.",
        "Flap 2 was up to 34 deg away from its command: at 1.25 s it was at -17 deg, and the board believed -46 deg.",
    ]
    assert evidence(log.slice(165, 20))[1:4] == [
        "The board's estimate was up to 5.0 cm (z, at 0.70 s) and 30.0 deg (yaw, at 0.80 s) wrong.",
        "Its supervisor: flying all the time.",
    ]
    assert "Its supervisor: flying from 0.80 s, failsafe from 0.90 s." in evidence(log.slice(180, 20))
    assert "Pose refused on board: once." in evidence(log.slice(90, 20))
    assert evidence(log.slice(100, 1)) == []
    known = pa.array(metrics.column(log, "truth.flap_2") + 0.6)
    lags = log.set_column(log.column_names.index("estimate.flap_2"), "estimate.flap_2", known)
    assert evidence(lags.slice(100)) == evidence(log.slice(100))[:-1], "the board knows that the flap lags"
    unseen = np.where(np.arange(301) < 110, 0.0, metrics.column(log, "estimator.fused"))
    later = log.set_column(log.column_names.index("estimator.fused"), "estimator.fused", pa.array(unseen))
    assert evidence(later.slice(100))[3] == evidence(log.slice(100))[3], "no pose for 250 ms"
    late = np.arange(301) >= 230
    for name, value in (
        ("truth.flap_1", np.where(late, 0.1, 0.6)),
        ("estimate.flap_3", np.where(late, 0.5, 0.0)),
    ):
        log = log.set_column(log.column_names.index(name), name, pa.array(value))
    assert [text[:49] for text in evidence(log.slice(100)) if text.startswith("Flap")] == [
        "Flap 1 was up to 29 deg away from its command: at", "Flap 2 was up to 34 deg away from its command: at",
    ], "the third obeys, whatever the board believes"  # fmt: skip


def test_close_ups_are_around_faults_that_begin_together_and_around_a_loss_or_limit_that_none_shows() -> None:
    faults = (Interval("fault", 5.0, 5.1, "b"), Interval("fault", 1.0, 1.25, "a"), Interval("held", -1.0, 0.0),
              Interval("fault", 5.0, 90.0, "c"), Interval("limit", 2.0, 3.0, "flap 1"))  # fmt: skip
    lost = (Instant("operator", 6.0, "x"), Instant("lost", 8.01, "fell"))
    at_faults = [("a", 1.0, 0.5, 2.25), ("b, c", 5.0, 4.5, 8.0)]
    loss, passed = ("Loss: fell", 8.01, 5.01, 8.51), ("First limit passed", 3.0, 1.0, 4.0)
    assert _windows(Marks(faults, lost), 3.0) == [*at_faults, loss, passed]
    assert _windows(Marks(faults), 4.5) == at_faults, "at the edge of what is shown"
    assert _windows(Marks(faults), 2.25) == at_faults
    assert _windows(Marks((), lost), 8.51) == [loss], "shown already"
    assert _windows(Marks(), None) == []


def test_a_close_up_has_the_estimate_and_commands_dashed_in_the_colours_of_the_truth() -> None:
    log = flown_log()
    shown = {panel.label: panel.series for panel in _plot(log, (0.0, 2.0)).panels}
    assert [*shown] == [
        "position error [cm]",
        "attitude error [deg]",
        "flaps [deg]",
        "without a pose [ms]",
        "states",
    ]
    pairs = (("position error [cm]", curves.POSITION, curves.POSITION_ESTIMATE, "estimate"),
        ("attitude error [deg]", curves.ATTITUDE, curves.ATTITUDE_ESTIMATE, "estimate"),
        ("flaps [deg]", curves.FLAPS, curves.FLAPS_COMMAND, "command"))  # fmt: skip
    for label, curve, other, name in pairs:
        lines = shown[label]
        assert [line.name for line in lines] == [*curve.names, name, *[""] * (len(curve.names) - 1)]
        assert [line.colour for line in lines] == [*curve.colours] * 2
        assert [line.dashed for line in lines] == [False] * len(curve.names) + [True] * len(curve.names)
        for line, values in zip(lines, [*curve.read(log).T, *other.read(log).T], strict=True):
            np.testing.assert_array_equal(line.values, values)
    bare = _plot(log.drop_columns(["estimate.x", "estimate.roll"]), (0.0, 2.0)).panels
    assert [len(panel.series) for panel in bare[:2]] == [3, 3], "of an imported log"


def judged(values: dict[str, float], limits: dict[str, float], outcome: str = "completed") -> Any:
    verdicts = tuple(judge(values, limits, {}))
    failed = tuple(one for one in verdicts if not one.holds)
    return SimpleNamespace(verdicts=verdicts, failed=failed, own_metrics={}, metrics=values, outcome=outcome, cause="fell",
                           failures=(), request=SimpleNamespace(duration_s=2.0))  # fmt: skip


def test_failures_come_in_the_order_of_their_instants_with_the_fault_before_each_and_what_they_mean() -> None:
    """Beyond 6 cm only y at 0.60 s, 30 deg at 0.80 s, failsafe from 0.90 to 1.10 s; a share has no value here."""
    values = {"max_y": 0.123, "attitude_max": np.radians(30), "uncontrolled": 0.2, "rise": 9.0, "lost": 1.0,
        "within_6cm_y": 0.99}  # fmt: skip
    limits = {"rise": 1.0, "uncontrolled": 0.105, "attitude_max": 0.3, "max_y": 0.1, "lost": 0.0,
        "within_6cm_y": 1.0}  # fmt: skip
    failures = failures_of(flown_log(), judged(values, limits, "lost"))
    push, stuck = KINDS["push.y"].meaning, KINDS["servo.stuck.2"].meaning
    about = {name: METRICS[name].meaning for name in values} | {"lost": ""}
    late = 1.0  # the eleventh row of failsafe
    expected = [("max_y", 0.60, f"0.10 s after the begin of push.y@0.5:0.2=1 (1 N: {push})"),
        ("within_6cm_y", 0.60, f"0.10 s after the begin of push.y@0.5:0.2=1 (1 N: {push})"),
        ("attitude_max", 0.80, f"0.30 s after the begin of push.y@0.5:0.2=1 (1 N: {push})"),
        ("uncontrolled", late, f"{late - 0.5:.2f} s after the begin of push.y@0.5:0.2=1 (1 N: {push})"),
        ("lost", 2.0, f"0.80 s after the begin of servo.stuck.2@1.2 ({stuck})"), ("rise", None, "")]  # fmt: skip
    assert sorted(one.text.split()[0] for one in failures[:2]) == ["max_y", "within_6cm_y"]
    told = {one.text.split()[0]: one for one in failures}
    for name, at_s, cause in expected:
        assert (told[name].at_s, told[name].cause) == (None if at_s is None else pytest.approx(at_s),
            cause), name  # fmt: skip
        assert told[name].meaning == about[name]
    assert [one.text.split()[0] for one in failures[2:]] == [name for name, *_ in expected[2:]]


def test_a_story_tells_everything_once_in_order() -> None:
    result = judged({"max_y": 0.123, "attitude_max": np.radians(30)}, {"max_y": 0.1, "attitude_max": 0.3},
        "lost")  # fmt: skip
    result.failures = ("planted",)
    texts = ((1_898_000, "supervisor: failsafe, imu stale"), (2_400_000, "planted"), (2_500_000, "harmless"))
    events = [{"t_us": us, "text": text} for us, text in texts]
    told = [(round(float(one.t_s), 3), one.text) for one in story_of(flown_log(), result, events)]
    assert told == [(0.0, "released"), (0.5, "fault push.y@0.5:0.2=1 begins"),
        (0.6, "first limit passed: max_y"), (0.6, "farthest from the goal: 12.3 cm (y)"),
        (0.61, "within 6 cm of the goal from here to the end"), (0.7, "fault push.y@0.5:0.2=1 ends"),
        (0.9, "failsafe begins: the gyro delivers nothing new"), (1.1, "failsafe ends"),
        (1.2, "fault servo.stuck.2@1.2 begins"), (1.2, "flap 2 saturates for the first time"),
        (1.4, "planted"), (2.0, "lost: fell")]  # fmt: skip
    begun = flown_log().slice(190)  # in failsafe
    assert (0.9, "failsafe begins") in [
        (round(float(one.t_s), 3), one.text) for one in story_of(begun, judged({}, {}))
    ]


def test_a_report_s_rows_have_values_and_limits_in_customary_units_those_with_a_limit_first() -> None:
    values = {"rms_x": 0.012, "max_y": 0.1234, "attitude_max": np.radians(21), "in_box": 0.5, "rise": np.inf,
        "flown": 1.5, "settle": np.nan}  # fmt: skip
    rows = metric_rows(judged(values, {"max_y": 0.2, "attitude_max": np.radians(20), "in_box": 0.45,
        "settle": 3.0}))  # fmt: skip
    shown = {one.name: (one.value, one.unit, one.limit, one.mark) for one in rows}
    assert shown == {"rms_x": ("1.2", "cm", "", None), "max_y": ("12.34", "cm", "≤ 20", "ok"),
        "attitude_max": ("21", "deg", "≤ 20", "FAILS"), "in_box": ("50", "% of 1.5 s", "≥ 45", "ok"),
        "rise": ("never", "s", "", None), "flown": ("1.5", "s", "", None),
        "settle": ("–", "s", "≤ 3", "FAILS")}  # fmt: skip
    assert [one.mark is None for one in rows] == [False] * 4 + [True] * 3
    assert all(one.meaning == METRICS[one.name].meaning for one in rows)


def test_a_report_s_faults_have_their_times_and_their_sizes_with_units() -> None:
    spans = spans_of({b"request": json.dumps({"faults": ["push.y@0.5:0.25=1.5",
        "servo.stuck.2@1.2"]}).encode()})  # fmt: skip
    push, stuck = KINDS["push.y"].meaning, KINDS["servo.stuck.2"].meaning
    assert fault_rows(spans) == [FaultRow("push.y", "0.500", "0.750", "1.5 N", push),
        FaultRow("servo.stuck.2", "1.200", "with the flight", "", stuck)]  # fmt: skip


@pytest.mark.parametrize(
    ("draws", "faults", "lacking"),
    [
        (False, ["push.y@1=2"], ""),
        (True, ["push.y@1=2"], "its own picture"),
        (False, ["own.b@1", "push.y@1=2", "own.a@2=3", "own.b@4"], "its own kinds of faults (own.a, own.b)"),
        (True, ["own.b@1"], "its own picture and its own kinds of faults (own.b)"),
    ],
)
def test_a_report_names_what_it_lacks_without_the_experiment_s_code(
    draws: bool, faults: list[str], lacking: str
) -> None:
    experiment: Any = SimpleNamespace(is_known=False, draw=len if draws else None, reference="mine.py:fly")
    rest = ", which need the experiment's code: '--experiment mine.py:fly' executes it"
    assert not_executed(experiment, faults) == (f"without {lacking}{rest}" if lacking else "")
    experiment.is_known = True
    assert not_executed(experiment, faults) == ""
