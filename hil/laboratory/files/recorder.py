"""The flight log: one row per 10 ms, written during the flight, so that the rows before a crash are kept.

During the flight the rows go to `log.arrows` (an Arrow stream, one batch per second); closing turns it into `log.parquet`.
Texts (console, supervisor, causes) go to `events.jsonl`, line by line. Each column carries `unit` and `frame` in its
metadata; the schema carries configuration, seed, versions and commit. `load_log` reads whichever file there is.
"""

import hashlib
import json
import mmap
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from itertools import chain, islice
from pathlib import Path
from tempfile import NamedTemporaryFile
from types import ModuleType
from typing import IO, Any, ParamSpec, Protocol
from weakref import WeakSet

import numpy as np
import pyarrow as pa
import pyarrow.ipc
from numpy.typing import NDArray
from pydantic import ValidationError

from ground_station.records import Records
from hil.config import LabConfig
from hil.errors import LabError, refusing
from hil.laboratory.files.ages import at_exposure
from hil.laboratory.files.whole_files import replacing
from hil.world.body import Channel, Quantity

if "pandas" not in sys.modules:
    # The first array imports pandas, to know its types, which takes a second or so in mid-flight. If pandas seems
    # too old, Arrow does without it, until `to_pandas` is called.
    sys.modules["pandas"] = ModuleType("pandas")
    sys.modules["pandas"].__version__ = "0"  # type: ignore[attr-defined]
    with warnings.catch_warnings(action="ignore"):
        pa.array([()])
    del sys.modules["pandas"]

ROWS_PER_BATCH, BATCH_US = 100, 1_000_000  # whichever is full first goes to disk
BUFFER_BYTES = 1 << 18  # of the file, more than a batch: it is written at once
BATCHES_PER_PIECE = 160  # of a long flight's log, written and read at once
PIECES_IN_MEMORY = 3  # of a log that is read as a whole: eight minutes
ROWS_SHOWN = 20  # given to the observer together: five times a second
SETTINGS = "settings"  # source of the events about what an image took over and what it lacks
MAPPED: WeakSet[mmap.mmap] = WeakSet()  # the files of long logs that are in use
OPERATOR = "operator"  # source of the events that an operator caused at the terminal
TIMES_US = 1 << 53  # of an event
STORED = ("request", "program", "config", "look")  # in the metadata of a log, as JSON
ARROW_ERRORS = (pa.ArrowException, ValueError, KeyError, TypeError, NotImplementedError, MemoryError)
RELEASE_US = b"release_us"  # in the metadata of a log whose flight was released
PARQUET, STREAM, EVENTS = "log.parquet", "log.arrows", "events.jsonl"

Correct = Callable[[pa.Table], pa.Table]  # adds to a log what became known only after the flight
P = ParamSpec("P")


class Observer(Protocol):
    """Watches a flight while it is recorded. Neither call blocks or raises."""

    def rows(self, batch: pa.RecordBatch) -> None:
        """Take the next rows; the schema of all of them is that of the log."""

    def note(self, t_us: int, source: str, text: str) -> None:
        """Take a line of text."""


class Recorder:
    """Writes one flight into its run folder, and passes it to an observer; without a folder nothing is stored.

    A write that fails raises `OSError`; or, with the `records` of a real flight, it ends its file by their rule, while the
    observer sees the rest.
    """

    def __init__(
        self,
        folder: Path | None,
        channels: tuple[Channel, ...],
        metadata: Mapping[str, str],
        observer: Observer | None = None,
        records: Records | None = None,
    ) -> None:
        self._records = records
        self.release_us: int | None = None
        self._observer = observer
        self._folder = folder
        self._row = self._shown = 0
        times = Channel("int64", lambda: 0, (Quantity(("t",), "us"),))
        # A second of the log, column by column, as the file gets it; the rows are written across.
        self._columns: list[NDArray[Any]] = []
        fields: list[pa.Field] = []
        arrays: list[pa.Array] = []
        for channel in (times, *channels):
            named = [(name, quantity) for quantity in channel.quantities for name in quantity.names]
            columns = np.zeros((len(named), ROWS_PER_BATCH), channel.dtype)
            kind = pa.from_numpy_dtype(columns.dtype)
            self._columns.append(columns)
            for column, (name, quantity) in zip(columns, named, strict=True):
                of_column = {"unit": quantity.unit, "frame": quantity.frame}
                fields.append(pa.field(name, kind, metadata=of_column))
                # Not by `pa.array`, which imports modules in mid-flight.
                arrays.append(pa.Array.from_buffers(kind, ROWS_PER_BATCH, [None, pa.py_buffer(column)]))
        self._times = self._columns[0][0]
        self._sources: list[tuple[Callable[[], Any], NDArray[Any]]] = [
            (channel.read, columns.T) for channel, columns in zip(channels, self._columns[1:], strict=True)
        ]
        self._schema = pa.schema(fields, metadata=dict(metadata))
        self._batch = pa.record_batch(arrays, schema=self._schema)
        self._hash = hashlib.sha256(" ".join(self._schema.names).encode())
        self._file: Any = None
        self._stream: Any = None
        self._events: IO[str] | None = None
        if folder is not None:
            self._write(STREAM, self._open_stream, folder / STREAM)
            self._write(EVENTS, self._open_events, folder / EVENTS)

    def _open_stream(self, path: Path) -> None:
        self._file = pa.output_stream(str(path), buffer_size=BUFFER_BYTES)
        self._stream = pa.ipc.new_stream(self._file, self._schema)
        self._stream.write_batch(self._batch.slice(0, 0))  # the schema, which describes the flight
        self._file.flush()

    def _open_events(self, path: Path) -> None:
        self._events = path.open("w", encoding="utf-8")

    def _write(self, name: str, write: Callable[P, object], *what: P.args, **more: P.kwargs) -> None:
        """Write to a file of the folder."""
        if self._records is None:
            write(*what, **more)
        else:
            assert self._folder is not None
            self._records.write(self._folder / name, write, *what, **more)

    def released(self, at_us: int) -> None:
        """Note when the robot is released."""
        self.release_us = at_us

    def row(self, now_us: int) -> None:
        """Take one sample of every channel."""
        row = self._row
        self._times[row] = now_us
        for read, block in self._sources:
            block[row] = read()
        self._row = row + 1
        if self._row == ROWS_PER_BATCH or now_us - self._times[0] >= BATCH_US:
            self._write_batch()
        elif self._row - self._shown == ROWS_SHOWN:
            self.pass_rows()

    def read_from(self, channels: tuple[Channel, ...]) -> None:
        """Sample these from now on: the same quantities of another object, like a board that has booted again."""
        self._sources = [
            (channel.read, block) for channel, (_, block) in zip(channels, self._sources, strict=True)
        ]

    def note(self, now_us: int, source: str, text: str) -> None:
        """Add a line of text to the log, written to disk at once."""
        if self._observer is not None:
            self._observer.note(now_us, source, text)
        if self._events is not None:
            line = json.dumps({"t_us": now_us, "source": source, "text": text}) + "\n"
            self._write(EVENTS, self._write_line, self._events, line)

    def close(self, correct: Correct | None = None) -> str:
        """Finish the files; returns the SHA-256 over times, names and values of all columns as they were recorded."""
        with ExitStack() as closing:  # all of them, even on a full disk
            for name, written in ((STREAM, self._file), (STREAM, self._stream), (EVENTS, self._events)):
                if written is not None:
                    closing.callback(self._close, name, written)
            if self._row:
                self._write_batch()
        if self._folder is not None:
            finish_log(self._folder, self.release_us, correct)
        return self._hash.hexdigest()

    def _write_batch(self) -> None:
        self.pass_rows()
        count = self._row
        self._row = self._shown = 0
        for columns in self._columns:
            self._hash.update(columns[:, :count].tobytes())
        if self._stream is not None:
            self._write(STREAM, self._store, count)

    def _store(self, count: int) -> None:
        self._stream.write_batch(self._batch.slice(0, count))
        self._file.flush()

    def _write_line(self, file: IO[str], line: str) -> None:
        file.write(line)
        file.flush()

    def _close(self, name: str, file: Any) -> None:
        """Close a file, which may have failed before."""
        if self._records is None:
            file.close()
        else:
            assert self._folder is not None
            self._records.attempt(self._folder / name, file.close)

    def pass_rows(self) -> None:
        """Pass the rows that it has not seen to the observer, which may keep them."""
        if self._observer is not None:
            fresh = self._batch.slice(self._shown, self._row - self._shown).serialize()
            self._observer.rows(pa.ipc.read_record_batch(fresh, self._schema))
            self._shown = self._row


def finish_log(folder: Path, release_us: int | None = None, correct: Correct | None = None) -> None:
    """Convert the stream into `log.parquet`, even when the flight ended in the middle of a batch."""
    from pyarrow.parquet import ParquetWriter  # loads TLS, which no flight needs

    stream = folder / STREAM
    pieces = _read_stream(stream)
    if correct is not None:
        pieces = iter([correct(pa.concat_tables(pieces))])
    first = next(pieces)
    more = {} if release_us is None else {RELEASE_US: str(release_us).encode()}
    schema = _with_metadata(first, more).schema
    with (
        replacing(folder / PARQUET) as partial,
        ParquetWriter(partial, schema, compression="zstd", use_dictionary=False) as writer,
    ):
        for table in chain([first], pieces):
            writer.write_table(table)
    stream.unlink()


def load_log(folder: Path) -> pa.Table:
    """Return the log of a run folder; a run whose process died is read up to its last complete second.

    Raises `LabError` when the folder holds no log that can be read.
    """
    pieces = log_pieces(folder)
    table = pa.concat_tables(islice(pieces, PIECES_IN_MEMORY))
    following = next(pieces, None)
    if following is not None:
        table = _mapped(chain([table, following], pieces), folder)
        pa.default_memory_pool().release_unused()  # the pieces
    return table


def _mapped(pieces: Iterator[pa.Table], folder: Path) -> pa.Table:
    """Return a long log as one table in a file without a name, of which only the columns that are read use memory."""
    first, place = next(pieces), folder if os.access(folder, os.W_OK) else None
    with NamedTemporaryFile(dir=place, prefix=".", suffix=".arrow") as file:
        with pa.ipc.new_file(file.name, first.schema) as writer:
            for piece in chain([first], pieces):
                writer.write_table(piece)
        mapping = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    MAPPED.add(mapping)
    return pa.ipc.open_file(pa.py_buffer(mapping)).read_all()


def forget_read_columns() -> None:
    """Give back the memory that columns of long logs have taken since they were read; read again, they take it again."""
    for mapping in MAPPED:
        mapping.madvise(mmap.MADV_DONTNEED)


def log_pieces(folder: Path) -> Iterator[pa.Table]:
    """Yield the log in the order of time, at least one piece, each of some minutes; else like `load_log`."""
    pa.default_memory_pool().release_unused()  # what was done with a long log before has left hundreds of megabytes
    if (folder / PARQUET).is_file():
        from pyarrow.parquet import ParquetFile

        try:
            with ParquetFile(folder / PARQUET, pre_buffer=False) as file:
                yield _checked(folder / PARQUET, file.schema_arrow).empty_table()
                for number in range(file.num_row_groups):
                    yield file.read_row_group(number, use_threads=False)
        except (*ARROW_ERRORS, OSError) as error:
            raise LabError(f"{folder / PARQUET}: not a flight log ({_line(error)})") from None
    elif (folder / STREAM).is_file():
        yield from _read_stream(folder / STREAM)
    else:
        if not folder.exists():
            raise LabError(f"{folder}: there is no such run folder; `floaty runs` lists those that exist")
        inside = ", ".join(sorted(log.parent.name for log in folder.glob(f"*/{PARQUET}"))[:3])
        but = f", but in {inside}" if inside else ""
        raise LabError(f"{folder}: no {PARQUET} or {STREAM} in it{but}; expected a run folder")


def _checked(path: Path, schema: pa.Schema) -> pa.Schema:
    """Return the schema of a flight's log. Raises `LabError` for another one."""
    with refusing(f"{path}: ", LabError):
        for name in STORED:
            stored_in(schema.metadata, name)
        if RELEASE_US in (schema.metadata or {}) and not schema.metadata[RELEASE_US].strip(b"-").isdigit():
            raise LabError(f"release_us = {schema.metadata[RELEASE_US]!r}: expected microseconds")
    if "t" not in schema.names:
        raise LabError(f"{path}: not a flight log (no column t)")
    for field in schema:
        kind = field.type
        if not (pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)):
            raise LabError(f"{path}: not a flight log ({field.name} is of type {kind}: expected numbers)")
    return schema


def _line(error: Exception) -> str:
    return " ".join(str(error).split())


def stored_in(metadata: Mapping[bytes, bytes] | None, name: str) -> dict[str, Any]:
    """Return what a log's metadata hold as JSON: one of `STORED`; empty for a log without. Raises `LabError`."""
    try:
        stored = json.loads((metadata or {}).get(name.encode(), b"{}"))
    except (ValueError, RecursionError) as error:
        raise LabError(f"{name} in the log's schema: not JSON: {error}") from None
    if not isinstance(stored, dict):
        raise LabError(f"{name} in the log's schema: expected a table")
    return stored


def config_of(folder: Path, metadata: Mapping[bytes, bytes] | None) -> LabConfig:
    """Return the configuration of a flight from its log's metadata. Raises `LabError` for one of another version."""
    try:
        return LabConfig.model_validate(stored_in(metadata, "config"))
    except ValidationError as error:
        key = ".".join(map(str, error.errors()[0]["loc"]))
        raise LabError(
            f"{folder}: flown by another version, whose configuration this one does not read ({key})"
        ) from None


def release_of(metadata: Mapping[bytes, bytes] | None) -> int:
    """Return when the robot of a log was released [us], or when that was planned; 0 for a log with neither."""
    known = metadata or {}
    if RELEASE_US in known:
        return int(known[RELEASE_US])
    return int(stored_in(known, "config").get("flight", {}).get("release_us", 0))


def load_events(folder: Path) -> list[dict[str, Any]]:
    """Return the texts of a run: dicts with `t_us`, `source` and `text`. Raises `LabError` for a line that is no event.

    The last line may be incomplete: it was being written when the process died.
    """
    path, events = folder / EVENTS, []
    with refusing(f"{path}: ", OSError):
        lines = path.read_bytes().split(b"\n") if path.exists() else [b""]
    for number, line in enumerate(lines[:-1], 1):
        try:
            event = json.loads(line)
            if not (abs(int(event["t_us"])) < TIMES_US and isinstance(event["text"] + event["source"], str)):
                raise ValueError
            f"{event['text']}{event['source']}".encode()
        except (ValueError, TypeError, KeyError, RecursionError):
            raise LabError(
                f"{path}:{number}: not an event: expected JSON with t_us, source and text"
            ) from None
        events.append(event)
    return events


def _with_metadata(table: pa.Table, more: Mapping[bytes, bytes]) -> pa.Table:
    return table.replace_schema_metadata({**(table.schema.metadata or {}), **more})


def _with_release(table: pa.Table) -> pa.Table:
    """Return the log of a real flight with its release, which was not known when the stream began."""
    free = np.flatnonzero(table.column("flight.free").to_numpy())
    first_us = table.column("t")[int(free[0]) if len(free) else 0].as_py() if table.num_rows else 0
    return _with_metadata(table, {RELEASE_US: str(first_us).encode()})


def _read_stream(path: Path) -> Iterator[pa.Table]:
    """Yield the log in pieces, at least one; that of a real flight in one piece, which its corrections need."""
    try:
        # A mapped file would stay in memory.
        with pa.OSFile(str(path)) as file, pa.ipc.open_stream(file) as reader:
            schema, batches = _checked(path, reader.schema), []
            real = "cameras.x" in schema.names
            with suppress(StopIteration, *ARROW_ERRORS, OSError):  # the end, or where a process died
                while True:
                    batches.append(reader.read_next_batch())
                    if len(batches) == BATCHES_PER_PIECE and not real:
                        yield pa.Table.from_batches(batches, schema)
                        batches = []
    except (*ARROW_ERRORS, OSError) as error:
        raise LabError(f"{path}: not a flight log ({_line(error)})") from None
    table = pa.Table.from_batches(batches, schema)
    yield _with_release(at_exposure(table)) if real else table
