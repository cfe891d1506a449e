"""The runner of many flights: workers, a dataset, progress, Ctrl-C and the decision when to stop.

A campaign, a study, the paper, seeds and tuning are plans (`hil.research.campaigns.jobs`); each is evaluated from its rows.
Rows arrive in any order; decisions use the flights in the order of their numbers, so they do not depend on the number of
workers.
"""

from __future__ import annotations

import os
import signal
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import chain
from math import sqrt
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as Bar

from ground_station.stops import heeded
from hil.errors import LabError
from hil.laboratory.request import Options
from hil.research.campaigns.dataset import Dataset
from hil.research.campaigns.jobs import LOG_AND_TELEMETRY, Job, Plan, Row
from hil.research.campaigns.workers import Workers

DEVIATIONS = 1.959963984540054  # of the normal distribution, contain 95 %
STOP_FROM = 30  # flights; from fewer the interval is too wide to stop
ALIKE = 2.0  # failures

# Turns flights into rows, in any order; ends early when interrupted.
Flyer = Callable[[Iterator[Job]], Generator[Row]]


@dataclass(frozen=True, slots=True)
class Rate:
    """A failure rate."""

    failed: int
    flown: int
    design: float = 1.0  # variance, relative to as many independent flights

    @property
    def interval(self) -> tuple[float, float]:
        """The rate's interval with 95 % confidence: Wilson's, for the effective number of flights."""
        return interval(self.failed / self.flown if self.flown else 0.0, self.flown / self.design)

    def __str__(self) -> str:
        return self.text()

    def text(self, which: str = "") -> str:
        """Return the rate and its interval; `which` flights follows their number."""
        if not self.flown:
            return f"0 of 0{which}"
        low, high = self.interval
        share = self.failed / self.flown
        return f"{self.failed} of {self.flown}{which}: {100 * share:.2f} % ({100 * low:.2f} to {100 * high:.2f} %)"


@dataclass(frozen=True, slots=True, kw_only=True)
class InterimResult(Rate):
    """The failure rate of the flights so far."""

    planned: int
    complete: bool  # all needed flights have been flown


def interval(share: float, flown: float) -> tuple[float, float]:
    """Return Wilson's interval for a rate of independent flights."""
    if flown == 0:
        return 0.0, 1.0
    z2 = DEVIATIONS * DEVIATIONS
    centre = (flown * share + z2 / 2.0) / (flown + z2)
    half = DEVIATIONS * sqrt(flown * share * (1.0 - share) + z2 / 4.0) / (flown + z2)
    return (centre - half if share > 0.0 else 0.0), (centre + half if share < 1.0 else 1.0)


class Tally:
    """Counts flights in clusters of `size` with similar results: one robot in one wind.

    The clusters' scatter gives the variance of the rate, like a bootstrap over the clusters, but also for few failures:
    `ALIKE` failures of whole clusters are added to them.
    """

    def __init__(self, size: int) -> None:
        self._size = size
        self._of: Counter[int] = Counter()  # failures by cluster
        self.failed = self.flown = self._squares = 0

    def add(self, cluster: int, passed: bool) -> None:
        self.flown += 1
        if not passed:
            self.failed += 1
            self._squares += 2 * self._of[cluster] + 1
            self._of[cluster] += 1

    @property
    def rate(self) -> Rate:
        clusters, rare = self.flown / self._size, min(self.failed, self.flown - self.failed)
        if clusters <= 1.0 or not rare:
            return Rate(self.failed, self.flown, min(self._size, max(self.flown, 1)))
        scatter = (self._squares - self.failed**2 / clusters) * clusters / (clusters - 1.0)
        design = scatter * self.flown / (self.failed * (self.flown - self.failed))
        design = (rare * design + ALIKE * self._size) / (rare + ALIKE)
        return Rate(self.failed, self.flown, min(max(design, 1.0), self._size))


class Progress:
    """Counts rows; `end` is the number of flights that the plan needs, once known."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._waiting: dict[int, bool] = {}  # flights with missing predecessors
        self._all, self._known = Tally(plan.cluster), Tally(plan.cluster)
        self.end: int | None = None

    def add(self, index: int, passed: bool) -> None:
        self._all.add(index // self._plan.cluster, passed)
        self._waiting[index] = passed
        while self.end is None and (known := self._known.flown) in self._waiting:
            self._known.add(known // self._plan.cluster, self._waiting.pop(known))
            if known + 1 == self._plan.flights or self._knows_enough():
                self.end = known + 1

    def _knows_enough(self) -> bool:
        known = self._known
        if self._plan.half_width is None or known.flown < STOP_FROM or known.flown % self._plan.cluster:
            return False
        low, high = known.rate.interval
        return (high - low) / 2.0 <= self._plan.half_width

    @property
    def interim(self) -> InterimResult:
        tally = self._all if self.end is None else self._known
        planned = self._plan.flights if self.end is None else self.end
        return InterimResult(**asdict(tally.rate), planned=planned, complete=self.end is not None)


def conduct(dataset: Dataset, flyer: Flyer, show: Callable[[InterimResult], None]) -> InterimResult:
    """Fly the flights missing in the dataset, until all are flown, the rate is known or the flyer ends."""
    plan, progress, there = dataset.plan, Progress(dataset.plan), set()
    for row in dataset.table(["index", "passed"]).to_pylist():
        progress.add(row["index"], row["passed"])
        there.add(row["index"])
    show(progress.interim)
    rows = flyer(plan.job(index) for index in range(plan.flights) if index not in there)
    try:
        while progress.end is None and (flown := next(rows, None)) is not None:
            dataset.add(flown)
            progress.add(flown.job.index, flown.passed)
            show(progress.interim)
    finally:
        rows.close()
        dataset.close(progress.end)
    return progress.interim


class Runner:
    """Flies plans, each into a dataset. Its workers run from the first flight to the end of the `with` block.

    Ctrl-C sets `interrupted`: running flights are completed, and no other plan is flown.
    """

    def __init__(
        self, notices: Console, workers: int | None = None, cluster: str = "", resume: bool = False
    ) -> None:
        if workers and cluster:
            raise LabError(f"--workers {workers}: not together with --cluster {cluster}")
        self._notices, self._cluster, self._resume = notices, cluster, resume
        self._count = workers or len(os.sched_getaffinity(0))
        self._workers: Workers | None = None
        self._stops: list[int] = []

    def __enter__(self) -> Runner:
        return self

    def __exit__(self, *_: object) -> None:
        if self._workers is not None:
            self._workers.close()

    @property
    def interrupted(self) -> bool:
        """Whether it was asked to end early."""
        return bool(self._stops)

    def campaign(self, plan: Plan, folder: Path, replace: bool = False) -> tuple[Dataset, InterimResult]:
        """Fly a plan into the dataset of a folder; an unfinished plan there may be replaced, unless it is resumed."""
        dataset = Dataset(folder, plan, self._resume, replace)
        with self._progress() as show, self._stops_noted():
            return dataset, conduct(dataset, self._flown, show)

    def fly(self, name: str, jobs: Sequence[Job], out: Path) -> list[Row]:
        """Return the rows of flights, after Ctrl-C of the complete ones; their dataset is `out/campaigns/name`."""
        return self.campaign(Plan.of(jobs), out / "campaigns" / name, replace=True)[0].rows()

    def log(self, name: str, flights: Mapping[str, tuple[str, Options]], out: Path) -> list[Row]:
        """Fly experiments, each with log and telemetry into the folder of its name in `out`; empty after Ctrl-C.

        Raises `LabError` for a flight that ends with an error.
        """
        jobs = [
            Job(0, experiment, options, {}, out / folder, LOG_AND_TELEMETRY)
            for folder, (experiment, options) in flights.items()
        ]
        rows = self.fly(name, jobs, out)
        for row in rows:
            if row.outcome == "error":
                raise LabError(f"{row.folder}: {row.error}")
        return [] if self.interrupted else rows

    def _flown(self, jobs: Iterator[Job]) -> Generator[Row]:
        first = next(jobs, None)
        if first is None or self._stops:
            return
        if self._workers is None:
            self._workers = Workers(self._count, self._cluster)
        yield from self._workers.fly(chain([first], jobs), lambda: len(self._stops))

    @contextmanager
    def _stops_noted(self) -> Iterator[None]:
        """Record the signals that request an orderly end."""
        numbers = heeded()
        before = [signal.signal(number, lambda got, _: self._stops.append(got)) for number in numbers]
        try:
            yield
        finally:
            for number, handler in zip(numbers, before, strict=True):
                signal.signal(number, handler)

    @contextmanager
    def _progress(self) -> Iterator[Callable[[InterimResult], None]]:
        columns = (
            TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"),
            TimeRemainingColumn(),
        )  # fmt: skip
        quiet = not self._notices.is_terminal
        with Bar(*columns, console=self._notices, transient=True, disable=quiet) as bar:
            task = bar.add_task("flying", rate="")

            def show(interim: InterimResult) -> None:
                low, high = interim.interval
                speed = bar.tasks[task].speed
                pace = f"{speed:.1f} flights/s, " if speed else ""
                rate = f"{pace}{interim.failed} failed: {100 * low:.1f}..{100 * high:.1f} %"
                bar.update(task, completed=interim.flown, total=interim.planned, rate=rate)

            yield show
