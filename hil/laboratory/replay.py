"""Replays a simulated flight through another estimator and law, open loop.

The flight is flown again by its request, bit for bit. Beside its core a second one with other parameters, or own logic,
gets every input of the first, in the same calls: gyro samples, poses, and the commands that really moved the flaps. What it
estimates and would command is logged as `replay.*`.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.config import parameters_of
from firmware_py.core_runner import CoreBlocks, CoreRunner, default_runner
from firmware_py.logic.loading import load_logic
from firmware_py.signals import COUNTERS, REFUSED
from hil.board.board_firmware import PythonBoard
from hil.board.cores.boards import PYTHON, C
from hil.config import LabConfig
from hil.errors import LabError
from hil.laboratory.channels import ESTIMATE, FLAPS, INPUTS, quantity
from hil.laboratory.files.recorder import load_log
from hil.laboratory.files.result import Result
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.metrics import attitude_error, column, free_flight, position_error
from hil.laboratory.request import Request
from hil.laboratory.run import fly

GROUP = "replay"
WRAP_US = 1 << 32  # of the board's time
COUNTED = COUNTERS[:-2]  # of its counters, the rest are values

Values = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Misses:
    """How an estimate differed from the truth after the release, and the poses that it used."""

    position: float  # [m] rms over the axes
    position_max: float
    attitude: float  # [rad]
    attitude_max: float
    fused: int
    refused: int


class Shadowed:
    """A `CoreRunner` that flies, with a second core beside it; `rows` has what that one knew after each control tick."""

    def __init__(self, blocks: CoreBlocks, replayed: LabConfig) -> None:
        self._flying, self._blocks = default_runner(blocks), blocks
        self._shadow = CoreBlocks(parameters_of(replayed), default_runner, load_logic(replayed.logic))
        self.rows: list[tuple[int, Values, Values, tuple[int, ...]]] = []

    def call(self, name: str) -> int:
        """Execute an entry point on both; the estimator of the second one gets the commands that flew."""
        shadow = self._shadow
        shadow.data.memory[:] = self._blocks.data.memory
        if self._blocks.sensed:
            shadow.sense(self._blocks.sensed)
        if name == "estimate":
            own = shadow.control.memory.copy()
            shadow.control.memory[:] = self._blocks.control.memory
            shadow.run.call(name)
            shadow.control.memory[:] = own
        else:
            shadow.run.call(name)
        if name == "control":
            estimator, u = shadow.estimator.memory, shadow.control.memory["u"][0]
            now_us = int(self._blocks.data.fields.now_us) % WRAP_US
            counts = tuple(int(estimator[one][0]) for one in COUNTED)
            self.rows.append((now_us, estimator["now"][0].copy(), u.copy(), counts))
        return self._flying.call(name)


def replay(request: Request, digest: str, replayed: LabConfig, folder: Path) -> Result:
    """Fly a request again, with the core of another configuration beside it, into a run folder.

    Raises `LabError` for a flight that is not in lockstep by the Python board, and when it differs from the one with the
    hash `digest`.
    """
    bench = request.bench
    if bench.board not in (C, PYTHON) or not bench.in_lockstep:
        raise LabError(
            f"--board {bench.board} --link {bench.link}: only flights in lockstep on {C} or {PYTHON} are replayed"
        )
    made: list[Shadowed] = []

    def shadowed(blocks: CoreBlocks) -> CoreRunner:
        made.append(Shadowed(blocks, replayed))
        return made[-1]

    def flight_of(request: Request, telemetry: Path | None, _stack: object) -> Flight:
        return lockstep_flight(request, telemetry, PythonBoard(shadowed), correct=partial(_with_replay, made))

    result = fly(request, folder, flight_of=flight_of)
    if result.hash != digest:
        now, then = result.hash[:16], digest[:16]
        raise LabError(
            f"{folder}: flown again, its hash is {now}, not {then}: another version flew it, or its files changed"
        )
    return result


def _with_replay(made: list[Shadowed], log: pa.Table) -> pa.Table:
    """Return a log with what the second core knew at each row; NaN before its first tick. A boot makes a new core."""
    rows = [row for shadowed in made for row in shadowed.rows]
    if not rows:  # interrupted before
        return log
    times = np.array([row[0] for row in rows], np.int64)
    times += WRAP_US * np.cumsum(np.diff(times, prepend=times[:1]) < -WRAP_US // 2)
    newest = np.searchsorted(times, column(log, "t"), "right") - 1
    counters = quantity(GROUP, " ".join(COUNTED))
    quantities = (*ESTIMATE, quantity("estimate", FLAPS, "rad", "B"), INPUTS, counters)
    values = np.array([np.concatenate(row[1:]) for row in rows], np.float64)
    shown = np.where(newest[:, None] >= 0, values[np.maximum(newest, 0)], np.nan)
    named = [(name, one) for one in quantities for name in one.names]
    for (name, one), series in zip(named, shown.T, strict=True):
        about = {"unit": one.unit, "frame": one.frame}
        log = log.append_column(
            pa.field(f"{GROUP}.{name.split('.')[1]}", pa.float64(), metadata=about), [series]
        )
    return log


def misses(folder: Path) -> tuple[Misses, Misses]:
    """Return how the flown and the replayed estimate of a run missed the truth."""
    flight = free_flight(load_log(folder))
    return _misses(flight, "estimate", "estimator"), _misses(flight, GROUP, GROUP)


def _misses(flight: pa.Table, estimate: str, counters: str) -> Misses:
    place = column(flight, *(f"{estimate}.{axis}" for axis in "xyz")) - position_error(flight)
    turn = column(flight, *(f"{estimate}.{name}" for name in ("roll", "pitch", "yaw"))) - attitude_error(
        flight
    )
    turn = (turn + np.pi) % (2.0 * np.pi) - np.pi
    fused, refused = (
        column(flight, *(f"{counters}.{name}" for name in names))
        .reshape(flight.num_rows, -1)[[0, -1]]
        .sum(axis=1)
        for names in (("fused",), REFUSED)
    )
    return Misses(
        float(np.sqrt((place**2).mean())), float(np.abs(place).max()),
        float(np.sqrt((turn**2).mean())), float(np.abs(turn).max()),
        int(fused[1] - fused[0]), int(refused[1] - refused[0]),
    )  # fmt: skip
