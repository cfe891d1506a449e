"""The result of a study: the outcome of every flight and cell, and whether it was expected."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from hil.experiments import find_experiment
from hil.laboratory.request import Request
from hil.laboratory.result import Result
from hil.studies.study import Expected, Study, Variant

OUTCOMES = ("holds", "degrades", "failsafe", "lost", "error")  # from good to bad
HOLDS, FAILSAFE, LOST = (OUTCOMES.index(name) for name in ("holds", "failsafe", "lost"))


@dataclass(frozen=True, slots=True)
class Cell:
    """The outcome of one variant at one size, seed by seed."""

    size: float
    outcomes: tuple[str, ...]
    errors: tuple[float, ...]  # rms distance from the goal [m], of the flights that were not lost

    @property
    def ranks(self) -> list[int]:
        """Indices in OUTCOMES, from good to bad."""
        return sorted(OUTCOMES.index(outcome) for outcome in self.outcomes)

    @property
    def typical(self) -> str:
        """The median outcome; of two the worse one."""
        return OUTCOMES[self.ranks[len(self.outcomes) // 2]]

    @property
    def text(self) -> str:
        """The number of seeds by outcome."""
        return ", ".join(f"{self.outcomes.count(name)} {name}" for name in OUTCOMES if name in self.outcomes)


@dataclass(frozen=True, slots=True)
class Curve:
    """A variant over the sizes that were flown."""

    variant: Variant
    cells: tuple[Cell, ...]


@dataclass(frozen=True, slots=True)
class StudyResult:
    """A study as it was flown."""

    study: Study
    curves: tuple[Curve, ...]

    def surprises(self, curve: Curve) -> list[str]:
        """Return the cells of a curve that differ from the expectation of its variant."""
        found = []
        for cell in curve.cells:
            if not all(self._bounds(curve.variant.expected, cell)):
                found.append(f"{cell.size:g} {self.study.unit}".strip() + f": {cell.text}")
        return found

    def _bounds(self, expected: Expected, cell: Cell) -> Iterator[bool]:
        """Yield whether a cell keeps each bound that concerns it."""
        sizes, best, worst = self.study.sizes, cell.ranks[0], cell.ranks[-1]
        place = sizes.index(cell.size)
        for last, allowed in ((expected.holds_to, HOLDS), (expected.flies_to, FAILSAFE)):
            if last is not None and place <= sizes.index(last):
                yield worst <= allowed
        for first, needed in ((expected.failsafe_from, FAILSAFE), (expected.lost_from, LOST)):
            if first is not None and place >= sizes.index(first):
                yield needed <= best and worst <= LOST

    @property
    def holds(self) -> bool:
        """Whether every outcome was expected and every flight was flown."""
        return len(self.curves) == len(self.study.variants) and all(
            len(curve.cells) == len(self.study.sizes) and not self.surprises(curve) for curve in self.curves
        )


def flights_of(study: Study, seeds: int) -> Iterator[tuple[Variant, float, Request]]:
    """Yield every flight of a study."""
    experiment = find_experiment(study.experiment)
    for variant in study.variants:
        for size in study.sizes:
            change = variant.change(size)
            settings, faults = (*variant.settings, *change.settings), change.faults
            for seed in range(1, seeds + 1):
                yield (
                    variant,
                    size,
                    Request.of(
                        experiment,
                        profile=variant.profile,
                        overrides=settings,
                        seed=seed,
                        duration_s=study.duration_s,
                        faults=faults,
                    ),
                )


def outcome_of(result: Result) -> str:
    """Return the outcome of a flight, one of OUTCOMES.

    lost: it ended as a crash; failsafe: the supervisor, or a reset, opened the loop for a while; degrades: a limit fails.
    """
    if result.outcome not in ("completed", "reset"):
        return "lost" if result.outcome == "lost" else "error"
    if result.outcome == "reset" or result.metrics["failsafe"] > 0:
        return "failsafe"
    return "holds" if result.passed else "degrades"


def summarise(study: Study, flown: list[tuple[Variant, float, Result]]) -> StudyResult:
    """Return the result of a study from the flights that were flown."""
    curves = []
    for variant in study.variants:
        cells = []
        for size in study.sizes:
            results = [result for v, s, result in flown if v is variant and s == size]
            if results:
                outcomes = tuple(map(outcome_of, results))
                errors = tuple(distance(r.metrics) for r in results if r.outcome == "completed")
                cells.append(Cell(size, outcomes, errors))
        if cells:
            curves.append(Curve(variant, tuple(cells)))
    return StudyResult(study, tuple(curves))


def distance(metrics: Mapping[str, float]) -> float:
    """Return the rms distance from the goal [m]."""
    return float(np.sqrt(sum(metrics[f"rms_{axis}"] ** 2 for axis in "xyz")))
