"""Baselines: metrics and a thinned path of a test's flights, kept as a small text beside the test file.

`baselines/NAME.json` is committed. A flight over a real link has no path there, because no two are alike.
"""

import json
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from hil.api import Run
from hil.errors import LabError
from hil.laboratory.files.whole_files import write_whole
from hil.laboratory.metric_pairs import MetricPair, differing, pairs_of, text_of
from hil.laboratory.metrics import column

FOLDER = "baselines"
POSE = tuple(f"truth.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))  # m and 1, W
PATH = ("t", *POSE)  # t [s] from the release
ROWS_MAX, ROWS_APART = 100, 10  # of the path; the log has 100 per second
Row = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Pinned:
    """What is kept of a flight."""

    flight: str  # experiment and seed
    outcome: str
    hash: str  # changes with every bit of the flight; the metrics alone decide
    metrics: dict[str, float]
    path: tuple[Row, ...] = ()

    @classmethod
    def of(cls, run: Run) -> "Pinned":
        """Return what is kept of a run."""
        known = {name: float(value) for name, value in run.metrics.items() if not math.isnan(value)}
        path = _path_of(run) if run.request.bench.in_lockstep else ()
        return cls(run.request.title, run.outcome, run.hash, known, path)


_FILE = TypeAdapter(tuple[Pinned, ...])


def file_of(home: Path, name: str) -> Path:
    """Return the file of a baseline beside the test file in `home`. Raises `LabError` for an invalid name."""
    if not re.fullmatch(r"\w[\w.-]*", name):
        raise LabError(f"baseline {name!r}: expected a name of letters, digits, '.', '-' and '_'")
    return home / FOLDER / f"{name}.json"


def write(path: Path, flights: Sequence[Pinned]) -> None:
    """Write a baseline, a row of the path on each line."""
    path.parent.mkdir(exist_ok=True)
    texts = []
    for one in flights:
        head = json.dumps({**asdict(one), "path": []}, indent=1).removesuffix("[]\n}")
        rows = ",\n".join(f"  {json.dumps(row)}" for row in one.path)
        texts.append(f"{head}[\n{rows}\n]}}" if rows else f"{head}[]}}")
    write_whole(path, "[" + ",\n".join(texts) + "]\n")


def read(path: Path) -> tuple[Pinned, ...]:
    """Return the flights of a baseline. Raises `LabError` for a file that is none."""
    try:
        return _FILE.validate_json(path.read_bytes())
    except ValidationError as error:
        raise LabError(f"{path}: not a baseline: {error.errors()[0]['msg']}") from None


def difference(kept: Pinned, run: Run, rel: float, metrics: Sequence[str]) -> list[str]:
    """Return lines on what left a baseline by more than `rel`; none if all is within it.

    `metrics` are those that count; empty: all.
    """
    now = Pinned.of(run)
    pairs = pairs_of(kept.metrics, now.metrics, run.result.own_metrics)
    wrong = [pair for pair in pairs if not pair.within(rel) and (not metrics or pair.name in metrics)]
    if now.outcome == kept.outcome and not wrong:
        return []
    ended = [] if now.outcome == kept.outcome else [f"outcome: {kept.outcome} | {now.outcome}"]
    title = [f"{now.flight}, left by more than {100 * rel:g} %: {', '.join(pair.name for pair in wrong)}"]
    return [*(title if wrong else [now.flight]), *ended, *_table(pairs), *_first_difference(kept, now)]


def _table(pairs: Sequence[MetricPair]) -> list[str]:
    unequal = differing(pairs)
    lines = text_of(unequal, ("metric", "baseline", "now", "difference", "unit")) if unequal else []
    return [f"  {line}" for line in lines] + [f"{len(pairs) - len(unequal)} metrics are equal."]


def _first_difference(kept: Pinned, now: Pinned) -> list[str]:
    for before, after in zip(kept.path, now.path, strict=False):
        for name, a, b in zip(PATH, before, after, strict=True):
            if a != b:
                return [f"first difference: row at {before[0]:.2f} s from the release, {name}: {a!r} | {b!r}"]
    if kept.path and len(kept.path) != len(now.path):
        ends = (path[-1][0] if path else 0.0 for path in (kept.path, now.path))
        return ["the rows are equal; the last is at {:.2f} s | {:.2f} s".format(*ends)]
    return []


def _path_of(run: Run) -> tuple[Row, ...]:
    free = run.free
    if free.num_rows == 0:
        return ()
    apart = max(ROWS_APART, ROWS_APART * math.ceil(free.num_rows / ROWS_APART / ROWS_MAX))
    chosen = free.take(list(range(0, free.num_rows, apart)))
    values = column(chosen, *PATH)
    values[:, 0] = (values[:, 0] - values[0, 0]) / 1e6
    return tuple(map(tuple, values.tolist()))
