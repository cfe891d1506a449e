"""Frames from a file, at their original pace: a record of `floaty station --record`, or a flight's telemetry.

Telemetry has only the latest frame at the start of each row, which arrived then at the latest. A record has a row
for every frame, without loss, and is complete to about a second when the process dies.
"""

import csv
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from firmware_py.geometry import from_euler_zyx
from ground_station.clock import clock_us, wait
from ground_station.errors import MocapError
from ground_station.mocap import MocapFrame, MocapSource
from ground_station.telemetry_log import POSE_COLUMNS, TELEMETRY, TIME_COLUMN

FLUSH_PERIOD_US = 1_000_000
COLUMNS = (
    "arrival [us]", "mocap.t [us]", "mocap.x [m]", "mocap.y [m]", "mocap.z [m]",
    "mocap.qw", "mocap.qx", "mocap.qy", "mocap.qz", "mocap.valid",
)  # fmt: skip


class MocapLog:
    """The record at `path`; raises `OSError`."""

    def __init__(self, path: Path) -> None:
        self._flush_us = 0
        self._file = path.open("w", encoding="utf-8", newline="\n")
        self._file.write(",".join(COLUMNS) + "\n")

    def write(self, frame: MocapFrame) -> None:
        """Write a frame that arrives now."""
        now_us = clock_us()
        numbers = (repr(value) for value in (*frame.p_WB, *frame.q_WB))  # the shortest that reads back equal
        self._file.write(f"{now_us},{frame.t_us},{','.join(numbers)},{int(frame.valid)}\n")
        if now_us >= self._flush_us:
            self._file.flush()
            self._flush_us = now_us + FLUSH_PERIOD_US

    def close(self) -> None:
        self._file.close()


@dataclass(frozen=True, slots=True)
class RecordingSource:
    """A source whose frames also go to `write`."""

    source: MocapSource
    write: Callable[[MocapFrame], object]

    def open(self) -> None:
        self.source.open()

    def receive(self, timeout_s: float) -> MocapFrame | None:
        frame = self.source.receive(timeout_s)
        if frame is not None:
            self.write(frame)
        return frame

    def notices(self) -> list[str]:
        return self.source.notices()

    def summary(self) -> str:
        return self.source.summary()

    def close(self) -> None:
        self.source.close()


TELEMETRY_COLUMNS = (TIME_COLUMN, *POSE_COLUMNS)
TIME_MAX_US = 2**53

Arrived = tuple[int, MocapFrame]  # instant of arrival [us], frame


class ReplaySource:
    """Plays the file, or the run folder, at `path` once, from the first `receive` that may wait; then it is `over`."""

    def __init__(self, path: Path) -> None:
        self.over = False
        self._path = path
        self._frames: list[Arrived] = []
        self._next = 0
        self._shift_us: int | None = None  # from the recording's clock to ours
        self._notices: list[str] = []

    def open(self) -> None:
        """Read the file; raises `MocapError`."""
        self._frames = read_frames(self._path / TELEMETRY if self._path.is_dir() else self._path)
        self.over, self._next, self._shift_us = False, 0, None
        first_us, last_us = self._frames[0][0], self._frames[-1][0]
        self._notices.append(
            f"mocap {self._path}, {len(self._frames)} frames in {(last_us - first_us) * 1e-6:.1f} s"
        )

    def receive(self, timeout_s: float) -> MocapFrame | None:
        now_us = clock_us()
        # A caller that only polls is not ready yet, so the replay does not start.
        if self._shift_us is None and timeout_s > 0:
            self._shift_us = now_us - self._frames[0][0]
        if self._shift_us is None or self.over:
            wait(timeout_s)
            return None
        t_us, frame = self._frames[self._next]
        ahead_s = (t_us + self._shift_us - now_us) * 1e-6
        wait(max(0.0, min(ahead_s, timeout_s)))
        if ahead_s > timeout_s:
            return None
        self._next += 1
        if self._next == len(self._frames):
            self.over = True
            self._notices.append(f"the recording is over: {len(self._frames)} frames")
        return MocapFrame(frame.t_us + self._shift_us, frame.p_WB, frame.q_WB, frame.valid)

    def notices(self) -> list[str]:
        notices, self._notices = self._notices, []
        return notices

    def summary(self) -> str:
        return f"mocap {self._next} of {len(self._frames)} replayed"

    def close(self) -> None:
        """Do nothing."""


def read_frames(path: Path) -> list[Arrived]:
    """Return the frames of a record or a telemetry log, at least one; `MocapError` for other files."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            whole_lines = (line for line in file if line.endswith("\n"))  # the last one may be cut off
            frames = list(_frames(csv.DictReader(whole_lines, strict=True)))
    except OSError as error:
        raise MocapError(f"{path}: {error.strerror or error}") from None
    except (csv.Error, UnicodeDecodeError, MocapError) as error:
        raise MocapError(f"{path}: {error}") from None
    if not frames:
        raise MocapError(f"{path}: no frames")
    for (t_us, _), (next_us, _) in pairwise(frames):
        if next_us < t_us:
            raise MocapError(f"{path}: frames go back in time, from {t_us} to {next_us} us")
    return frames


def _frames(rows: "csv.DictReader[str]") -> Iterator[Arrived]:
    titles = set(rows.fieldnames or ())
    recorded = titles.issuperset(COLUMNS)
    if not recorded and not titles.issuperset(TELEMETRY_COLUMNS):
        raise MocapError("neither frames of floaty station --record nor telemetry of a flight")
    last_us: int | None = None
    for row in rows:
        try:
            arrived = _recorded(row) if recorded else _telemetry(row)
        except (TypeError, ValueError) as error:  # a cell that is missing or not a number
            raise MocapError(f"line {rows.line_num}: {error}") from None
        if arrived is not None and (recorded or arrived[1].t_us != last_us):
            last_us = arrived[1].t_us
            yield arrived


def _recorded(row: dict[str, str]) -> Arrived:
    x, y, z, qw, qx, qy, qz = (float(row[title]) for title in COLUMNS[2:9])
    valid = bool(int(row[COLUMNS[9]]))
    return _time(row[COLUMNS[0]]), MocapFrame(_time(row[COLUMNS[1]]), (x, y, z), (qw, qx, qy, qz), valid)


def _telemetry(row: dict[str, str]) -> Arrived | None:
    """Return a row's frame, None before the first."""
    arrival_s, t_s, x, y, z, roll, pitch, yaw = (float(row[title]) for title in TELEMETRY_COLUMNS)
    if math.isnan(t_s):
        return None
    frame = MocapFrame(_time(t_s * 1e6), (x, y, z), from_euler_zyx(roll, pitch, yaw), valid=True)
    return _time(arrival_s * 1e6), frame


def _time(value: str | float) -> int:
    t_us = float(value)
    if not abs(t_us) <= TIME_MAX_US:  # false for NaN, too
        raise ValueError(f"{value} us is not a time")
    return round(t_us)
