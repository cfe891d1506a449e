"""Reduces a failing flight to the fewest faults and parameters, smallest sizes and shortest times that still fail.

Every step is a flight. Faults and parameters are removed one at a time if the flight still fails without them; sizes and
durations are halved towards harmless as long as it still fails. So no single part of the result can be removed; a smaller
combination may still exist.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

from hil.campaigns.config import Spec
from hil.campaigns.jobs import Job, fly_within
from hil.errors import LabError
from hil.laboratory.fault_kinds import KINDS, add, either, times
from hil.laboratory.faults import Fault, parse
from hil.laboratory.request import Options, Request
from hil.laboratory.result import Result

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
    for number in range(len(trial.faults)):
        trial = _smaller(trial, number, fails)
        trial = _shorter(trial, number, duration_s, fails)
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


def _smaller(trial: Trial, number: int, fails: Fails) -> Trial:
    fault = trial.faults[number]
    none = harmless(fault.kind)
    if none is None or none == fault.size:
        return trial
    return _halved(none, fault.size, lambda size: _with(trial, number, replace(fault, size=size)), fails)


def _shorter(trial: Trial, number: int, duration_s: float, fails: Fails) -> Trial:
    fault = trial.faults[number]
    whole_s = min(fault.duration_s, duration_s - fault.start_s)
    return _halved(
        SHORTEST_S, whole_s, lambda span: _with(trial, number, replace(fault, duration_s=span)), fails, trial
    )


def _halved(
    passing: float, failing: float, made: Callable[[float], Trial], fails: Fails, before: Trial | None = None
) -> Trial:
    """Return the failing trial nearest to `passing`; `before` when no reduced one fails."""
    whole = failing
    for _ in range(HALVINGS):
        middle = float(f"{(passing + failing) / 2.0:.6g}")
        if fails(made(middle)):
            failing = middle
        else:
            passing = middle
    return before if before is not None and failing == whole else made(failing)


def _with(trial: Trial, number: int, fault: Fault) -> Trial:
    return replace(trial, faults=(*trial.faults[:number], fault, *trial.faults[number + 1 :]))


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
    """Flies reduced versions of one flight of a campaign; calls `said` with a line per flight."""

    def __init__(self, spec: Spec, drawn: Job, said: Callable[[str], None]) -> None:
        self._spec, self._drawn, self._said = spec, drawn, said
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
        """Return the request of a trial."""
        reduced = Options(overrides=(*self._spec.settings, *trial.settings), faults=trial.faults)
        return replace(self._drawn, options=self._drawn.options | reduced).request()

    def fails(self, trial: Trial) -> bool:
        """Whether it fails with the same outcome as the whole."""
        result = fly_within(self.request(trial), self._spec.limits)
        self._outcome = self._outcome or result.outcome
        failed = not result.passed and result.outcome == self._outcome
        verdict = "fails" if failed else "holds" if result.passed else "fails otherwise"
        self._said(f"{verdict}: {_text(trial)}{_why(result)}")
        return failed


def _text(trial: Trial) -> str:
    return " ".join((*map(str, trial.faults), *trial.settings)) or "nothing but its seed"


def _why(result: Result) -> str:
    broken = ", ".join(verdict.metric for verdict in result.failed)
    return f" ({result.cause or broken})" if not result.passed else ""
