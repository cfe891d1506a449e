"""Why two boards fly one seed differently: what was put into a log as a difference is told, with its size."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.result import read_result, write_result
from hil.laboratory.metrics import column
from hil.laboratory.request import REAL, Bench, Request
from hil.laboratory.run import fly
from hil.laboratory.schedule import SCHEMA
from hil.pictures.compare import FlownRun, load_flown
from hil.research.studies.two_boards import CLOCK, RATES, _boot, _radio, comparable, seeds_of, two_boards

Columns = dict[str, NDArray[np.generic]]
RELEASE, FLOWN = 100, 30  # rows


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("boards") / "hover-1"
    fly(Request.of(EXPERIMENTS["hover"], duration_s=FLOWN / 100), folder)
    return folder


def other(flown: Path, folder: Path, change: Callable[[Columns], None], board: str = "cf2.elf") -> FlownRun:
    """The same flight by a board whose log is changed."""
    shutil.copytree(flown, folder)
    log = load_flown(folder).log
    columns = {name: log.column(name).to_numpy().copy() for name in log.column_names}
    change(columns)
    pq.write_table(pa.table(columns).replace_schema_metadata(log.schema.metadata), folder / "log.parquet")
    result = read_result(folder)
    write_result(replace(result, request=replace(result.request, bench=Bench(board=board))))
    return load_flown(folder)


def bumped(columns: Columns) -> None:
    """From the sample after the release on the counts are others, and so is what the gyro then sees."""
    columns["motor.m3"][RELEASE + 1 :] += 1
    columns["imu.gx"][RELEASE + 2 :] += 1


@pytest.mark.long
def test_a_board_that_closes_its_loop_earlier_differs_by_its_boot_time(flown: Path, tmp_path: Path) -> None:
    def change(columns: Columns) -> None:
        state = columns["supervisor.state"]
        begin = int(np.argmax(state == 2))
        state[begin - 4 : begin] = 2
        columns["motor.m2"][begin - 4] += 7
        columns["cpu.IDLE"] += 3_100_000

    a, b = load_flown(flown), other(flown, tmp_path / "b", change)
    begin = int(np.argmax(a.log.column("supervisor.state").to_numpy() == 2))
    found = two_boards(a, b)
    assert found.first is not None
    assert (found.first.row, found.first.servo, found.first.why) == (begin - 4, "motor.m2", "boot time")
    assert found.first.counts[1] - found.first.counts[0] == 7
    (cause,) = found.causes
    assert cause.startswith("boot time: the loops are closed at ")
    assert "0.000 | 3.100 s when the record began" in cause


def test_another_boot_time_is_not_why_counts_differ_once_both_loops_are_closed(
    flown: Path, tmp_path: Path
) -> None:
    def change(columns: Columns) -> None:
        begin = int(np.argmax(columns["supervisor.state"] == 2))
        columns["supervisor.state"][begin - 4 : begin] = 2
        bumped(columns)

    found = two_boards(load_flown(flown), other(flown, tmp_path / "b", change))
    assert found.first is not None
    assert (found.first.row, found.first.why) == (RELEASE + 1, "none of the known causes")
    assert [cause.partition(":")[0] for cause in found.causes] == ["boot time"]


def test_a_board_that_never_closes_its_loop_has_no_time_at_which_it_does(flown: Path, tmp_path: Path) -> None:
    b = other(flown, tmp_path / "b", lambda columns: columns["supervisor.state"].fill(0))
    logs = load_flown(flown).log, b.log
    assert [_boot(pair) for pair in (logs, logs[::-1], logs[1:] * 2)] == [""] * 3


def test_another_gyro_zero_is_measured_before_the_flights_part(flown: Path, tmp_path: Path) -> None:
    def change(columns: Columns) -> None:
        bumped(columns)
        for name, offset in zip(RATES, (-4e-4, -1e-4, 0.0), strict=True):
            columns[name] += np.float32(offset)
            columns[name][RELEASE + 2 :] += np.float32(0.5)  # what comes of the other counts is no cause

    found = two_boards(load_flown(flown), other(flown, tmp_path / "b", change))
    assert found.first is not None
    assert (found.first.row, found.first.why) == (RELEASE + 1, "sensor start")
    assert any("-0.400 -0.100 +0.000 mrad/s (p q r)" in cause for cause in found.causes)


def test_an_estimator_that_begins_later_differs_by_its_phase(flown: Path, tmp_path: Path) -> None:
    def change(columns: Columns) -> None:
        bumped(columns)
        columns["estimator.pose_age_us"][columns["estimator.fused"] > 0] += 500

    b = other(flown, tmp_path / "b", change)
    rows = [(10_000 * step + 3_000 + us, event, who, 0, 0) for step in range(5) for us, event, who in
            ((0, "IN", "STABILIZE"), (700, "IN", "IDLE"))]  # fmt: skip
    columns = [
        pa.array(values, field.type) for values, field in zip(zip(*rows, strict=True), SCHEMA, strict=True)
    ]
    pq.write_table(pa.table(columns, schema=SCHEMA), b.result.folder / "schedule.parquet")
    found = two_boards(load_flown(flown), b)
    assert found.first is not None
    assert found.first.why == "task phases"
    (cause,) = (cause for cause in found.causes if cause.startswith("task phases"))
    assert "| 3000 us into its ten ms" in cause
    first, second = (float(text) for text in cause.split("takes poses ")[1].split(" ms")[0].split(" | "))
    assert second - first == pytest.approx(0.5, abs=0.011)


def test_a_clock_with_long_microseconds_is_measured_through_its_carries(flown: Path, tmp_path: Path) -> None:
    def change(columns: Columns) -> None:
        bumped(columns)
        columns[CLOCK] = (3_100_000 + columns["t"] * 84 / 85).astype(np.int64)
        columns[CLOCK][40] -= 1 << 16  # read while the timer carried

    found = two_boards(load_flown(flown), other(flown, tmp_path / "b", change))
    assert found.first is not None
    assert found.first.why == "long microsecond"
    assert found.causes == ("long microsecond: a microsecond of the boards' clocks lasts 1.0000 | 1.0119 us",)


def test_only_rows_that_both_boards_have_are_compared(flown: Path, tmp_path: Path) -> None:
    def shorter(columns: Columns) -> None:
        bumped(columns)
        columns.update({name: column[: RELEASE + 9] for name, column in columns.items()})

    a, b = load_flown(flown), other(flown, tmp_path / "b", shorter)
    firsts = [one.first for one in (two_boards(a, b), two_boards(b, a))]
    assert [(one.row, one.servo) for one in firsts if one] == [(RELEASE + 1, "motor.m3")] * 2


def test_an_unexplained_difference_is_reported(flown: Path, tmp_path: Path) -> None:
    found = two_boards(load_flown(flown), other(flown, tmp_path / "b", bumped))
    assert found.first is not None
    assert found.first.why == "none of the known causes"
    assert found.causes == ()


def test_boards_with_the_same_counts_need_no_cause(flown: Path, tmp_path: Path) -> None:
    found = two_boards(load_flown(flown), other(flown, tmp_path / "b", lambda columns: None, "c"))
    assert (found.first, found.causes) == (None, ())


def test_only_equal_requests_on_two_boards_are_comparable(flown: Path, tmp_path: Path) -> None:
    a = load_flown(flown)
    b = other(flown, tmp_path / "b", lambda columns: None)
    assert comparable(a, b)
    assert not comparable(a, a)
    changes: list[dict[str, Any]] = [{"seed": 2}, {"overrides": ("a.b=1",)}, {"faults": ("push.y@1=1",)}]
    for change in changes:
        assert not comparable(
            a, FlownRun(b.log, replace(b.result, request=replace(b.result.request, **change)))
        )
    assert not comparable(other(flown, tmp_path / "real", lambda columns: None, REAL), b)


@pytest.mark.parametrize(("down", "up", "expected"), [
    ((4, 5), (2, 4), "packets take 1.50 | 0.50 ms up, beside 4 | 5 that come down"),
    ((4, 4), (2, 4), ""), ((4, 5), (0, 4), ""), ((4, 5), (2, 0), ""), (None, None, "")])  # fmt: skip
def test_packets_of_the_uplink_wait_beside_those_that_come_down(down: Any, up: Any, expected: str) -> None:
    def log(n: int) -> pa.Table:
        ends = (
            {"up_delivered": up[n], "up_latency_sum": (3000, 2000)[n], "down_delivered": down[n]}
            if up
            else {}
        )
        return pa.table({f"link.{name}": [0, value] for name, value in ends.items()} | {"t": [0, 1]})

    assert _radio([log(0), log(1)]) == expected


def test_two_folders_of_runs_are_a_row_per_seed(flown: Path, tmp_path: Path) -> None:
    """The second body is 12.3 mm beside the first, once 20 mm, and its board fuses three poses more."""

    shift = np.full(RELEASE + FLOWN, 0.0123)
    shift[RELEASE + 7] = 0.02

    def beside(columns: Columns) -> None:
        bumped(columns)
        columns["truth.x"] += shift[: len(columns["t"])]
        columns["estimator.fused"] += 3

    first, second = tmp_path / "first", tmp_path / "second"
    for seed in (10, 2, 3):  # the last has no partner
        runs = [Path(shutil.copytree(flown, first / f"hover-{seed}"))]
        runs += [other(flown, second / f"hover-{seed}", beside).result.folder] * (seed != 3)
        for run in runs:
            result = read_result(run)
            write_result(replace(result, request=replace(result.request, seed=seed)))
    found = seeds_of(first, second)
    assert [one.seed for one in found] == [2, 10]
    free = load_flown(flown).log.slice(RELEASE)
    errors = [column(free, f"truth.{axis}") - column(free, f"goal.{axis}") for axis in "xyz"]
    rms = [
        float(np.sqrt((error**2).mean())) for error in (*errors, errors[0] + shift[RELEASE:][: free.num_rows])
    ]
    fused = int(column(free, "estimator.fused")[-1])
    for one in found:
        assert one.first is not None
        assert str(one.first).startswith(f"first servo count: row {RELEASE + 1}, 0.01")
        assert [*one.rms_m[0], *one.rms_m[1]] == pytest.approx([*rms[:3], rms[3], *rms[1:3]], rel=1e-6)
        assert (one.apart_m, one.fused) == (pytest.approx(0.02, rel=1e-6), (fused, fused + 3))
    with pytest.raises(LabError, match="neither two runs nor folders with runs of the same names"):
        seeds_of(first, flown.parent)
