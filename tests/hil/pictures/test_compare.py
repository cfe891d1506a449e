"""Comparing flights: the first difference is the first, and what differs besides is told."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace as Made

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hil.config import load_config
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import RELEASE_US, load_log
from hil.laboratory.metrics import free_flight, measure, position_error
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.pictures.compare import FlownRun, _flown_s, compare, difference, load_flown, shown_curves
from hil.pictures.curves import ORANGE
from hil.pictures.trials import DARK
from support.command import Cli
from support.html_page import Page


def flown(folder: Path, seed: int, *overrides: str) -> Path:
    fly(Request.of(EXPERIMENTS["hover"], overrides=overrides, seed=seed, duration_s=0.5), folder)
    return folder


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    parent = tmp_path_factory.mktemp("compare")
    return {
        "one": flown(parent / "one", 1),
        "again": flown(parent / "again", 1),
        "two": flown(parent / "two", 2),
        "strong": flown(parent / "strong", 1, "controller.gain_z=3.5"),
    }


@pytest.mark.long
def test_the_same_seed_is_identical(runs: dict[str, Path]) -> None:
    comparison = compare(load_flown(runs["one"]), load_flown(runs["again"]))
    assert comparison.identical
    assert comparison.first is None
    assert comparison.settings == ()
    assert all(pair.difference == 0 for pair in comparison.metrics)


@pytest.mark.long
def test_the_first_difference_is_the_first_by_row_then_by_column(runs: dict[str, Path]) -> None:
    a, b = load_flown(runs["one"]), load_flown(runs["two"])
    found = next(  # slow and plain: Python rows instead of numpy columns
        (row, name, x[name], y[name])
        for row, (x, y) in enumerate(zip(a.log.to_pylist(), b.log.to_pylist(), strict=True))
        for name in a.log.column_names
        if x[name] != y[name]
    )
    first = compare(a, b).first
    assert first is not None
    assert (first.row, first.column, *first.values) == found
    release_us = load_config().flight.release_us
    assert first.t_s == pytest.approx(1e-6 * (a.log.column("t")[first.row].as_py() - release_us))


def test_only_differing_settings_are_reported(runs: dict[str, Path]) -> None:
    a, b = load_flown(runs["one"]), load_flown(runs["strong"])
    comparison = compare(a, b)
    gain = load_config().controller.gain_z
    assert ("controller.gain_z", str(gain), "3.5") in comparison.settings
    lost, old = (
        replace(b.result, outcome="lost"),
        replace(b.result.program, commit="x", versions={"numpy": "1"}),
    )
    other = {
        name: values for name, *values in compare(a, replace(b, result=replace(lost, program=old))).settings
    }
    assert other["outcome"] == ["completed", "lost"]
    assert (other["commit"][1], other["versions.numpy"][1]) == ("x", "1")
    empty = replace(a, log=a.log.replace_schema_metadata({}))
    for runs_of, values in (((a, empty), (str(gain), "–")), ((empty, a), ("–", str(gain)))):
        assert ("controller.gain_z", *values) in compare(*runs_of).settings, "one has no such setting"
    assert {name for name, _, _ in comparison.settings} <= {"controller.gain_z", "overrides", "commit"}


def test_metrics_are_side_by_side_in_the_unit_of_the_table(runs: dict[str, Path]) -> None:
    a, b = (json.loads((runs[name] / "result.json").read_text())["metrics"] for name in ("one", "two"))
    told = {pair.name: pair for pair in compare(load_flown(runs["one"]), load_flown(runs["two"])).metrics}
    assert told["rms_x"].values == pytest.approx((100 * a["rms_x"], 100 * b["rms_x"]))
    assert told["rms_x"].unit == "cm"
    assert told["rms_x"].difference == pytest.approx(100 * (b["rms_x"] - a["rms_x"]))


@pytest.mark.long
def test_metrics_of_unequal_flights_cover_the_common_time(runs: dict[str, Path]) -> None:
    long = load_flown(runs["one"])
    rows = long.log.num_rows - 30  # 0.3 s less
    short = FlownRun(
        long.log.slice(0, rows), replace(long.result, metrics=measure(long.log.slice(0, rows), lost=False))
    )
    for a, b in ((long, short), (short, long)):
        comparison = compare(a, b)
        assert all(pair.difference == 0 for pair in comparison.metrics)
        assert comparison.span.startswith("Over the first 0.19 s after the release, which both flew")
    assert compare(long, long).span == "Over the 0.49 s after the release that both flew."
    whole = {pair.name: pair.values[0] for pair in compare(long, long).metrics}
    assert whole["flown"] == pytest.approx(long.result.metrics["flown"]), "nothing is cut of equal flights"


def test_flights_are_compared_by_the_time_since_their_release(runs: dict[str, Path]) -> None:
    a, b = load_flown(runs["one"]), load_flown(runs["two"])
    assert compare(a, b).apart == (), "row by row"
    t = b.log.column_names.index("t")
    release_us = load_config().flight.release_us + 2_000_000
    metadata = {**b.log.schema.metadata, b"release_us": str(release_us).encode()}
    later = b.log.set_column(t, b.log.schema.field(t), pa.array(b.log.column("t").to_numpy() + 2_000_000))
    told = {
        one.name: one for one in compare(a, FlownRun(later.replace_schema_metadata(metadata), b.result)).apart
    }
    free = [free_flight(run.log) for run in (a, b)]
    miss = np.subtract(*(100 * position_error(log)[:, 1] for log in reversed(free)))
    assert (told["y"].unit, told["y"].largest) == ("cm", pytest.approx(np.abs(miss).max(), rel=1e-6))
    assert told["y"].rms == pytest.approx(np.sqrt((miss**2).mean()), rel=1e-6)


def test_the_difference_is_the_second_less_the_first_at_the_same_time(runs: dict[str, Path]) -> None:
    a, b = load_flown(runs["one"]), load_flown(runs["two"])
    plot = difference(a.log, b.log)
    assert plot is not None
    miss = 100 * np.subtract(*(position_error(free_flight(run.log)) for run in (b, a)))
    assert [line.values for line in plot.panels[0].series] == [pytest.approx(axis) for axis in miss.T]
    first = int(np.argmax(b.log.column("flight.free").to_numpy()))
    assert [difference(a.log, b.log.slice(0, rows)) is None for rows in (0, first + 1, first + 2)] == [
        True,
        True,
        False,
    ]


def test_the_exit_code_of_the_command_is_the_verdict(
    cli: Cli, runs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.pictures.compare.png", lambda draw: b"drawn")
    assert cli("compare", runs["one"], runs["again"], "--out", tmp_path) == 0
    assert "\nidentical\n" in cli.out
    assert cli("compare", runs["one"], runs["two"], "--out", tmp_path / "new") == 1
    assert cli.out.startswith("seed: 1 | 2\n")
    assert cli.out.endswith(f"\n  {tmp_path}/new/compare.html\n")
    assert (tmp_path / "new" / "compare.png").read_bytes() == b"drawn"
    page = (tmp_path / "new" / "compare.html").read_text(encoding="utf-8")
    told = Page(page)
    assert f"first differ in row {compare(*map(load_flown, (runs['one'], runs['two']))).first.row}" in page  # type: ignore[union-attr]
    assert f"Blue: {runs['one']}; orange: {runs['two']}." in page
    assert {line["colour"] for line in told.plots["both"]["panels"][0]["series"]} == {DARK, ORANGE}
    assert len(told.plots["both"]["panels"]) == 10
    assert len(told.plots["difference"]["panels"]) == 3
    assert ["seed", "1", "2"] in told.tables["settings"]
    assert page.index('id="settings"') < page.index('id="differing"') < page.index('id="both"')
    assert all(float(row[3]) != 0 for row in told.tables["differing"][1:])
    assert all(float(row[3]) == 0 for row in told.tables["equal"][1:])
    flaps = load_log(runs["one"])
    rotors = flaps.rename_columns(
        [name.replace("truth.flap_", "rotor.thrust_") for name in flaps.column_names]
    )
    shown = [[name for name, _ in shown_curves(*logs)] for logs in ((flaps, rotors), (rotors, flaps))]
    assert shown == [["position", "attitude"]] * 2, "a robot of flaps beside one of rotors"


def test_flights_with_other_columns_differ_and_the_flight_without_them_is_named(
    runs: dict[str, Path],
) -> None:
    whole, names = load_flown(runs["one"]), ("imu.gx", "imu.gy")
    less = replace(whole, log=whole.log.drop_columns(list(names)))
    for a, b, missing in ((whole, less, ((), names)), (less, whole, (names, ()))):
        comparison = compare(a, b)
        assert (comparison.missing, comparison.first, comparison.identical) == (missing, None, False)


@pytest.mark.parametrize("damage", ["missing", "empty", "no parquet", "no flight", "no json"])
def test_a_bad_folder_is_one_line(cli: Cli, runs: dict[str, Path], tmp_path: Path, damage: str) -> None:
    bad = tmp_path / "bad"
    if damage == "empty":
        bad.mkdir()
    elif damage != "missing":
        shutil.copytree(runs["one"], bad)
    if damage == "no parquet":
        (bad / "log.parquet").write_bytes(b"PAR1 and then nothing")
    elif damage == "no flight":
        pq.write_table(load_log(bad).select(["t", "truth.x"]), bad / "log.parquet")
    elif damage == "no json":
        (bad / "result.json").write_text("{")
    assert "bad" in cli.refusal("compare", runs["one"], bad, "--out", tmp_path / "out")


@pytest.mark.parametrize(("place", "flown_s"), [("cameras.x", 1.0), ("truth.x", 2.0)])
def test_a_real_flight_was_flown_as_long_as_it_was_judged_and_any_other_to_its_last_row(
    place: str, flown_s: float
) -> None:
    times = [1_000_000 * second for second in range(4)]
    log = pa.table(
        {"t": times, "flight.free": [0, 1, 1, 0], place: [0.0] * 4}, metadata={RELEASE_US: b"1000000"}
    )
    whole, empty = Made(log=log), Made(log=log.slice(0, 0))
    assert (_flown_s(whole), _flown_s(empty)) == (flown_s, 0.0)  # type: ignore[arg-type]
