"""Whole flights: the limits of the hover, determinism, what the predictor saves, how flights end."""

import gc
import json
import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from hil.board.clock import FreeRunning
from hil.commands.tables import print_result, print_seeds
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.files.result import Result, read_result
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import in_lockstep, lockstep_flight
from hil.laboratory.metrics import ALWAYS, column
from hil.laboratory.request import LOCKSTEP, Bench, Request
from hil.laboratory.run import Started, fly
from hil.research.campaigns.jobs import Job, row_of
from support.flights import PAPER, explain, flown, hover
from support.full_disk import small_files

HOVER = EXPERIMENTS["hover"]


@pytest.fixture(scope="module")
def hovered(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """The hover of the paper, as long as its limits are for."""
    return hover(tmp_path_factory.mktemp("hovered") / "run")


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (10, 1234))])
def test_hover_holds_its_limits(hovered: Result, tmp_path: Path, seed: int) -> None:
    result = hovered if seed == 1 else hover(tmp_path / "run", seed=seed)
    assert result.passed, explain(result)
    assert {verdict.metric for verdict in result.verdicts} == {*HOVER.limits, *ALWAYS}


def test_flight_without_a_recorder_keeps_what_is_noted() -> None:
    class Late(FreeRunning):
        said = iter([["late"]])

        def notices(self) -> list[str]:
            return next(self.said, [])

    flight = lockstep_flight(Request.of(HOVER, duration_s=0.1), clock=Late())
    flight.note("lab", "before the start")
    assert flight.run().lost is None
    flight.close()
    assert [flight._early.count(("lab", text)) for text in ("before the start", "late")] == [1, 1]


@pytest.mark.long
def test_a_flight_that_is_over_records_nothing_more(tmp_path: Path) -> None:
    """Its laboratory may run on, for a link that is still to send something."""
    with ExitStack() as stack:
        started = Started(Request.of(HOVER, duration_s=0.1), tmp_path, stack)
        started.fly()
        end_us = started.flight.now_us
        started.flight.lab.end_at(end_us + 50_000)
        started.flight.lab.run()
        started.close()
    assert 0 <= end_us - load_log(tmp_path).column("t")[-1].as_py() < 10_000


def test_a_robot_that_was_lost_before_an_error_is_counted_as_lost(tmp_path: Path) -> None:
    request = Request.of(HOVER, duration_s=0.03, overrides=["flight.release_us=10000"])
    with ExitStack() as stack:
        started = Started(request, tmp_path, stack)
        started.fly()
        started.close()
    started._ended = "error", "broke"
    for lost in (None, "left the flow"):
        started.flight.lost = lost
        result = started.result()
        assert (result.outcome, result.cause) == ("error", "broke")
        assert result.metrics["lost"] == (lost is not None)


@pytest.mark.long
@pytest.mark.parametrize(("board", "faults"), [("python", ()), ("c", ("push.y@0.6=20",))])
def test_an_estimate_that_is_not_finite_fails_the_flight_and_is_reported(
    tmp_path: Path, board: str, faults: tuple[str, ...]
) -> None:
    """Also of a robot that is lost afterwards."""

    def made(*arguments: object) -> Flight:
        flight = in_lockstep(*arguments)  # type: ignore[arg-type]

        def spoil(now_us: int) -> None:
            flight.robot.firmware._core.estimator.fields.x[0] = np.nan

        flight.events.at(1_500_000, spoil)
        return flight

    request = Request.of(HOVER, duration_s=1.0, board=board, faults=faults)
    result = fly(request, tmp_path / "run", flight_of=made)
    assert (result.outcome, result.passed, result.metrics["lost"]) == ("error", False, bool(faults))
    assert ("left the flow" in str(result.cause)) == bool(faults)
    texts = [event["text"] for event in load_events(result.folder)]
    (text,) = (text for text in texts if "NaN" in text)
    assert text.startswith("the estimate was NaN or infinite at 1.5")
    assert text in str(result.cause)


def test_an_estimate_that_is_not_finite_again_after_a_reset_is_reported_again() -> None:
    flight = lockstep_flight(Request.of(HOVER, duration_s=0.1, overrides=["flight.release_us=2500000"]))
    for number in range(2):
        for at_us, act in (
            (1_200_000, lambda _: flight.robot.firmware._core.estimator.fields.x.fill(np.nan)),
            (1_300_000, lambda _: flight.robot.board.reset()),
        ):
            flight.events.at(at_us + 1_000_000 * number, act)
    flight.run()
    told = [text for _, text in flight._early if "NaN" in text]
    assert [text[:42] for text in told] == [
        f"the estimate was NaN or infinite at {number}.21 s" for number in (1, 2)
    ]
    assert flight.logic_failed == told[0], "the first is the cause"


@pytest.mark.long
def test_flight_makes_no_garbage_that_only_the_collector_frees() -> None:
    for duration_s in (0.1, 0.5):  # the first one leaves what is made once per process
        flight = lockstep_flight(Request.of(HOVER, duration_s=duration_s))
        gc.collect()
        gc.disable()
        try:
            flight.run()
            garbage = gc.collect()
        finally:
            gc.enable()
            flight.close()
    assert garbage == 0


@pytest.mark.long
def test_hover_with_the_authors_gains_swings_in_y_and_survives(tmp_path: Path) -> None:
    results = [hover(tmp_path / str(seed), profile="as-flown", seed=seed) for seed in (1, 2, 3, 4)]
    for result in results:
        assert result.passed, explain(result)
    rms = {axis: np.mean([result.metrics[f"rms_{axis}"] for result in results]) for axis in "xy"}
    assert rms["y"] > rms["x"]
    for axis in "xyz":
        assert np.mean([result.metrics[f"within_6cm_{axis}"] for result in results]) > 0.95


HEALTHY = (  # besides those of the paper, which test_experiments.py flies
    *((name, ()) for name in EXPERIMENTS if name not in ("endurance", *PAPER)),
    ("hover", ("push.x@1=20",)),
    ("hover", ("push.y@1=20",)),
    ("hover", ("push.z@1=-20",)),
    ("hover", ("push.yaw@1=1",)),
    ("hover", ("wind.fan@1=0",)),
)


@pytest.mark.long
@pytest.mark.parametrize(("name", "faults"), HEALTHY)
def test_the_tracker_refuses_no_healthy_pose(tmp_path: Path, name: str, faults: tuple[str, ...]) -> None:
    duration_s = 4.0 if faults else min(12.0, EXPERIMENTS[name].duration_s)
    flown(tmp_path / "run", name, duration_s=duration_s, faults=faults)
    log = load_log(tmp_path / "run")
    assert column(log, "tracker.refused")[-1] == column(log, "tracker.restarts")[-1] == 0


@pytest.mark.long
def test_pacing_changes_nothing_that_is_flown(tmp_path: Path) -> None:
    request = Request.of(HOVER, overrides=["flight.release_us=100000"], seed=3, duration_s=0.2)
    free = fly(request, tmp_path / "free")
    paced = fly(replace(request, bench=Bench(realtime=True)), tmp_path / "paced")
    assert free.hash == paced.hash


def test_ctrl_c_keeps_what_was_flown(tmp_path: Path) -> None:
    def interrupt(now_us: int, flight: Flight) -> None:
        if now_us > 2_000_000:
            raise KeyboardInterrupt

    request, thresholds = Request.of(HOVER, duration_s=30.0), gc.get_threshold()
    result = fly(request, tmp_path / "run", progress=interrupt)
    assert gc.get_threshold() == thresholds, "a flight's own are of the flight"
    assert result.outcome == "interrupted"
    assert not result.passed
    assert load_log(result.folder).num_rows == pytest.approx(200, abs=30)
    assert read_result(result.folder).outcome == "interrupted"


@pytest.mark.long
def test_an_error_of_the_firmware_ends_the_flight_with_its_log(tmp_path: Path) -> None:
    def burn(counts: Sequence[int]) -> None:
        raise ValueError("no pin is left")

    def sabotage(now_us: int, flight: Flight) -> None:
        if now_us > 1_500_000:
            flight.robot.board.write_compare = burn  # type: ignore[method-assign]

    request = Request.of(HOVER, duration_s=30.0)
    result = fly(request, tmp_path / "run", progress=sabotage)
    assert result.outcome == "error"
    assert re.search(r"task STABILIZER at 1\d{3}\.\d+ ms: ValueError: no pin is left", str(result.cause))
    assert load_log(result.folder).num_rows > 140


def test_log_carries_units_frames_and_origin(hovered: Result) -> None:
    assert hovered.real_time_factor == round(hovered.real_time_factor, 2)
    table = load_log(hovered.folder)
    assert table.schema.field("truth.x").metadata == {b"unit": b"m", b"frame": b"W"}
    assert table.schema.field("motor.m1").metadata[b"unit"] == b"counts"
    metadata = table.schema.metadata
    assert json.loads(metadata[b"request"])["seed"] == 1
    assert json.loads(metadata[b"config"])["controller"]["gain_y"] == -1.8
    assert b"numpy" in metadata[b"program"]


def test_estimate_follows_the_truth(hovered: Result) -> None:
    table = load_log(hovered.folder)
    late = column(table, "t") > 2_000_000
    for name, limit in (("x", 0.01), ("y", 0.01), ("vx", 0.08), ("vy", 0.08)):
        error = column(table, f"estimate.{name}") - column(table, f"truth.{name}")
        assert np.sqrt((error[late] ** 2).mean()) < limit, name
    flap = column(table, "estimate.flap_1") + 0.436332 - column(table, "truth.flap_1")
    assert np.sqrt((flap[late] ** 2).mean()) < 0.03
    p = column(table, "estimate.p") - column(table, "truth.p")
    assert np.sqrt((p[late] ** 2).mean()) < 0.15


@pytest.mark.long
@pytest.mark.parametrize("link", LOCKSTEP)
def test_a_full_disk_leaves_no_file_of_the_flight_open(tmp_path: Path, link: str) -> None:
    request = Request.of(HOVER, duration_s=1.0, link=link)
    with small_files(100_000), pytest.raises(OSError, match="File too large"):
        fly(request, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} >= {"log.arrows", "events.jsonl", "telemetry.csv"}
    assert [path for path in open_files() if path.is_relative_to(tmp_path)] == []


def open_files() -> list[Path]:
    return [link.readlink() for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]


def test_a_lost_flight_is_marked_in_every_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    result = hover(tmp_path / "run", duration_s=3.0, faults=["wind.fan@0.5=0.3"])
    assert {verdict.metric for verdict in result.verdicts if verdict.holds} == set()
    assert [verdict.metric for verdict in result.failed] == ["lost"]
    print_result(result)
    print_seeds([row_of(Job(0, "hover", {"profile": "floaty"}, {}), result)])
    shown = capsys.readouterr().out
    share = next(line for line in shown.splitlines() if "within_6cm_x" in line)
    assert f"100 % of {result.metrics['flown']:.4g} s" in share
    assert "lost" in share
    assert "ok" not in shown


@dataclass(frozen=True)
class Reboots:
    """Reboots the board again and again from 1 s after the release on."""

    count: int

    def __call__(self, flight: Flight) -> None:
        flight.events.at(200_000, lambda now_us: flight.robot.board.reset())  # it flies again by the release
        for number in range(self.count):
            at_us = flight.release_us + 1_000_000 + 100_000 * number
            flight.events.at(at_us, lambda now_us: flight.robot.board.reset())


def test_a_board_that_is_reset_has_not_completed_its_flight(tmp_path: Path) -> None:
    experiment = replace(HOVER, name="reboots", script=Reboots(3), duration_s=1.5)
    result = fly(Request.of(experiment), tmp_path / "run")
    assert (result.outcome, result.cause) == ("reset", "the board was reset 3 times")
    assert result.metrics["resets"] == 3.0
    assert result.metrics["uncontrolled"] == pytest.approx(0.5, abs=0.02)
    assert {"resets", "uncontrolled"} <= {verdict.metric for verdict in result.failed}
    assert not result.passed
    patient = replace(experiment, limits={"resets": 3.0, "uncontrolled": 0.6})
    assert fly(Request.of(patient), tmp_path / "patient").passed


@pytest.mark.long
def test_only_the_resets_after_the_release_are_counted() -> None:
    flight = lockstep_flight(Request.of(HOVER, duration_s=0.2))
    for moment_us in (200_000, 1_050_000, 1_100_000):
        flight.events.at(moment_us, flight.robot._reset)
    flight.run()
    assert (flight.robot.resets, flight.resets) == (3, 2)
