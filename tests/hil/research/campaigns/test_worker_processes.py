"""Flights on worker processes, here and of a scheduler: the same rows as without them, whatever becomes of a worker."""

import multiprocessing
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import dask
import pytest
from distributed import LocalCluster
from rich.console import Console

from hil.errors import LabError
from hil.research.campaigns.config import Spec
from hil.research.campaigns.dataset import Dataset
from hil.research.campaigns.jobs import Row, fly_job
from hil.research.campaigns.run import InterimResult, Runner, conduct
from hil.research.campaigns.sampling import draw, plan_of
from hil.research.campaigns.workers import DIED, FlyOne, Workers
from support.campaigns import hanging, killing, planted, raising, spec_of
from support.command import Cli
from support.html_page import Page
from support.paths import ROOT

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("default")]


@pytest.fixture(scope="module")
def crew() -> Iterator[Workers]:
    workers = Workers(2)
    yield workers
    workers.close()


def cluster(workers: int, threads: int = 1) -> LocalCluster:
    return LocalCluster(workers, threads, dashboard_address=":0", silence_logs=50)


def rows_of(crew: Workers, spec: Spec, fly_one: FlyOne) -> dict[int, Row]:
    plan = plan_of(spec)
    rows = list(crew.fly(map(plan.job, range(spec.flights)), lambda: 0, fly_one))
    assert len({row.job.index for row in rows}) == len(rows), "none twice"
    return {row.job.index: row for row in rows}


def test_flights_are_the_same_as_in_this_process(crew: Workers) -> None:
    spec = spec_of(flights=4)
    rows = rows_of(crew, spec, fly_job)
    assert len({row.hash for row in rows.values()}) == 4
    for index in (0, 3):
        assert str(fly_job(draw(spec, index)).columns()) == str(rows[index].columns())


def test_a_flight_that_raises_is_a_row_with_its_error(crew: Workers) -> None:
    spec = spec_of(flights=8)
    rows = rows_of(crew, spec, raising)
    assert (rows[3].outcome, rows[3].error, rows[3].passed) == ("error", "ZeroDivisionError: planted", False)
    assert all(rows[n].hash == planted(draw(spec, n)).hash for n in range(8) if n != 3)


def test_a_flight_that_always_kills_its_worker_is_a_row_beside_others(crew: Workers, tmp_path: Path) -> None:
    spec = spec_of(flights=10, settings=[str(tmp_path / "once")])
    rows = rows_of(crew, spec, killing)
    assert sorted(rows) == list(range(10))
    assert [n for n, row in rows.items() if row.outcome == "error"] == [3]
    assert "the process that flew it died" in rows[3].error


def test_a_flight_that_never_ends_is_a_row_and_the_workers_go_on(crew: Workers) -> None:
    spec = spec_of(flights=6, limits={"wall_s": 1.0})
    rows = rows_of(crew, spec, hanging)
    assert sorted(rows) == list(range(6))
    assert [n for n, row in rows.items() if row.outcome == "error"] == [3]


def test_a_worker_killed_from_outside_costs_no_flight(crew: Workers) -> None:
    flights = crew.fly(map(plan_of(spec_of(flights=30)).job, range(30)), lambda: 0, planted)
    rows = [next(flights)]
    multiprocessing.active_children()[0].kill()
    rows += flights
    assert sorted(row.job.index for row in rows) == list(range(30))
    assert {row.outcome for row in rows} == {"completed"}


def test_an_interrupt_ends_it_with_what_is_there(crew: Workers) -> None:
    stops: list[int] = []
    rows = []
    for row in crew.fly(map(plan_of(spec_of(flights=500)).job, range(500)), lambda: len(stops), planted):
        rows.append(row)
        if len(rows) == 5:
            stops.append(signal.SIGINT)
    assert 5 <= len(rows) < 20


def test_workers_end_with_a_program_that_is_killed() -> None:
    code = (
        "import time\n"
        "from hil.research.campaigns.sampling import draw\n"
        "from hil.research.campaigns.workers import Workers\n"
        "from support.campaigns import planted, spec_of\n"
        "print(len(list(Workers(2).fly((draw(spec_of(), n) for n in range(4)), lambda: 0, planted))), flush=True)\n"
        "time.sleep(60)\n"
    )
    program = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT / "tests"
    )
    assert program.stdout is not None
    assert program.stdout.readline() == "4\n"
    program.kill()
    assert program.communicate(timeout=20.0)[0] == "", (
        "the workers, which have this output as well, have closed it"
    )


def test_a_cluster_that_is_there_flies_the_same_dataset(tmp_path: Path) -> None:
    spec = spec_of(flights=20)
    with cluster(1, 2) as there:
        crew = Workers(0, there.scheduler_address)
        flyer = partial(crew.fly, stopped=lambda: 0, fly_one=planted)
        dataset = Dataset(tmp_path / "cluster", plan_of(spec), False)
        conduct(dataset, flyer, _nothing)
        crew.close()
    assert dataset.table()["index"].to_pylist() == list(range(20))


def test_a_flight_that_kills_the_cluster_s_worker_each_time_is_a_row(tmp_path: Path) -> None:
    once = tmp_path / "once"
    once.touch()  # only the third flight kills: two of three workers, because Dask does not always replace one
    spec = spec_of(flights=6, settings=[str(once)])
    with (
        dask.config.set({"distributed.scheduler.allowed-failures": 0}),
        cluster(3) as there,
    ):
        crew = Workers(0, there.scheduler_address)
        rows = rows_of(crew, spec, killing)
        crew.close()
    assert sorted(rows) == list(range(6))
    assert {n: row.error for n, row in rows.items() if row.error} == {3: DIED}, (
        "none that was on the same worker"
    )


def test_a_cluster_that_loses_its_workers_or_itself_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    for loss in (lambda there: there.scale(0), lambda there: there.close()):
        with cluster(1) as there:
            crew = Workers(0, there.scheduler_address)
            flights = crew.fly(map(plan_of(spec_of(flights=500)).job, range(500)), lambda: 0, planted)
            next(flights)
            monkeypatch.setattr("hil.research.campaigns.workers.LOST_S", 1.0)
            loss(there)
            with pytest.raises(
                LabError, match=r"^--cluster tcp://127\.0\.0\.1:\d+: lost; --resume continues"
            ):
                list(flights)
            monkeypatch.undo()
            crew.close()


def _nothing(interim: InterimResult) -> None:
    """Show nothing."""


def test_a_cluster_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.research.campaigns.workers.CONNECT_S", 1.0)
    with pytest.raises(LabError, match=r"--cluster tcp://127\.0\.0\.1:9: no workers"):
        list(Runner(Console(), cluster="tcp://127.0.0.1:9")._flown(map(plan_of(spec_of()).job, range(1))))


def test_the_command_flies_and_resumes(cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tiny.toml").write_text(
        'experiments = ["hover"]\nprofiles = ["floaty", "as-flown"]\nduration_s = 0.3\nflights = 4\n'
        '[parameters]\n"actuators.tau" = { uniform = [0.04, 0.06] }\n'
    )
    assert cli("campaign", "tiny.toml", "--workers", "1") == 0
    out = Path("runs/campaign-tiny")
    assert {path.name for path in out.iterdir()} == {"campaign.json", "flights", "report.html", "result.json"}
    assert "of 4: " in cli.out
    for name in ("floaty", "as-flown"):
        assert f"  hover, {name}: 0 of 2" in cli.out
        assert f"  hover, {name}, within_6cm_x: 0 of 2" in cli.out
    page = Page((out / "report.html").read_text(encoding="utf-8"))
    assert [row[1] for row in page.tables["cells"][1:]] == ["floaty", "as-flown"]
    before = (out / "flights" / "all.parquet").read_bytes()
    assert cli("campaign", "tiny.toml", "--resume", "--cluster", "tcp://127.0.0.1:9") == 0
    assert (out / "flights" / "all.parquet").read_bytes() == before, "nothing was left to fly"
    assert cli("campaign", "tiny.toml") == 2
    assert "--resume continues it" in cli.err
