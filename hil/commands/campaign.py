"""`floaty campaign`: thousands of flights over sampled parameters and faults, and what breaks the robot in them."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.progress import MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from hil.commands.options import INTERRUPTED, announce_compilation, console, notices, progress_bar
from hil.errors import LabError, require

if TYPE_CHECKING:
    from hil.campaigns.config import Spec
    from hil.campaigns.flying import Campaign, CampaignRow
    from hil.campaigns.run import Standing
    from hil.campaigns.sampling import Draw


@click.command()
@click.argument("spec")
@click.option("--out", type=click.Path(path_type=Path), metavar="DIR", help="[runs/campaign-SPEC]")
@click.option(
    "--workers", type=click.IntRange(1, 1024), metavar="N", help="Processes here; default: one per core."
)
@click.option("--cluster", metavar="tcp://HOST:PORT", help="A Dask scheduler whose workers fly instead.")
@click.option("--resume", is_flag=True, help="Continue the campaign in DIR; no flight is flown twice.")
@click.option(
    "--shrink", type=click.IntRange(0), metavar="FLIGHT",
    help="Instead: reduce a failing flight to the fewest faults and the smallest sizes that still fail.",
)  # fmt: skip
def campaign(
    spec: str, out: Path | None, workers: int | None, cluster: str | None, resume: bool, shrink: int | None
) -> int:
    """Fly the campaign SPEC into a dataset, and report what breaks the robot (docs/howto/campaigns.md).

    SPEC is a TOML file, or `table`: every robot that the paper's Table allows.

    Exit code 0: all flights were flown, whatever their outcome; 2: bad input or a full disk, with the flights kept; 130:
    interrupted, likewise.
    """
    if workers and cluster:
        raise LabError(f"--workers {workers}: not together with --cluster {cluster}")
    require("floaty campaign", "campaign", "distributed", "SALib", "scipy")
    from hil.campaigns.config import find_spec, read_spec
    from hil.campaigns.flying import Campaign
    from hil.campaigns.sampling import check_spec, draw

    file = find_spec(spec)
    read = read_spec(file)
    check_spec(read)
    if shrink is not None:
        if shrink >= read.flights:
            raise LabError(f"--shrink {shrink}: the campaign has flights 0..{read.flights - 1}")
        announce_compilation()
        return _shrink(read, draw(read, shrink))
    out = out or Path("runs") / f"campaign-{file.stem}"
    return _fly(spec, Campaign.of(read), out, workers, cluster or "", resume)


def _fly(named: str, flown: Campaign, out: Path, workers: int | None, address: str, resume: bool) -> int:
    from hil.campaigns.cluster import Workers
    from hil.campaigns.dataset import Dataset
    from hil.campaigns.report import write_report
    from hil.campaigns.run import conduct

    dataset = Dataset(out, flown, resume)
    stops: list[int] = []

    def flyer(indices: Iterator[int]) -> Generator[CampaignRow]:
        first = next(indices, None)
        if first is None:
            return
        _compile(flown.spec)
        count = workers or len(os.sched_getaffinity(0))
        with _quiet_interrupts():
            crew = Workers(count, address)
        try:
            with _stops_noted(stops):
                yield from crew.fly(flown, lambda: bool(stops), _from(first, indices))
        finally:
            crew.close()

    with _progress() as show:
        standing = conduct(flown.spec, dataset, flyer, show)
    page, findings = write_report(out, named, flown, standing.complete)
    console.print(f"failed: {findings.rate}", soft_wrap=True)
    for one in findings.limits:
        console.print(f"  {one.name}: {one.rate}", soft_wrap=True)
    for text in findings.errors:
        console.print(f"  did not end: {text}", soft_wrap=True, markup=False)
    for worst in findings.worst[:3]:
        console.print(f"  flight {worst.index}: {worst.command}", soft_wrap=True, markup=False)
    console.print(f"  {page}", soft_wrap=True)
    if stops:
        notices.print(f"interrupted: {standing.flown} flights are kept; --resume flies the others")
        return INTERRUPTED
    return 0


def _from(first: int, others: Iterator[int]) -> Iterator[int]:
    yield first
    yield from others


def _compile(spec: Spec) -> None:
    """Compile once, before several workers do it at the same time."""
    from firmware_py.compiling import is_kept
    from hil.campaigns.flying import fly_within
    from hil.experiments import EXPERIMENTS
    from hil.laboratory.request import Request
    from hil.world.motion import advance

    if not is_kept(advance):
        announce_compilation()
        fly_within(Request.of(EXPERIMENTS["hover"], duration_s=0.1), spec)


def _shrink(spec: Spec, drawn: Draw) -> int:
    from hil.api import command_of
    from hil.campaigns.shrink import Reflight, shrink

    reflight = Reflight(spec, drawn, lambda text: notices.print(text, soft_wrap=True, markup=False))
    whole = reflight.request(reflight.whole)
    least = shrink(reflight.whole, whole.duration_s, reflight.fails)
    console.print(f"flight {drawn.index} still fails with", soft_wrap=True)
    console.print(f"  {command_of(reflight.request(least))}", soft_wrap=True, markup=False)
    return 0


@contextmanager
def _quiet_interrupts() -> Iterator[None]:
    """Have the processes that are started here ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def _stops_noted(stops: list[int]) -> Iterator[None]:
    """Record the signals that request an orderly end."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda received, _: stops.append(received)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextmanager
def _progress() -> Iterator[Callable[[Standing], None]]:
    columns = (MofNCompleteColumn(), TextColumn("{task.fields[rate]}"), TimeRemainingColumn())
    with progress_bar(*columns) as progress:
        bar = progress.add_task("flying", rate="")
        yield partial(_show, progress, bar)


def _show(progress: Progress, bar: TaskID, standing: Standing) -> None:
    low, high = standing.interval
    speed = progress.tasks[bar].speed
    pace = f"{speed:.1f} flights/s, " if speed else ""
    rate = f"{pace}{standing.failed} failed: {100 * low:.1f}..{100 * high:.1f} %"
    progress.update(bar, completed=standing.flown, total=standing.planned, rate=rate)
