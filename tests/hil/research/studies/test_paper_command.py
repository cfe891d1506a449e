"""`floaty paper`: every row is flown on both profiles, judged by the experiments' limits, and told in one report."""

import dataclasses
import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.metrics import METRICS
from hil.laboratory.request import Options
from hil.pictures.panels import Instant
from hil.research.campaigns.jobs import Job, Row, fly_job
from hil.research.studies.catalogue import PROFILES
from hil.research.studies.paper import Paper, Trials, fly_paper
from hil.research.studies.paper_report import _figures, _trials, write_paper
from hil.research.studies.paper_rows import OUTSIDE, ROWS, MetricClaim, PaperRow
from hil.research.studies.study import Curve, Expected, Study, StudyResult, Variant, VariantOutcome
from support.html_page import Page


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Row:
    folder = tmp_path_factory.mktemp("flown") / "hover-1"
    return fly_job(Job(0, "hover", Options(duration_s=0.3), {}, folder))


def content(folder: Path) -> dict[str, Any]:
    told: dict[str, Any] = json.loads((folder / "result.json").read_text())
    return told


def test_every_experiment_is_a_row_or_known_not_to_be_the_papers() -> None:
    assert set(EXPERIMENTS) == set(ROWS) | set(OUTSIDE)
    assert not set(ROWS) & set(OUTSIDE)


@pytest.mark.parametrize("name", ROWS)
def test_a_row_shows_existing_metrics_with_the_paper_s_source(name: str) -> None:
    assert set(ROWS[name].claims) <= set(METRICS)
    assert ROWS[name].claim
    assert ROWS[name].place


def test_the_report_has_the_papers_value_and_the_spread_of_each_profile_s_flights(
    result: Row, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.pictures.drawing.png", lambda draw: b"\x89PNG")
    deg = math.radians(1.0)
    spread = {"floaty": (1.0 * deg, 3.0 * deg), "as-flown": (4.0 * deg, 4.5 * deg)}

    def flight(name: str, size: float) -> Row:
        return dataclasses.replace(
            result, passed=True, hash=f"{name}{size}", metrics=result.metrics | {"attitude_max": size}
        )

    both = tuple(Trials(name, tuple(flight(name, size) for size in each)) for name, each in spread.items())
    page = Page(write_paper(tmp_path, Paper((("hover", ROWS["hover"], both),), (), False)).read_text("utf-8"))
    rows = {row[0]: row[1:] for row in page.tables["paper"]}
    found = ["2 ± 1.4 deg", "4.25 ± 0.35 deg"]
    assert rows[METRICS["attitude_max"].meaning] == [ROWS["hover"].claims["attitude_max"].text, *found]
    assert rows["limits held"][1:] == ["2 of 2", "2 of 2"]
    assert page.links == ["hover.html"] * 2, "in the contents and in the table"
    told = content(tmp_path)["rows"][0]["profiles"]
    for name, (low, high) in spread.items():
        metric = told[name]["metrics"]["attitude_max"]
        expected = {
            "mean": (low + high) / 2,
            "deviation": (high - low) / math.sqrt(2),
            "low": low,
            "high": high,
        }
        assert {key: metric[key] for key in expected} == {
            key: pytest.approx(value / deg) for key, value in expected.items()
        }
        assert (metric["unit"], metric["count"]) == ("deg", 2)
        assert [one["hash"] for one in told[name]["flights"]] == [f"{name}{one}" for one in (low, high)]
    figures = Page((tmp_path / "hover.html").read_text(encoding="utf-8"))
    assert {f"{name}-errors" for name in spread} <= figures.plots.keys()
    assert len(figures.pictures) == 2, "the tracks"
    assert all(plot["alone"] for plot in figures.plots.values())
    assert {plot["marks"] for plot in figures.plots.values()} == {0, 1}, "each profile's flight has its own"
    assert figures.links == ["report.html"]


def test_the_result_tells_of_each_flight_how_it_ended(result: Row) -> None:
    told = _trials(ROWS["hover"], trials(result, True, False))
    assert (told["holds"], list(told["missed"])) == (False, ["y_over_x"])
    assert [(one["passed"], one["failed"], one["cause"]) for one in told["flights"]] == [
        (True, [], None), (False, ["max_x"], None)]  # fmt: skip
    lost = Trials("floaty", (dataclasses.replace(result, outcome="lost", error="it fell"),))
    for trials_of, marked in ((lost, {"it fell"}), (trials(result, True), set())):
        ((_, figures),) = _figures(ROWS["hover"], (trials_of,))
        assert {instant.text for figure in figures for instant in figure.marks.instants} == marked
    (one,) = _trials(ROWS["hover"], lost)["flights"]
    assert (one["outcome"], one["cause"]) == ("lost", "it fell")
    assert (one["seed"], one["folder"]) == (result.seed, result.folder.name)


def trials(result: Row, *passed: bool) -> Trials:
    """Flights of which some failed a limit."""
    flights = (dataclasses.replace(result, passed=one, holds={"max_x": one}) for one in passed)
    return Trials("floaty", tuple(flights))


def test_every_seed_of_the_default_profile_must_hold(result: Row) -> None:
    row = ROWS["hover"]
    good, bad = trials(result, True, True), trials(result, True, False)
    assert Paper((("hover", row, (good, bad)),), (), False).holds, "the other profile shows what it shows"
    assert not Paper((("hover", row, (bad, good)),), (), False).holds
    assert not Paper((("hover", row, (good, good)),), (), True).holds, "interrupted"
    assert not Paper((("hover", row, (Trials("floaty", ()), good)),), (), False).holds, "nothing was flown"
    assert bad.failed == ["max_x 1×"]


@pytest.mark.parametrize("ended", [99, 3])
def test_each_flight_is_flown_once_for_all_rows_and_studies_that_need_it(tmp_path: Path, ended: int) -> None:
    """Two studies have the same flights; without the last flights each has the cells that are complete."""
    same = Variant("v", lambda size: Options(overrides=(f"tunnel.speed={10 + size:g}",)), Expected())
    study = Study("s", "q", "a", "", (0.0, 1.0), (same,), duration_s=8.0)
    asked: list[Job] = []

    def fly(name: str, jobs: list[Job], out: Path) -> list[Row]:
        asked.extend(jobs)
        return [Row(job, "completed", "", True, f"{n}", {"failsafe": 0.0, "rms_x": 0.1 * n, "rms_y": 0.0, "rms_z": 0.0}, {})
            for n, job in enumerate(jobs)][:ended]  # fmt: skip

    runner: Any = SimpleNamespace(fly=fly, interrupted=ended < 99)
    flown = fly_paper(["hover"], [study, dataclasses.replace(study, name="t")], 2, tmp_path, runner)
    texts = [job.text for job in asked]
    assert len(texts) == len(set(texts)) == 2 * len(PROFILES) + 4, "both studies share their flights"
    assert [job.folder.name for job in asked if job.folder] == [
        f"hover-{one}-{seed}" for one in PROFILES for seed in (1, 2)
    ]
    [(name, row, both)] = flown.rows
    assert (name, row, flown.interrupted) == ("hover", ROWS["hover"], ended < 99)
    hashes = [[one.hash for one in trials.results] for trials in both]
    assert hashes == ([["0", "1"], ["2", "3"]] if ended == 99 else [["0", "1"], ["2"]])
    cells = [
        [(cell.size, cell.errors) for curve in one.curves for cell in curve.cells] for one in flown.studies
    ]
    expected = [(0.0, pytest.approx((0.4, 0.5))), (1.0, pytest.approx((0.6, 0.7)))]
    assert cells == [expected, expected] if ended == 99 else cells == [[], []]


def test_the_badges_name_their_kind_of_verdict(
    result: Row, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.pictures.drawing.png", lambda draw: b"\x89PNG")
    good = trials(result, True, True)
    marks = (Instant("paper", 0.5, "paper: settled"),)
    row = PaperRow("t", "c", "p", {"rms_x": MetricClaim("0", 0.0)}, "why", marks=marks)
    study = StudyResult(
        Study("s", "q", "a", "", (0.0, 1.0), ()),
        (
            Curve(
                Variant("v", lambda size: Options(), Expected(holds_to=1.0)),
                (VariantOutcome(0.0, ("degrades",), (0.1,)),),
            ),
        ),
    )
    for paper, badges in (
        (
            Paper((("t", row, (good, good)),), (study,), False),
            ["limits of floaty: all hold", "the paper's values: 2 missed", "studies: 1 expectation failed"],
        ),
        (
            Paper((("t", PaperRow("t", "c", "p", {}), (trials(result, False),)),), (), True),
            ["interrupted", "limits of floaty: some fail", "the paper's values: none missed"],
        ),
    ):
        page = write_paper(tmp_path, paper).read_text(encoding="utf-8")
        (_, shown, _), *_ = paper.rows
        of_one = (tmp_path / "t.html").read_text(encoding="utf-8")
        assert ('"paper: settled"' in of_one) == bool(shown.marks)
        assert re.findall(r'class="verdict \w+">([^<]+)<', page) == badges
        assert (
            Page(page).links[: 1 + len(paper.studies)] == ["t.html", "studies.html"][: 1 + len(paper.studies)]
        )
    studies = Page((tmp_path / "studies.html").read_text(encoding="utf-8"))
    assert len(studies.pictures) == 1
    assert studies.links == ["report.html", "t.html"]
