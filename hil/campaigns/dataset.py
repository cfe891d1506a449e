"""A campaign's dataset: one row per flight, stored as it arrives, so that it survives whatever ends the program.

`DIR/campaign.json` describes the campaign. A row is first a line of `DIR/arriving.jsonl`; from time to time, and at the
end, lines become files of `DIR/flights/`, a Parquet dataset, each written under another name and then renamed. After a kill
in between, at worst a row is in both, which reading detects, or a line is incomplete, and its flight is flown again.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from firmware_py.logic.loading import digest_of
from hil.campaigns.config import Distribution, spec_text, table_dimensions
from hil.campaigns.flying import Campaign, CampaignRow
from hil.config import load_config
from hil.errors import LabError, writing
from hil.experiments import find_experiment
from hil.installation import commit, versions
from hil.laboratory.metrics import METRICS, limits_of

ABOUT, ARRIVING, FLIGHTS = "campaign.json", "arriving.jsonl", "flights"
WHOLE = "all.parquet"
ROWS_PER_FILE = 500


class Dataset:
    """The flights so far; `add` stores a row at once. Raises `LabError` when it cannot be written."""

    def __init__(self, folder: Path, campaign: Campaign, resume: bool) -> None:
        self.folder, self.schema = folder, schema_of(campaign)
        self._begin(about(campaign), resume)
        self.indices = set(read_flights(folder, self.schema, ["index"]).column("index").to_pylist())
        self._arriving: IO[str] | None = None
        self._lines = 0
        self._pack()

    def add(self, row: CampaignRow) -> None:
        """Store a row."""
        with writing("--out", self.folder):
            if self._arriving is None:
                self._arriving = (self.folder / ARRIVING).open("a", encoding="utf-8")
            self._arriving.write(json.dumps(asdict(row)) + "\n")
            self._arriving.flush()
        self.indices.add(row.index)
        self._lines += 1
        if self._lines >= ROWS_PER_FILE:
            self._pack()

    def close(self, end: int | None = None) -> None:
        """Make all rows one file in the order of the flights; those from `end` on do not belong to the campaign."""
        self._pack()
        if end is None:
            return
        table = read_flights(self.folder, self.schema)
        self._write(table.filter(pc.less(table["index"], end)), WHOLE)
        for file in self._files():
            if file.name != WHOLE:
                file.unlink()
        self.indices = {index for index in self.indices if index < end}

    def _begin(self, now: dict[str, Any], resume: bool) -> None:
        path = self.folder / ABOUT
        with writing("--out", self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
            if not path.is_file():
                if any(self.folder.iterdir()):
                    raise LabError(f"--out {self.folder}: the folder is not empty and holds no campaign")
                (self.folder / FLIGHTS).mkdir()
                partial = path.with_suffix(".partial")
                partial.write_text(json.dumps(now, indent=2) + "\n", encoding="utf-8")
                partial.replace(path)
                return
            text = path.read_text(encoding="utf-8")
        try:
            before = json.loads(text)
        except json.JSONDecodeError as error:
            raise LabError(f"{path}: not JSON: {error}") from None
        if not resume:
            raise LabError(f"--out {self.folder}: holds a campaign; --resume continues it")
        for name, value in now.items():
            if value != before.get(name):
                raise LabError(
                    f"--resume: {_difference(name, before.get(name), value)}: choose another --out"
                )

    def _pack(self) -> None:
        """Write the rows that have arrived into a file."""
        if self._arriving is not None:
            with writing("--out", self.folder):
                self._arriving.close()
            self._arriving, self._lines = None, 0
        path = self.folder / ARRIVING
        rows = list(_lines_of(path))
        if rows:
            self.indices.update(row["index"] for row in rows)
            names = {file.name for file in self._files()}
            number = next(n for n in range(len(names) + 1) if f"part-{n:06}.parquet" not in names)
            self._write(table_of(rows, self.schema), f"part-{number:06}.parquet")
        path.unlink(missing_ok=True)

    def _write(self, table: pa.Table, name: str) -> None:
        partial = self.folder / f"{name}.partial"
        with writing("--out", self.folder):
            try:
                pq.write_table(table, partial, compression="zstd")
                partial.replace(self.folder / FLIGHTS / name)
            except OSError:
                partial.unlink(missing_ok=True)
                raise

    def _files(self) -> list[Path]:
        return sorted((self.folder / FLIGHTS).glob("*.parquet"))


def read_flights(folder: Path, schema: pa.Schema, columns: list[str] | None = None) -> pa.Table:
    """Return the rows of a campaign in the order of the flights, each once. Raises `LabError` for another file."""
    wanted = schema if columns is None else pa.schema([schema.field(name) for name in columns])
    tables = [wanted.empty_table()]
    for file in sorted((folder / FLIGHTS).glob("*.parquet")):
        try:
            tables.append(pq.read_table(file, columns=wanted.names, partitioning=None).cast(wanted))
        except (pa.ArrowInvalid, OSError, ValueError) as error:
            raise LabError(f"{file}: not of this campaign ({error})") from None
    table = pa.concat_tables(tables).sort_by("index")
    indices = table["index"].to_pylist()
    first = [n for n, index in enumerate(indices) if n == 0 or index != indices[n - 1]]
    return table if len(first) == len(indices) else table.take(first)


def about(campaign: Campaign) -> dict[str, Any]:
    """Return what identifies a campaign: if it is equal, flights of the same number are equal."""
    spec = campaign.spec
    return {
        "spec": spec_text(spec),
        "experiments": [source and source.sha256 for source in campaign.sources],
        "profiles": {name: _digest_of(name) for name in spec.profiles},
        "commit": commit(),
        "versions": versions(),
    }


def _digest_of(profile: str) -> str:
    config = load_config(profile)
    return hashlib.sha256((config.model_dump_json() + digest_of(config.logic)).encode()).hexdigest()[:16]


def _difference(name: str, before: Any, now: Any) -> str:
    """Return the first difference, with its name."""
    if isinstance(before, dict) and isinstance(now, dict):
        key = next(key for key in [*now, *before] if now.get(key) != before.get(key))
        return _difference(f"{name}.{key}", before.get(key), now.get(key))
    return f"{name} was {before!r} and is {now!r}"


def schema_of(campaign: Campaign) -> pa.Schema:
    """Return the columns of a campaign: the same for every flight, with units of the metrics."""
    spec = campaign.spec
    experiments = [find_experiment(name) for name in spec.experiments]
    metrics = dict(METRICS)
    limits: dict[str, None] = {}
    for experiment in experiments:
        metrics |= experiment.metrics
        limits |= dict.fromkeys(limits_of(experiment.limits))
        for profile in spec.profiles:
            limits |= dict.fromkeys(load_config(profile).limits.get(experiment.name, ()))
    texts = pa.list_(pa.string())
    parameters = [*spec.parameters.items(), *table_dimensions(spec.table)]
    return pa.schema(
        [
            ("index", pa.int64()), ("experiment", pa.string()), ("profile", pa.string()), ("seed", pa.int64()),
            ("settings", texts), ("faults", texts), ("outcome", pa.string()), ("error", pa.string()),
            ("passed", pa.bool_()), ("hash", pa.string()),
            *((f"parameter.{name}", _type_of(varies)) for name, varies in parameters),
            *(
                pa.field(f"metric.{name}", pa.float64(), metadata={"unit": metric.unit})
                for name, metric in metrics.items()
            ),
            *((f"holds.{name}", pa.bool_()) for name in limits),
        ]
    )  # fmt: skip


def _type_of(varies: Distribution) -> pa.DataType:
    values = varies.choice or (0.0,)
    if all(isinstance(value, bool) for value in values):
        return pa.bool_()
    return pa.string() if any(isinstance(value, str | bool) for value in values) else pa.float64()


def table_of(rows: Iterable[dict[str, Any]], schema: pa.Schema) -> pa.Table:
    """Return rows, as read from lines, as a table."""
    flat = [
        {
            **row,
            **{f"parameter.{name}": value for name, value in row["parameters"].items()},
            **{f"metric.{name}": value for name, value in row["metrics"].items()},
            **{f"holds.{name}": value for name, value in row["holds"].items()},
        }
        for row in rows
    ]
    columns = []
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
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            yield json.loads(line)
        except json.JSONDecodeError:
            return
