"""A flight's log for identification: inputs, excitation, gyro rates and poses, each with its times.

The log is the ground station's `telemetry.csv`, alone or in a run folder, of a simulated or a real flight. Times are
those of the board's clock; a pose's time comes from the ground's clock, which runs `clock_s` ahead. The remaining offset,
the telemetry's latency, is a few milliseconds and is estimated from the data (`hil.research.identify.spectra`).
"""

import csv
from dataclasses import dataclass
from math import nan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from firmware_py.wire.supervisor import State
from ground_station.telemetry_log import POSE_COLUMNS, TELEMETRY, TIME_COLUMN
from hil.config import DEFAULT_PROFILE, LabConfig, read_config
from hil.errors import LabError
from hil.laboratory.files.recorder import config_of, load_log, release_of
from hil.laboratory.files.result import read_result
from hil.world.floaty.shape import MIX, SIGNS

Array = NDArray[np.float64]
BOARD_COLUMN = "board.t [ms]"
INPUTS = tuple(f"controller.u{i} [rad]" for i in range(1, 5))
EXCITATIONS = tuple(f"excite.u{i} [rad]" for i in range(1, 5))
RATES = tuple(f"stateEstimate.{name}_rate [rad/s]" for name in ("roll", "pitch", "yaw"))
FACING = np.radians(30.0)  # a choice: largest median turn of the robot
AT_LIMIT = 0.003  # [rad] from a limit: the steps of four half floats, and one tick of two a little inside
WRAP_MS = 1 << 24  # of the board's time stamps
SHARES = (SIGNS[:, None] * MIX).T  # (4, 4) opening of each flap per input; u4 closes
EXCHANGED_MS = 1000.0  # largest step back of rows that a link exchanged; a board that boots goes back further
UNLIKE = 100.0  # ratio of two clocks that do not count in their units
TICK_MS = 10.0  # the controller runs in every tenth millisecond, on the previous millisecond's rates


@dataclass(frozen=True, slots=True)
class Record:
    """One controlled flight. Rows of `t` (N,) and of `pose_t` (M,) have different times."""

    name: str
    t: Array  # (N,) [s] board's clock, of the tick for which the rates were estimated
    u_t: Array  # (N,) [s] board's clock, of the tick that commanded the inputs
    u: Array  # (N, 4) [rad] the commanded inputs, mean of that tick and of the one before, after the flaps' limits
    excitation: Array  # (N, 4) [rad] zero where none was reported
    rates: Array  # (N, 3) [rad/s] gyro, B
    pose_t: Array  # (M,) [s] board's clock, when the cameras exposed
    pose: Array  # (M, 6) x y z [m], roll pitch yaw [rad], W
    saturated: float  # share of the rows with a flap at its limit
    lost_rows: float  # share of missing rows
    config: LabConfig  # the profile that flew: gains and limits
    simulated: bool  # its plant is known

    @property
    def flap_angle(self) -> float:
        """The mean opening of all flaps [rad], where the constants hold."""
        return float(self.config.allocation.hover_angle + np.mean(self.u.mean(axis=0) @ SHARES))

    @property
    def mean_t(self) -> Array:
        """The times (N,) [s] of the ticks whose inputs are like `u`: midway between both ticks of the mean."""
        return self.u_t - 0.5e-3 * TICK_MS

    @property
    def period_s(self) -> float:
        """The usual period of rows."""
        return float(np.median(np.diff(self.t)))


def profile_of(path: Path) -> str:
    """Return the profile of a run folder; the default one for a bare `telemetry.csv`."""
    return read_result(path).request.profile if path.is_dir() else DEFAULT_PROFILE


def load_record(path: Path, profile: str) -> Record:
    """Return the record of a run folder, or of a `telemetry.csv`, flown with `profile`. Raises `LabError`."""
    folder, file = (path, path / TELEMETRY) if path.is_dir() else (path.parent, path)
    if not file.is_file():
        raise LabError(f"{path}: no {TELEMETRY} there; identify takes run folders and telemetry.csv")
    config, simulated, release_s = (
        _flown_with(folder) if path.is_dir() else (read_config(profile), False, 0.0)
    )
    columns = _in_order(_read(file), path)
    state = columns["supervisor.state []"]
    flown = (state == State.FLYING) & np.all(
        np.isfinite([columns[name] for name in (*INPUTS, *EXCITATIONS, *RATES)]), axis=0
    )
    board_s = 1e-3 * columns[BOARD_COLUMN]
    flown &= board_s > release_s
    if np.count_nonzero(flown) < 100:
        raise LabError(
            f"{path}: {np.count_nonzero(flown)} rows of flight under control; identification needs 100 at least"
        )
    ahead_s = float(np.median(columns[TIME_COLUMN] - board_s))
    u_t, t = _ticks(board_s[flown])
    u = np.stack([columns[name][flown] for name in INPUTS], axis=1)
    limited, saturated = _limited(u, config)
    steps = np.diff(t)
    usual = float(np.median(steps))
    pose_t, pose = _poses(columns, flown, ahead_s)
    if not len(pose):
        raise LabError(f"{path}: no pose in {POSE_COLUMNS[0]!r} to {POSE_COLUMNS[-1]!r}")
    facing = float(np.median(pose[:, 5]))
    if np.cos(facing) < np.cos(FACING):
        raise LabError(
            f"{path}: it looks along {np.degrees(facing):.0f} deg; expected within {np.degrees(FACING):.0f} deg of 0, "
            "because x and y of the world count as those of the body"
        )
    excitation = np.stack([columns[name][flown] for name in EXCITATIONS], axis=1)
    rates = np.stack([columns[name][flown] for name in RATES], axis=1)
    return Record(
        str(path), t, u_t, limited, excitation, rates, pose_t, pose, saturated,
        1.0 - len(t) / (1.0 + (t[-1] - t[0]) / usual), config, simulated,
    )  # fmt: skip


def _ticks(sampled_s: Array) -> tuple[Array, Array]:
    """Return the ticks of the inputs and of the rates in rows sampled at these times.

    A row sampled in the last millisecond of a tick has the next tick's rates and this tick's inputs.
    """
    inputs_s = np.floor(np.round(1e3 * sampled_s) / TICK_MS) * TICK_MS * 1e-3
    last = np.round(1e3 * (sampled_s - inputs_s)) == TICK_MS - 1.0
    return inputs_s, inputs_s + 1e-3 * TICK_MS * last


def _read(file: Path) -> dict[str, Array]:
    """Return the columns by their titles; a missing excitation is zero, an empty cell NaN."""
    try:
        with file.open(encoding="utf-8-sig", newline="") as lines:
            rows = list(csv.reader(lines))
    except (UnicodeDecodeError, csv.Error):
        raise LabError(f"{file}: not a CSV file; identify takes run folders and {TELEMETRY}") from None
    titles = rows[0] if rows else []
    if len(titles) == 1 and titles[0].count(";") > 1:
        raise LabError(f"{file}: its columns are separated by ';'; ',' is expected")
    # A killed process may leave half a row.
    whole = [row for row in rows[1:] if len(row) == len(titles)]
    try:
        table = np.array([[cell.strip() or "nan" for cell in row] for row in whole], float).reshape(
            len(whole), len(titles)
        )
    except ValueError as error:
        raise LabError(f"{file}: {error}") from None
    columns = dict(zip(titles, table.T, strict=True))
    for name in EXCITATIONS:
        if not np.isfinite(columns.get(name, nan)).any():
            columns[name] = np.zeros(len(whole))
    for name in (BOARD_COLUMN, TIME_COLUMN, *POSE_COLUMNS, *INPUTS, *RATES, "supervisor.state []"):
        if name not in columns:
            raise LabError(f"{file}: no column {name!r}")
    return columns


def _in_order(columns: dict[str, Array], path: Path) -> dict[str, Array]:
    """Return each row once, in the order of the board's time, which no longer wraps; rows without a time are left out.

    Links may exchange rows that follow each other. Raises `LabError` for a clock that is not one of milliseconds.
    """
    known = np.isfinite(columns[BOARD_COLUMN]) & np.isfinite(columns[TIME_COLUMN])
    columns = {name: values[known] for name, values in columns.items()}
    board_ms = columns[BOARD_COLUMN] = np.unwrap(columns[BOARD_COLUMN], period=WRAP_MS)
    if np.min(np.diff(board_ms), initial=0.0) < -EXCHANGED_MS:
        raise LabError(f"{path}: the board's time runs backwards; one flight, in its order, is expected")
    steps = np.abs(np.diff(board_ms)), np.abs(np.diff(columns[TIME_COLUMN]))
    board, ground = (float(np.median(step[step > 0])) if step.any() else 1.0 for step in steps)
    if not 1 / UNLIKE < 1e-3 * board / ground < UNLIKE:
        raise LabError(
            f"{path}: from row to row {BOARD_COLUMN!r} advances by {board:g} and {TIME_COLUMN!r} by {ground:g}: is one of "
            "them in another unit, such as microseconds?"
        )
    _, once = np.unique(board_ms, return_index=True)
    return {name: values[once] for name, values in columns.items()}


def _flown_with(folder: Path) -> tuple[LabConfig, bool, float]:
    """Return a run folder's configuration, whether it was simulated, and its release [s], board's clock.

    0: unknown.
    """
    metadata = load_log(folder).schema.metadata or {}
    simulated = not read_result(folder).request.is_real
    try:
        config = config_of(folder, metadata)
    except LabError as error:
        raise LabError(f"{error}; give its {TELEMETRY} and --profile") from None
    return config, simulated, 1e-6 * release_of(metadata) if simulated else 0.0


def _limited(u: Array, config: LabConfig) -> tuple[Array, float]:
    """Return the inputs produced by the limited flaps, like `allocate` on board, and how often a flap is at its limit."""
    allocation = config.allocation
    opening = allocation.hover_angle + u @ SHARES
    inside = np.clip(opening, allocation.opening_min, allocation.opening_max)
    room = np.minimum(inside - allocation.opening_min, allocation.opening_max - inside)
    saturated = float(np.mean(np.any(room < AT_LIMIT, axis=1)))
    return (inside - allocation.hover_angle) @ SHARES.T / 4.0, saturated


def _poses(columns: dict[str, Array], flown: NDArray[np.bool_], ahead_s: float) -> tuple[Array, Array]:
    """Return every complete pose once, in its order, with yaw unwrapped."""
    rows = np.stack([columns[name][flown] for name in POSE_COLUMNS], axis=1)
    rows = rows[np.isfinite(rows).all(axis=1)]
    t, once = np.unique(rows[:, 0], return_index=True)
    pose = rows[once, 1:]
    pose[:, 5] = np.unwrap(pose[:, 5])
    return t - ahead_s, pose
