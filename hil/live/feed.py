"""Sends rows and texts of a flight to its live picture.

The picture has a separate process (`hil.live.picture`), at a lower priority. Its data wait in a bounded queue for the
thread that writes them into a pipe: an Arrow stream, whose batches carry texts and the board's parameters as metadata.
Lines come back: the number of rows taken, and typed commands. A picture that is slow, hangs, is closed or never opens
delays nothing: rows that it does not take are dropped and counted.
"""

import json
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeVar

import pyarrow as pa

from hil.errors import LabError

START_TIMEOUT_S = 30.0  # for the picture to open, after which it is not waited for
CATCH_UP_S = 10.0  # for it to show the rest at the end
PIPE_BREAKS_S = 1.0  # for a writing thread to notice that the reader is gone
QUEUE_PIECES = 300  # as the recorder shows them: a minute of flight
TOGETHER = 100  # pieces that are written as one batch, when that many wait
WAIT_S = 0.2  # before it looks whether the picture still runs
LINES = 1000  # typed lines that wait to be fetched; texts before the first row
EVENTS, PARAMETERS = b"events", b"parameters"  # metadata of a batch
READY, FAILED, TAKEN, TYPED = "ready", "failed", "taken", "typed"  # first words of the returned lines

T = TypeVar("T")
Piece = tuple[pa.RecordBatch, list[dict[str, Any]]]


class Feed:
    """Passes pieces to a sink in a thread of its own; when the sink is slow, the oldest waiting ones are dropped."""

    def __init__(self, sink: Callable[[list[Piece]], None], capacity: int = QUEUE_PIECES) -> None:
        self._sink = sink
        self._waiting: deque[Piece] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="live feed", daemon=True)
        self._thread.start()

    def offer(self, piece: Piece) -> None:
        """Queue a piece; returns at once."""
        with self._changed:
            self._waiting.append(piece)
            self._changed.notify()

    def close(self, timeout_s: float) -> bool:
        """Let the sink finish what is waiting; False when it did not within the time."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                pieces = _all(self._waiting, TOGETHER)
            try:
                self._sink(pieces)
            except OSError:  # the picture has gone
                return


class LiveView:
    """`hil.laboratory.files.recorder.Observer` of a picture in another process, which `command` starts.

    `say` gets lines for the user. Raises `LabError` when the picture reports that it cannot open; a silent one is
    not waited for.
    """

    def __init__(
        self, command: Sequence[str], say: Callable[[str], None], start_timeout_s: float = START_TIMEOUT_S
    ) -> None:
        self.offered = self.taken = 0  # rows
        self.address = ""  # of a picture that is served until it ends
        self._texts: deque[dict[str, Any]] = deque(maxlen=LINES)
        self._line_arrived = threading.Event()  # a line came, or the picture has ended
        self._typed: deque[str] = deque(maxlen=LINES)
        self._parameters: deque[tuple[str, float]] = deque()  # not yet sent to the picture
        self._schema: pa.Schema | None = None
        self._stream: Any = None
        self._failure = ""
        self._is_late = False
        self._up = threading.Event()  # set when it has reported whether it opens, or has ended
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, start_new_session=True
        )  # fmt: skip
        self._answers = threading.Thread(
            target=self._listen, args=(say,), name="live feed answers", daemon=True
        )
        self._answers.start()
        self._feed = Feed(self._write)
        if not self._up.wait(start_timeout_s):
            self._is_late = True
            say(f"the viewer has not opened within {start_timeout_s:g} s; the flight goes on without waiting")
        elif self._failure:
            self._end()
            raise LabError(self._failure)

    # Recorder's observer

    def rows(self, batch: pa.RecordBatch) -> None:
        """Queue the next rows, with the texts before them."""
        self.offered += batch.num_rows
        self._schema = batch.schema
        self._feed.offer((batch, _all(self._texts)))

    def note(self, t_us: int, source: str, text: str) -> None:
        """Keep a text for the next rows."""
        self._texts.append({"t_us": t_us, "source": source, "text": text})

    # Parameters of the board, which some pictures show and can change

    def know(self, values: Sequence[tuple[str, float]]) -> None:
        """Send values of the board's parameters with the next rows."""
        self._parameters.extend(values)

    def lines(self) -> list[str]:
        """Return what was typed at the picture since the last call."""
        return _all(self._typed)

    def wait(self) -> list[str]:
        """Wait until something is typed, and return it; nothing when the picture has ended."""
        while not self._typed and self._answers.is_alive():
            self._line_arrived.wait(WAIT_S)
            self._line_arrived.clear()
        return self.lines()

    def answer(self, t_us: int, text: str) -> None:
        """Show a text at once."""
        self.note(t_us, "panel", text)
        self._flush()

    # The end

    def stay(self) -> None:
        """Wait until the picture ends or Ctrl-C is pressed."""
        self._flush()
        with suppress(KeyboardInterrupt):
            self._process.wait()

    def close(self, catch_up_s: float = CATCH_UP_S) -> int:
        """Let the picture catch up for a while and end; returns how many rows it did not take. May be called again."""
        self._flush()
        if self._is_late and not self.taken:
            catch_up_s = 0.0
        if self._feed.close(catch_up_s):
            with suppress(OSError):
                if self._stream is not None:
                    self._stream.close()
            self._stream = None
            self._close_pipe()
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(catch_up_s)
        self._end()
        return self.offered - self.taken

    def _flush(self) -> None:
        """Send the texts for which no rows follow."""
        if self._texts and self._schema is not None:
            self.rows(pa.RecordBatch.from_pylist([], schema=self._schema))

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()
        self._answers.join()
        if self._feed.close(PIPE_BREAKS_S):
            self._close_pipe()  # otherwise a process that the picture started holds its other end
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _close_pipe(self) -> None:
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()

    # Threads

    def _write(self, pieces: list[Piece]) -> None:
        """Write pieces into the pipe, in the feed's thread. `OSError`: the reader is gone."""
        batches = [batch for batch, _ in pieces]
        if self._stream is None:
            self._stream = pa.ipc.new_stream(self._process.stdin, batches[0].schema)
        events = [event for _, texts in pieces for event in texts]
        known = dict(_all(self._parameters))
        metadata = {EVENTS: json.dumps(events).encode(), PARAMETERS: json.dumps(known).encode()}
        (batch, *_) = pa.Table.from_batches(batches).combine_chunks().to_batches() or batches
        self._stream.write_batch(batch, custom_metadata=metadata)
        assert self._process.stdin is not None
        self._process.stdin.flush()

    def _listen(self, say: Callable[[str], None]) -> None:
        """Take the lines of the picture until it ends."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            word, _, text = line.decode(errors="replace").strip().partition(" ")
            if word == READY:
                self.address = text
                if text:
                    say(f"view   {text}")
                self._up.set()
            elif word == FAILED:
                self._failure = text
                if self._up.is_set():
                    say(f"the viewer has ended: {text}")
            elif word == TAKEN:
                self.taken = int(text)
            elif word == TYPED:
                self._typed.append(text)
                self._line_arrived.set()
        if not self._up.is_set():
            self._failure = self._failure or "the viewer's process ended without a message"
            self._up.set()


def _all(waiting: deque[T], most: int = LINES) -> list[T]:
    """Take the waiting items; another thread may add to them meanwhile."""
    return [waiting.popleft() for _ in range(min(len(waiting), most))]


def open_view(target: str, program: str, say: Callable[[str], None]) -> LiveView:
    """Return the picture for a target of `--view`, with the commands of a program: fly, serve or station.

    Raises `LabError` for an unknown target, or one that cannot open.
    """
    return LiveView([sys.executable, "-m", "hil.live.picture", target, program], say)


def missed_text(rows: int) -> str:
    """Return the notice about rows that a picture has missed."""
    return f"the live viewer did not take {rows} rows of the flight"
