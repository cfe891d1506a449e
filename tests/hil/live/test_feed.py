"""The live feed: whatever its picture does, the flight is the same, and what was missed is counted."""

import json
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pytest

from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import Recorder, load_log
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.live import feed
from hil.live.feed import Feed, LiveView
from hil.world.body import Channel, Quantity
from support.watching import Watcher

# Pictures that do not behave, in place of `hil.live.picture`; what they do is their whole program.
STALLS = "print('ready', flush=True); import signal; signal.pause()"
IS_CLOSED = """
import pyarrow as pa, sys
print('ready', flush=True)
reader = pa.ipc.open_stream(sys.stdin.buffer)
print('taken', reader.read_next_batch().num_rows, flush=True)
"""  # in mid-flight
NEVER_COMES_UP = "import signal; signal.pause()"
FAILS = "print('failed no such screen', flush=True)"
DIES = "raise SystemExit"
TAKES_ALL = """
import pyarrow as pa, sys
print('ready here', flush=True)
reader, taken = pa.ipc.open_stream(sys.stdin.buffer), 0
for batch in reader:
    taken += batch.num_rows
    print('taken', taken, flush=True)
print('typed set a.b 2.0', flush=True)
"""


def picture(program: str) -> list[str]:
    """The command of a picture."""
    return [sys.executable, "-c", program]


SCHEMA = pa.schema([("t", pa.int64())])


def rows(first: int, count: int) -> pa.RecordBatch:
    return pa.record_batch([pa.array(range(first, first + count), pa.int64())], schema=SCHEMA)


def flight_hash(folder: Path, view: LiveView | None) -> str:
    return fly(Request.of(EXPERIMENTS["hover"], duration_s=0.5), folder, observer=view).hash


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The hash of a flight of 150 rows that nobody watches."""
    return flight_hash(tmp_path_factory.mktemp("unseen") / "run", None)


@pytest.mark.long
@pytest.mark.parametrize(
    ("program", "taken"),
    [
        (STALLS, range(1)),
        (IS_CLOSED, range(20, 150)),
        (NEVER_COMES_UP, range(1)),
        (TAKES_ALL, range(150, 151)),
    ],
)
def test_the_picture_does_not_affect_flights(program: str, taken: range, unseen: str, tmp_path: Path) -> None:
    is_silent = program == NEVER_COMES_UP
    view = LiveView(picture(program), [].append, start_timeout_s=0.01 if is_silent else 30)
    assert flight_hash(tmp_path / "run", view) == unseen
    missed = view.close(0.0 if program == STALLS else 30)
    assert load_log(tmp_path / "run").num_rows == view.offered == 150
    assert view.offered - missed in taken


@pytest.mark.long
def test_rows_beyond_the_queue_are_dropped_and_counted() -> None:
    view = LiveView(picture(STALLS), [].append)
    for piece in range(2000):
        view.rows(rows(1000 * piece, 1000))  # 8 kB: more than a pipe holds
    assert len(view._feed._waiting) == feed.QUEUE_PIECES
    assert view.close(0.0) == 2_000_000
    assert not view._feed._thread.is_alive()  # it was in the middle of a piece


def test_a_silent_picture_does_not_delay_the_flight() -> None:
    said: list[str] = []
    view = LiveView(picture(NEVER_COMES_UP), said.append, start_timeout_s=0.01)
    assert said == ["the viewer has not opened within 0.01 s; the flight goes on without waiting"]
    view.rows(rows(0, 20))
    assert view.close(catch_up_s=3600.0) == 20, "nor its end: it may never open"


@pytest.mark.parametrize(("program", "why"), [(FAILS, "no such screen"), (DIES, "ended without a message")])
def test_a_picture_that_cannot_come_up_is_an_error_before_the_flight_and_is_ended(
    program: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[subprocess.Popen[bytes]] = []
    start = subprocess.Popen
    monkeypatch.setattr(
        feed.subprocess, "Popen", lambda *what, **how: started.append(start(*what, **how)) or started[-1]
    )
    with pytest.raises(LabError, match=why):
        LiveView(picture(program), [].append, 5.0)
    assert [one.returncode is None for one in started] == [False]


def test_a_picture_that_ends_is_told_once_it_was_open() -> None:
    said: list[str] = []
    lines = [
        (feed.FAILED, "early"),
        (feed.READY, "here"),
        (feed.TAKEN, "20"),
        (feed.TYPED, "set a 1"),
        (feed.FAILED, "gone"),
    ]
    view: Any = SimpleNamespace(
        _process=SimpleNamespace(stdout=[f"{word} {text}\n".encode() for word, text in lines]),
        _up=threading.Event(), _line_arrived=threading.Event(), _typed=[], _failure="", taken=0,
    )  # fmt: skip
    LiveView._listen(view, said.append)
    assert said == ["view   here", "the viewer has ended: gone"]
    assert (view.address, view.taken, view._typed, view._failure) == ("here", 20, ["set a 1"], "gone")
    assert (view._up.is_set(), view._line_arrived.is_set()) == (True, True)


def test_a_picture_reports_its_address_and_typed_lines() -> None:
    said: list[str] = []
    view = LiveView(picture(TAKES_ALL), said.append)
    for number in range(feed.LINES + 1):
        view.note(5, "lab", f"text {number}")
    assert (len(view._texts), view._texts[0]["text"]) == (feed.LINES, "text 1"), "the oldest gives way"
    view.rows(rows(0, 20))
    view.note(25, "lab", "the last text")
    assert view.close() == 0
    assert said == ["view   here"]
    assert view.lines() == ["set a.b 2.0"]
    assert view.lines() == []


@pytest.mark.long
def test_texts_and_parameters_travel_with_the_rows() -> None:
    """The picture's program is the test's own: it says back what it got."""
    program = """
import pyarrow as pa, sys
print('ready', flush=True)
reader = pa.ipc.open_stream(sys.stdin.buffer)
try:
    while True:
        batch, metadata = reader.read_next_batch_with_custom_metadata()
        print('typed', batch.num_rows, metadata[b'events'].decode(), metadata[b'parameters'].decode(), flush=True)
except StopIteration:
    pass
"""
    view = LiveView(picture(program), [].append)
    many = {f"p.{number}": float(number) for number in range(500)}  # a board has a hundred
    view.know([("a.b", 1.0), ("c.d", 3.0), *many.items()])
    view.know([("a.b", 2.0)])
    view.note(7, "lab", "released")
    view.rows(rows(0, 20))
    view.note(30, "lab", "over")
    view.close()
    first, last = (
        '{"t_us": 7, "source": "lab", "text": "released"}',
        '{"t_us": 30, "source": "lab", "text": "over"}',
    )
    known = json.dumps({"a.b": 2.0, "c.d": 3.0, **many})
    assert " ".join(view.lines()) in (
        f"20 [{first}] {known} 0 [{last}] {{}}",
        f"20 [{first}, {last}] {known}",  # both waited
    )


def test_a_full_feed_drops_the_oldest_and_never_waits() -> None:
    busy, go_on, seen = threading.Event(), threading.Event(), list[int]()

    def sink(pieces: list[feed.Piece]) -> None:
        busy.set()
        go_on.wait()
        seen.extend(batch.column(0)[0].as_py() for batch, _ in pieces)

    queue = Feed(sink, capacity=3)
    queue.offer((rows(0, 1), []))
    busy.wait()
    for item in range(1, 9):
        queue.offer((rows(item, 1), []))
    assert not queue.close(timeout_s=0.05)
    go_on.set()
    assert queue.close(timeout_s=10)
    assert seen == [0, 6, 7, 8]


def test_waiting_pieces_are_written_a_hundred_at_a_time() -> None:
    busy, go_on, together = threading.Event(), threading.Event(), list[int]()

    def sink(pieces: list[feed.Piece]) -> None:
        together.append(len(pieces))
        busy.set()
        go_on.wait()

    queue = Feed(sink)
    queue.offer((rows(0, 1), []))
    busy.wait()
    for item in range(250):
        queue.offer((rows(item, 1), []))
    go_on.set()
    assert queue.close(timeout_s=10)
    assert together == [1, 100, 100, 50]


@pytest.mark.parametrize("kept", [True, False])
def test_a_viewer_gets_every_row_once_five_times_a_second(kept: bool, tmp_path: Path) -> None:
    seen, value = Watcher(), [0.0]
    channel = Channel("float64", lambda: value, (Quantity(("x",), "m"),))
    recorder = Recorder(tmp_path if kept else None, (channel,), {}, seen)
    for row in range(250):
        recorder.row(10_000 * row)
    recorder.note(2_500_000, "lab", "over")
    recorder.close()
    assert pa.Table.from_batches(seen.batches)["t"].to_pylist() == [10_000 * row for row in range(250)]
    assert max(batch.num_rows for batch in seen.batches) == 20
    assert seen.notes == [(2_500_000, "lab", "over")]
    assert bool(list(tmp_path.iterdir())) is kept


def test_a_picture_stays_until_it_ends_by_itself() -> None:
    view = LiveView(picture(IS_CLOSED), [].append)
    view.rows(rows(0, 20))
    view.stay()
    assert view.close() == 0
    assert view.close() == 0


@pytest.mark.long
def test_nothing_is_imported_while_a_flight_is_recorded_and_shown() -> None:
    """An import takes up to seconds on a busy machine; pyarrow imports pandas when it first sees an array of numpy's."""
    program = f"""
import sys, tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from hil.laboratory.files.recorder import Recorder
from hil.live.feed import LiveView
from hil.world.body import Channel, Quantity
view = LiveView([sys.executable, '-c', {TAKES_ALL!r}], print)
with tempfile.TemporaryDirectory() as folder:
    recorder = Recorder(Path(folder), (Channel('float64', lambda: 0.0, (Quantity(('x',), 'm'),)),), {{}}, view)
    before = set(sys.modules)
    for row in range(250):
        recorder.note(row, 'lab', 'text')
        recorder.row(10_000 * row)
    while not view.taken:
        pass
    print(sorted(set(sys.modules) - before))
    recorder.close()
view.close()
"""
    shown = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert shown.stdout.splitlines() == ["view   here", "[]"]


ANSWERS = """
import json, pyarrow as pa, sys
print('ready', flush=True)
reader, taken = pa.ipc.open_stream(sys.stdin.buffer), 0
for number in range(2):
    batch, metadata = reader.read_next_batch_with_custom_metadata()
    taken += batch.num_rows
    print('taken', taken, flush=True)
    print('typed', batch.num_rows, *[one['text'] for one in json.loads(metadata[b'events'])], flush=True)
print('failed out of words', flush=True)
"""


@pytest.mark.long
def test_a_picture_that_opened_late_catches_up_and_what_ends_it_later_is_said_at_once() -> None:
    """An answer goes with no rows; nobody waits for a picture that has ended."""
    said: list[str] = []
    view = LiveView(picture(ANSWERS), said.append, start_timeout_s=0.0)
    view.rows(rows(0, 20))
    assert view.wait() == ["20"]
    view.answer(7, "set a.b: refused")
    assert view.wait() == ["0 set a.b: refused"]
    view.stay()
    assert view.wait() == []
    assert view.close() == 0
    assert said == ["the viewer has not opened within 0 s; the flight goes on without waiting",
        "the viewer has ended: out of words"]  # fmt: skip
    late = LiveView(picture(ANSWERS), said.append, start_timeout_s=0.0)
    late.rows(rows(0, 20))
    assert late.wait() == ["20"]
    late.rows(rows(20, 20))
    assert late.close() == 0, "it has time for the rest"
