"""The timeline of a flight, at the beginning of its report: failures and events, in seconds from the release; and close-ups
around each fault, around the first exceeded limit, and in the last seconds before a loss, with sentences on the robot,
the board's estimate, its poses and its flaps, which state only recorded facts.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.wire.supervisor import State
from hil.laboratory import metrics
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.faults import Span, spans_of
from hil.laboratory.files.recorder import release_of, stored_in
from hil.laboratory.files.result import Result
from hil.pictures import curves
from hil.pictures.curves import Curves, since_release
from hil.pictures.figures import lanes_of_states, without_a_pose
from hil.pictures.pages import PageFigure, embedded
from hil.pictures.panels import Interval, Marks, Panel, Plot, Series, panel, saturated

FAILSAFE = "supervisor: failsafe, "  # begins a line of the board; its cause follows
MEANING = {
    "silence": "silence, the board has fused no pose for too long",
    "imu stale": "the gyro delivers nothing new",
}
ROW_S = 0.02  # a line of the board and the row of its state are no farther apart


@dataclass(frozen=True, slots=True)
class Moment:
    """What happened at an instant."""

    t_s: float  # from the release
    text: str


def story_of(log: pa.Table, result: Result, events: Iterable[Mapping[str, Any]] = ()) -> list[Moment]:
    """Return release, faults, the first limit passed and the end of that, the first command at its limit, failsafes and
    loss, in order; `events` are those of the run, which have the causes of failsafes.
    """
    release_us, events = release_of(log.schema.metadata), list(events)
    free = metrics.free_flight(log)
    if free.num_rows == 0:
        return []
    seconds = 1e-6 * (metrics.column(free, "t") - release_us)
    moments = [Moment(0.0, "released")]
    for span in spans_of(log.schema.metadata):
        turns = ((span.begin_s, "begins"), (span.end_s, "ends"))
        moments += [Moment(at_s, f"fault {span.fault} {turn}") for at_s, turn in turns if at_s <= seconds[-1]]
    passed = [(_first(wrong), name) for name, wrong in _passed(free, result)]
    if passed:
        row, name = min(passed)
        moments += [Moment(seconds[row], f"first limit passed: {name}"), *_away(free)]
    first: dict[int, list[str]] = {}
    for name, at_limit in saturated(free):
        first.setdefault(_first(at_limit), []).append(name)
    for row, names in first.items():
        verb = "saturate" if len(names) > 1 else "saturates"
        moments.append(Moment(seconds[row], f"{', '.join(names)} {verb} for the first time"))
    failsafe = metrics.column(free, "supervisor.state") == State.FAILSAFE
    causes = {1e-6 * (one["t_us"] - release_us): one["text"].partition(FAILSAFE)[2] for one in events}
    for row in np.flatnonzero(np.diff(failsafe, prepend=False)).tolist():
        why = [cause for at_s, cause in causes.items() if cause and abs(at_s - seconds[row]) < ROW_S]
        text = f"failsafe begins{''.join(f': {MEANING.get(one, one)}' for one in why)}"
        moments.append(Moment(seconds[row], text if failsafe[row] else "failsafe ends"))
    for one in events:
        if one["text"] in result.failures:
            moments.append(Moment(1e-6 * (one["t_us"] - release_us), one["text"]))
    if result.outcome == "lost":
        moments.append(Moment(seconds[-1], f"lost: {result.cause}"))
    return sorted(moments, key=lambda moment: moment.t_s)


def _away(flight: pa.Table) -> Iterator[Moment]:
    """Yield when the robot was farthest from its goal, and since when it stayed near it to the end."""
    seconds, error = since_release(flight), np.abs(metrics.position_error(flight))
    if not np.isfinite(error).all():
        return
    row, axis = np.unravel_index(np.argmax(error), error.shape)
    yield Moment(seconds[row], f"farthest from the goal: {100 * error[row, axis]:.1f} cm ({'xyz'[axis]})")
    far = np.flatnonzero((error > metrics.NEAR).any(axis=1))
    if len(far) and far[-1] + 1 < len(seconds):
        yield Moment(
            seconds[far[-1] + 1], f"within {100 * metrics.NEAR:.0f} cm of the goal from here to the end"
        )


def _first(wrong: NDArray[np.bool_]) -> int:
    return int(np.argmax(wrong))


def _passed(flight: pa.Table, result: Result) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield the limits that failed and have an instant at which they were passed, and the rows beyond them."""
    times, held = since_release(flight), metrics.held_rows(flight)
    error = np.where(held[:, None], np.abs(metrics.position_error(flight)), 0.0)
    open_loop = metrics.column(flight, "supervisor.state") != State.FLYING
    beyond: Mapping[str, tuple[NDArray[np.float64], float | None]] = {
        **{f"max_{axis}": (error[:, index], None) for index, axis in enumerate("xyz")},
        **{f"within_6cm_{axis}": (error[:, index], metrics.NEAR) for index, axis in enumerate("xyz")},
        "in_box": (error.max(axis=1), metrics.BOX),
        "attitude_max": (np.abs(metrics.attitude_error(flight)).max(axis=1), None),
        "uncontrolled": (np.cumsum(open_loop * np.diff(times, prepend=times[0])), None),
    }
    for verdict in result.verdicts:
        if not verdict.holds and verdict.metric in beyond:
            values, bound = beyond[verdict.metric]
            wrong = values > (verdict.bound if bound is None else bound)
            if wrong.any():
                yield verdict.metric, wrong


@dataclass(frozen=True, slots=True)
class FailedLimit:
    text: str  # the verdict
    at_s: float | None  # first passed; None: it has no such instant
    cause: str  # the fault that came before; empty where the instant is unknown
    meaning: str  # of the metric; empty where the name says it


RECENT_S = 3.0  # a fault that ended longer ago is not named as the cause


def failures_of(log: pa.Table, result: Result) -> list[FailedLimit]:
    """Return the limits that failed, those with an instant first and in the order of time."""
    free = metrics.free_flight(log)
    times = since_release(free)
    passed = (
        {name: float(times[_first(wrong)]) for name, wrong in _passed(free, result)} if len(times) else {}
    )
    if result.outcome == "lost" and len(times):
        passed["lost"] = float(times[-1])
    known = {**metrics.METRICS, **result.own_metrics}
    found = [
        FailedLimit(
            str(one),
            at_s := passed.get(one.metric),
            "" if at_s is None else _before(log, at_s),
            known[one.metric].meaning if one.metric in known and one.metric != "lost" else "",
        )
        for one in result.failed
    ]
    return sorted(found, key=lambda failure: math.inf if failure.at_s is None else failure.at_s)


def _before(log: pa.Table, at_s: float) -> str:
    """Return which fault was in force, or had ended shortly before an instant: the one that began last."""
    recent = [
        (span.begin_s, str(span.fault), _meaning(span))
        for span in spans_of(log.schema.metadata)
        if span.begin_s <= at_s <= span.end_s + RECENT_S
    ]
    if not recent:
        return "no fault was in force"
    begin_s, fault, meaning = max(recent)
    return f"{at_s - begin_s:.2f} s after the begin of {fault} ({meaning})"


def _meaning(span: Span) -> str:
    """Return what a fault is, with its size where that has a unit."""
    kind = KINDS[span.fault.kind]
    return f"{span.fault.size:g} {kind.unit}: {kind.meaning}" if kind.sized and kind.unit else kind.meaning


BEFORE_S, AFTER_S = 0.5, 1.0  # of a fault
FAULT_S = 2.0  # shown of the beginning of a longer fault
LAST_S = 3.0  # before a loss


@dataclass(frozen=True, slots=True)
class CloseUp:
    """A close-up, with its begin and end [s]."""

    figure: PageFigure
    at_s: float
    begin_s: float
    end_s: float
    evidence: tuple[str, ...]


def close_ups(log: pa.Table, marks: Marks, passed_s: float | None = None) -> list[CloseUp]:
    """Return a figure for each instant at which faults begin, the loss, and the first limit passed, unless one shows it."""
    times = since_release(log)
    shown: list[CloseUp] = []
    for title, at_s, begin_s, end_s in _windows(marks, passed_s):
        rows = metrics.rows_where(log, (times >= begin_s) & (times <= end_s))
        if rows.num_rows > 1:
            plot = embedded(_plot(rows, (begin_s, end_s)))
            figure = PageFigure(f"close-up-{len(shown) + 1}", title, "", plot=plot, alone=True, marks=marks)
            of_it = tuple(evidence(rows.filter(since_release(rows) >= min(at_s, begin_s + BEFORE_S))))
            shown.append(CloseUp(figure, at_s, begin_s, end_s, of_it))
    return shown


def _windows(marks: Marks, passed_s: float | None) -> list[tuple[str, float, float, float]]:
    """Return title, instant, begin and end [s]."""
    faults = [interval for interval in marks.intervals if interval.kind == "fault"]
    windows = []
    for begin_s, together in groupby(sorted(faults, key=_begin), key=_begin):
        intervals = list(together)
        end_s = min(max(interval.end_s for interval in intervals), begin_s + FAULT_S) + AFTER_S
        windows.append(
            (", ".join(interval.text for interval in intervals), begin_s, begin_s - BEFORE_S, end_s)
        )
    further = [
        (f"Loss: {loss.text}", loss.t_s, loss.t_s - LAST_S, loss.t_s + BEFORE_S)
        for loss in marks.instants
        if loss.kind == "lost"
    ]
    if passed_s is not None:
        further.append(("First limit passed", passed_s, passed_s - FAULT_S, passed_s + AFTER_S))
    for window in further:
        if not any(begin_s <= window[1] <= end_s for _, _, begin_s, end_s in windows):
            windows.append(window)
    return windows


def _begin(interval: Interval) -> float:
    return interval.begin_s


def _plot(rows: pa.Table, window_s: tuple[float, float]) -> Plot:
    """Draw the truth with what the board believed and commanded."""
    moving = [
        panel(plot, rows, name) if command is None else _with(plot, command, "command", rows, name)
        for name, plot in curves.actuators(rows)
        for command in [curves.command_of(plot, rows)]
    ]
    return Plot(
        (
            _with(curves.POSITION, curves.POSITION_ESTIMATE, "estimate", rows, "position error"),
            _with(curves.ATTITUDE, curves.ATTITUDE_ESTIMATE, "estimate", rows, "attitude error"),
            *moving,
            *without_a_pose(rows),
            lanes_of_states(rows),
        ),
        window_s,
    )


def _with(curve: Curves, other: Curves, name: str, rows: pa.Table, label: str) -> Panel:
    """Return a panel of curves, with others dashed in the same colours; the first of those names them."""
    if not other.fits(rows.column_names):  # of an imported log
        return panel(curve, rows, label)
    times, values = since_release(rows), other.read(rows)
    dashed = (
        Series(name if index == 0 else "", colour, times, values[:, index], dashed=True)
        for index, colour in enumerate(curve.colours)
    )
    drawn = panel(curve, rows, label)
    return replace(drawn, series=(*drawn.series, *dashed))


GAP_MS = 50.0  # without a fused pose: worth a sentence
FAR_DEG = 10.0  # of a flap from its command, for longer than a servo needs
FAR_S = 0.1
FAR_MN = 7.0  # of a rotor's mean thrust from its command: a tenth of that in a hover
OUTWARDS = np.array([1.0, -1.0, 1.0, -1.0])  # the sign of an opening flap's angle


def evidence(rows: pa.Table) -> list[str]:
    """Return sentences about rows of a log; none about fewer than two."""
    if rows.num_rows < 2:
        return []
    return [*_robot(rows), *_belief(rows), *_poses(rows), *_limits(rows), *_flaps(rows), *_rotors(rows)]


def _robot(rows: pa.Table) -> Iterator[str]:
    seen = "In truth" if not metrics.is_real(rows) else "By the cameras"
    far, turned = _largest(curves.POSITION, rows), _largest(curves.ATTITUDE, rows)
    if far and turned:
        yield f"{seen} the robot was up to {far} away from its goal, and {turned} from its attitude{_speed(rows)}."


def _speed(rows: pa.Table) -> str:
    """Return the highest speed with its instant; empty where it is unknown."""
    if metrics.is_real(rows):
        return ""
    speed = np.linalg.norm(metrics.column(rows, "truth.vx", "truth.vy", "truth.vz"), axis=1)
    row = int(np.argmax(speed))
    return f"; it moved at up to {speed[row]:.2f} m/s (at {since_release(rows)[row]:.2f} s)"


def _belief(rows: pa.Table) -> Iterator[str]:
    off, tilted = _largest(curves.POSITION_MISS, rows), _largest(curves.ATTITUDE_MISS, rows)
    if off and tilted:
        yield f"The board's estimate was up to {off} and {tilted} wrong."
    begins, names = curves.changes(rows, curves.SUPERVISOR)
    since = begins * 1e-6 + since_release(rows)[0] - metrics.column(rows, "t")[0] * 1e-6
    if len(names) == 1:
        yield f"Its supervisor: {names[0]} all the time."
    else:
        yield f"Its supervisor: {', '.join(f'{n} from {t:.2f} s' for n, t in zip(names, since, strict=True))}."


def _poses(rows: pa.Table) -> Iterator[str]:
    if curves.SINCE_FUSION.needs in rows.column_names:
        gaps = curves.since_fusion(rows)[:, 0]
        if np.isfinite(gaps).any() and (longest := float(np.nanmax(gaps))) > GAP_MS:
            end_s = since_release(rows)[np.nanargmax(gaps)]
            yield f"It fused no pose for {longest:.0f} ms, from {end_s - 1e-3 * longest:.2f} s on."
    for text, (_, names) in curves.MARK_KINDS.items():
        known = [name for name in names if name in rows.column_names]
        count = sum(float(np.ptp(metrics.column(rows, name))) for name in known)
        if count > 0:
            yield f"{text.capitalize()}: {'once' if count == 1 else f'{count:.0f} times'}."


def _limits(rows: pa.Table) -> Iterator[str]:
    times = since_release(rows)
    shown = [
        f"{name} for {at_limit.mean() * (times[-1] - times[0]):.2f} s, from {times[_first(at_limit)]:.2f} s on"
        for name, at_limit in saturated(rows)
    ]
    if shown:
        yield f"Commands at their limits: {'; '.join(shown)}."


def _flaps(rows: pa.Table) -> Iterator[str]:
    hover = stored_in(rows.schema.metadata, "config").get("allocation", {}).get("hover_angle")
    if hover is None or not {"truth.flap_1", "control.flap_1"} <= {*rows.column_names}:
        return
    angles, times = curves.FLAPS.read(rows), since_release(rows)
    away = np.abs(angles - curves.FLAPS_COMMAND.read(rows))
    deviations = metrics.column(rows, *(f"estimate.flap_{flap}" for flap in (1, 2, 3, 4)))
    believed = np.degrees(OUTWARDS * hover + deviations)
    wrong = np.abs(angles - believed)
    # a flap that only lags behind its command is known to the board
    lasts_s = ((away > FAR_DEG) & (wrong > FAR_DEG)).mean(axis=0) * (times[-1] - times[0])
    for flap in np.flatnonzero(lasts_s > FAR_S).tolist():
        row = int(np.argmax(wrong[:, flap]))
        yield (
            f"Flap {flap + 1} was up to {away[:, flap].max():.0f} deg away from its command: at {times[row]:.2f} s it "
            f"was at {angles[row, flap]:z.0f} deg, and the board believed {believed[row, flap]:z.0f} deg."
        )


def _rotors(rows: pa.Table) -> Iterator[str]:
    if curves.command_of(curves.ROTORS, rows) is None:
        return
    given, wanted = curves.ROTORS.read(rows).mean(axis=0), curves.ROTORS_COMMAND.read(rows).mean(axis=0)
    apart = given - wanted
    for index in np.flatnonzero(
        np.abs(apart - np.median(apart)) > FAR_MN
    ).tolist():  # the ground helps them all
        name = curves.ROTORS.names[index]
        yield f"{name} gave {given[index]:.0f} mN on average where {wanted[index]:.0f} mN were commanded."


def _largest(curve: Curves, rows: pa.Table) -> str:
    """Return the largest value with its axis and instant; empty where nothing is known."""
    values: NDArray[np.float64] = np.abs(curve.read(rows))
    if not np.isfinite(values).any():
        return ""
    row, axis = np.unravel_index(np.nanargmax(values), values.shape)
    at_s = since_release(rows)[row]
    return f"{values[row, axis]:.1f} {curve.unit} ({curve.names[axis]}, at {at_s:.2f} s)"
