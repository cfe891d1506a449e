"""One flight of a campaign: from its number to its row, as a worker process executes it.

A flight that cannot be flown, raises or takes too long becomes a row with its error. A full disk raises instead.
"""

from __future__ import annotations

import errno
import os
import tempfile
import time
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path

from hil.campaigns.config import Spec
from hil.campaigns.sampling import Draw, draw, request_of
from hil.errors import LabError, blame
from hil.experiments import find_experiment
from hil.laboratory.experiment import Source
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import in_lockstep
from hil.laboratory.request import Request
from hil.laboratory.result import Result
from hil.laboratory.run import LOADED_US, fly

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True, slots=True)
class Campaign:
    """What every worker gets: the spec, and the source files of its experiments."""

    spec: Spec
    sources: tuple[Source | None, ...]  # of its experiments

    @classmethod
    def of(cls, spec: Spec) -> Campaign:
        """Return a campaign of experiments as they are now. Raises `LabError` for an unknown one."""
        return cls(spec, tuple(find_experiment(name).source for name in spec.experiments))


@dataclass(frozen=True, slots=True)
class CampaignRow(Draw):
    """A flight and its result; equal for the same flight on every worker."""

    outcome: str  # completed, lost or error
    error: str  # why it was lost or failed
    passed: bool
    hash: str  # empty: it did not end
    metrics: Mapping[str, float]  # empty: it was not flown
    holds: Mapping[str, bool]  # by limit


class TooLongError(Exception):
    """A flight goes beyond the campaign's limits."""


def fly_flight(campaign: Campaign, index: int) -> CampaignRow:
    """Fly flight `index`. Raises `LabError` when there is no room on the disk, or an experiment's file has changed."""
    drawn = draw(campaign.spec, index)
    which = campaign.spec.experiments.index(drawn.experiment)
    try:
        request = request_of(campaign.spec, drawn)
    except LabError as error:
        return failed(drawn, str(error))
    if request.experiment.source != campaign.sources[which]:
        raise LabError(f"experiment {drawn.experiment}: its file has changed since the campaign began")
    try:
        result = fly_within(request, campaign.spec)
    except OSError as error:
        if error.errno in FULL:
            raise LabError(f"flight {index}: {tempfile.gettempdir()}: {error.strerror}") from None
        return failed(drawn, blame(error))
    except Exception as error:
        return failed(drawn, f"{type(error).__name__}: {blame(error)}")
    if result.outcome == "error" and any(os.strerror(number) in (result.cause or "") for number in FULL):
        raise LabError(f"flight {index}: {tempfile.gettempdir()}: {result.cause}")
    return row_of(drawn, result)


def fly_within(request: Request, spec: Spec) -> Result:
    """Fly within the campaign's limits without leaving files. Real time counts from the end of loading and compiling."""
    begun: list[float] = []

    def watch(now_us: int, flight: Flight) -> None:
        if now_us >= LOADED_US and not begun:
            begun.append(time.monotonic())
        if now_us > spec.limits.simulated_s * 1e6:
            raise TooLongError(f"limits.simulated_s = {spec.limits.simulated_s:g}: the flight had not ended")
        if begun and time.monotonic() - begun[0] > spec.limits.wall_s:
            raise TooLongError(f"limits.wall_s = {spec.limits.wall_s:g}: the flight had not ended")

    with tempfile.TemporaryDirectory(prefix="floaty-") as parent:
        return fly(request, Path(parent) / "run", progress=watch, flight_of=_unlogged)


def _unlogged(request: Request, _telemetry: Path | None, stack: ExitStack) -> Flight:
    """Return the flight without the station's log, which nobody would read: an eighth of its time."""
    return in_lockstep(request, None, stack)


def row_of(drawn: Draw, result: Result) -> CampaignRow:
    """Return the row of a flight that was flown."""
    return CampaignRow(
        **asdict(drawn), outcome=result.outcome, error=result.cause or "", passed=result.passed,
        hash=result.hash if result.outcome != "error" else "", metrics=dict(result.metrics),
        holds={verdict.metric: verdict.holds for verdict in result.verdicts},
    )  # fmt: skip


def failed(drawn: Draw, error: str) -> CampaignRow:
    """Return the row of a flight that did not end by itself."""
    return CampaignRow(
        **asdict(drawn), outcome="error", error=error, passed=False, hash="", metrics={}, holds={}
    )
