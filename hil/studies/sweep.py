"""Many flights at once: one process per core, results in the order of the jobs, a progress bar meanwhile."""

from __future__ import annotations

import io
import multiprocessing
import os
import pickle
import signal
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from hil.arguments import checked
from hil.errors import LabError
from hil.experiments import find_again
from hil.laboratory.experiment import Experiment, Source
from hil.laboratory.folder import reserved
from hil.laboratory.request import Request
from hil.laboratory.result import Result
from hil.laboratory.run import fly


@checked
@dataclass(frozen=True, slots=True)
class Job:
    """A flight, its folder, and which of its files are kept: None for all, an empty tuple for none, not even the folder.

    Where all are kept, a flight of another request is not replaced.
    """

    request: Request
    folder: Path
    keep: tuple[str, ...] | None = None


@checked
def fly_all(jobs: Sequence[Job], notices: Console) -> tuple[list[Result], bool]:
    """Fly every job; return the results in the order of the jobs, and whether Ctrl-C ended it early.

    After Ctrl-C the running flights are completed first: every complete flight is among the results.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(len(jobs), os.cpu_count() or 1), context, _leave_interrupts_to_the_parent)
    futures = [pool.submit(_fly, _packed(job)) for job in jobs]
    interrupted = False
    try:
        with Progress(*columns, console=notices, transient=True, disable=not notices.is_terminal) as progress:
            bar = progress.add_task("flying", total=len(jobs))
            for future in as_completed(futures):
                future.result()  # an error ends the sweep
                progress.advance(bar)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    landed = [future for future in futures if not future.cancelled() and future.exception() is None]
    return [future.result() for future in landed], interrupted


class _Packer(pickle.Pickler):
    """Packs a user's experiment as a reference to its source, because it may contain lambdas."""

    def persistent_id(self, value: Any) -> Source | None:
        return value.source if isinstance(value, Experiment) else None


class _Unpacker(pickle.Unpickler):
    def persistent_load(self, source: Source) -> Experiment:
        experiment = find_again("", source)
        if experiment is None:
            raise LabError(f"experiment {source.reference}: its file has changed while it was flown")
        return experiment


def _packed(job: Job) -> bytes:
    content = io.BytesIO()
    _Packer(content).dump(job)
    return content.getvalue()


def _fly(packed: bytes) -> Result:
    job: Job = _Unpacker(io.BytesIO(packed)).load()
    with reserved(job.request, job.folder, replace=job.keep is not None):
        result = fly(job.request, job.folder)
        if job.keep is not None:
            for file in job.folder.iterdir():
                if file.name not in job.keep:
                    file.unlink()
            if not job.keep:
                job.folder.rmdir()
    return result


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
