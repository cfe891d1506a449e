"""The schedule of tasks: the kernel's trace of a window of the flight, as `schedule.parquet`.

Columns: `us` (instant), `event` and `who` (the words of tests/vectors/README.md), `a`, `b`. By default the window
is the 50 ms after the release, enough for a picture; `floaty fly --perfetto` traces the whole flight.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from hil.board.board_firmware import BoardScheduler
from hil.errors import LabError
from hil.laboratory.files.recorder import ARROW_ERRORS
from hil.laboratory.files.whole_files import replacing

FILE = "schedule.parquet"
WINDOW_US = 50_000
SCHEMA = pa.schema(
    {"us": pa.int64(), "event": pa.string(), "who": pa.string(), "a": pa.int64(), "b": pa.int64()}
)


@dataclass(frozen=True, slots=True)
class Turn:
    """An interval in which a task had the processor."""

    task: str
    start_us: int
    end_us: int


class ScheduleTrace:
    """Collects the scheduler's trace between `begin` and `end`; the flight plans both as events."""

    def __init__(self, scheduler: BoardScheduler | None) -> None:
        self._scheduler = scheduler
        self._rows: list[tuple[int, str, str, int, int]] = []

    def begin(self, now_us: int) -> None:
        """Start tracing; record a switch to the running task first."""
        if self._scheduler is not None:
            self._take(now_us, "IN", self._scheduler.current.name, self._scheduler.current.priority, 0)
            self._scheduler.set_trace(self._take)

    def end(self, now_us: int) -> None:
        """Stop tracing if it is running."""
        if self._scheduler is not None and self._scheduler.trace is not None:
            self._take(now_us, "END", "-", 0, 0)
            self._scheduler.set_trace(None)

    def write(self, folder: Path) -> None:
        """Write `schedule.parquet`."""
        from pyarrow.parquet import write_table

        columns = list(zip(*self._rows, strict=True)) or [()] * len(SCHEMA)
        table = pa.table([pa.array(c, f.type) for c, f in zip(columns, SCHEMA, strict=True)], schema=SCHEMA)
        with replacing(folder / FILE) as partial:
            write_table(table, partial, compression="zstd")

    def _take(self, us: int, event: str, who: str, a: int, b: int) -> None:
        self._rows.append((us, event, who, a, b))


def load_schedule(folder: Path) -> pa.Table:
    """Return a run's schedule; empty when it has none, as after a kill. Raises `LabError` when it cannot be read."""
    path = folder / FILE
    if not path.exists():
        return SCHEMA.empty_table()
    from pyarrow.parquet import ParquetFile

    try:
        with ParquetFile(path) as file:  # loads no datasets, as `read_table` does
            table = file.read()
            return table if table.schema == SCHEMA else table.cast(SCHEMA)  # loads 30 ms of functions
    except (*ARROW_ERRORS, OSError) as error:
        raise LabError(f"{path}: not a schedule ({' '.join(str(error).split())})") from None


def runs(schedule: pa.Table) -> Iterator[Turn]:
    """Yield the intervals in which tasks had the processor, including the idle task, without empty ones."""
    events, times, names = (schedule.column(name).to_pylist() for name in ("event", "us", "who"))
    task, start_us = "", 0
    for event, us, who in zip(events, times, names, strict=True):
        if event not in ("IN", "END"):
            continue
        if task and us > start_us and who != task:
            yield Turn(task, start_us, us)
        if who != task:
            task, start_us = who, us
