"""The dataset of many flights: one row per flight, stored on arrival, so that it survives the program's end.

`DIR/campaign.json` describes the plan. A row is first a line of `DIR/arriving.jsonl`; at the end the lines become
`DIR/flights/all.parquet`, written under another name and then renamed. After a kill in between, at worst a row is in
both, which the reader detects, or a line is incomplete, and its flight is repeated.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from firmware_py.logic.loading import digest_of
from hil.board.cores.boards import C
from hil.config import load_config
from hil.errors import LabError, writing
from hil.laboratory.bodies import digest_of_body
from hil.laboratory.experiments import find_experiment
from hil.laboratory.files.installation import ROOT, commit, has_git, versions
from hil.laboratory.files.whole_files import PARTIAL, write_whole
from hil.laboratory.metrics import METRICS, limits_of
from hil.research.campaigns.jobs import Plan, Row

ABOUT, ARRIVING, FLIGHTS = "campaign.json", "arriving.jsonl", Path("flights", "all.parquet")
AT_ONCE = 500  # lines read at a time
TYPES = {bool: pa.bool_(), str: pa.string()}  # others are float


class Dataset:
    """The flights so far; `add` stores a row at once. Raises `LabError` when it cannot be written.

    An unfinished plan in the folder is continued with `resume`, replaced with `replace`, otherwise refused.
    """

    def __init__(self, folder: Path, plan: Plan, resume: bool, replace: bool = False) -> None:
        self.folder, self.plan, self.schema = folder, plan, schema_of(plan)
        self._arriving: IO[str] | None = None
        with writing("--out", folder):
            folder.mkdir(parents=True, exist_ok=True)
            if replace and not resume:
                for name in (FLIGHTS, ARRIVING, ABOUT):  # no plan without its description
                    (folder / name).unlink(missing_ok=True)
            if not (folder / ABOUT).is_file():
                if not replace and any(path.name != ABOUT + PARTIAL for path in folder.iterdir()):
                    raise LabError(f"--out {folder}: the folder is not empty and holds no campaign")
                write_whole(folder / ABOUT, json.dumps(about(plan), indent=2) + "\n")
            elif not resume:
                raise LabError(f"--out {folder}: holds a campaign; --resume continues it")
        self._check_resumed()
        self.close()

    def _check_resumed(self) -> None:
        """Raise `LabError` when the folder holds flights of another plan."""
        path = self.folder / ABOUT
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except json.JSONDecodeError as error:
            raise LabError(f"{path}: not JSON: {error}") from None
        for name, value in json.loads(json.dumps(about(self.plan))).items():
            if value != before.get(name):
                raise LabError(
                    f"--resume: {_difference(name, before.get(name), value)}: choose another --out"
                )

    def add(self, row: Row) -> None:
        """Store a row."""
        with writing("--out", self.folder):
            if self._arriving is None:
                self._arriving = (self.folder / ARRIVING).open("a", encoding="utf-8")
            self._arriving.write(json.dumps(row.columns()) + "\n")
            self._arriving.flush()

    def close(self, end: int | None = None) -> None:
        """Store all rows before number `end` in one file, in the order of the flights."""
        if self._arriving is not None:
            with writing("--out", self.folder):
                self._arriving.close()
            self._arriving = None
        if end is None and not (self.folder / ARRIVING).is_file():
            return
        table = self.table()
        if end is not None:
            table = table.filter(pc.less(table["index"], end))
        path, partial = self.folder / FLIGHTS, self.folder / "flights.partial"
        with writing("--out", self.folder):
            path.parent.mkdir(exist_ok=True)
            try:
                pq.write_table(table, partial, compression="zstd")
                partial.replace(path)
            finally:
                partial.unlink(missing_ok=True)
            (self.folder / ARRIVING).unlink(missing_ok=True)

    def table(self, columns: list[str] | None = None) -> pa.Table:
        """Return the rows in the order of the flights, each once. Raises `LabError` for another campaign's file."""
        wanted = self.schema if columns is None else pa.schema([self.schema.field(name) for name in columns])
        path = self.folder / FLIGHTS
        tables = [wanted.empty_table()]
        try:
            if path.is_file():
                tables.append(pq.read_table(path, columns=wanted.names, partitioning=None).cast(wanted))
        except (pa.ArrowInvalid, OSError, ValueError) as error:
            raise LabError(f"{path}: not of this campaign ({error})") from None
        lines = _lines_of(self.folder / ARRIVING)
        while rows := list(islice(lines, AT_ONCE)):
            tables.append(table_of(rows, wanted))
        table = pa.concat_tables(tables).sort_by("index")
        indices = table["index"].to_pylist()
        first = [n for n, index in enumerate(indices) if n == 0 or index != indices[n - 1]]
        return table if len(first) == len(indices) else table.take(first)

    def rows(self) -> list[Row]:
        return [Row.of(self.plan.job(row["index"]), row) for row in self.table().to_pylist()]


def about(plan: Plan) -> dict[str, Any]:
    """Return a plan's identity: plans with equal ones have equal flights of equal number."""
    sources = [find_experiment(name).source for name in plan.experiments]
    board = Path(plan.job(0).options.get("board", C))
    return {
        **plan.about,
        "experiments": [source and source.sha256 for source in sources],
        "image": hashlib.sha256(board.read_bytes()).hexdigest()[:16] if board.is_file() else "",
        "profiles": {name: _digest_of(name) for name in plan.profiles},
        "commit": _commit(),
        "versions": versions(),
    }


def _commit() -> str:
    """Return the commit, `unknown` without git or a repository; a campaign that cannot be compared is not begun."""
    found = commit()
    if not found and has_git():
        raise LabError(f"git does not name the commit, which a campaign stores: try `git -C {ROOT} status`")
    return found or "unknown"


def _digest_of(profile: str) -> str:
    config = load_config(profile)
    files = digest_of(config.logic) + digest_of_body(config)
    return hashlib.sha256((config.model_dump_json() + files).encode()).hexdigest()[:16]


def _difference(name: str, before: Any, now: Any) -> str:
    """Return the first difference, with its name."""
    if isinstance(before, dict) and isinstance(now, dict):
        key = next(key for key in [*now, *before] if now.get(key) != before.get(key))
        return _difference(f"{name}.{key}", before.get(key), now.get(key))
    return f"{name} was {before!r} and is {now!r}"


def schema_of(plan: Plan) -> pa.Schema:
    """Return the columns of a plan: the same for every flight, with units of the metrics."""
    metrics = dict(METRICS)
    limits: dict[str, None] = {}
    for experiment in map(find_experiment, plan.experiments):
        metrics |= experiment.metrics
        limits |= dict.fromkeys(limits_of(experiment.limits))
        for profile in plan.profiles:
            limits |= dict.fromkeys(load_config(profile).limits.get(experiment.name, ()))
    texts = pa.list_(pa.string())
    return pa.schema(
        [
            ("index", pa.int64()), ("experiment", pa.string()), ("profile", pa.string()), ("seed", pa.int64()),
            ("settings", texts), ("faults", texts), ("outcome", pa.string()), ("error", pa.string()),
            ("passed", pa.bool_()), ("hash", pa.string()),
            *((f"parameter.{name}", TYPES.get(kind, pa.float64())) for name, kind in plan.values.items()),
            *(
                pa.field(f"metric.{name}", pa.float64(), metadata={"unit": metric.unit})
                for name, metric in metrics.items()
            ),
            *((f"holds.{name}", pa.bool_()) for name in limits),
        ]
    )  # fmt: skip


def table_of(rows: Iterable[dict[str, Any]], schema: pa.Schema) -> pa.Table:
    flat, columns = list(rows), []
    for field in schema:
        values = [row.get(field.name) for row in flat]
        if pa.types.is_string(field.type):
            values = [None if value is None else str(value) for value in values]
        elif pa.types.is_floating(field.type):  # a flight that was not flown has no metrics
            values = [math.nan if value is None else float(value) for value in values]
        columns.append(pa.array(values, field.type))
    return pa.table(columns, schema=schema)


def _lines_of(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the complete lines; the last one is incomplete when the program died while writing it."""
    if not path.is_file():
        return
    with path.open(encoding="utf-8") as file:
        for line in file:
            try:
                yield json.loads(line)
            except json.JSONDecodeError:
                return
