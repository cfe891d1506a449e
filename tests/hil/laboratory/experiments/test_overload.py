"""What becomes of a flight when the processor has no time: deadlines, queues, watchdog; and the scheduler's trace."""

import json
import math
import re
from collections.abc import Generator
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TrackEvent

from hil.config import load_config
from hil.laboratory.experiment import Experiment
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.flight import Flight
from hil.laboratory.schedule import load_schedule, runs
from hil.pictures.exports.perfetto import write_perfetto
from hil.pictures.report import write_report
from support.flights import flown
from support.html_page import Page


def hover(script: object = None) -> Experiment:
    assert script is None or callable(script)
    return Experiment("hover", "", 2.0, {}, **({"script": script} if script else {}))


@pytest.mark.long
def test_overload_names_the_loads_at_which_tasks_are_late_and_the_hover_fails(tmp_path: Path) -> None:
    overload = EXPERIMENTS["overload"]
    result = flown(tmp_path, overload, duration_s=overload.duration_s)
    assert result.passed, [str(verdict) for verdict in result.verdicts]
    cost = load_config().cpu
    # The estimator's step is late once thief, IMU and step do not fit into a tick. The controller's fits beside all but a
    # thief that takes everything.
    fits_estimator = (1000 - cost.sensors_us - cost.estimator_us) / 1000
    assert result.metrics["estimator_late_from"] == pytest.approx(fits_estimator, abs=0.06)
    assert cost.controller_us < 50
    assert result.metrics["controller_late_from"] == math.inf
    assert result.metrics["lost"] == 1
    assert result.metrics["held_up_to"] > result.metrics["estimator_late_from"]
    page = write_report(tmp_path).read_text()
    assert 'alt="Overload"' in page
    assert "scheduler" in Page(page).plots
    assert '<table id="tasks">' in page


@pytest.mark.long
def test_processor_time_adds_up(tmp_path: Path) -> None:
    result = flown(tmp_path, hover(), duration_s=2.0)
    cost = load_config().cpu
    tasks = {task.name: task for task in result.tasks}
    milliseconds = 3000
    assert tasks["SENSORS"].run_time_us == pytest.approx(milliseconds * cost.sensors_us, abs=cost.sensors_us)
    assert tasks["STABILIZER"].run_time_us == pytest.approx(milliseconds / 10 * cost.controller_us, rel=0.02)
    assert tasks["KALMAN"].run_time_us == pytest.approx(milliseconds / 10 * cost.estimator_us, rel=0.02)
    assert tasks["KALMAN"].worst_response_us >= cost.estimator_us
    assert tasks["KALMAN"].deadline_misses == 0
    rows = load_log(tmp_path)
    spent = sum(rows.column(name)[-1].as_py() for name in rows.column_names if name.startswith("cpu."))
    assert spent == pytest.approx(rows.column("t")[-1].as_py(), abs=1000)  # the idle task has the rest


@pytest.mark.long
def test_without_costs_no_time_is_spent(tmp_path: Path) -> None:
    costs = [f"cpu.{name}=0" for name in type(load_config().cpu).model_fields]
    result = flown(tmp_path, hover(), *costs, duration_s=0.5)
    assert {task.run_time_us for task in result.tasks} == {0}


@pytest.mark.long
def test_a_task_that_never_ends_with_interrupts_off_is_named_by_the_watchdog(tmp_path: Path) -> None:
    def seize(flight: Flight) -> None:
        kernel = flight.robot.firmware.kernel

        def rogue() -> Generator[int, None, None]:
            yield from kernel.delay(1500)
            kernel.enter_critical()
            while True:
                yield from kernel.work(1_000_000)

        kernel.create_task("ROGUE", 1, rogue)

    result = flown(tmp_path, hover(seize), duration_s=5.0)
    assert result.outcome == "lost"
    assert "task ROGUE at 18" in str(result.cause)
    assert "watchdog reset, STABILIZER has not run for " in str(result.cause)
    assert load_log(tmp_path).num_rows == pytest.approx(185, abs=5)
    assert json.loads((tmp_path / "result.json").read_text())["outcome"] == "lost"


@pytest.mark.long
def test_a_critical_section_that_ends_costs_samples_and_nothing_else(tmp_path: Path) -> None:
    def pause(flight: Flight) -> None:
        kernel = flight.robot.firmware.kernel

        def rude() -> Generator[int, None, None]:
            yield from kernel.delay(1500)
            kernel.enter_critical()
            yield from kernel.work(30_000)
            yield from kernel.exit_critical()
            yield from kernel.delay(1_000_000)

        kernel.create_task("RUDE", 1, rude)

    result = flown(tmp_path, hover(pause), duration_s=3.0)
    assert result.outcome == "completed"
    late = load_log(tmp_path).column("late.KALMAN")[-1].as_py()
    assert 0 <= late < 5


@pytest.mark.long
def test_a_task_that_raises_is_named_and_the_log_is_there(tmp_path: Path) -> None:
    def plant_bug(flight: Flight) -> None:
        def buggy() -> Generator[int, None, None]:
            yield from flight.robot.firmware.kernel.delay(1205)
            raise ZeroDivisionError("bug")

        flight.robot.firmware.kernel.create_task("BUGGY", 1, buggy)

    result = flown(tmp_path, hover(plant_bug), duration_s=5.0)
    assert result.outcome == "error"
    assert "task BUGGY at 1205." in str(result.cause)
    assert "ZeroDivisionError: bug" in str(result.cause)
    assert load_log(tmp_path).num_rows == 121


@pytest.mark.long
def test_a_full_queue_is_counted_and_noted_again_after_a_second_if_it_dropped_more(tmp_path: Path) -> None:
    """Starved from 0.5 s to 2.5 s, then never again; each note says more than the last, and the last says it all."""

    def starve(flight: Flight) -> None:
        thief = flight.robot.thief
        flight.events.at(500_000, lambda _: setattr(thief, "share", 0.97))
        flight.events.at(2_500_000, lambda _: setattr(thief, "share", 0.0))

    result = flown(tmp_path, hover(starve), duration_s=5.0)
    noted: dict[str, list[int]] = {}
    times_us = []
    for event in load_events(tmp_path):
        if match := re.fullmatch(r"queue (\w+) is full: (\d+) dropped so far", event["text"]):
            noted.setdefault(match[1], []).append(int(match[2]))
            times_us.append(event["t_us"])
    assert 500_000 < times_us[0] < 1_000_000
    assert np.diff(times_us).min() >= 1_000_000
    dropped = {queue.name: queue.dropped for queue in result.queues if queue.dropped}
    assert dropped["syslink"] > 100
    assert {queue.high_water == queue.length for queue in result.queues if queue.dropped} == {True}
    assert len(noted["syslink"]) > 1
    for name, counts in noted.items():
        assert counts == sorted(set(counts)), name
    assert {name: counts[-1] for name, counts in noted.items()} == dropped


@pytest.mark.long
def test_perfetto_has_a_track_per_task_and_the_slices_of_the_schedule(tmp_path: Path) -> None:
    plain = flown(tmp_path / "plain", hover(), duration_s=0.3)
    traced = flown(tmp_path / "traced", hover(), duration_s=0.3, trace=True)
    assert traced.hash == plain.hash
    trace = Trace()
    trace.ParseFromString(write_perfetto(tmp_path / "traced").read_bytes())
    tracks = {
        p.track_descriptor.uuid: p.track_descriptor.name
        for p in trace.packet
        if p.HasField("track_descriptor")
    }
    assert {"SENSORS", "STABILIZER", "KALMAN", "CRTP-TX"} <= set(tracks.values())
    opened = [p for p in trace.packet if p.track_event.type == TrackEvent.TYPE_SLICE_BEGIN]
    closed = [p for p in trace.packet if p.track_event.type == TrackEvent.TYPE_SLICE_END]
    stretches = [run for run in runs(load_schedule(tmp_path / "traced")) if run.task != "IDLE"]
    assert [(tracks[p.track_event.track_uuid], p.timestamp) for p in opened] == [
        (run.task, run.start_us * 1000) for run in stretches
    ]
    assert [p.timestamp for p in closed] == [run.end_us * 1000 for run in stretches]
    spent = sum(run.end_us - run.start_us for run in stretches if run.task == "SENSORS")
    assert spent == next(task for task in traced.tasks if task.name == "SENSORS").run_time_us


def test_schedule_of_every_flight_covers_fifty_milliseconds(tmp_path: Path) -> None:
    flown(tmp_path, hover(), duration_s=0.3)
    times = pyarrow.parquet.read_table(tmp_path / "schedule.parquet").column("us").to_pylist()
    assert times[0] == 1_000_000
    assert times[-1] == 1_050_000
