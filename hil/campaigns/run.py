"""Flying a campaign: which flights are left, when enough is known, and the interim result.

The function that flies is handed in: `hil.campaigns.cluster` uses Dask's workers. Rows arrive in any order; decisions are
made on the flights in the order of their numbers, so it is the same for every number of workers.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass

from scipy.stats import binomtest

from hil.campaigns.config import Spec
from hil.campaigns.dataset import Dataset, read_flights
from hil.campaigns.flying import CampaignRow

CONFIDENCE = 0.95
STOP_FROM = 30  # flights; from fewer the interval is too wide to stop

# From numbers of flights to their rows, in any order; ends early when interrupted.
Flyer = Callable[[Iterator[int]], Generator[CampaignRow]]


@dataclass(frozen=True, slots=True)
class Rate:
    """How often something failed."""

    failed: int
    flown: int

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's interval of the rate with CONFIDENCE."""
        return interval(self.failed, self.flown)

    def __str__(self) -> str:
        low, high = self.interval
        share = self.failed / self.flown if self.flown else 0.0
        return f"{self.failed} of {self.flown}: {100 * share:.2f} % ({100 * low:.2f} to {100 * high:.2f} %)"


@dataclass(frozen=True, slots=True)
class Standing(Rate):
    """The interim result."""

    planned: int
    complete: bool  # all flights that the campaign needs have been flown


def interval(failed: int, flown: int) -> tuple[float, float]:
    """Return Wilson's interval for a rate."""
    if flown == 0:
        return 0.0, 1.0
    low, high = binomtest(failed, flown).proportion_ci(CONFIDENCE, "wilson")
    return float(low), float(high)


class Progress:
    """Counts rows; `end` is the number of flights that the campaign needs, once it is known."""

    def __init__(self, spec: Spec) -> None:
        self._spec = spec
        self._waiting: dict[int, bool] = {}  # flights of which some predecessors are missing
        self._flown = self._failed = self._known = self._failed_of_known = 0
        self.end: int | None = None

    def add(self, index: int, passed: bool) -> None:
        """Count a row."""
        self._flown += 1
        self._failed += not passed
        self._waiting[index] = passed
        while self.end is None and self._known in self._waiting:
            self._failed_of_known += not self._waiting.pop(self._known)
            self._known += 1
            if self._known == self._spec.flights or self._knows_enough():
                self.end = self._known

    def _knows_enough(self) -> bool:
        if self._spec.half_width is None or self._known < STOP_FROM:
            return False
        low, high = interval(self._failed_of_known, self._known)
        return (high - low) / 2.0 <= self._spec.half_width

    @property
    def standing(self) -> Standing:
        """The interim result now."""
        if self.end is None:
            return Standing(self._failed, self._flown, self._spec.flights, complete=False)
        return Standing(self._failed_of_known, self.end, self.end, complete=True)


def conduct(spec: Spec, dataset: Dataset, flyer: Flyer, show: Callable[[Standing], None]) -> Standing:
    """Fly the flights missing in the dataset, until all are flown, enough is known or the flyer ends."""
    progress = Progress(spec)
    for row in read_flights(dataset.folder, dataset.schema, ["index", "passed"]).to_pylist():
        progress.add(row["index"], row["passed"])
    show(progress.standing)
    there = frozenset(dataset.indices)
    left = (index for index in range(spec.flights) if index not in there)
    rows = flyer(left)
    try:
        while progress.end is None and (row := next(rows, None)) is not None:
            dataset.add(row)
            progress.add(row.index, row.passed)
            show(progress.standing)
    finally:
        rows.close()
        dataset.close(progress.end)
    return progress.standing
