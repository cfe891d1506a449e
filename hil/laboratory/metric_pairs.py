"""The metrics of two flights side by side, in customary units."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from hil.laboratory.metrics import METRICS, SHOWN, Metric

REL = 0.1  # by which metrics may leave those of a baseline
SMALL = 1e-9  # a difference that is none, also from zero


@dataclass(frozen=True, slots=True)
class MetricPair:
    """A metric of both flights, in the displayed unit."""

    name: str
    unit: str
    values: tuple[float, float]  # NaN: none

    @property
    def difference(self) -> float:
        """Second less first."""
        return self.values[1] - self.values[0]

    @property
    def cells(self) -> tuple[str, ...]:
        """Name, first, second, difference and unit as text."""
        numbers = (*self.values, self.difference)
        return (self.name, *("–" if math.isnan(one) else f"{one:.4g}" for one in numbers), self.unit)

    def within(self, rel: float) -> bool:
        """Whether the second is the first to a share of it; where only one flight has the metric, it is not."""
        first, second = self.values
        return first == second or abs(second - first) <= max(rel * abs(first), SMALL)


HEADINGS = ("metric", "first", "second", "difference", "unit")


def pairs_of(
    first: Mapping[str, float], second: Mapping[str, float], own: Mapping[str, Metric]
) -> list[MetricPair]:
    """Return every metric that one of two flights has; `own` are those of their experiments."""
    pairs = []
    for name, metric in {**METRICS, **own}.items():
        scale, unit = SHOWN.get(metric.unit, (1.0, metric.unit))
        values = (first.get(name, math.nan) * scale, second.get(name, math.nan) * scale)
        if not all(map(math.isnan, values)):
            pairs.append(MetricPair(name, unit, values))
    return pairs


def differing(pairs: Iterable[MetricPair]) -> list[MetricPair]:
    """Return the pairs whose values are not equal."""
    return [pair for pair in pairs if pair.difference != 0]


def text_of(pairs: Iterable[MetricPair], headings: tuple[str, ...] = HEADINGS) -> list[str]:
    """Return a table as lines, numbers to the right."""
    rows = [headings, *(pair.cells for pair in pairs)]
    wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(
            (str.rjust if 0 < index < len(wide) - 1 else str.ljust)(cell, wide[index])
            for index, cell in enumerate(row)
        ).rstrip()
        for row in rows
    ]
