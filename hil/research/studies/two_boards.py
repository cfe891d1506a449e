"""Explains why flights of two boards with the same seed differ in bits: causes, computed from the two logs.

The two boards are in one laboratory, whose truth and sensors are equal until the first servo count differs. The causes
are on the boards: the time of power-on, the samples at rest for the gyro's zero, the estimator's phase in its ten
milliseconds, other radio packets, and the length of the board's microsecond (`clock.board_us`, only from images).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.wire.supervisor import State
from hil.errors import LabError
from hil.laboratory.files.result import RESULT
from hil.laboratory.metrics import column, free_flight, position_error
from hil.laboratory.schedule import load_schedule, runs
from hil.pictures.compare import FlownRun, load_flown
from hil.pictures.curves import since_release

COUNTS = tuple(f"motor.m{servo}" for servo in range(1, 5))
GYRO, RATES = ("imu.gx", "imu.gy", "imu.gz"), ("estimate.p", "estimate.q", "estimate.r")
STEP_US = 10_000  # of the estimator
ESTIMATING = ("KALMAN", "STABILIZER", "STABILIZE")  # its possible tasks: the first that runs for so long
LONG_US = 200  # longer than any step without an estimate
SAME_ZERO = 1e-6  # [rad/s] a count over 512 samples is 2e-6
CLOCK = "clock.board_us"
JUMP_US = 1000  # possible error of a clock read during a carry


@dataclass(frozen=True, slots=True)
class FirstCount:
    """The first row with a different servo count; `why` is its visible cause."""

    row: int
    t_s: float  # from the release
    servo: str
    counts: tuple[int, int]
    why: str

    def __str__(self) -> str:
        first, second = self.counts
        place = f"row {self.row}, {self.t_s:.3f} s from the release, {self.servo}"
        return f"first servo count: {place}: {first} | {second}: {self.why}"


@dataclass(frozen=True, slots=True)
class TwoBoards:
    """The differences of two boards in one laboratory; `causes` are sentences, each with its figures."""

    first: FirstCount | None  # None: no servo count differs
    causes: tuple[str, ...]


def comparable(a: FlownRun, b: FlownRun) -> bool:
    """Return whether two runs differ only in their boards, by their requests."""
    asked = [{**one.result.request.parts(), "board": "", "duration": ""} for one in (a, b)]
    boards = {one.result.request.bench.board for one in (a, b)}
    return asked[0] == asked[1] and not a.result.request.is_real and len(boards) == 2


def two_boards(a: FlownRun, b: FlownRun) -> TwoBoards:
    """Compare two runs that are `comparable`, over the rows that both have."""
    rows = min(a.log.num_rows, b.log.num_rows)
    logs = a.log.slice(0, rows), b.log.slice(0, rows)
    differing = np.array([column(logs[0], name) != column(logs[1], name) for name in COUNTS])
    if not differing.any():
        return TwoBoards(None, ())
    row = int(np.argmax(differing.any(axis=0)))
    servo = COUNTS[int(np.argmax(differing[:, row]))]
    found = [
        ("boot time", _boot(logs)),
        ("sensor start", _gyro_zero(logs)),
        ("task phases", _phases(a, b)),
        ("radio", _radio(logs)),
        ("long microsecond", _clocks(logs)),
    ]
    causes = tuple(f"{name}: {text}" for name, text in found if text)
    counts = tuple(int(column(log, servo)[row]) for log in logs)
    flying = [column(log, "supervisor.state")[row] == State.FLYING for log in logs]
    # A servo moves with its loop; while both loops are closed, every cause applies, the earliest first.
    later = [name for name, text in found[1:] if text]
    why = "boot time" if flying[0] != flying[1] else (later or ["none of the known causes"])[0]
    first = FirstCount(row, float(since_release(logs[0])[row]), servo, (counts[0], counts[1]), why)
    return TwoBoards(first, causes)


def _boot(logs: Sequence[pa.Table]) -> str:
    """Describe when each board was powered, and when it closed its loop."""
    ran_s = [
        1e-6 * sum(column(log, name)[0] for name in log.column_names if name.startswith("cpu."))
        for log in logs
    ]
    states = [column(log, "supervisor.state") for log in logs]
    if any(not (state == State.FLYING).any() for state in states):
        return ""
    rows = [int(np.argmax(state == State.FLYING)) for state in states]
    if rows[0] == rows[1]:
        return ""
    closed_s = [since_release(log)[row] for log, row in zip(logs, rows, strict=True)]
    return (
        f"the loops are closed at {closed_s[0]:.3f} | {closed_s[1]:.3f} s from the release; the boards had run for "
        f"{ran_s[0]:.3f} | {ran_s[1]:.3f} s when the record began"
    )


def _gyro_zero(logs: Sequence[pa.Table]) -> str:
    """Describe the difference of the gyros' zeros, by the estimated rates of equal samples, with both loops closed."""
    same = np.logical_and.reduce([column(logs[0], name) == column(logs[1], name) for name in GYRO])
    flying = np.logical_and.reduce([column(log, "supervisor.state") == State.FLYING for log in logs])
    until = len(same) if same.all() else int(np.argmax(~same))
    at = np.flatnonzero(flying[:until])
    if not len(at):
        return ""
    rates = [float((column(logs[1], name)[at] - column(logs[0], name)[at]).mean()) for name in RATES]
    if max(map(abs, rates)) < SAME_ZERO:
        return ""
    shown = " ".join(f"{1000 * rate:+.3f}" for rate in rates)
    return f"with gyro zeros of other samples at rest, the second estimates {shown} mrad/s (p q r) above the first"


def _phases(a: FlownRun, b: FlownRun) -> str:
    """Describe each estimator's phase in its ten milliseconds, and the age of its poses."""
    begins = [_phase_us(run.result.folder) for run in (a, b)]
    ages = [_pose_age_us(run.log) for run in (a, b)]
    if begins == [None, None] or begins[0] == begins[1] or None in begins or not all(map(np.isfinite, ages)):
        return ""
    return (
        f"the estimator begins {begins[0]} | {begins[1]} us into its ten ms, and takes poses "
        f"{ages[0] / 1000:.2f} | {ages[1] / 1000:.2f} ms old"
    )


def _phase_us(folder: Path) -> int | None:
    found = [run for run in runs(load_schedule(folder)) if run.end_us - run.start_us >= LONG_US]
    for task in ESTIMATING:
        starts = [run.start_us % STEP_US for run in found if run.task == task]
        if starts:
            return int(np.median(starts))
    return None


def _pose_age_us(log: pa.Table) -> float:
    ages = column(log, "estimator.pose_age_us")[column(log, "estimator.fused") > 0]
    return float(ages.mean()) if len(ages) else float("nan")


def _radio(logs: Sequence[pa.Table]) -> str:
    """Describe the uplink latency of packets, which depends on the downlink."""
    if any("link.up_latency_sum" not in log.column_names for log in logs):
        return ""
    up, sums, down = (
        [column(log, f"link.{name}")[-1] for log in logs]
        for name in ("up_delivered", "up_latency_sum", "down_delivered")
    )
    if down[0] == down[1] or not all(up):
        return ""
    means = [total / count / 1000 for total, count in zip(sums, up, strict=True)]
    return f"packets take {means[0]:.2f} | {means[1]:.2f} ms up, beside {down[0]:.0f} | {down[1]:.0f} that come down"


def _clocks(logs: Sequence[pa.Table]) -> str:
    """Describe the length of the boards' microseconds; a board without a clock uses the laboratory's."""
    lengths = [_microsecond(log) for log in logs]
    if lengths[0] == lengths[1]:
        return ""
    return f"a microsecond of the boards' clocks lasts {lengths[0]:.4f} | {lengths[1]:.4f} us"


def _microsecond(log: pa.Table) -> float:
    if CLOCK not in log.column_names:
        return 1.0
    steps: list[NDArray[np.float64]] = [np.diff(column(log, name)) for name in ("t", CLOCK)]
    usual = np.abs(steps[1] - np.median(steps[1])) < JUMP_US
    return float(steps[0][usual].sum() / steps[1][usual].sum())


@dataclass(frozen=True, slots=True)
class Seed:
    """One seed, flown by two boards."""

    seed: int
    first: FirstCount | None
    rms_m: tuple[NDArray[np.float64], NDArray[np.float64]]  # (3,) each, of the position errors
    apart_m: float  # largest distance of the bodies
    fused: tuple[int, int]  # poses


def seeds_of(first: Path, second: Path) -> list[Seed]:
    """Return the seeds in two folders of runs, flown by another board in each. Raises `LabError` for none."""
    seeds = []
    for folder in first.iterdir():
        other = second / folder.name
        if (folder / RESULT).is_file() and (other / RESULT).is_file():
            a, b = load_flown(folder), load_flown(other)
            if comparable(a, b):
                seeds.append(_seed(a, b))
    if not seeds:
        raise LabError(
            f"{first}, {second}: neither two runs nor folders with runs of the same names that differ in their boards only"
        )
    return sorted(seeds, key=lambda one: one.seed)


def _seed(a: FlownRun, b: FlownRun) -> Seed:
    flights = [free_flight(run.log) for run in (a, b)]
    rows = min(flight.num_rows for flight in flights)
    flights = [flight.slice(0, rows) for flight in flights]
    places = [np.array([column(flight, f"truth.{axis}") for axis in "xyz"]) for flight in flights]
    rms = [np.sqrt((position_error(flight) ** 2).mean(axis=0)) for flight in flights]
    fused = [int(column(flight, "estimator.fused")[-1]) for flight in flights]
    apart = np.sqrt(((places[0] - places[1]) ** 2).sum(axis=0))
    return Seed(
        a.result.request.seed,
        two_boards(a, b).first,
        (rms[0], rms[1]),
        float(apart.max(initial=0.0)),
        (fused[0], fused[1]),
    )
