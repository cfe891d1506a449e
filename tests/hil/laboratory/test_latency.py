"""Where the age of a pose comes from: the budget of its stages, and that the age on board is the true one."""

import math
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.signals import COUNTERS
from ground_station.latency import (
    SENT_POSES,
    STAGES,
    LatencyBudget,
    LinkLatency,
    Stage,
    budget_line,
    budget_of,
    columns_of,
    reported_stages,
    row_of,
)
from ground_station.mocap import MocapFrame
from ground_station.telemetry_log import AGE_COLUMNS, TELEMETRY, TIME_COLUMN
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.ages import STATION_CLOCK, ages_in_time_of, ages_of, reported_ages, with_goals_sent
from hil.laboratory.files.recorder import load_log
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import MAVLINK, RADIO, Request
from hil.laboratory.run import fly

HOME = (0.0, 0.0, 1.15)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
HOVER = EXPERIMENTS["hover"]
stage = st.integers(0, 100_000)
ASSUMED = LinkLatency("radio", 1400, measured=False)


def frame(t_us: int, *way_us: int) -> MocapFrame:
    """Exposed at `t_us`; received, transmitted and arrived that much later, each."""
    instants = np.cumsum([t_us, *way_us]).tolist()
    return MocapFrame(t_us, HOME, UPRIGHT, True, *instants[1:])


@pytest.mark.long
@given(st.lists(st.tuples(stage, stage, stage, stage, stage), min_size=1, max_size=30))
def test_the_budget_is_numpys_mean_and_percentile_of_each_stage(times: list[tuple[int, ...]]) -> None:
    rows = [row_of(frame(7_000, *way[:3]), 7_000 + sum(way[:4]), way[4]) for way in times]
    pose, *stages = budget_of(columns_of(rows), "radio")
    assert [one.name for one in stages] == ["camera", "processing", "network", "station", "radio"]
    for one, values in ((pose, np.sum(times, axis=1)), *zip(stages, np.transpose(times), strict=True)):
        assert one.mean_us == pytest.approx(np.mean(values))
        assert one.p99_us == np.percentile(values, 99, method="inverted_cdf")


def test_the_line_marks_assumptions_and_omits_unknown_stages() -> None:
    budget = LatencyBudget()
    assert str(budget) == "no pose sent"
    assert all(map(math.isnan, budget.last()))
    budget.add(MocapFrame(0, HOME, UPRIGHT, True), 38_200, ASSUMED)
    assert str(budget) == (
        "pose 39.6 ms old on arrival (99 %: 39.6): mocap 38.2 + station 0.0 + radio (assumed) 1.4"
    )
    budget = LatencyBudget()
    budget.add(frame(0, 20_000, 18_000, 300), 38_500, LinkLatency("serial", 2100, measured=True))
    assert str(budget) == (
        "pose 40.6 ms old on arrival (99 %: 40.6): camera 20.0 + processing 18.0 + network 0.3 + station 0.2 + serial 2.1"
    )


@pytest.mark.parametrize("untold", [(), *STAGES[:3], STAGES[:2], STAGES[:3]])
def test_unknown_camera_stages_are_one_stage(untold: tuple[str, ...] | str) -> None:
    columns = {stage: [1.0, math.nan if stage in untold else 2.0] for stage in STAGES}
    assert reported_stages(columns) == ((*STAGES[:3], *STAGES[4:]) if untold == () else STAGES[3:])


def test_the_budget_forgets_what_is_long_ago() -> None:
    budget = LatencyBudget()
    for late_us in (100_000, *[0] * SENT_POSES):
        budget.add(frame(0, 20_000, 18_000, 0), 38_000 + late_us, ASSUMED)
    assert "station 0.0" in str(budget)
    assert "(99 %: 39.4)" in str(budget)


@pytest.mark.long
@pytest.mark.parametrize("link", [RADIO, MAVLINK])
def test_the_age_on_board_is_the_true_one_while_the_latency_changes(link: str) -> None:
    """A pose that the estimator thinks to be so old was sent: poses are 20 ms apart."""
    settings = ["radio.uplink_loss=0", "radio.downlink_loss=0"]
    flight = lockstep_flight(Request.of(HOVER, overrides=settings, duration_s=3.0, link=link))
    rng = np.random.default_rng(1)
    exposed_us: list[int] = []
    fused_us: list[int] = []  # exposures, as the board has them
    on_frame = flight.line.station.on_frame

    def send(frame: MocapFrame, now_us: int) -> None:
        sent = flight.line.station.counters.sent
        on_frame(frame, now_us)
        if flight.line.station.counters.sent > sent:
            exposed_us.append(frame.t_us)
        flight.robot.mocap.more_latency_us = rng.uniform(0.0, 25_000.0)

    def look(now_us: int) -> None:
        """At the end of a tick: the age is that at the estimator's next step, at 9 ms of every 10."""
        age_us = int(flight.robot.firmware.signals.counters[COUNTERS.index("pose_age_us")])
        tick = now_us // 1000
        step_us = 1000 * (tick + (9 - tick) % 10)
        if now_us > 1_500_000 and age_us != last[0]:
            fused_us.append(step_us - age_us)
        last[0] = age_us

    last = [0]
    flight.line.station.on_frame = send  # type: ignore[method-assign]
    flight.events.every(1000, 999, look)
    flight.run()
    assert len(fused_us) > 60
    wrong_us = np.abs(np.subtract.outer(fused_us, exposed_us)).min(axis=1)
    assert wrong_us.max() <= 1000


@pytest.mark.long
@pytest.mark.parametrize(("link", "name", "off_us"), [(RADIO, "radio", 40.0), (MAVLINK, "serial", 500.0)])
def test_a_flight_has_its_budget(tmp_path: Path, link: str, name: str, off_us: float) -> None:
    """The first packets up are short: they ask for telemetry. On the serial line the way down is not quite that up."""
    settings = ("mocap.latency_us=30000", "mocap.processing_us=12000")
    result = fly(Request.of(HOVER, overrides=settings, duration_s=1.0, link=link), tmp_path / "run")
    means = {stage.name: stage.mean_us for stage in result.ages}
    assert list(means) == ["pose", "camera", "processing", "network", "station", name]
    expected = {"camera": 18_000.0, "processing": 12_000.0, "network": 0.0, "station": 0.0}
    assert {name: means[name] for name in expected} == pytest.approx(expected, abs=0.01)
    assert means["pose"] == pytest.approx(sum(expected.values()) + means[name], abs=0.01)
    log = load_log(tmp_path / "run")
    delivered, sum_us = (log.column(f"link.up_{what}")[-1].as_py() for what in ("delivered", "latency_sum"))
    assert means[name] == pytest.approx(sum_us / delivered, abs=off_us)


def test_a_budget_has_mean_and_99th_of_the_pose_and_the_means_of_its_parts() -> None:
    stages = [
        Stage("pose", 39_440.0, 40_300.0),
        Stage("camera", 20_000.0, 21_000.0),
        Stage("radio", 1_390.0, 2_000.0),
    ]
    told = "pose 39.4 ms old on arrival (99 %: 40.3): camera 20.0 + radio 1.4"
    assert (budget_line(stages), budget_line([])) == (told, "no pose sent")


@pytest.mark.long
def test_cut_telemetry_is_read_up_to_the_cut(tmp_path: Path) -> None:
    result = fly(Request.of(HOVER, duration_s=0.5), tmp_path / "run")
    telemetry, log = tmp_path / "run" / "telemetry.csv", load_log(tmp_path / "run")
    text = telemetry.read_text()
    telemetry.write_text(text[: len(text) - 30])
    assert budget_line(ages_of(reported_ages(telemetry.parent), log, RADIO)) == budget_line(result.ages)
    telemetry.write_text(text.splitlines(keepends=True)[0])
    assert ages_of(reported_ages(telemetry.parent), log, RADIO) == ()


def test_ages_in_a_paced_log_are_at_its_time_not_at_the_station_s(tmp_path: Path) -> None:
    titles = (TIME_COLUMN, *AGE_COLUMNS)
    (tmp_path / TELEMETRY).write_text(
        f"{','.join(titles)}\n7.000020,1,2,3,6,5,4\n7.00004,nan,2,3,6,5,4\n8,1,2,3,6,5,nan\n"
    )
    log = pa.table({"t": [0, 100_000], STATION_CLOCK: [7_000_000, 7_200_000]})
    found = ages_in_time_of(iter([log.slice(0, 1), log.slice(1)]), tmp_path)
    first, second = found.to_pylist()  # of a pose that was not sent there is no age
    assert first == dict(zip(("t", *STAGES), (10.0, 1e3, 2e3, 3e3, 6e3, 5e3, 4e3), strict=True))
    assert (second["t"], second["link"], math.isnan(second["camera"])) == (20.0, 4e3, True)


def test_a_log_gets_the_goals_that_the_station_recorded_at_their_time(tmp_path: Path) -> None:
    record = tmp_path / "telemetry.csv"
    titles = ("board.t [ms]", "ground.t [s]", "goal.x [m]", "goal.y [m]", "goal.z [m]", "goal.yaw [rad]")
    rows = ("1,1.000009,1,2,3,0.1", "2,7.000040,4,5,6,0.2", "3,7.0000")
    record.write_bytes("\n".join((",".join(titles), *rows)).encode() + b"\xff")
    columns = {"goal.x": 0.0, "goal.y": 0.0, "goal.z": 1.15, "goal.yaw": 0.0}
    clock = [1_000_008, 1_000_009, 7_000_039, 7_000_040, 9_000_000]
    log = pa.table({STATION_CLOCK: clock, **{name: [value] * 5 for name, value in columns.items()}})
    told = with_goals_sent(record, log)
    assert told.column("goal.z").to_pylist() == [1.15, 3.0, 3.0, 6.0, 6.0]
    assert told.column("goal.yaw").to_pylist() == [0.0, 0.1, 0.1, 0.2, 0.2]
    assert with_goals_sent(tmp_path / "none.csv", log).equals(log)
