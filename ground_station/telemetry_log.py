"""The ground station's record of a flight: a CSV file with one row per telemetry time stamp.

A row joins the blocks that carry the same time stamp with the ground station's own data when the first
of them arrived: its clock, the goal, the last usable pose, the tracker's result and the age of the last sent
pose by stages. Missing values are `nan`. The header names each column's unit: `stateEstimate.x [m]`. The file is
complete to about a second when the process dies; memory holds one row.
"""

from math import nan
from pathlib import Path

from firmware_py.geometry import to_euler_zyx
from firmware_py.wire.telemetry import ALL_BLOCKS, Sample, TelemetryBlock
from ground_station.latency import STAGES, LatencyBudget
from ground_station.mocap import MocapFrame
from ground_station.tracker import Track
from ground_station.trajectory import Goal

FLUSH_PERIOD_US = 1_000_000

TELEMETRY = "telemetry.csv"  # in a run folder
TIME_COLUMN = "ground.t [s]"
GOAL_COLUMNS = ("goal.x [m]", "goal.y [m]", "goal.z [m]", "goal.yaw [rad]")
POSE_COLUMNS = (
    "mocap.t [s]", "mocap.x [m]", "mocap.y [m]", "mocap.z [m]", "mocap.roll [rad]", "mocap.pitch [rad]", "mocap.yaw [rad]",
)  # fmt: skip
AGE_COLUMNS = tuple(f"age.{stage} [s]" for stage in STAGES)

MOTION_COLUMNS = (
    "mocap.vx [m/s]", "mocap.vy [m/s]", "mocap.vz [m/s]", "mocap.p [rad/s]", "mocap.q [rad/s]", "mocap.r [rad/s]",
)  # fmt: skip
_GROUND_COLUMNS = (
    TIME_COLUMN, *GOAL_COLUMNS, *POSE_COLUMNS, *MOTION_COLUMNS, "mocap.quality []", *AGE_COLUMNS,
)  # fmt: skip


_TIMES = (TIME_COLUMN, POSE_COLUMNS[0])  # to the microsecond


class TelemetryLog:
    """Writes the CSV file at `path`, of samples of `blocks`; raises `OSError`."""

    def __init__(self, path: Path, blocks: tuple[TelemetryBlock, ...] = ALL_BLOCKS) -> None:
        titles: list[str] = []
        self._first_column: dict[int, int] = {}  # of each block, by its number
        for block in blocks:
            self._first_column[block.id] = len(titles)
            titles += [f"{variable.name} [{variable.unit}]" for variable in block.variables]
        self._empty = [nan] * len(titles)
        formats = ["%.6f" if title in _TIMES else "%.7g" for title in (*_GROUND_COLUMNS, *titles)]
        self._row = ",".join(["%d", *formats]) + "\n"
        self._file = path.open("w", encoding="utf-8", newline="\n")
        self._file.write(",".join(("board.t [ms]", *_GROUND_COLUMNS, *titles)) + "\n")
        self._timestamp_ms: int | None = None
        self._ground: tuple[float, ...] = ()
        self._telemetry: list[float] = []
        self._next_flush_us = 0

    def write(
        self,
        now_us: int,
        sample: Sample,
        goal: Goal,
        frame: MocapFrame | None,
        track: Track | None,
        budget: LatencyBudget,
    ) -> None:
        """Put `sample`, received at `now_us`, into its row; the rest is of that instant."""
        if sample.timestamp_ms != self._timestamp_ms:
            self._write_row()
            self._timestamp_ms = sample.timestamp_ms
            ages = [1e-6 * us for us in budget.last()]
            self._ground = (*_ground_values(now_us, goal, frame, track), *ages)
            self._telemetry = self._empty.copy()
        first = self._first_column[sample.block.id]
        self._telemetry[first : first + len(sample.values)] = sample.values
        if now_us >= self._next_flush_us:
            self._file.flush()
            self._next_flush_us = now_us + FLUSH_PERIOD_US

    def close(self) -> None:
        """Write the last row and close the file; a second call does nothing."""
        if not self._file.closed:
            with self._file:
                self._write_row()

    def _write_row(self) -> None:
        if self._timestamp_ms is not None:
            self._file.write(self._row % (self._timestamp_ms, *self._ground, *self._telemetry))


def _ground_values(
    now_us: int, goal: Goal, frame: MocapFrame | None, track: Track | None
) -> tuple[float, ...]:
    pose = [nan] * 7 if frame is None else [frame.t_us * 1e-6, *frame.p_WB, *to_euler_zyx(frame.q_WB)]
    motion = [nan] * 7 if track is None else [*track.v_WB, *track.w_B, track.quality]
    return (now_us * 1e-6, *goal.p_WG, goal.yaw, *pose, *motion)
