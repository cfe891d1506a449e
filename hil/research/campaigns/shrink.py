"""Reduces a failing flight to the fewest faults and parameters, smallest sizes and shortest times that still fail.

Every step is a flight. Faults and parameters are removed one at a time if the flight still fails without them; sizes and
durations are halved towards harmless as long as it still fails. So no single part of the result can be removed; a smaller
combination may still exist.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

from hil.errors import LabError
from hil.laboratory.fault_kinds import KINDS, add, either, times
from hil.laboratory.faults import Fault, parse
from hil.laboratory.files.result import Result
from hil.laboratory.request import Options, Request
from hil.research.campaigns.config import Spec
from hil.research.campaigns.jobs import Job, fly_within

HALVINGS = 6  # a size is found to 1/64 of the drawn one
SHORTEST_S = 0.01


@dataclass(frozen=True, slots=True)
class Trial:
    """The reduced faults and settings of a flight."""

    settings: tuple[str, ...]  # the sampled ones
    faults: tuple[Fault, ...]


Fails = Callable[[Trial], bool]


def shrink(trial: Trial, duration_s: float, fails: Fails) -> Trial:
    """Return the smallest failing trial. Raises `LabError` when the whole does not fail."""
    if not fails(trial):
        raise LabError("--shrink: the flight does not fail; there is nothing to shrink")
    trial = _fewer(trial, fails)
    for number, fault in enumerate(trial.faults):
        mildest = harmless(fault.kind)
        if mildest is not None and mildest != fault.size:
            trial = _halved(trial, number, "size", (mildest, fault.size), fails)
        whole_s = min(fault.duration_s, duration_s - fault.start_s)
        trial = _halved(trial, number, "duration_s", (SHORTEST_S, whole_s), fails)
    return trial


def _fewer(trial: Trial, fails: Fails) -> Trial:
    """Remove parts one at a time until every one is needed."""
    changed = True
    while changed:
        changed = False
        for less in _one_less(trial):
            if fails(less):
                trial, changed = less, True
                break
    return trial


def _one_less(trial: Trial) -> Iterator[Trial]:
    if trial.settings:
        yield replace(trial, settings=())  # all at once: mostly none of them matters
    for n in range(len(trial.faults)):
        yield replace(trial, faults=trial.faults[:n] + trial.faults[n + 1 :])
    for n in range(len(trial.settings)) if len(trial.settings) > 1 else ():
        yield replace(trial, settings=trial.settings[:n] + trial.settings[n + 1 :])


def _halved(
    trial: Trial,
    number: int,
    field: Literal["size", "duration_s"],
    between: tuple[float, float],
    fails: Fails,
) -> Trial:
    """Return the trial that fails with a fault's field nearest to the first of two values; the second one is the drawn."""
    passing, failing = between
    reduced = trial
    for _ in range(HALVINGS):
        middle = float(f"{(passing + failing) / 2.0:.6g}")
        changed: dict[str, Any] = {field: middle}
        fault = replace(trial.faults[number], **changed)
        tried = replace(trial, faults=(*trial.faults[:number], fault, *trial.faults[number + 1 :]))
        if fails(tried):
            reduced, failing = tried, middle
        else:
            passing = middle
    return reduced


def harmless(name: str) -> float | None:
    """Return the size at which a kind of fault has no effect, or the mildest one; None: it has no size."""
    kind = KINDS[name]
    if not kind.sized:
        return None
    blend = kind.knobs[0].blend
    mildest = 1.0 if blend is times else math.inf if blend is min else 0.0
    if blend not in (times, min, max, add, either) and kind.low > 0.0:
        return None  # a user's kind, whose harmless direction is unknown
    return min(max(mildest, kind.low), kind.high)


class Reflight:
    """Flies reduced versions of one flight of a campaign; calls `report` with a line per flight."""

    def __init__(self, spec: Spec, drawn: Job, report: Callable[[str], None]) -> None:
        self._spec, self._drawn, self._report = spec, drawn, report
        self._outcome: str | None = None  # of the whole

    @property
    def whole(self) -> Trial:
        """The flight as it was drawn."""
        options = self._drawn.options
        return Trial(
            tuple(options["overrides"])[len(self._spec.settings) :],
            tuple(parse(str(fault)) for fault in options["faults"]),
        )

    def request(self, trial: Trial) -> Request:
        reduced = Options(overrides=(*self._spec.settings, *trial.settings), faults=trial.faults)
        return replace(self._drawn, options=self._drawn.options | reduced).request()

    def fails(self, trial: Trial) -> bool:
        """Whether it fails with the same outcome as the whole."""
        result = fly_within(self.request(trial), self._spec.limits)
        self._outcome = self._outcome or result.outcome
        failed = not result.passed and result.outcome == self._outcome
        verdict = "fails" if failed else "holds" if result.passed else "fails otherwise"
        self._report(f"{verdict}: {_text(trial)}{_why(result)}")
        return failed


def _text(trial: Trial) -> str:
    return " ".join((*map(str, trial.faults), *trial.settings)) or "nothing but its seed"


def _why(result: Result) -> str:
    broken = ", ".join(verdict.metric for verdict in result.failed)
    return f" ({result.cause or broken})" if not result.passed else ""
