"""A campaign of planted flights: the same dataset for any order, nothing lost or repeated, and what is found in it."""

import errno
import gc
import io
import itertools
import json
import os
import random
import re
import signal
import tempfile
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from PIL import Image
from rich.console import Console
from scipy.stats import binomtest

from hil.errors import LabError
from hil.laboratory.metrics import METRICS
from hil.laboratory.request import Options
from hil.research.campaigns import jobs
from hil.research.campaigns.config import Spec
from hil.research.campaigns.dataset import ARRIVING, FLIGHTS, Dataset, schema_of
from hil.research.campaigns.findings import Findings, find
from hil.research.campaigns.jobs import Job, Row, fly_job
from hil.research.campaigns.report import write_report
from hil.research.campaigns.run import Flyer, InterimResult, Rate, Runner, conduct, interval
from hil.research.campaigns.sampling import draw, plan_of
from support.browser import BROWSER, browser
from support.campaigns import BAD_PUSH, planted, spec_of
from support.full_disk import small_files
from support.html_page import Page


def nothing(interim: InterimResult) -> None:
    """Show nothing."""


def flown_into(folder: Path, spec: Spec, flyer: Flyer, resume: bool = False) -> InterimResult:
    return conduct(Dataset(folder, plan_of(spec), resume, replace=resume), flyer, nothing)


def workers(count: int, asked: list[int] | None = None) -> Flyer:
    """`count` workers, whose flights come in an order of their own."""
    rng = random.Random(count)

    def fly(jobs: Iterator[Job]) -> Iterator[Row]:
        under_way: list[Job] = []
        while under_way := under_way + list(itertools.islice(jobs, count - len(under_way))):
            job = under_way.pop(rng.randrange(len(under_way)))
            if asked is not None:
                asked.append(job.index)
            yield planted(job)

    return fly  # type: ignore[return-value]


def bytes_of(folder: Path) -> bytes:
    assert not (folder / ARRIVING).exists()
    return (folder / FLIGHTS).read_bytes()


@pytest.mark.parametrize("stop", ["", "failure rate known to ±10 %"])
def test_the_dataset_is_the_same_for_any_number_of_workers(tmp_path: Path, stop: str) -> None:
    spec = spec_of(flights=200, stop=stop)
    standings = [flown_into(tmp_path / str(n), spec, workers(n)) for n in (1, 2, 17)]
    assert len({bytes_of(tmp_path / str(n)) for n in (1, 2, 17)}) == 1
    assert len(set(standings)) == 1
    assert standings[0].complete
    assert (standings[0].flown < 200) == bool(stop)


@pytest.mark.long
def test_a_row_describes_its_flight_and_columns_have_units(tmp_path: Path) -> None:
    spec = spec_of()
    flown_into(tmp_path / "out", spec, workers(1))
    table = pq.read_table(tmp_path / "out" / FLIGHTS)
    row = table.to_pylist()[7]
    expected = planted(draw(spec, 7))
    assert (row["index"], row["seed"], row["hash"]) == (7, 8, expected.hash)
    assert row["parameter.actuators.tau"] == expected.job.values["actuators.tau"]
    assert tuple(row["faults"]) == expected.job.options["faults"]
    assert row["metric.max_y"] == expected.metrics["max_y"]
    assert row["holds.in_box"] is expected.holds["in_box"]
    assert table.schema.field("metric.max_y").metadata == {b"unit": b"m"}


@pytest.mark.long
def test_every_metric_and_limit_of_every_flight_has_a_column() -> None:
    spec = spec_of(experiments=["hover", "y-square"], profiles=["floaty", "as-flown"], faults=[])
    plan = plan_of(spec)
    columns = set(schema_of(plan).names)
    requests = [plan.job(index).request() for index in range(plan.flights)]
    assert len({(one.experiment.name, one.profile) for one in requests}) == 4
    metrics = {f"metric.{name}" for one in requests for name in {**METRICS, **one.experiment.metrics}}
    assert {name for name in columns if name.startswith("metric.")} == metrics
    assert {f"holds.{name}" for one in requests for name in one.limits} <= columns


@pytest.mark.long
def test_a_campaign_that_was_interrupted_flies_the_rest_and_nothing_twice(tmp_path: Path) -> None:
    spec = spec_of()
    asked: list[int] = []
    whole = workers(3, asked)
    first = flown_into(tmp_path / "out", spec, limited(whole, 11))
    assert (first.flown, first.complete) == (11, False)
    then = flown_into(tmp_path / "out", spec, whole, resume=True)
    assert then.complete
    assert sorted(asked) == list(range(40))
    flown_into(tmp_path / "straight", spec, workers(1))
    assert bytes_of(tmp_path / "out") == bytes_of(tmp_path / "straight")


@pytest.mark.parametrize("stops", [[], [signal.SIGINT]])
def test_an_interrupted_runner_has_no_rows_to_go_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stops: list[int]
) -> None:
    runner = Runner(Console())
    monkeypatch.setattr(
        runner, "fly", lambda name, jobs, out: runner._stops.extend(stops) or [*map(planted, jobs)]
    )
    flown = runner.log("x", {"a": ("hover", Options(seed=3, faults=()))}, tmp_path)
    assert [(row.seed, row.folder) for row in flown] == ([] if stops else [(3, tmp_path / "a")])


def limited(flyer: Flyer, count: int) -> Flyer:
    """Workers that are interrupted after `count` flights."""

    def fly(jobs: Iterator[Job]) -> Iterator[Row]:
        yield from itertools.islice(flyer(jobs), count)

    return fly  # type: ignore[return-value]


def flown_and_killed(folder: Path, when: str) -> None:
    """Fly eleven flights, and die in the middle of a line, or between the file and the end of the lines that became it."""
    rows = Dataset(folder, plan_of(spec_of()), resume=False)
    unlink = Path.unlink

    def die_once_packed(path: Path, missing_ok: bool = False) -> None:
        if path.name == ARRIVING:
            os.kill(os.getpid(), signal.SIGKILL)
        unlink(path, missing_ok)

    Path.unlink = die_once_packed  # type: ignore[method-assign, assignment]
    for index in range(11):
        rows.add(planted(draw(spec_of(), index)))
    if when == "packing":
        rows.close()
    with (folder / ARRIVING).open("a") as file:
        file.write('{"index": 11, "exper')
        file.flush()
        os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.long
@pytest.mark.parametrize("when", ["writing", "packing"])
def test_kill_9_loses_no_row_that_was_there_and_repeats_none(tmp_path: Path, when: str) -> None:
    child = os.fork()
    if child == 0:
        try:
            flown_and_killed(tmp_path / "out", when)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
    assert (tmp_path / "out" / ARRIVING).is_file()
    asked: list[int] = []
    assert flown_into(tmp_path / "out", spec_of(), workers(2, asked), resume=True).complete
    assert sorted(asked) == list(range(11, 40))
    flown_into(tmp_path / "straight", spec_of(), workers(1))
    assert bytes_of(tmp_path / "out") == bytes_of(tmp_path / "straight")


@pytest.mark.long
@pytest.mark.parametrize("limit", [30_000, 4_000])
def test_a_full_disk_is_one_line_and_what_is_there_is_kept(tmp_path: Path, limit: int) -> None:
    """4 kB do not even take the file that the first lines become."""
    spec = spec_of(flights=100)
    asked: list[int] = []
    with small_files(limit), pytest.raises(LabError, match="cannot be written") as refused:
        flown_into(tmp_path / "out", spec, workers(1, asked))
    assert "\n" not in str(refused.value)
    there = len(asked) - 1
    assert 1 <= there < 99
    assert flown_into(tmp_path / "out", spec, workers(1, asked), resume=True).complete
    assert asked == [*range(there + 1), *range(there, 100)], (
        "only the flight that found no room is flown again"
    )


@pytest.mark.long
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_full_disk_for_a_flight_s_files_ends_the_campaign_without_a_row() -> None:
    with small_files(10_000), pytest.raises(LabError, match=r"flight 0: .*File too large"):
        fly_job(draw(spec_of(flights=1), 0))
    gc.collect()  # the telemetry log that found no room


@pytest.mark.long
@pytest.mark.parametrize(("changed", "what"), [("robot.py", "profiles"), ("cf2.elf", "image")])
def test_a_campaign_resumes_only_with_its_original_files(changed: str, what: str, tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text('base = "floaty"\n[robot]\nbody = "robot.py"\n')
    for name in ("robot.py", "cf2.elf"):
        (tmp_path / name).write_text("x = 1\n")
    spec = spec_of(profiles=[str(tmp_path / "own.toml")], board=str(tmp_path / "cf2.elf"))
    Dataset(tmp_path / "out", plan_of(spec), resume=False).close()
    Dataset(tmp_path / "out", plan_of(spec), resume=True).close()
    (tmp_path / changed).write_text("x = 2\n")
    with pytest.raises(LabError, match=rf"--resume: {what}.* was .* and is .*: choose another --out"):
        Dataset(tmp_path / "out", plan_of(spec), resume=True)


def test_a_folder_is_not_mistaken_for_another_campaign(tmp_path: Path) -> None:
    spec = spec_of()
    flown_into(tmp_path / "out", spec, limited(workers(1), 3))
    with pytest.raises(LabError, match="holds a campaign; --resume continues it"):
        flown_into(tmp_path / "out", spec, workers(1))
    with pytest.raises(LabError, match=r"--resume: spec\.seed was 1 and is 9: choose another --out"):
        flown_into(tmp_path / "out", spec_of(seed=9), workers(1), resume=True)
    path = tmp_path / "out" / "campaign.json"
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"versions": content["versions"] | {"gone": "1.0"}}))
    with pytest.raises(LabError, match=r"--resume: versions\.gone was '1.0' and is None"):
        flown_into(tmp_path / "out", spec, workers(1), resume=True)
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "campaign.json.partial").write_text("{")  # of a process that was killed
    assert flown_into(tmp_path / "begun", spec, workers(1)).complete
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine.txt").touch()
    with pytest.raises(LabError, match="not empty and holds no campaign"):
        flown_into(tmp_path / "other", spec, workers(1))
    with pytest.raises(LabError, match="cannot be written"):
        flown_into(Path("/proc/floaty"), spec, workers(1))


@pytest.mark.long
def test_flying_stops_at_the_first_flight_by_which_the_rate_is_known_well_enough(tmp_path: Path) -> None:
    spec = spec_of(flights=2000, stop="failure rate known to ±6 %")
    interim = flown_into(tmp_path / "out", spec, workers(3))
    table = pq.read_table(tmp_path / "out" / FLIGHTS)
    failed = [not one for one in table["passed"].to_pylist()]
    assert table["index"].to_pylist() == list(range(interim.flown))

    def half(n: int) -> float:
        low, high = binomtest(sum(failed[:n]), n).proportion_ci(0.95, "wilson")
        return float(high - low) / 2.0

    assert half(interim.flown) <= 0.06 < half(interim.flown - 1)
    assert interim.failed == sum(failed)


def test_the_interval_is_wilson_s() -> None:
    assert interval(0.0, 0) == (0.0, 1.0)
    low, high = interval(0.1, 10)
    assert (low, high) == pytest.approx((0.01787621, 0.40415005), abs=1e-6)  # statsmodels, proportion_confint


@pytest.mark.long
def test_the_planted_effect_is_found(tmp_path: Path) -> None:
    spec = spec_of(flights=128, sampling="sobol", table={"constants": ["roll_u1"]})
    flown_into(tmp_path, spec, workers(2))
    found = find(spec, Dataset(tmp_path, plan_of(spec), resume=True).table())
    expected = [not planted(draw(spec, n)).passed for n in range(128)]
    assert (found.rate.failed, found.rate.flown) == (sum(expected), 128)
    mapped, *others = found.influences
    assert mapped.method == "logistic map"
    strongest = {name for name, _ in mapped.ranked[:2]}
    assert strongest == {"fault 1 push.y size", "fault 1 push.y happens"}
    assert dict(mapped.ranked)["fault 1 push.y size"] > 2.0
    assert dict(mapped.ranked)["fault 1 push.y happens"] > 2.0
    pawn = next(one for one in others if one.figure == "failing")
    assert pawn.method == "PAWN"
    assert pawn.chance is not None
    assert pawn.by_axis.keys() > dict(pawn.ranked).keys()
    assert all("push.y" in name for name, _ in pawn.ranked), "what is below chance is not listed"
    assert all(float(one.command.split("push.y@0.1=")[1]) >= BAD_PUSH for one in found.worst)
    assert all(one.command.startswith("floaty fly hover --seed ") for one in found.worst)


@pytest.fixture(scope="module")
def reported(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Findings]:
    """The report of a campaign, and what it found."""
    folder, spec = tmp_path_factory.mktemp("campaign"), spec_of(flights=128, sampling="sobol")
    dataset = Dataset(folder, plan_of(spec), resume=False)
    for number in range(128):
        dataset.add(planted(draw(spec, number)))
    dataset.close(128)
    return write_report("my spec.toml", spec, dataset, complete=True)


def test_the_report_has_rates_influences_commands_and_pictures(reported: tuple[Path, Findings]) -> None:
    path, found = reported
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert [len(page.tables[name]) for name in ("limits", "worst")] == [1 + len(found.limits), 1 + 10]
    assert len(page.tables["influences"]) == 1 + len(found.influences) > 2
    assert "floaty campaign &#39;my spec.toml&#39; --shrink FLIGHT" in text
    assert [picture[:4] for picture in page.pictures] == [b"\x89PNG"] * 2
    told = json.loads((path.parent / "result.json").read_text())
    flown = [draw(spec_of(flights=128, sampling="sobol"), n) for n in range(128)]
    pushes = {
        n: float(str(one.options["faults"][0]).partition("=")[2])
        for n, one in enumerate(flown)
        if one.options["faults"]
    }
    failed = [n for n, push in pushes.items() if push >= BAD_PUSH]
    counts = {"failed": len(failed), "flown": 128, "interval_95": [*found.rate.interval]}
    assert {name: told[name] for name in ("complete", "errors", *counts)} == {
        "complete": True,
        "errors": [],
        **counts,
    }
    none = {"failed": 0, "flown": 128, "interval_95": [*Rate(0, 128).interval]}
    where = {"experiment": "hover", "profile": "floaty"}
    assert told["cells"] == [{**where, "loss_allowed": False, **counts, "lost": none}]
    for one, row, shown in zip(found.limits, told["limits"], page.tables["limits"][1:], strict=True):
        wrong = counts if one.name == "in_box" else {"failed": 0, "flown": 0, "interval_95": [0.0, 1.0]}
        assert row == {**where, "metric": one.name, "bound": one.bound, **wrong}
        upper = one.metric.bound == "max"
        levels = [one.metric.show(np.quantile(one.values, q if upper else 1.0 - q)) for q in (0.5, 0.95, 1.0)]
        limit = f"{one.name} {'≤' if upper else '≥'} {one.metric.show(one.bound)}"
        assert shown == ["hover, floaty", limit, str(one.rate), *levels]
    assert page.tables["cells"][1:] == [["hover", "floaty", str(found.rate), str(Rate(0, 128))]]
    assert [row["index"] for row in told["worst"]] == sorted(failed, key=lambda n: -pushes[n])[:10]
    for one, row in zip(found.influences, told["influences"], strict=True):
        assert row == {"figure": one.figure, "method": one.method, "chance": one.chance, "by_axis": dict(one.by_axis),
            "half_interval_95": {}}  # fmt: skip


@pytest.mark.long
def test_a_cell_of_the_failure_map_leads_to_its_flights(reported: tuple[Path, Findings]) -> None:
    path, found = reported
    text = path.read_text(encoding="utf-8")
    cells = re.findall(
        r'href="#(cell-\d+)" title="([^"]*): (\d+) of (\d+) failed" '
        r'style="left: ([\d.]+)%; bottom: ([\d.]+)%; width: ([\d.]+)%; height: ([\d.]+)%"',
        text,
    )
    assert sum(int(cell[3]) for cell in cells) == 64, "half of the flights get a push"
    assert sum(int(cell[2]) for cell in cells) == found.rate.failed
    shares = [int(cell[2]) / int(cell[3]) for cell in cells]
    assert shares == sorted(shares, reverse=True)
    with Image.open(io.BytesIO(Page(text).pictures[1])) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    height, width, _ = pixels.shape
    for name, _, failed, _, *place in cells:
        left, bottom, wide, high = (float(share) / 100 for share in place)
        part = pixels[
            round(height * (1 - bottom - high)) : round(height * (1 - bottom)),
            round(width * left) : round(width * (left + wide)),
        ]
        if int(failed):
            assert (np.abs(part - (0xD5, 0x5E, 0x00)).max(axis=2) < 8).any(), (
                "a point of a flight that failed"
            )
        rows = text.split(f'<tbody id="{name}">')[1].split("</tbody>")[0]
        number, out, report = re.findall(r"<td>(\d+)|--out (\S+)</code>|<a href=\"([^\"]+)\"", rows)[:3]
        assert out[1] == f"{path.parent}/flight-{number[0]}"
        assert report[2] == f"flight-{number[0]}/report.html"


@pytest.mark.long
@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")
def test_the_report_fits_a_phone_and_its_cells_link(reported: tuple[Path, Findings], tmp_path: Path) -> None:
    with browser(tmp_path) as tab:
        for width in (390, 1180):
            tab.open(reported[0].as_uri(), width)
            assert tab.value("document.documentElement.scrollWidth") <= width
            tab.value("[...document.querySelectorAll('.map a')].at(-1).click()")
            assert tab.value("document.querySelector('tbody:target tr') !== null")
        assert tab.errors == []


@pytest.mark.long
def test_a_report_of_nothing_and_of_nothing_that_failed_can_be_written(tmp_path: Path) -> None:
    spec = spec_of(faults=[])
    dataset = Dataset(tmp_path, plan_of(spec), resume=False)
    assert "not complete" in write_report("spec.toml", spec, dataset, complete=False)[0].read_text()
    flown_into(tmp_path, spec, workers(1), resume=True)
    text = write_report("spec.toml", spec, dataset, complete=True)[0].read_text()
    assert "No flight failed a limit." in text


@pytest.mark.long
@pytest.mark.parametrize(
    ("sampling", "flights", "method"), [("saltelli", 640, "total Sobol index"), ("morris", 80, "Morris' mu*")]
)
def test_a_design_has_its_own_indices(tmp_path: Path, sampling: str, flights: int, method: str) -> None:
    spec = spec_of(sampling=sampling, flights=flights)
    flown_into(tmp_path, spec, workers(2))
    table = Dataset(tmp_path, plan_of(spec), resume=True).table()
    (failing,) = (
        one for one in find(spec, table).influences if (one.figure, one.method) == ("failing", method)
    )
    assert failing.by_axis["actuators.tau"] == pytest.approx(0.0, abs=1e-9)
    assert failing.by_axis["fault 1 push.y size"] > 0.1
    assert method not in {one.method for one in find(spec, table.slice(1)).influences}, "one point is missing"


def test_flights_without_an_end_are_distinct_failures(tmp_path: Path) -> None:
    spec = spec_of(flights=3, settings=["limits.hover.unsee=1"])
    rows = Dataset(tmp_path, plan_of(spec), False)
    for index in range(3):
        rows.add(fly_job(draw(spec, index)))
    rows.close(3)
    found = find(spec_of(flights=3), rows.table())
    assert (found.rate.failed, found.worst) == (3, ())
    assert found.errors == ("3×, first flight 0: limit on 'unsee': no such metric; did you mean unseen?",)


@pytest.mark.parametrize(
    ("limit", "value", "ended"),
    [
        ("simulated_s", 1.26, False),
        ("simulated_s", 1.28, True),
        ("wall_s", 2.4, False),
        ("wall_s", 2.6, True),
    ],
)
def test_a_flight_beyond_its_time_limit_is_a_row_that_names_it(
    limit: str, value: float, ended: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is asked shortly after 0.02, 0.27, 0.52 ... 1.27 s, and a clock of the wall shows half a second more each time."""
    clock = SimpleNamespace(monotonic=(0.5 * number for number in count(1000)).__next__)
    monkeypatch.setattr("hil.research.campaigns.jobs.time", clock)
    row = fly_job(draw(spec_of(limits={limit: value}), 0))
    if ended:
        assert (row.outcome, row.error) == ("completed", "")
        return
    assert (row.outcome, row.passed, row.hash) == ("error", False, "")
    assert row.error == f"TooLongError: limits.{limit} = {value:g}: the flight had not ended"


@pytest.mark.parametrize(
    ("error", "limited", "row"),
    [
        (LabError("no such body"), True, "no such body"), (LabError("no such body"), False, None),
        (OSError(errno.ENOSPC, "No space left"), True, None), (OSError(errno.EDQUOT, "Quota exceeded"), False, None),
        (OSError(errno.EACCES, "denied"), False, r"test_campaigns\.py:\d+: PermissionError: \[Errno 13\] denied"),
        (ZeroDivisionError("odd"), False, r"test_campaigns\.py:\d+: ZeroDivisionError: odd"),
    ],
)  # fmt: skip
def test_a_flight_s_error_is_its_row_but_for_a_user_s_in_a_plan_without_limits_and_a_full_disk(
    monkeypatch: pytest.MonkeyPatch, error: Exception, limited: bool, row: str | None
) -> None:
    def flown(job: Job, request: Any) -> None:
        raise error

    monkeypatch.setattr(jobs, "_flown", flown)
    job = draw(spec_of(), 7)
    if not limited:
        job = replace(job, limits=None)
    if row is not None:
        found = fly_job(job)
        assert (found.outcome, found.passed, found.hash) == ("error", False, "")
        assert re.fullmatch(row, found.error)
        return
    full = rf"^flight 7: {tempfile.gettempdir()}: " if isinstance(error, OSError) else "^no such body$"
    with pytest.raises(LabError, match=full):
        fly_job(job)
    monkeypatch.setattr(jobs, "find_again", lambda name, source: None)
    with pytest.raises(LabError, match=r"^experiment hover: its file has changed since the first flight$"):
        fly_job(job)


@pytest.mark.parametrize("files", [None, ("a.json", "c.csv")])
def test_of_a_flight_s_files_those_that_are_asked_for_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: tuple[str, ...] | None
) -> None:
    asked: list[object] = []

    def fly(request: object, folder: Path) -> str:
        folder.mkdir()
        for name in ("a.json", "b.parquet", "c.csv"):
            (folder / name).touch()
        return "result"

    monkeypatch.setattr(jobs, "fly", fly)
    monkeypatch.setattr(jobs, "reserved", lambda *what, replace: asked.append(replace) or nullcontext())
    job = Job(0, "hover", Options(), {}, tmp_path / "x", files)
    assert jobs._flown(job, "request") == "result"  # type: ignore[arg-type, comparison-overlap]
    assert sorted(path.name for path in job.folder.iterdir()) == sorted(
        files or ("a.json", "b.parquet", "c.csv")
    )  # type: ignore[union-attr]
    assert asked == [files is not None]
