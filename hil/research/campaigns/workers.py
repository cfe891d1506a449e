"""Worker processes that fly: on this computer, or of a Dask scheduler.

A process of this computer flies one flight at a time; a worker of a scheduler has a second one waiting. A dead process is
replaced. Its flights are repeated when all others have ended, one at a time: the one with which a process dies again
becomes a row.
"""

from __future__ import annotations

import faulthandler
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, TypeAlias

from ground_station.stops import HANGUP
from hil.errors import LabError, require
from hil.research.campaigns.jobs import Job, Row, failed, fly_job

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as ClusterFuture

LOOK_S = 0.2  # how often Ctrl-C is checked
PER_WORKER = 2  # of a scheduler: one flies and one waits, so that no worker idles while a row is sent
CONNECT_S = 30.0
LOST_S = 300.0  # a cluster without workers for so long is lost; dead ones may be replaced
DIED = "the process that flew it died, also when it flew it again"
FlyOne = Callable[[Job], Row]
Handle: TypeAlias = "Future[Row] | ClusterFuture[Row]"

_ALONE = threading.Lock()  # one flight per process at a time: the process has one time limit


def fly_alone(job: Job, fly_one: FlyOne) -> Row:
    """Fly in a worker; a hanging flight ends the process."""
    with _ALONE, open(os.devnull, "w") as nowhere:
        if job.limits is not None:
            faulthandler.dump_traceback_later(2.0 * job.limits.wall_s, exit=True, file=nowhere)
        try:
            return fly_one(job)
        finally:
            faulthandler.cancel_dump_traceback_later()


class Workers:
    """Workers until `close`. `address` is that of a Dask scheduler; empty: `count` processes of this computer.

    Raises `LabError` when the scheduler does not answer or has no workers.
    """

    def __init__(self, count: int, address: str = "") -> None:
        self._client: Client | None = None
        self._address = address
        self._processes: list[ProcessPoolExecutor] = []
        self._bell = threading.Event()  # set when a flight has ended
        self._looks = 0  # since the cluster had a worker
        self._room = 1  # flights at a time for each process, or for the cluster
        if not address:
            self._processes += [_process() for _ in range(count)]
            return
        require(f"--cluster {address}", "campaign", "distributed")
        from distributed import Client

        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the user gets a row or an error
        try:
            self._client = Client(address, timeout=CONNECT_S)
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise LabError(f"--cluster {address}: no workers ({error})") from None
        self._room = PER_WORKER * sum(self._client.nthreads().values())

    def close(self) -> None:
        """End the processes started here, with their flights."""
        if self._client is not None:
            self._client.close()
            return
        for process_of_one in self._processes:
            process_of_one.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()

    def fly(
        self, jobs: Iterator[Job], stopped: Callable[[], int], fly_one: FlyOne = fly_job
    ) -> Generator[Row]:
        """Yield the rows of flights as they arrive. Raises `LabError` for a full disk or a lost cluster.

        `stopped` counts the requests to end: the first starts no more flights, the second does not wait for running ones.
        """
        free = list(range(max(1, len(self._processes)))) * self._room
        flying: dict[Handle, tuple[int, Job]] = {}
        died: list[Job] = []  # their process died, perhaps by another flight's fault
        alone = False  # only those are left
        while stopped() < 2:
            while free and not stopped() and (job := next(jobs, None)) is not None:
                number = free.pop()
                flying[self._submit(number, job, fly_one)] = number, job
            if not flying and died and not stopped():
                alone, number, job = True, free.pop(), died.pop(0)
                flying[self._submit(number, job, fly_one)] = number, job
            if not flying:
                return
            for future in self._done(flying):
                try:
                    row = self._row_of(future, flying[future][1])
                except TimeoutError:
                    continue  # its worker died with the row: the scheduler lets another one fly it
                number, job = flying.pop(future)
                free.append(number)
                if row is None and not alone:
                    died.append(job)
                else:
                    yield row or failed(job, DIED)
                if row is None and self._processes:
                    self._processes[number] = _process()

    def _submit(self, number: int, job: Job, fly_one: FlyOne) -> Handle:
        future: Handle
        if self._client is None:
            future = self._processes[number].submit(fly_alone, job, fly_one)
        else:
            future = self._client.submit(fly_alone, job, fly_one, pure=False)
        future.add_done_callback(lambda _: self._bell.set())
        return future

    def _done(self, flying: Iterable[Handle]) -> list[Handle]:
        """Return the flights that have ended, after a wait for one. Raises `LabError` for a lost cluster."""
        self._bell.wait(LOOK_S)
        self._bell.clear()
        done = [future for future in flying if future.done()]
        if self._client is not None:
            # A scheduler that is lost in this call answers nothing, after a while.
            present = self._client.status == "running" and self._client.scheduler_info().get("workers")
            self._looks = 0 if done or present else self._looks + 1
            if self._client.status != "running" or self._looks * LOOK_S > LOST_S:
                raise LabError(
                    f"--cluster {self._address}: lost; --resume continues with the flights that are kept"
                )
        return done

    def _row_of(self, future: Handle, job: Job) -> Row | None:
        """Return the row of a flight; None when its process has died. Raises `TimeoutError` when the row is lost."""
        try:
            error = future.exception(LOOK_S)
            if error is None:
                return future.result(LOOK_S)
        except TimeoutError:
            raise
        except Exception as raised:
            error = raised
        if isinstance(error, LabError):
            raise error
        if isinstance(error, BrokenProcessPool | CancelledError) or type(error).__name__ == "KilledWorker":
            return None
        return failed(job, f"{type(error).__name__}: {error}")


def _process() -> ProcessPoolExecutor:
    """Return a process, forked from a server that has loaded the laboratory once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return ProcessPoolExecutor(1, context, _begin)


def _begin() -> None:
    """Leave Ctrl-C and a lost terminal to the parent process, and end when that ends."""
    for number in (signal.SIGINT, *HANGUP):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
