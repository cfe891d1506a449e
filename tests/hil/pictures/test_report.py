"""The report: one self-contained page with every metric, for every outcome of a flight."""

import dataclasses
import functools
import hashlib
import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import hil.pictures.figures
import hil.pictures.report
from firmware_py.wire.supervisor import State
from ground_station.latency import STAGES
from ground_station.telemetry_log import TELEMETRY
from hil.config import load_config
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files import ages
from hil.laboratory.files.recorder import load_log
from hil.laboratory.files.result import read_result, write_result
from hil.laboratory.metrics import ALWAYS, METRICS, judge
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.laboratory.schedule import load_schedule
from hil.pictures import curves
from hil.pictures.figures import PICTURES, goal_moves, latency_budget
from hil.pictures.links import link_to
from hil.pictures.pages import PageFigure, embedded, library, thinned, zoomable
from hil.pictures.panels import Interval, Marks, Panel, Plot, Series
from hil.pictures.report import metric_rows, write_report
from hil.pictures.timeline import story_of
from support.html_page import Page, lines_of


def report(folder: Path) -> Page:
    page = Page(write_report(folder).read_text(encoding="utf-8"))
    drawn = [
        picture for picture in hil.pictures.figures.PICTURES if picture.fits(load_log(folder).column_names)
    ]
    others = [table for table in (ages.reported_ages(folder), load_schedule(folder)) if table.num_rows]
    close_ups = [name for name in page.plots if name.startswith("close-up")]
    more = 1 + goal_moves(load_log(folder))  # the path, and the one against a goal that moves
    assert len(page.pictures) + len(page.plots) - len(close_ups) == len(drawn) + len(others) + more
    assert page.places == list(page.plots)
    assert all(picture.startswith((b"\x89PNG\r\n\x1a\n", b"<svg xmlns=")) for picture in page.pictures)
    assert len(page.links) == len(close_ups), "into the recording, and nowhere else"
    assert (folder / "report.html").stat().st_size < 1_000_000
    return page


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report") / "run"
    fly(Request.of(EXPERIMENTS["hover"], duration_s=2.0), folder)
    return folder


@pytest.fixture
def folder(flown: Path, tmp_path: Path) -> Path:
    """A copy that may be damaged."""
    return Path(shutil.copytree(flown, tmp_path / "run"))


@pytest.fixture
def few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """For pages whose figures are another test's subject."""
    monkeypatch.setattr(hil.pictures.figures, "PICTURES", PICTURES[:1])


def change_result(folder: Path, **changes: Any) -> None:
    content = json.loads((folder / "result.json").read_text()) | changes
    (folder / "result.json").write_text(json.dumps(content))


def keep_rows(folder: Path, count: int) -> None:
    pq.write_table(load_log(folder).slice(0, count), folder / "log.parquet")


@pytest.mark.long
def test_the_report_tells_every_metric_and_every_limit(folder: Path) -> None:
    result, rows = read_result(folder), report(folder).tables["metrics"][1:]
    assert {row[0] for row in rows} == {
        name for name, value in result.metrics.items() if not math.isnan(value)
    }
    assert {verdict.metric for verdict in result.verdicts} <= {row[0] for row in rows} <= set(METRICS)
    told = {row[0]: row for row in rows}
    for verdict in result.verdicts:
        name, value, _, limit, holds, _ = told[verdict.metric]
        scale = {**dict.fromkeys(("lost", *ALWAYS), 1), "attitude_max": math.degrees(1)}.get(name, 100)
        assert float(value) == pytest.approx(verdict.value * scale, rel=1e-3)
        assert float(limit[1:]) == pytest.approx(verdict.bound * scale, rel=1e-3)
        assert limit[0] == ("≤" if METRICS[name].bound == "max" else "≥")
        assert holds == ("holds" if verdict.holds else "fails")
    assert {row[0] for row in rows if row[3]} == {verdict.metric for verdict in result.verdicts}
    assert float(told["rms_x"][1]) == pytest.approx(100 * result.metrics["rms_x"], rel=1e-3)
    assert told["rms_x"][2] == "cm"


@pytest.mark.long
def test_the_latency_budget_adds_up_to_their_age_and_survives_a_cut_file(folder: Path) -> None:
    reported = ages.reported_ages(folder)
    stage = {name: reported.column(name).to_numpy() for name in STAGES}
    assert reported.num_rows > 100
    apart = stage["camera"] + stage["processing"] + stage["network"]
    assert apart == pytest.approx(stage["mocap"], abs=1e-3)
    (panel,) = latency_budget(reported).panels
    assert panel.stacked
    top = sum(line.values for line in panel.series)
    assert top == pytest.approx(apart + stage["station"] + stage["link"])
    file = folder / TELEMETRY
    file.write_bytes(file.read_bytes()[:-40])
    assert ages.reported_ages(folder).num_rows in (reported.num_rows, reported.num_rows - 1)
    for rest in (b"", b"board.t [ms],gr"):
        file.write_bytes(rest)
        assert ages.reported_ages(folder).num_rows == 0
    report(folder)


@pytest.mark.long
@pytest.mark.usefixtures("few_pictures")
def test_the_report_tells_where_the_age_of_the_poses_comes_from(folder: Path) -> None:
    stages = read_result(folder).ages
    rows = report(folder).tables["ages"][1:]
    assert [row[0] for row in rows] == [
        "pose on board", "camera", "processing", "network", "station", "radio",
    ]  # fmt: skip
    for row, stage in zip(rows, stages, strict=True):
        assert [float(text) for text in row[1:]] == pytest.approx(
            [1e-3 * stage.mean_us, 1e-3 * stage.p99_us], abs=0.006
        )


@pytest.mark.usefixtures("few_pictures")
def test_the_report_tells_where_the_flight_comes_from(folder: Path) -> None:
    change_result(folder, overrides=["tunnel.turbulence=T1"], commit="0123456789ab")
    result, page = read_result(folder), report(folder)
    run = {row[0]: row[1] for row in page.tables["run"]}
    assert run["seed"] == "1"
    assert run["hash"] == result.hash
    assert run["commit"] == "0123456789ab"
    assert run["profile"] == "floaty --set tunnel.turbulence=T1"
    for name, number in result.program.versions.items():
        assert f"{name} {number}" in run["versions"]
    assert "released" in [row[2] for row in page.tables["events"]]


@pytest.mark.long
@pytest.mark.usefixtures("few_pictures")
def test_a_failed_limit_comes_first_and_its_instant_is_shown_close_up(folder: Path) -> None:
    log = load_log(folder)
    place, z = log.column_names.index("truth.z"), log.column("truth.z").to_numpy().copy()
    z[150:] += 0.5  # 0.5 s after the release
    pq.write_table(log.set_column(place, log.schema.field(place), pa.array(z)), folder / "log.parquet")
    failed = {"value": 0.5, "bound": 0.1, "holds": False, "unit": "m", "sense": "max"}
    verdicts = [failed | {"metric": name} for name in ("max_z", "rise")]
    change_result(folder, passed=False, verdicts=verdicts)
    page = report(folder)
    first = page.tables["metrics"][1]
    assert first[:1] + first[2:5] == ["max_z", "cm", "≤ 10", "fails"]
    assert page.plots["close-up-1"]["window"] == pytest.approx([-1.5, 1.5], abs=2e-3)


@pytest.mark.long
@pytest.mark.parametrize("rows", [0, 1, 15])
def test_a_flight_that_never_began_has_a_report(folder: Path, rows: int) -> None:
    keep_rows(folder, rows)
    change_result(folder, metrics=dict.fromkeys(METRICS, None), verdicts=[], passed=False)
    told = report(folder).tables["metrics"][1:]
    assert told == []


@pytest.mark.usefixtures("few_pictures")
def test_a_killed_flight_has_a_report(folder: Path) -> None:
    (folder / "result.json").unlink()
    (folder / "events.jsonl").unlink()
    page = report(folder)
    assert page.tables["events"][1:] == []
    assert {"rms_x", "flown"} <= {row[0] for row in page.tables["metrics"][1:]}


@pytest.mark.long
@pytest.mark.usefixtures("few_pictures")
@pytest.mark.parametrize(("outcome", "lost"), [("lost", "why"), ("error", None), ("reset", None)])
def test_only_a_lost_robot_has_the_mark_of_a_loss(
    folder: Path, monkeypatch: pytest.MonkeyPatch, outcome: str, lost: str | None
) -> None:
    change_result(folder, outcome=outcome, cause="why")
    marked: list[str | None] = []
    marks = hil.pictures.report.marks_of_flight
    monkeypatch.setattr(
        hil.pictures.report, "marks_of_flight", lambda log, lost: marked.append(lost) or marks(log, lost)
    )
    write_report(folder)
    assert marked == [lost]


@pytest.mark.usefixtures("few_pictures")
def test_texts_of_a_flight_cannot_become_markup(folder: Path) -> None:
    text = "<script>alert(1)</script> & <b>"
    (folder / "events.jsonl").write_text(json.dumps({"t_us": 500_000, "source": "<i>", "text": text}) + "\n")
    change_result(folder, cause=text, profile=text, overrides=[text])
    assert report(folder).tables["events"][1] == ["-0.500", "<i>", text]


@pytest.mark.usefixtures("few_pictures")
def test_the_report_begins_with_what_was_asked_for_what_failed_and_what_happened(folder: Path) -> None:
    """Row 150 is 0.5 s after the release; there x leaves the box, failsafe lasts 0.1 s, a flap reaches its limit."""
    log, result = load_log(folder), read_result(folder)
    columns = {name: log.column(name).to_numpy().copy() for name in log.column_names}
    columns["truth.x"][150:] = 0.2
    columns["supervisor.state"][160:170] = State.FAILSAFE
    columns["control.flap_2"][155] = -load_config().allocation.opening_max
    faults = ("push.y@0.3=2", "servo.slow.2@1=0.5")
    metadata = {**log.schema.metadata, b"request": json.dumps({"faults": faults}).encode()}
    changed = pa.table(columns, schema=log.schema.with_metadata(metadata))
    pq.write_table(changed, folder / "log.parquet")
    verdicts = judge({"in_box": 0.2, "lost": 1.0}, {"in_box": 0.99, "lost": 0.0}, {})
    request = dataclasses.replace(result.request, overrides=("a.b=c",), faults=("push.y@0.3=2",))
    lost = dataclasses.replace(
        result, outcome="lost", cause="fell", verdicts=tuple(verdicts), request=request
    )
    write_result(lost)
    page = write_report(folder).read_text(encoding="utf-8")
    story = page[page.index('<dl id="story">') : page.index("</dl>")]
    assert page.index('<dl id="story">') < page.index('<table id="metrics">')
    assert "--set a.b=c" in story
    assert "--fault push.y@0.3=2" in story
    assert "--board" not in story  # it was the laboratory's own
    failures = page[page.index('<ul id="failures">') : page.index('<dl id="story">')]
    assert failures.count(">fails<") == 1
    assert "(limit &lt;= 0): beyond it from" in failures
    assert "1.99 s</span> on, 0.99 s after the begin of servo.slow.2@1=0.5" in failures
    assert 'href="#close-up-2"' in failures
    assert "The robot was lost, and so no limit holds." in failures
    failsafe_us = int(log.column("t")[160].as_py())
    events = [{"t_us": failsafe_us, "source": "board", "text": "supervisor: failsafe, silence"}]
    told = [(moment.t_s, moment.text) for moment in story_of(changed, lost, events)]
    assert [(pytest.approx(t_s, abs=2e-3), text) for t_s, text in told] == [
        (0.0, "released"),
        (0.3, "fault push.y@0.3=2 begins"),
        (0.4, "fault push.y@0.3=2 ends"),
        (0.5, "first limit passed: in_box"),
        (0.5, "farthest from the goal: 20.0 cm (x)"),
        (0.55, "flap 2 saturates for the first time"),
        (0.6, "failsafe begins: silence, the board has fused no pose for too long"),
        (0.7, "failsafe ends"),
        (1.0, "fault servo.slow.2@1=0.5 begins"),
        (1.99, "lost: fell"),
    ]
    assert all(text.partition(": silence")[0] in story for _, text in told), (
        "the events of the page have no cause"
    )


def test_faults_failsafe_flap_limits_and_loss_are_marked_and_shown_close_up(folder: Path) -> None:
    """Row 150 is 0.5 s after the release."""
    log, result = load_log(folder), read_result(folder)
    columns = {name: log.column(name).to_numpy().copy() for name in log.column_names}
    columns["supervisor.state"][160:170] = State.FAILSAFE
    columns["control.flap_2"][155:158] = -load_config().allocation.opening_max
    columns["control.flap_2"][159] = -load_config().allocation.opening_max
    faults = ("push.y@0.3=2", "push.x@0.3=1", "servo.slow.2@1=0.5")
    metadata = {**log.schema.metadata, b"request": json.dumps({"faults": faults}).encode()}
    pq.write_table(pa.table(columns, schema=log.schema.with_metadata(metadata)), folder / "log.parquet")
    asked = dataclasses.replace(result.request, faults=("push.y@0.3=2",))
    write_result(dataclasses.replace(result, outcome="lost", cause="fell", request=asked))
    page = Page(write_report(folder).read_text(encoding="utf-8"))
    (marks,) = page.marks
    assert {plot["marks"] for plot in page.plots.values()} == {0}
    times = [(one["kind"], one["text"], one["begin_s"], one["end_s"]) for one in marks["intervals"]]
    exact = functools.partial(pytest.approx, abs=2e-3)
    assert times == [
        ("held", "", exact(-1.0), exact(-0.01)),
        ("fault", "push.y@0.3=2", exact(0.3), exact(0.4)),
        ("fault", "push.x@0.3=1", exact(0.3), exact(0.4)),
        ("fault", "servo.slow.2@1=0.5", exact(1.0), exact(1.99)),
        ("failsafe", "", exact(0.6), exact(0.7)),
        ("limit", "flap 2", exact(0.55), exact(0.6)),
    ]
    assert marks["instants"] == [{"kind": "lost", "t_s": exact(1.99), "text": "fell"}]
    windows = {name: plot["window"] for name, plot in page.plots.items() if plot["alone"]}
    assert windows == {
        "close-up-1": [exact(-0.2), exact(1.4)],
        "close-up-2": [exact(0.5), exact(2.99)],
        "scheduler": [exact(0.0), exact(0.02)],
    }
    flown = read_result(folder)
    assert page.links == [link_to(flown, at_s) for at_s in (0.3, 1.0)]
    assert page.links[0].endswith(f":9877/{flown.hash[:16]}/0.30")
    position = lines_of(page.plots["close-up-1"]["panels"][0])
    assert position["y"][0][[0, -1]] == pytest.approx([-0.2, 1.4], abs=0.01)
    shown = page.plots["errors"]["panels"][0]
    assert shown["limits"] == [-6.0, 6.0]
    assert lines_of(shown)["y"][1] == pytest.approx(curves.POSITION.read(log)[:, 1], abs=1e-4)


def test_a_thinned_curve_keeps_every_lowest_and_highest_value_and_its_gaps() -> None:
    wild = np.random.default_rng(1).normal(size=(50_000, 2))
    wild[20_000, 0], wild[30_001, 1], wild[40_000:40_100, 0] = 99.0, -99.0, np.nan
    rows = thinned([wild[:, 0], wild[:, 1]], 100)
    assert len(rows) < 1000
    assert {0, 20_000, 30_001, 40_000, 49_999} <= set(rows.tolist())
    kept = wild[rows]
    for stretch in range(100):
        all_of = wild[500 * stretch : 500 * stretch + 500]
        some = kept[(rows >= 500 * stretch) & (rows < 500 * stretch + 500)]
        assert np.array_equal(np.nanmax(some, axis=0), np.nanmax(all_of, axis=0))
        assert np.array_equal(np.nanmin(some, axis=0), np.nanmin(all_of, axis=0))
    few = np.zeros(300)
    assert thinned([few], 150).tolist() == list(range(300)), "nothing is lost of a short curve"
    assert thinned([few, few], 75).tolist() == list(range(300)), "nor of two"


def test_the_script_that_draws_is_uplot_as_npm_has_it() -> None:
    """SHA-256 of dist/uPlot.iife.min.js and dist/uPlot.min.css of uplot 1.6.31, from the package of npm."""
    hashes = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in library().items()}
    assert hashes == {
        "script": "2d27e8ad3d228164525ce213f9dc716f39b4e3aee0cc773fb3491c96cf4921a2",
        "style": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
    }


@pytest.mark.parametrize(("outcome", "marked"), [("lost", "it fell"), ("error", None), ("interrupted", None)])
def test_only_a_lost_flight_has_a_mark_of_its_cause(
    folder: Path, monkeypatch: pytest.MonkeyPatch, outcome: str, marked: str | None
) -> None:
    def mark(log: object, lost: str | None) -> None:
        raise LookupError(lost)

    change_result(folder, outcome=outcome, cause="it fell")
    monkeypatch.setattr("hil.pictures.report.marks_of_flight", mark)
    with pytest.raises(LookupError, match=f"^{marked}$"):
        write_report(folder)


def test_a_metric_without_a_value_is_a_dash_and_fails(folder: Path) -> None:
    verdict = {"metric": "rms_x", "value": None, "bound": 0.1, "holds": False, "unit": "m", "sense": "max"}
    change_result(folder, metrics={"rms_x": None}, verdicts=[verdict])
    rows = {row.name: row for row in metric_rows(read_result(folder))}
    assert (rows["rms_x"].value, rows["rms_x"].mark) == ("–", "FAILS")
    assert "rms_y" not in rows  # neither a value nor a limit


def test_only_a_figure_with_a_time_axis_of_its_own_has_a_window_and_equal_marks_are_embedded_once() -> None:
    marks, times = Marks((Interval("fault", 1.0, 2.0, "x"),)), np.array([0.0, 1.0])
    both = (
        Series("a", "red", times, times),
        Series("b", "blue", times, -times),
        Series("c", "red", times + 1.0, times),
    )
    plot = embedded(Plot((Panel("x [m]", both, least=0.5),), (0.25, 0.75)))
    figures = [PageFigure("one", "One", "", plot=plot, marks=marks), PageFigure("two", "", "", plot=plot, alone=True),
        PageFigure("still", "", "", source="data:"), PageFigure("three", "", "", plot=plot, marks=marks)]  # fmt: skip
    content = zoomable(figures)["content"]
    assert [(one["place"], one["alone"], one["window"], one["marks"]) for one in content["figures"]] == [
        ("one", False, None, 0), ("two", True, (0.25, 0.75), 1), ("three", False, None, 0)]  # fmt: skip
    assert content["marks"] == [dataclasses.asdict(one) for one in (marks, Marks())]
    (panel,) = content["figures"][0]["panels"]
    assert [len(table) for table in panel["tables"]] == [3, 2], "curves of the same instants share them"
    assert {name: shown[0].tolist() for name, shown in lines_of(panel).items()} == {
        "a": [0.0, 1.0], "b": [0.0, 1.0], "c": [1.0, 2.0]}  # fmt: skip
