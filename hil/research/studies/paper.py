"""Flies the whole paper: every row's experiment on both profiles with several seeds, and the studies.

Flights of rows keep their logs in `OUT/EXPERIMENT-PROFILE-SEED`, those of studies only their rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from itertools import chain
from pathlib import Path

import numpy as np

from hil.errors import LabError
from hil.laboratory.metrics import METRICS, SHOWN
from hil.laboratory.request import Options
from hil.research.campaigns.jobs import LOG, Job, Row
from hil.research.campaigns.run import Runner
from hil.research.studies.catalogue import PROFILES
from hil.research.studies.paper_rows import ROWS, PaperRow
from hil.research.studies.study import Study, StudyResult, distance, flights_of, summarise


@dataclass(frozen=True, slots=True)
class Spread:
    """A metric over the seeds, in the displayed unit; flights without a value are omitted."""

    unit: str
    count: int
    mean: float
    deviation: float  # standard, of a single flight; NaN for one flight
    low: float
    high: float

    @classmethod
    def of(cls, metric: str, results: Sequence[Row]) -> Spread:
        """Return the spread of a metric over some flights."""
        scale, unit = SHOWN.get(METRICS[metric].unit, (1.0, METRICS[metric].unit))
        found = np.array([result.metrics.get(metric, math.nan) * scale for result in results])
        found = found[np.isfinite(found)]
        if not len(found):
            return cls(unit, 0, *4 * (math.nan,))
        deviation = float(found.std(ddof=1)) if len(found) > 1 else math.nan
        return cls(unit, len(found), float(found.mean()), deviation, float(found.min()), float(found.max()))

    def __str__(self) -> str:
        if not self.count:
            return "–"
        spread = f" ± {self.deviation:.2g}" if self.deviation > 0 else ""
        return f"{self.mean:.3g}{spread} {self.unit}".strip()


@dataclass(frozen=True, slots=True)
class Trials:
    """A row on one profile: its flights by seed."""

    profile: str
    results: tuple[Row, ...]

    @property
    def passed(self) -> int:
        """The number of flights that held every limit."""
        return sum(result.passed for result in self.results)

    @property
    def holds(self) -> bool:
        return self.passed == len(self.results) > 0

    @property
    def failed(self) -> list[str]:
        """Failed limits with their number, and causes of lost flights."""
        failures = [name for row in self.results for name in row.failed]
        return [f"{name} {failures.count(name)}×" for name in dict.fromkeys(failures)]

    @property
    def lost(self) -> int:
        return sum(result.outcome == "lost" for result in self.results)

    def missed(self, row: PaperRow, metric: str) -> str:
        """Return how far the mean misses the paper's value; empty when it does not, or the paper has none."""
        bound, spread = row.claims[metric].bound, Spread.of(metric, self.results)
        if bound is None or not spread.count:
            return ""
        scale, unit = SHOWN.get(METRICS[metric].unit, (1.0, METRICS[metric].unit))
        above = METRICS[metric].bound == "max"
        beyond = spread.mean - bound * scale if above else bound * scale - spread.mean
        return f"misses by {beyond:.2g} {unit}".strip() if beyond > 1e-9 else ""

    def gaps(self, row: PaperRow) -> dict[str, str]:
        """Return how far the means miss the paper's values, by metric."""
        return {metric: gap for metric in row.claims if (gap := self.missed(row, metric))}

    def representative_first(self) -> list[Row]:
        """Return the flights, the one with the median error first."""
        ranked = sorted(self.results, key=_error)
        return [ranked.pop((len(ranked) - 1) // 2), *ranked] if ranked else []


@dataclass(frozen=True, slots=True)
class Paper:
    rows: tuple[tuple[str, PaperRow, tuple[Trials, ...]], ...]  # experiment, row, per profile
    studies: tuple[StudyResult, ...]
    interrupted: bool

    @property
    def misses(self) -> list[tuple[PaperRow, str, list[str]]]:
        """Rows and profiles that miss a paper's value or fail a limit, with the reasons."""
        found = []
        for _, row, both in self.rows:
            for trials in both:
                why = [f"{metric} {gap}" for metric, gap in trials.gaps(row).items()]
                why += [f"limits fail: {', '.join(trials.failed)}"] if trials.failed else []
                if why:
                    found.append((row, trials.profile, why))
        return found

    @property
    def values_missed(self) -> int:
        """The number of values of the paper that are missed, over both profiles."""
        return sum(len(trials.gaps(row)) for _, row, both in self.rows for trials in both)

    @property
    def surprises(self) -> int:
        """The number of unmet expectations of the studies."""
        return sum(len(result.surprises(curve)) for result in self.studies for curve in result.curves)

    @property
    def holds(self) -> bool:
        """Whether all flights were flown and all limits hold for the default profile; other profiles are not judged."""
        return not self.interrupted and self.limits_hold

    @property
    def limits_hold(self) -> bool:
        """Whether every flight of the default profile held all its limits."""
        return all(trials[0].holds for _, _, trials in self.rows)


def select(pattern: str | None) -> list[str]:
    """Return the experiments of the rows that match a pattern like `yaw-*`. Raises `LabError` when none does."""
    chosen = [name for name in ROWS if pattern is None or fnmatch(name, pattern)]
    if not chosen:
        raise LabError(f"--only {pattern}: no row matches; there are {', '.join(ROWS)}")
    return chosen


def fly_paper(names: Sequence[str], studies: Sequence[Study], seeds: int, out: Path, runner: Runner) -> Paper:
    """Fly rows and studies, equal flights once; after Ctrl-C the result has the complete ones."""
    trials = {
        (name, profile): [
            Job(0, name, Options(profile=profile, seed=seed), {}, out / f"{name}-{profile}-{seed}", LOG)
            for seed in range(1, seeds + 1)
        ]
        for name in names
        for profile in PROFILES
    }
    cells = {study.name: list(flights_of(study, seeds)) for study in studies}
    jobs: dict[str, Job] = {}
    for job in chain(*trials.values(), *cells.values()):
        jobs.setdefault(job.text, job)
    flown = {row.job.text: row for row in runner.fly("paper", list(jobs.values()), out)}

    def of(name: str, profile: str) -> Trials:
        planned = trials[name, profile]
        return Trials(profile, tuple(flown[job.text] for job in planned if job.text in flown))

    return Paper(
        tuple((name, ROWS[name], tuple(of(name, profile) for profile in PROFILES)) for name in names),
        tuple(
            summarise(study, [(job, flown[job.text]) for job in cells[study.name] if job.text in flown])
            for study in studies
        ),
        runner.interrupted,
    )


def _error(row: Row) -> tuple[bool, float]:
    """Return the key that sorts flights from good to bad."""
    return row.outcome != "completed", distance(row.metrics)
