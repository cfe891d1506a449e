"""Workers of which the test decides when a flight ends and how, and the runner that conducts plans with them."""

import io
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from hil.errors import LabError
from hil.laboratory.request import Options
from hil.research.campaigns import run, workers
from hil.research.campaigns.config import FlightLimits
from hil.research.campaigns.jobs import LOG_AND_TELEMETRY, Job, Row, failed
from hil.research.campaigns.run import Runner
from hil.research.campaigns.workers import DIED, Workers
from support.campaigns import planted, raising


def job(index: int) -> Job:
    return Job(index, "hover", Options(faults=()), {})


class Pool:
    """One process, or a cluster: a flight ends when the test rings, and as `ends` says for its number."""

    status = "running"

    def __init__(self, ends: Callable[[int], Row | BaseException | None], single: bool) -> None:
        self.ends, self.single, self.dead = ends, single, False
        self.given: list[Any] = []
        self.open: list[tuple[Future[Row], Job]] = []
        self.workers: dict[str, int] = {"a": 2, "b": 1}

    def submit(self, run: Any, job: Job, fly_one: Any, **more: Any) -> Future[Row]:
        assert not self.dead, "a dead process flies nothing"
        self.given.append(job.index)
        self.open.append((future := Future[Row](), job))
        return future

    def end(self) -> None:
        """End the flights that are under way."""
        for future, job in self.open:
            found = self.ends(job.index)
            if isinstance(found, BaseException):
                self.dead = self.single and isinstance(found, BrokenProcessPool)
                future.set_exception(found)
            else:
                future.set_result(found or planted(job))
        self.open.clear()

    def shutdown(self, **how: bool) -> None:
        self.given.append(how)

    def nthreads(self) -> dict[str, int]:
        return self.workers

    def scheduler_info(self) -> dict[str, Any]:
        return {"workers": self.workers}

    def wait_for_workers(self, count: int, timeout: float) -> None:
        self.given.append((count, timeout))

    def close(self) -> None:
        self.given.append("close")


class Crew:
    """Processes of this computer or a cluster; each look ends what flies, after a check by the test."""

    def __init__(self, patch: pytest.MonkeyPatch, ends: Any = lambda index: None, count: int = 2) -> None:
        self.pools: list[Pool] = []
        patch.setattr(workers, "LOOK_S", 0.001)
        patch.setattr(workers, "_process", lambda: self.pools.append(Pool(ends, True)) or self.pools[-1])
        cluster = ModuleType("distributed")
        cluster.__spec__ = ModuleSpec("distributed", None)
        cluster.Client = lambda address, timeout: self.pools.append(Pool(ends, False)) or self.pools[-1]  # type: ignore[attr-defined]
        patch.setitem(sys.modules, "distributed", cluster)
        self.looks: list[Any] = []
        self.workers = Workers(count) if count else Workers(0, "tcp://x:1")
        done = self.workers._done

        def look(flying: Any) -> Any:
            self.looks.append([sorted(job.index for _, job in pool.open) for pool in self.pools])
            for pool in self.pools:
                pool.end()
            ended = any(future.done() for future in flying)
            assert self.workers._bell.is_set() or not ended, "noticed at once"
            return done(flying)

        patch.setattr(self.workers, "_done", look)

    def fly(self, count: int, stopped: Callable[[], int] = lambda: 0) -> list[Row]:
        return list(self.workers.fly(map(job, range(count)), stopped))


def test_each_process_flies_one_at_a_time_and_a_cluster_two_for_each_of_its_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    crew = Crew(monkeypatch)
    assert [(row.job.index, row.hash) for row in crew.fly(5)] == [(n, f"{n:064x}") for n in range(5)]
    assert crew.looks == [[[1], [0]], [[2], [3]], [[], [4]]]
    crew.workers.close()
    assert [pool.given[-1] for pool in crew.pools] == [{"wait": False, "cancel_futures": True}] * 2
    crew = Crew(monkeypatch, count=0)
    assert sorted(row.job.index for row in crew.fly(8)) == [*range(8)]
    assert crew.looks == [[[0, 1, 2, 3, 4, 5]], [[6, 7]]], "of three threads"
    crew.workers.close()
    assert (crew.pools[0].given[0], crew.pools[0].given[-1]) == ((1, workers.CONNECT_S), "close")


@pytest.mark.parametrize("count", [2, 0])
@pytest.mark.parametrize(
    "death", [BrokenProcessPool(), CancelledError(), type("KilledWorker", (Exception,), {})()]
)
def test_flights_whose_process_died_are_repeated_alone_at_the_end_and_become_a_row_if_it_dies_again(
    monkeypatch: pytest.MonkeyPatch, count: int, death: BaseException
) -> None:
    deaths = {2: 1, 3: 9}

    def ends(index: int) -> Any:
        deaths[index] = deaths.get(index, 0) - 1
        return death if deaths[index] >= 0 else None

    crew = Crew(monkeypatch, ends, count)
    rows = crew.fly(7)
    assert sorted(row.job.index for row in rows) == [*range(7)]
    assert {row.job.index: row.error for row in rows if row.error} == {3: DIED}
    assert sorted(row.job.index for row in rows[-2:]) == [2, 3], "after all others"
    alone = [sorted(one for pool in look for one in pool) for look in crew.looks[-2:]]
    assert sorted(alone) == [[2], [3]]
    assert len(crew.pools) == (2 + 3 if count else 1), "a dead process is replaced each time"


def test_an_error_of_a_flight_is_its_row_and_one_of_the_user_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = Crew(monkeypatch, lambda index: ValueError("odd") if index == 1 else None).fly(3)
    assert {row.job.index: (row.outcome, row.error) for row in rows if row.job.index == 1} == {
        1: ("error", "ValueError: odd")}  # fmt: skip
    with pytest.raises(LabError, match=r"^full$"):
        Crew(monkeypatch, lambda index: LabError("full") if index == 1 else None).fly(3)
    crew = Crew(monkeypatch, count=0)
    late = Future[Row]()
    monkeypatch.setattr(crew.pools[0], "submit", lambda *_, **more: late)
    flown = crew.workers.fly(map(job, range(1)), lambda: 0)
    late.set_result(planted(job(0)))

    def comes_late(wait_s: float) -> BaseException | None:
        monkeypatch.undo()
        raise TimeoutError

    monkeypatch.setattr(late, "exception", comes_late)
    assert [row.job.index for row in flown] == [0], "a row that was lost on its way comes again"


def test_the_first_request_to_end_starts_no_flight_and_the_second_waits_for_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    crew, stops = Crew(monkeypatch, lambda index: BrokenProcessPool() if index == 0 else None), [0]
    flown = crew.workers.fly(map(job, range(9)), lambda: stops[0])
    rows = [next(flown)]
    stops[0] = 1
    assert [row.job.index for row in (*rows, *flown)] == [1], "no repetition of the other either"
    crew = Crew(monkeypatch)
    assert list(crew.workers.fly(map(job, range(9)), lambda: 2 if crew.looks else 0)) != []
    assert len(crew.looks) == 1
    assert list(Crew(monkeypatch).workers.fly(map(job, range(9)), lambda: 2)) == []


@pytest.mark.parametrize("lost", ["status", "workers", "back", "rows"])
def test_a_cluster_that_is_lost_or_stays_without_workers_ends_it_in_one_line(
    monkeypatch: pytest.MonkeyPatch, lost: str
) -> None:
    crew = Crew(monkeypatch, count=0)
    (cluster,) = crew.pools
    monkeypatch.setattr(workers, "LOST_S", 0.0031)  # three looks
    looks = 0

    def idle() -> None:
        nonlocal looks
        looks += 1
        cluster.workers = {"a": 1} if lost == "back" and looks % 4 == 0 else {}
        cluster.status = "closed" if lost == "status" and looks == 2 else "running"
        if looks == 30 or (lost == "rows" and looks % 3 == 0):  # the first of its flights
            flying, cluster.open = (cluster.open, []) if looks == 30 else (cluster.open[:1], cluster.open[1:])
            for future, one in flying:
                future.set_result(planted(one))

    monkeypatch.setattr(cluster, "end", idle)
    if lost in ("back", "rows"):
        assert len(crew.fly(3)) == 3
        return
    with pytest.raises(
        LabError, match=r"^--cluster tcp://x:1: lost; --resume continues with the flights that are kept$"
    ):
        crew.fly(3)
    assert looks == (2 if lost == "status" else 4)


def test_a_hanging_flight_ends_its_process_after_twice_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    watch = SimpleNamespace(
        dump_traceback_later=lambda after, exit, file: asked.append((after, exit, file.name)),
        cancel_dump_traceback_later=lambda: asked.append("cancelled"),
    )
    monkeypatch.setattr(workers, "faulthandler", watch)
    limits = FlightLimits(wall_s=3.0)
    limited = Job(4, "hover", Options(faults=()), {}, limits=limits)
    assert workers.fly_alone(limited, lambda one: asked.append(one.index) or planted(one)).job is limited  # type: ignore[func-returns-value]
    assert asked == [(6.0, True, os.devnull), 4, "cancelled"]
    with pytest.raises(ZeroDivisionError):
        workers.fly_alone(job(3), raising)
    assert asked[3:] == ["cancelled"]
    assert not workers._ALONE.locked()


class Flown:
    """Workers of a runner, which fly at once; the test may interrupt before a flight."""

    made: list[Any] = []  # noqa: RUF012
    before: Callable[[Job], object] = staticmethod(lambda one: None)

    def __init__(self, count: int, address: str) -> None:
        self.made.append((count, address))

    def fly(self, jobs: Iterator[Job], stopped: Callable[[], int]) -> Iterator[Row]:
        for one in jobs:
            if stopped():
                return
            Flown.before(one)
            yield planted(one)

    def close(self) -> None:
        self.made.append("closed")


@pytest.fixture
def flown(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    monkeypatch.setattr(run, "Workers", Flown)
    monkeypatch.setattr(Flown, "made", [])
    return Flown.made


def jobs(*pushes: float) -> list[Job]:
    return [
        Job(9, "hover", Options(faults=(f"push.y@1={push}",), seed=n), {}) for n, push in enumerate(pushes)
    ]  # type: ignore[arg-type]


def test_a_runner_flies_its_plans_with_the_same_workers_and_shows_how_far_it_is(
    flown: list[Any], tmp_path: Path
) -> None:
    shown = Console(file=io.StringIO(), force_terminal=True, width=150)
    with Runner(shown, 3) as runner:
        rows = runner.fly("one", jobs(9.0, 1.0, 2.0), tmp_path)
        assert [(row.job.index, row.seed, row.passed) for row in rows] == [
            (0, 0, False),
            (1, 1, True),
            (2, 2, True),
        ]
        both = {"a": ("hover", Options(faults=(), seed=5)), "b/c": ("yaw-step", Options(faults=()))}
        logged = runner.log("two", both, tmp_path)
        assert [(row.folder, row.job.files) for row in logged] == [
            (tmp_path / name, LOG_AND_TELEMETRY) for name in ("a", "b/c")]  # fmt: skip
        assert [row.seed for row in logged] == [5, 1]
        assert flown == [(3, "")]
        again = runner.fly("one", jobs(1.0), tmp_path)
        assert [row.passed for row in again] == [True], "an earlier plan of this name is replaced"
    assert flown == [(3, ""), "closed"]
    assert {path.name for path in (tmp_path / "campaigns").iterdir()} == {"one", "two"}
    text = shown.file.getvalue()  # type: ignore[attr-defined]
    assert re.search(r"flying.*3/3.*1 failed: 6\.1\.\.79\.2 %", text)
    resumed = Runner(Console(quiet=True), cluster="tcp://x:1", resume=True)
    assert len(resumed.fly("two", [row.job for row in logged], tmp_path)) == 2
    assert flown[2:] == [], "no workers for what is there"
    with pytest.raises(LabError, match=r"^--workers 2: not together with --cluster tcp://x:1$"):
        Runner(shown, 2, "tcp://x:1")
    Runner(Console(quiet=True)).fly("three", jobs(1.0), tmp_path)
    assert flown[2:] == [(len(os.sched_getaffinity(0)), "")]


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_completes_the_flight_and_no_other_plan_is_flown(
    flown: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, number: int
) -> None:
    before = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    monkeypatch.setattr(
        Flown, "before", staticmethod(lambda one: one.index == 1 and os.kill(os.getpid(), number))
    )
    with Runner(Console(quiet=True), 1) as runner:
        assert not runner.interrupted
        assert len(runner.fly("one", jobs(1.0, 2.0, 3.0), tmp_path)) == 2
        assert runner.interrupted
        assert runner.fly("two", jobs(1.0), tmp_path) == []
        assert runner.log("one", {"a": ("hover", Options())}, tmp_path) == []
    assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == before


def test_a_logged_flight_that_ends_with_an_error_is_one_line_and_a_lost_one_a_row(
    flown: list[Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    outcome = "lost"
    monkeypatch.setattr(run, "Workers", lambda *_: SimpleNamespace(fly=lambda jobs, stopped: (
        replace(failed(one, "no such body"), outcome=outcome) for one in jobs), close=lambda: None))  # fmt: skip
    (row,) = Runner(Console(quiet=True)).log("one", {"a": ("hover", Options())}, tmp_path)
    assert (row.outcome, row.folder) == ("lost", tmp_path / "a")
    outcome = "error"
    with pytest.raises(LabError, match=f"^{tmp_path}/a: no such body$"):
        Runner(Console(quiet=True)).log("one", {"a": ("hover", Options())}, tmp_path)


def test_a_flight_without_a_seed_has_that_of_a_request() -> None:
    plain = Job(0, "hover", Options(), {})
    assert failed(plain, "").columns()["seed"] == plain.request().seed == 1
