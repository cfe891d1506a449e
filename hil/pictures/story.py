"""The story of a flight, which its report begins with: what happened when, in seconds from the release."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.wire.supervisor import State
from hil.laboratory.faults import spans_of
from hil.laboratory.metrics import BOX, NEAR, attitude_error, column, free_flight, position_error
from hil.laboratory.recorder import release_of
from hil.laboratory.result import Result
from hil.pictures.panels import saturated


@dataclass(frozen=True, slots=True)
class Moment:
    """What happened at an instant."""

    t_s: float  # from the release
    text: str


def story_of(log: pa.Table, result: Result) -> list[Moment]:
    """Return release, faults, the first limit passed, the first saturated flap, failsafes and loss in the order of time."""
    release_us = release_of(log.schema.metadata)
    free = free_flight(log)
    if free.num_rows == 0:
        return []
    seconds = 1e-6 * (column(free, "t") - release_us)
    moments = [Moment(0.0, "released")]
    for span in spans_of(log.schema.metadata):
        begin_s, end_s = (1e-6 * (us - release_us) for us in (span.begin_us, span.end_us))
        moments += [Moment(begin_s, f"fault {span.fault} begins")] if begin_s <= seconds[-1] else []
        moments += [Moment(end_s, f"fault {span.fault} ends")] if end_s <= seconds[-1] else []
    passed = [(_first(wrong), name) for name, wrong in _passed(free, result)]
    if passed:
        row, name = min(passed)
        moments.append(Moment(seconds[row], f"first limit passed: {name}"))
    for flap, at_limit in saturated(free):
        moments.append(Moment(seconds[_first(at_limit)], f"flap {flap} saturates for the first time"))
    failsafe = column(free, "supervisor.state") == State.FAILSAFE
    for row in np.flatnonzero(np.diff(failsafe, prepend=False)).tolist():
        moments.append(Moment(seconds[row], f"failsafe {'begins' if failsafe[row] else 'ends'}"))
    if result.outcome == "lost":
        moments.append(Moment(seconds[-1], f"lost: {result.cause}"))
    return sorted(moments, key=lambda moment: moment.t_s)


def _first(wrong: NDArray[np.bool_]) -> int:
    return int(np.argmax(wrong))


def _passed(flight: pa.Table, result: Result) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield the limits that failed and have an instant at which they were passed, and the rows beyond them."""
    error = np.abs(position_error(flight))
    beyond: Mapping[str, tuple[NDArray[np.float64], float | None]] = {
        **{f"max_{axis}": (error[:, index], None) for index, axis in enumerate("xyz")},
        **{f"within_6cm_{axis}": (error[:, index], NEAR) for index, axis in enumerate("xyz")},
        "in_box": (error.max(axis=1), BOX),
        "attitude_max": (np.abs(attitude_error(flight)).max(axis=1), None),
    }
    for verdict in result.verdicts:
        if not verdict.holds and verdict.metric in beyond:
            values, bound = beyond[verdict.metric]
            wrong = values > (verdict.bound if bound is None else bound)
            if wrong.any():
                yield verdict.metric, wrong
