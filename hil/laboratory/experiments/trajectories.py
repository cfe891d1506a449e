"""Trajectories of Crazyswarm2 as experiments: files of `uav_trajectories`, or a folder with one for each robot.

A row is a piece of the path: its duration [s], then eight coefficients each of x, y, z [m] and yaw [rad], from the constant
to t^7, with the time since the piece began. Like Crazyswarm2's `startTrajectory` with `relative=True`, x, y and z count
from where the robot is; yaw is absolute. After the last piece the robot holds its end.
"""

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ground_station.trajectory import Along
from hil.errors import LabError, refusing
from hil.laboratory.experiment import Experiment, Source

COLUMNS, ORDER, AXES = 33, 8, 4
BEGIN_S, AROUND_S = 1.0, 8.0  # at rest before it; a Crazyflie's take-off and landing, and the rest
SUFFIX = ".csv"


@dataclass(frozen=True, slots=True)
class Pieces:
    """Polynomial pieces, as a function of time for `Along`."""

    rows: tuple[tuple[float, ...], ...]  # (N, 33)

    @property
    def duration_s(self) -> float:
        """The duration of all pieces."""
        return math.fsum(row[0] for row in self.rows)

    def __call__(self, since_s: float) -> Sequence[float]:
        """Return x, y, z [m] from the first point and yaw [rad]."""
        left_s = max(since_s - BEGIN_S, 0.0)
        for row in self.rows[:-1]:
            if left_s < row[0]:
                return self._from_start(row, left_s)
            left_s -= row[0]
        return self._from_start(self.rows[-1], min(left_s, self.rows[-1][0]))

    def _from_start(self, row: Sequence[float], t: float) -> Sequence[float]:
        first, point = self.rows[0], [_value(row, axis, t) for axis in range(AXES)]
        return [point[axis] - first[1 + ORDER * axis] for axis in range(AXES - 1)] + point[-1:]


def _value(row: Sequence[float], axis: int, t: float) -> float:
    value = 0.0
    for coefficient in reversed(row[1 + ORDER * axis : 1 + ORDER * (axis + 1)]):
        value = value * t + coefficient
    return value


def in_csv(path: Path) -> Experiment:
    """Return the experiment of a trajectory file. Raises `LabError` for a line that is not a piece."""
    with refusing(f"experiment {path}: ", OSError):
        content = path.read_bytes()
    pieces = Pieces(tuple(_rows(path, content.decode(errors="replace"))))
    if not pieces.rows:
        raise LabError(f"experiment {path}: no line with {COLUMNS} numbers")
    return Experiment(
        name=re.sub(r"[^\w.-]+", "-", path.stem).lstrip(".-") or "trajectory",
        summary=f"fly the {len(pieces.rows)} pieces of {path.name}, {pieces.duration_s:.3g} s",
        duration_s=pieces.duration_s + BEGIN_S + AROUND_S,
        limits={"lost": 0.0},
        trajectory=Along(pieces),
        source=Source(str(path.resolve()), hashlib.sha256(content).hexdigest()),
    )


def _rows(path: Path, text: str) -> list[tuple[float, ...]]:
    found = []
    for number, line in enumerate(text.splitlines(), 1):
        words = [word.strip() for word in line.rstrip(", ").split(",")]
        if words == [""] or (number == 1 and words[0].lower() == "duration"):
            continue
        try:
            row = tuple(map(float, words))
        except ValueError:
            row = ()
        if len(row) != COLUMNS or not all(map(math.isfinite, row)) or row[0] <= 0.0:
            raise LabError(
                f"experiment {path}:{number}: {len(words)} values: expected {COLUMNS} numbers: a duration above 0 and "
                "eight coefficients each of x, y, z and yaw"
            )
        found.append(row)
    return found


def in_folder(folder: Path, count: int) -> list[Experiment]:
    """Return the experiments of a folder's trajectory files, one per robot in the order of their names."""
    files = sorted(folder.glob(f"*{SUFFIX}"), key=_in_order)
    if len(files) < count:
        raise LabError(
            f"experiment {folder}: {len(files)} trajectories ({SUFFIX}): expected one for each of {count} robots"
        )
    return [in_csv(path) for path in files[:count]]


def _in_order(path: Path) -> list[tuple[int, str]]:
    """Return the key by which traj2.csv comes before traj10.csv."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]
