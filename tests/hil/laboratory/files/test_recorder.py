"""The recorder: what was written is what was read, whatever ends the flight."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from hil.errors import LabError
from hil.laboratory.files.recorder import (
    BATCHES_PER_PIECE,
    RELEASE_US,
    ROWS_PER_BATCH,
    STORED,
    Observer,
    Recorder,
    forget_read_columns,
    load_events,
    load_log,
    release_of,
    stored_in,
)
from hil.world.body import Channel, Quantity
from support.watching import Watcher


def make(folder: Path, values: np.ndarray, observer: Observer | None = None) -> Recorder:
    return Recorder(
        folder,
        (
            Channel("float64", lambda: values, (Quantity(("a.x",), "m", "W"), Quantity(("a.y",), "m", "W"))),
            Channel("int32", lambda: int(values[0]), (Quantity(("n",), ""),)),
        ),
        {"seed": "7"},
        observer,
    )


@pytest.mark.parametrize("name", STORED)
@pytest.mark.parametrize(("text", "error"), [
    (b"{", "not JSON: Expecting"), (b"[" * 100_000, "not JSON: maximum recursion depth"), (b"[1]", "expected a table"),
], ids=["cut", "deep", "list"])  # fmt: skip
def test_what_a_log_s_schema_stores_is_a_table_or_refused(name: str, text: bytes, error: str) -> None:
    with pytest.raises(LabError, match=f"^{name} in the log's schema: {error}"):
        stored_in({name.encode(): text}, name)
    assert stored_in({name.encode(): b'{"a": [1]}'}, name) == {"a": [1]}
    assert stored_in({b"other": text}, name) == stored_in(None, name) == {}


def test_rows_survive_the_way_to_parquet_and_to_an_observer_that_keeps_them(tmp_path: Path) -> None:
    watcher, values = Watcher(), np.zeros(2)
    recorder = make(tmp_path, values, watcher)
    for row in range(250):
        values[:] = row, -row
        recorder.row(row * 10)
    recorder.close()
    table = load_log(tmp_path)
    assert table.column("t").to_pylist() == list(range(0, 2500, 10))
    assert table.column("a.y").to_pylist() == [-row for row in range(250)]
    assert table.column("n").to_pylist() == list(range(250))
    assert table.schema.metadata[b"seed"] == b"7"
    assert not (tmp_path / "log.arrows").exists()
    assert pa.Table.from_batches(watcher.batches).equals(table)
    assert watcher.notes == []


@pytest.mark.parametrize("writable", [True, False])
def test_a_long_log_is_read_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writable: bool) -> None:
    rows = 2 * ROWS_PER_BATCH * BATCHES_PER_PIECE + 7
    recorder = make(tmp_path, np.ones(2))
    for row in range(rows):
        recorder.row(row)
    recorder.close()
    whole, files = load_log(tmp_path), sorted(tmp_path.iterdir())
    monkeypatch.setattr("hil.laboratory.files.recorder.PIECES_IN_MEMORY", 1)
    monkeypatch.setattr("os.access", lambda path, mode: writable)
    before = pa.total_allocated_bytes()
    mapped = load_log(tmp_path)
    assert pa.total_allocated_bytes() - before < whole.nbytes / 10
    assert mapped.equals(whole, check_metadata=True)
    assert sorted(tmp_path.iterdir()) == files


@pytest.mark.long
def test_a_long_log_is_readable_with_freed_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = 20 * ROWS_PER_BATCH * BATCHES_PER_PIECE
    recorder = make(tmp_path, np.ones(2))
    for row in range(rows):
        recorder.row(row)
    recorder.close()
    monkeypatch.setattr("hil.laboratory.files.recorder.PIECES_IN_MEMORY", 1)
    log = load_log(tmp_path)
    total, before = log.column("t").to_numpy().sum(), mapped_bytes()
    forget_read_columns()
    assert mapped_bytes() < before - 0.9 * 8 * rows
    assert log.column("t").to_numpy().sum() == total == rows * (rows - 1) / 2


def mapped_bytes() -> int:
    """Return how much of mapped files is in this process's memory."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("RssFile:"))


def killed(folder: Path, lost_bytes: int = 0, rows: int = 250, period_us: int = 1) -> Path:
    """What lies on disk of a run when the process dies, and when the disk lost the last bytes."""
    (folder / "run").mkdir()
    recorder = make(folder / "run", np.zeros(2))
    for row in range(rows):
        recorder.row(row * period_us)
    recorder.note(5, "lab", "half way")
    left = folder / "left"
    shutil.copytree(folder / "run", left)
    recorder.close()
    stream = left / "log.arrows"
    stream.write_bytes(stream.read_bytes()[: -lost_bytes or None])
    return left


def test_a_killed_process_leaves_all_complete_seconds(tmp_path: Path) -> None:
    left = killed(tmp_path)
    assert load_log(left).num_rows == 200
    assert load_events(left) == [{"t_us": 5, "source": "lab", "text": "half way"}]


def test_rows_that_are_a_second_apart_are_on_disk(tmp_path: Path) -> None:
    assert load_log(killed(tmp_path, rows=21, period_us=100_000)).num_rows == 11


@pytest.mark.parametrize("sign", [1, -1])
def test_the_time_of_an_event_is_below_the_numbers_that_a_float_rounds(tmp_path: Path, sign: int) -> None:
    line = '{{"t_us": {}, "source": "lab", "text": "a"}}\n'
    (tmp_path / "events.jsonl").write_text(line.format(sign * (2**53 - 1)))
    assert [event["t_us"] for event in load_events(tmp_path)] == [sign * (2**53 - 1)]
    (tmp_path / "events.jsonl").write_text(line.format(0) + line.format(sign * 2**53))
    with pytest.raises(LabError, match=r"events\.jsonl:2: not an event"):
        load_events(tmp_path)


def test_a_flight_that_was_not_released_counts_from_its_planned_release() -> None:
    planned = {b"config": b'{"flight": {"release_us": 5}}'}
    assert [release_of(known) for known in ({}, planned, planned | {RELEASE_US: b"-7"})] == [0, 5, -7]


def test_a_batch_cut_in_the_middle_is_dropped(tmp_path: Path) -> None:
    assert load_log(killed(tmp_path, lost_bytes=500)).num_rows == 100


def test_hash_depends_on_values_and_names_only(tmp_path: Path) -> None:
    digests = []
    for name, value in (("a", 1.0), ("b", 1.0), ("c", 1.0 + 2**-52)):
        (tmp_path / name).mkdir()
        recorder = make(tmp_path / name, np.array([value, 0.0]))
        recorder.row(0)
        digests.append(recorder.close())
    assert digests[0] == digests[1] != digests[2]


def test_a_folder_without_a_log_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LabError, match=r"no log\.parquet or log\.arrows in it; expected a run folder$"):
        load_log(tmp_path)
    for name in "dbca":
        (tmp_path / name).mkdir()
        (tmp_path / name / "log.parquet").touch()
    with pytest.raises(LabError, match=r"in it, but in a, b, c; expected a run folder$"):
        load_log(tmp_path)
    (tmp_path / "log.arrows").write_bytes(b"not arrow at all")
    with pytest.raises(LabError, match="not a flight log"):
        load_log(tmp_path)
