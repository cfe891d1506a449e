"""Flights on Dask's workers: processes of this computer, or those of an existing scheduler.

A worker that dies is replaced and its flights are flown again. When several flights wait
there, it is not known which one has killed it; so they are flown again at the end, each alone, and only one that kills its
worker again becomes a row.
"""

from __future__ import annotations

import faulthandler
import logging
import os
import threading
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import CancelledError

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, wait

from hil.campaigns.flying import Campaign, CampaignRow, failed, fly_flight
from hil.campaigns.sampling import draw
from hil.errors import LabError

LOOK_S = 0.2  # how often Ctrl-C is checked
PER_WORKER = 2  # one flies and one waits, so that no worker is idle while a row is sent
CONNECT_S = 30.0
OF_OUR_OWN = {  # settings of the scheduler and the workers that are started here
    "distributed.scheduler.allowed-failures": 0,
    # What Dask keeps for its own debugging, 50 kB of each flight's specification among it: memory stays flat without.
    "distributed.admin.low-level-log-length": 10,
    "distributed.worker.profile.enabled": False,
}
FlyOne = Callable[[Campaign, int], CampaignRow]

_ALONE = threading.Lock()  # one flight per process at a time: its time limit is the process'


def fly_alone(campaign: Campaign, index: int, fly_one: FlyOne) -> CampaignRow:
    """Fly in a worker; a flight that hangs ends the process."""
    with _ALONE, open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(2.0 * campaign.spec.limits.wall_s, exit=True, file=nowhere)
        try:
            return fly_one(campaign, index)
        finally:
            faulthandler.cancel_dump_traceback_later()


class Workers:
    """Dask's workers, until `close`. `address` is that of a scheduler; empty: `count` processes of this computer.

    Raises `LabError` when the scheduler is not there or has no workers.
    """

    def __init__(self, count: int, address: str = "") -> None:
        self.cluster: LocalCluster | None = None
        self._address = address
        dask.config.set(OF_OUR_OWN)
        for name in ("distributed", "distributed.nanny", "distributed.scheduler", "distributed.worker"):
            # What concerns the user is reported in a row or as an error.
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            if address:
                self.client = Client(address, timeout=CONNECT_S)
                self.client.wait_for_workers(1, timeout=CONNECT_S)
            else:
                self.cluster = LocalCluster(
                    n_workers=count, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address="127.0.0.1:0",
                    memory_limit=0, silence_logs=logging.CRITICAL,
                )  # fmt: skip
                self.client = Client(self.cluster)
        except (OSError, TimeoutError, ValueError) as error:
            raise LabError(f"--cluster {address or 'local'}: no workers ({error})") from None

    def close(self) -> None:
        """End the workers that were started here, and their flights."""
        self.client.close()
        if self.cluster is not None:
            self.cluster.close()

    def fly(
        self,
        campaign: Campaign,
        stopped: Callable[[], bool],
        indices: Iterator[int],
        fly_one: FlyOne = fly_flight,
    ) -> Generator[CampaignRow]:
        """Yield the rows of flights as they arrive, until `stopped`. Raises `LabError` for a full disk or a lost cluster."""
        suspects: list[int] = []
        room = PER_WORKER * sum(self.client.nthreads().values())
        yield from self._fly(campaign, stopped, indices, fly_one, room, suspects)
        yield from self._fly(campaign, stopped, iter(suspects.copy()), fly_one, 1, None)

    def _fly(
        self, campaign: Campaign, stopped: Callable[[], bool], indices: Iterator[int], fly_one: FlyOne,
        room: int, suspects: list[int] | None,
    ) -> Generator[CampaignRow]:  # fmt: skip
        """Fly `room` flights at a time; those of dead workers become suspects, or rows where there is no such list."""
        flying: dict[Future, int] = {}
        try:
            while not stopped():
                while len(flying) < max(1, room) and (index := next(indices, None)) is not None:
                    flying[self.client.submit(fly_alone, campaign, index, fly_one, pure=False)] = index
                if not flying:
                    return
                try:
                    wait(list(flying), timeout=LOOK_S, return_when="FIRST_COMPLETED")
                except TimeoutError:
                    continue
                except CancelledError:
                    pass  # one of them has finished; the loop below finds which
                ended = [future for future in flying if future.status != "pending"]
                for future in ended:
                    index = flying.pop(future)
                    row = self._row_of(future, campaign, index, suspects)
                    if row is not None:
                        yield row
        finally:
            self.client.cancel(list(flying), force=True)

    def _row_of(
        self, future: Future, campaign: Campaign, index: int, suspects: list[int] | None
    ) -> CampaignRow | None:
        try:
            row: CampaignRow = future.result()
            return row
        except LabError:
            raise
        # CancelledError: the flight had ended, and its row was lost with the worker.
        except (KilledWorker, CancelledError):
            if self.client.status != "running":
                where = self._address or "local"
                raise LabError(
                    f"--cluster {where}: lost; --resume continues with the flights that are kept"
                ) from None
        except Exception as error:
            return failed(draw(campaign.spec, index), f"{type(error).__name__}: {error}")
        if suspects is not None:
            suspects.append(index)
            return None
        return failed(
            draw(campaign.spec, index), "the process that flew it died, also when it flew nothing else"
        )
