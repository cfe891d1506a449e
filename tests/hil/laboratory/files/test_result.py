"""A run's result: written once, read back as the same type, and whatever is not one is one clear line."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest

from firmware_py.export.usage import EntryLoad, Usage
from firmware_py.rtos import TaskReport
from ground_station.latency import Stage
from hil.board.board_firmware import ImageReport
from hil.errors import LabError
from hil.laboratory.experiment import Source, unknown
from hil.laboratory.experiments import EXPERIMENTS, find_again
from hil.laboratory.files.recorder import Recorder
from hil.laboratory.files.result import (
    RESULT,
    Program,
    QueueReport,
    Result,
    metadata_of,
    read_result,
    with_failures,
    with_resets,
    write_result,
)
from hil.laboratory.metrics import Metric, Verdict
from hil.laboratory.request import REAL, Bench, Request
from hil.world.body import Channel, Quantity
from hil.world.scene import VisualModel
from support.command import Cli

KEYS = """
    experiment profile overrides seed duration_s link board faults source logic outcome cause metrics
    own_metrics verdicts passed tasks queues usage ages hash versions commit real_time_factor robot
    stood_still_ms image failures not_shown elf in_loop gdb realtime trace pictures draws
""".split()  # noqa: SIM905  of result.json, which programs of users read


@pytest.fixture
def result(tmp_path: Path) -> Result:
    wide = unknown("hover", Source("/home/anna/eights.py:wide", "5e" * 32, "eights 1.0"))
    bench = Bench("radio", "cortex-m4", elf=Path("image.elf"))
    return Result(
        Request(wide, "floaty", ("predictor.enabled=false",), 7, 2.5, ("push.y@1:0.3=2", "own.kind@1"), bench),
        Program({"python": "3.11.2"}, "0123456789ab+", "1c" * 32),
        outcome="lost", cause="fell", metrics={"rms_x": 0.01, "settle": math.nan, "rise": math.inf, "lap": 9.5},
        own_metrics={"lap": Metric("s", "max", "time of a lap")},
        verdicts=(Verdict("rms_x", 0.01, 0.02, True, "m", "max"), Verdict("settle", math.nan, 0.5, False, "s", "max")),
        tasks=(TaskReport("KALMAN", 2, 50, 100, 900, 30, (1,) * 12, None, 0),), queues=(QueueReport("log", 5, 2, 0),),
        usage=Usage(7530, 4820, 256, {"estimate": EntryLoad(3, 100, 120, 50, 60)}), ages=(Stage("pose", 40.5, 41.0),),
        hash="ab" * 32, real_time_factor=12.34, stood_still_ms=0.0, folder=tmp_path,
        image=ImageReport("cd" * 32, {"KALMAN": 400}, 900, 300, 1, 2), failures=("hard fault",), not_shown=3,
    )  # fmt: skip


def change(folder: Path, **values: Any) -> None:
    content = json.loads((folder / RESULT).read_text(encoding="utf-8"))
    (folder / RESULT).write_text(json.dumps(content | values), encoding="utf-8")


def drop(folder: Path, key: str) -> None:
    content = json.loads((folder / RESULT).read_text(encoding="utf-8"))
    del content[key]
    (folder / RESULT).write_text(json.dumps(content), encoding="utf-8")


def test_a_result_is_read_back_as_it_was_written(result: Result) -> None:
    write_result(result)
    read = read_result(result.folder)
    metrics = {"rms_x": 0.01, "settle": math.nan, "rise": math.inf, "lap": 9.5}
    # A NaN does not equal a NaN, but is written alike.
    assert repr(read) == repr(replace(result, metrics=metrics))


def test_a_stored_request_is_read_back_equal() -> None:
    options = {"link": "mavlink", "board": "c", "realtime": True, "trace": True}
    for request in (
        Request.of(EXPERIMENTS["hover"]),
        Request.of(
            EXPERIMENTS["pushes"], profile="lqr", overrides={"servo.trim": (1, 2, 3, 4)}, seed=7, duration_s=1.5,
            faults=["imu.noise@0.1:0.123456789=2"], **options,
        ),
        Request(EXPERIMENTS["hover"], "floaty", (), 0, 8.0, (), Bench("radio://0/80", REAL)),
    ):  # fmt: skip
        assert Request.read(json.loads(json.dumps(request.stored())), find_again) == request


def test_the_file_has_documented_keys_and_null_for_missing_numbers(result: Result) -> None:
    write_result(result)
    content = json.loads((result.folder / RESULT).read_text(encoding="utf-8"))
    assert set(content) == set(KEYS)
    assert content["metrics"] == {"rms_x": 0.01, "settle": None, "rise": "inf", "lap": 9.5}
    assert content["verdicts"][1] == {
        "metric": "settle", "value": None, "bound": 0.5, "holds": False, "unit": "s", "sense": "max",
        "applies": True,
    }  # fmt: skip
    assert content["usage"]["entries"]["estimate"]["worst_cycles"] == 60


@pytest.mark.parametrize(
    ("outcome", "holds", "passed"),
    [("completed", True, True), ("lost", True, True), ("completed", False, False), ("lost", False, False),
     ("interrupted", True, False), ("error", True, False)],
)  # fmt: skip
def test_a_complete_run_within_limits_passes(result: Result, outcome: Any, holds: bool, passed: bool) -> None:
    verdicts = (Verdict("rms_x", 0.0, 1.0, True, "m", "max"), Verdict("rms_y", 0.0, 1.0, holds, "m", "max"))
    write_result(replace(result, outcome=outcome, verdicts=verdicts))
    assert json.loads((result.folder / RESULT).read_text(encoding="utf-8"))["passed"] is passed
    assert read_result(result.folder).passed is passed


@pytest.mark.long
@pytest.mark.parametrize(
    ("damage", "told"),
    [
        (lambda folder: (folder / RESULT).write_bytes(b"{"), "invalid JSON"),
        (lambda folder: (folder / RESULT).write_bytes(b'{"hash": "\xff"}'), "invalid JSON"),
        (lambda folder: (folder / RESULT).write_text("[]"), "should be a dictionary"),
        (lambda folder: drop(folder, "ages"), "ages is missing: it was written by another version"),
        (lambda folder: change(folder, seed="x"), "seed = 'x': input should be a valid integer"),
        (lambda folder: change(folder, outcome="won"), "outcome = 'won': input should be 'completed', 'lost'"),
        (lambda folder: change(folder, metrics={"rms_x": "big"}), "metrics.rms_x = 'big': input should be a"),
        (lambda folder: change(folder, verdicts=[{"metric": "rms_x"}]), "verdicts.0.value is missing"),
    ],
)  # fmt: skip
def test_bad_result_is_one_line(cli: Cli, result: Result, damage: Callable[[Path], None], told: str) -> None:
    write_result(result)
    killed(result.folder, metadata_of(result.request, result.program, VisualModel()))
    damage(result.folder)
    error = cli.refusal("report", result.folder)
    assert error.startswith(f"floaty: {result.folder / RESULT}: ")
    assert told in error


def killed(folder: Path, metadata: dict[str, str]) -> None:
    """Leave a log of no rows."""
    Recorder(folder, (Channel("f8", lambda: 0.0, (Quantity(("flight.free",), ""),)),), metadata).close()


def test_the_origin_of_a_killed_run_is_read_from_its_log(result: Result) -> None:
    killed(result.folder, metadata_of(result.request, result.program, VisualModel()))
    read = read_result(result.folder)
    assert (read.request, read.program) == (result.request, result.program)
    assert (read.outcome, read.passed, read.hash, read.folder) == ("error", False, "", result.folder)
    assert (math.isnan(read.real_time_factor), read.metrics["lost"]) == (True, 0.0)


def test_a_log_whose_schema_does_not_tell_where_it_comes_from_is_refused(result: Result) -> None:
    stored = {**result.request.stored(), **asdict(result.program)}
    for values, told in (
        ({name: value for name, value in stored.items() if name != "seed"}, "seed is missing"),
        (stored | {"overrides": "["}, "overrides = '['"),
    ):
        killed(result.folder, {"request": json.dumps(values), "program": json.dumps(values)})
        with pytest.raises(LabError, match=f"{result.folder}.*{told}".replace("[", r"\[")):
            read_result(result.folder)


@pytest.mark.parametrize(
    ("ended", "resets", "expected"),
    [
        (("completed", None), math.nan, ("completed", None)),
        (("completed", None), 0, ("completed", None)),
        (("completed", None), 1, ("reset", "the board was reset 1 time")),
        (("lost", "fell"), 2, ("lost", "fell; the board was reset 2 times")),
    ],
)
def test_resets_end_a_completed_flight_otherwise_and_join_another_cause(
    ended: tuple[Any, Any], resets: float, expected: tuple[Any, Any]
) -> None:
    assert with_resets(*ended, resets) == expected


@pytest.mark.parametrize(
    ("ended", "failures", "expected"),
    [
        (("completed", None), [], ("completed", None)),
        (("completed", None), ["a"], ("error", "a")),
        (("lost", "fell"), ["a", "b", "c"], ("lost", "a; 2 more in events.jsonl; fell")),
    ],
)
def test_the_first_failure_of_a_firmware_comes_before_the_other_cause(
    ended: tuple[Any, Any], failures: list[str], expected: tuple[Any, Any]
) -> None:
    assert with_failures(*ended, failures) == expected
