"""Many flights at once: one process per core, results in the order of the requests, a progress bar meanwhile."""

import multiprocessing
import os
import signal
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from hil.run import Request, Result, fly, prepare


def fly_all(requests: list[Request], parent: Path, notices: Console) -> Iterator[Result]:
    """Fly every request into `parent/<experiment>-<seed>` and yield the results in order."""
    workers = min(len(requests), os.cpu_count() or 1)
    columns = (TextColumn("flying"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, context, _leave_interrupts_to_the_parent)
    with Progress(*columns, console=notices, transient=True, disable=not notices.is_terminal) as progress:
        bar = progress.add_task("", total=len(requests))
        futures = [pool.submit(_fly, request, parent) for request in requests]
        try:
            for future in futures:
                yield future.result()
                progress.advance(bar)
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _fly(request: Request, parent: Path) -> Result:
    folder = parent / f"{request.experiment.name}-{request.seed}"
    prepare(folder)
    return fly(request, folder)


def _leave_interrupts_to_the_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
