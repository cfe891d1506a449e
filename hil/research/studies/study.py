"""A robustness study, one axis of sizes with several variants, and its result: the outcome of every flight, expected or not.

Sizes are listed from harmless to harmful; "up to" and "from" refer to that order.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from hil.config import DEFAULT_PROFILE, settings_of
from hil.laboratory.request import Options
from hil.research.campaigns.config import Value
from hil.research.campaigns.jobs import Job, Row

OUTCOMES = ("holds", "degrades", "failsafe", "lost", "error")  # from good to bad
HOLDS, FAILSAFE, LOST = (OUTCOMES.index(name) for name in ("holds", "failsafe", "lost"))


@dataclass(frozen=True, slots=True)
class Expected:
    """The expected outcome of a variant, by size; None: not stated."""

    holds_to: float | None = None  # every seed holds the experiment's limits up to this size
    flies_to: float | None = None  # no seed is lost up to this size
    # From this size on the supervisor opens the loop or the robot is lost.
    failsafe_from: float | None = None
    lost_from: float | None = None  # every seed is lost from this size on

    def text(self, unit: str) -> str:
        """Return the expectation as a sentence."""
        parts = (
            ("holds the limits up to", self.holds_to),
            ("is not lost up to", self.flies_to),
            ("is stopped by the supervisor from", self.failsafe_from),
            ("is lost from", self.lost_from),
        )
        return ", ".join(f"{words} {size:g} {unit}".strip() for words, size in parts if size is not None)


@dataclass(frozen=True, slots=True)
class Variant:
    name: str
    change: Callable[[float], Options]  # the settings and faults of a size
    expected: Expected
    profile: str = DEFAULT_PROFILE
    settings: tuple[str, ...] = ()  # besides those of the size


@dataclass(frozen=True, slots=True)
class Study:
    name: str
    question: str
    axis: str  # meaning of the sizes
    unit: str
    sizes: tuple[float, ...]
    variants: tuple[Variant, ...]
    duration_s: float = 8.0
    experiment: str = "hover"
    remark: str = ""  # explains the picture


@dataclass(frozen=True, slots=True)
class VariantOutcome:
    """The outcome of one variant at one size, seed by seed."""

    size: float
    outcomes: tuple[str, ...]
    errors: tuple[float, ...]  # rms distance from the goal [m], of the surviving flights

    @property
    def ranks(self) -> list[int]:
        """Indices in OUTCOMES, from good to bad."""
        return sorted(OUTCOMES.index(outcome) for outcome in self.outcomes)

    @property
    def typical(self) -> str:
        """The median outcome; the worse of two."""
        return OUTCOMES[self.ranks[len(self.outcomes) // 2]]

    @property
    def text(self) -> str:
        """The number of seeds by outcome."""
        return ", ".join(f"{self.outcomes.count(name)} {name}" for name in OUTCOMES if name in self.outcomes)


@dataclass(frozen=True, slots=True)
class Curve:
    """A variant over the flown sizes."""

    variant: Variant
    cells: tuple[VariantOutcome, ...]


@dataclass(frozen=True, slots=True)
class StudyResult:
    study: Study
    curves: tuple[Curve, ...]

    def surprises(self, curve: Curve) -> list[str]:
        """Return the cells of a curve that differ from the expectation of its variant."""
        found = []
        for cell in curve.cells:
            if not all(self._bounds(curve.variant.expected, cell)):
                found.append(f"{cell.size:g} {self.study.unit}".strip() + f": {cell.text}")
        return found

    def _bounds(self, expected: Expected, cell: VariantOutcome) -> Iterator[bool]:
        """Yield whether a cell keeps each of its bounds."""
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
        """Whether all flights were flown with expected outcomes."""
        return len(self.curves) == len(self.study.variants) and all(
            len(curve.cells) == len(self.study.sizes) and not self.surprises(curve) for curve in self.curves
        )


def flights_of(study: Study, seeds: int) -> Iterator[Job]:
    """Yield every flight of a study; only its row is kept."""
    for variant in study.variants:
        for size in study.sizes:
            change = variant.change(size)
            settings = (*variant.settings, *settings_of(change.get("overrides", ())))
            values: dict[str, Value] = {"study": study.name, "variant": variant.name, "size": float(size)}
            for seed in range(1, seeds + 1):
                options = Options(
                    profile=variant.profile, overrides=settings, seed=seed, duration_s=study.duration_s,
                    faults=change.get("faults", ()),
                )  # fmt: skip
                yield Job(0, study.experiment, options, values)


def outcome_of(row: Row) -> str:
    """Return the outcome of a flight, one of OUTCOMES.

    lost: it ended as a crash; failsafe: the supervisor, or a reset, opened the loop for a while; degrades: a limit fails.
    """
    if row.outcome not in ("completed", "reset"):
        return "lost" if row.outcome == "lost" else "error"
    if row.outcome == "reset" or row.metrics["failsafe"] > 0:
        return "failsafe"
    return "holds" if row.passed else "degrades"


def summarise(study: Study, flown: Iterable[tuple[Job, Row]]) -> StudyResult:
    """Return the result of a study from its finished flights."""
    by_cell: dict[tuple[Value, Value], list[Row]] = {}
    for job, row in flown:
        by_cell.setdefault((job.values["variant"], job.values["size"]), []).append(row)
    curves = []
    for variant in study.variants:
        cells = tuple(
            VariantOutcome(
                size, tuple(map(outcome_of, rows)),
                tuple(distance(row.metrics) for row in rows if row.outcome == "completed"),
            )
            for size in study.sizes
            if (rows := by_cell.get((variant.name, size)))
        )  # fmt: skip
        if cells:
            curves.append(Curve(variant, cells))
    return StudyResult(study, tuple(curves))


def distance(metrics: Mapping[str, float]) -> float:
    """Return the rms distance from the goal [m]."""
    return float(np.sqrt(sum(metrics[f"rms_{axis}"] ** 2 for axis in "xyz")))
