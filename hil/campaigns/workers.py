"""Worker processes that fly: on this computer, or of a Dask scheduler.

A process of this computer flies one flight at a time. A dead process is replaced and its flight is repeated; if it dies
again, the flight becomes a row.
"""

from __future__ import annotations

import faulthandler
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING

from hil.campaigns.jobs import Job, Row, failed, fly_job
from hil.errors import LabError, require

if TYPE_CHECKING:
    from distributed import Client

LOOK_S = 0.2  # how often Ctrl-C is checked
PER_WORKER = 2  # of a scheduler: one flies and one waits, so that no worker idles while a row is sent
CONNECT_S = 30.0
DIED = "the process that flew it died, also when it flew it again"
FlyOne = Callable[[Job], Row]

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
        self._executors: list[Executor] = []
        self._room = 1  # flights at a time for each executor
        if not address:
            self._executors += [_process() for _ in range(count)]
            return
        require(f"--cluster {address}", "campaign", "distributed")
        from distributed import Client

        logging.getLogger("distributed").setLevel(logging.CRITICAL)  # the user gets a row or an error
        try:
            self._client = Client(address, timeout=CONNECT_S)
            self._client.wait_for_workers(1, timeout=CONNECT_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise LabError(f"--cluster {address}: no workers ({error})") from None
        self._executors.append(self._client.get_executor(pure=False))
        self._room = PER_WORKER * sum(self._client.nthreads().values())

    def close(self) -> None:
        """End the processes started here, with their flights."""
        if self._client is not None:
            self._client.close()
            return
        for executor in self._executors:
            executor.shutdown(wait=False, cancel_futures=True)
        for process in multiprocessing.active_children():
            process.kill()

    def fly(
        self, jobs: Iterator[Job], stopped: Callable[[], int], fly_one: FlyOne = fly_job
    ) -> Generator[Row]:
        """Yield the rows of flights as they arrive. Raises `LabError` for a full disk or a lost cluster.

        `stopped` counts the requests to end: the first starts no more flights, the second does not wait for running ones.
        """
        free = [number for number in range(len(self._executors)) for _ in range(self._room)]
        flying: dict[Future[Row], tuple[int, Job]] = {}
        again: list[Job] = []
        died: set[int] = set()  # flights whose process died
        while stopped() < 2:
            while free and not stopped() and (job := again.pop() if again else next(jobs, None)) is not None:
                executor = self._executors[free[-1]]
                flying[executor.submit(fly_alone, job, fly_one)] = free.pop(), job
            if not flying:
                return
            for future in wait(flying, LOOK_S, FIRST_COMPLETED).done:
                number, job = flying.pop(future)
                free.append(number)
                row = self._row_of(future, job)
                if row is not None:
                    yield row
                    continue
                if self._client is None:
                    self._executors[number] = _process()
                if job.index in died:
                    yield failed(job, DIED)
                else:
                    died.add(job.index)
                    again.append(job)

    def _row_of(self, future: Future[Row], job: Job) -> Row | None:
        """Return the row of a flight; None when its process has died."""
        try:
            return future.result()
        except LabError:
            raise
        except (BrokenProcessPool, CancelledError):
            died = True
        except Exception as error:
            died = type(error).__name__ == "KilledWorker"  # of `distributed`
            if not died:
                return failed(job, f"{type(error).__name__}: {error}")
        if self._client is not None and self._client.status != "running":
            raise LabError(
                f"--cluster {self._address}: lost; --resume continues with the flights that are kept"
            )
        return None


def _process() -> ProcessPoolExecutor:
    """Return a process, forked from a server that has loaded the laboratory once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return ProcessPoolExecutor(1, context, _begin)


def _begin() -> None:
    """Leave Ctrl-C to the parent process, and end when that ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
