"""Many flights at once: one process per core, results in the order of the jobs, a progress bar meanwhile."""

import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from hil.run import Request, Result, fly, prepare


@dataclass(frozen=True, slots=True)
class Job:
    """A flight, its folder, and what of it is kept: None for everything, no name for nothing, not even the folder."""

    request: Request
    folder: Path
    keep: tuple[str, ...] | None = None


def fly_all(jobs: Sequence[Job], notices: Console, workers: int | None = None) -> Iterator[Result]:
    """Fly every job and yield the results in order; whoever stops early, as by Ctrl-C, waits for those in the air."""
    workers = workers or min(len(jobs), os.cpu_count() or 1)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _leave_interrupts_to_the_parent)
    with Progress(*columns, console=notices, transient=True, disable=not notices.is_terminal) as progress:
        bar = progress.add_task("", total=len(jobs))
        futures = [pool.submit(_fly, job) for job in jobs]
        try:
            for job, future in zip(jobs, futures, strict=True):
                progress.update(bar, description=f"flying {job.folder.name}")
                yield future.result()
                progress.advance(bar)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _fly(job: Job) -> Result:
    prepare(job.folder)
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
