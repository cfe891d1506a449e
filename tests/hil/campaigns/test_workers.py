"""Flights on Dask's processes: the same rows as without them, whatever becomes of a worker."""

import gc
import os
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from distributed import LocalCluster
from distributed.worker_state_machine import StateMachineEvent

from hil.campaigns.cluster import FlyOne, Workers
from hil.campaigns.config import Spec
from hil.campaigns.dataset import FLIGHTS, Dataset
from hil.campaigns.flying import Campaign, CampaignRow, fly_flight
from hil.campaigns.run import Standing, conduct
from hil.errors import LabError
from support.campaigns import hanging, killing, planted, raising, spec_of
from support.command import Cli

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("default")]


@pytest.fixture(scope="module")
def crew() -> Iterator[Workers]:
    workers = Workers(2)
    yield workers
    workers.close()


def rows_of(crew: Workers, spec: Spec, fly_one: FlyOne) -> dict[int, CampaignRow]:
    rows = list(crew.fly(Campaign.of(spec), lambda: False, iter(range(spec.flights)), fly_one))
    assert len({row.index for row in rows}) == len(rows), "none twice"
    return {row.index: row for row in rows}


def test_flights_are_the_same_as_in_this_process(crew: Workers) -> None:
    spec = spec_of(flights=4)
    rows = rows_of(crew, spec, fly_flight)
    assert len({row.hash for row in rows.values()}) == 4
    for index in (0, 3):
        row = fly_flight(Campaign.of(spec), index)
        assert (row.hash, row.faults, row.outcome) == (
            rows[index].hash, rows[index].faults, rows[index].outcome,
        )  # fmt: skip


def test_a_flight_that_raises_is_a_row_with_its_error(crew: Workers) -> None:
    spec = spec_of(flights=8)
    rows = rows_of(crew, spec, raising)
    assert (rows[3].outcome, rows[3].error, rows[3].passed) == ("error", "ZeroDivisionError: planted", False)
    assert all(rows[n].hash == planted(Campaign.of(spec), n).hash for n in range(8) if n != 3)


def test_the_flight_that_kills_its_worker_each_time_is_a_row_and_all_others_are_flown(
    crew: Workers, tmp_path: Path
) -> None:
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
    spec = spec_of(flights=30)
    flights = crew.fly(Campaign.of(spec), lambda: False, iter(range(30)), planted)
    rows = [next(flights)]
    assert crew.cluster is not None
    victim = next(nanny.pid for nanny in crew.cluster.workers.values() if nanny.pid)
    os.kill(victim, signal.SIGKILL)
    rows += flights
    assert sorted(row.index for row in rows) == list(range(30))
    assert {row.outcome for row in rows} == {"completed"}


def events_in_memory() -> int:
    gc.collect()
    return sum(isinstance(thing, StateMachineEvent) for thing in gc.get_objects())


def test_workers_keep_no_history_of_the_flights_that_they_have_flown(crew: Workers) -> None:
    rows_of(crew, spec_of(flights=100), planted)
    assert max(crew.client.run(events_in_memory).values()) < 30


def test_an_interrupt_ends_it_with_what_is_there(crew: Workers) -> None:
    stops: list[int] = []
    rows = []
    for row in crew.fly(Campaign.of(spec_of(flights=500)), lambda: bool(stops), iter(range(500)), planted):
        rows.append(row)
        if len(rows) == 5:
            stops.append(signal.SIGINT)
    assert 5 <= len(rows) < 20


def test_a_cluster_that_is_there_flies_the_same_dataset(tmp_path: Path) -> None:
    spec = spec_of(flights=20)
    campaign = Campaign.of(spec)
    with LocalCluster(
        n_workers=1, threads_per_worker=2, dashboard_address=":0", silence_logs=50
    ) as there:  # fmt: skip
        crew = Workers(0, there.scheduler_address)
        flyer = partial(crew.fly, campaign, lambda: False, fly_one=planted)
        conduct(spec, Dataset(tmp_path / "cluster", campaign, False), flyer, _nothing)
        crew.close()
    assert pq.read_table(tmp_path / "cluster" / FLIGHTS)["index"].to_pylist() == list(range(20))


def _nothing(standing: Standing) -> None:
    """Show nothing."""


def test_a_cluster_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.campaigns.cluster.CONNECT_S", 1.0)
    with pytest.raises(LabError, match=r"--cluster tcp://127\.0\.0\.1:9: no workers"):
        Workers(0, "tcp://127.0.0.1:9")


def test_the_command_flies_reports_and_resumes(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tiny.toml").write_text(
        'experiments = ["hover"]\nduration_s = 0.3\nflights = 3\n'
        '[parameters]\n"actuators.tau" = { uniform = [0.04, 0.06] }\n'
    )
    assert cli("campaign", "tiny.toml", "--workers", "1") == 0
    out = Path("runs/campaign-tiny")
    assert {path.name for path in out.iterdir()} == {"campaign.json", "flights", "report.html", "result.json"}
    assert "of 3: " in cli.out
    before = (out / "flights" / "all.parquet").read_bytes()
    assert cli("campaign", "tiny.toml", "--resume", "--cluster", "tcp://127.0.0.1:9") == 0
    assert (out / "flights" / "all.parquet").read_bytes() == before, "nothing was left to fly"
    assert cli("campaign", "tiny.toml") == 2
    assert "--resume continues it" in cli.err
