"""The process that shows a live flight: `python -m hil.live.picture TARGET PROGRAM`, fed by `hil.live.feed`.

A TARGET is `window` (rerun's viewer), `web` (the same in a browser, with the commands of PROGRAM: fly, serve or station),
`connect:HOST:PORT` (a viewer that is already open), `foxglove` (a WebSocket server for Foxglove) or `foxglove:parameters`
(which also shows and changes the board's). It reads rows from standard input and writes lines to standard output.
"""

import json
import os
import signal
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import IO, Any, Protocol

import pyarrow as pa

from firmware_py.extras import why_missing
from hil.errors import LabError
from hil.live.feed import EVENTS, FAILED, PARAMETERS, READY, TAKEN, TYPED

WITH_PARAMETERS = "foxglove:parameters"
NICE = 5  # lower priority than everything that flies
Say = Callable[[str, str], None]  # (first word, text)


class Screen(Protocol):
    """Where a flight is shown."""

    address: str  # the address to show to the user; empty if it is not needed

    def show_rows(self, rows: pa.Table, events: Iterable[Mapping[str, Any]]) -> None:
        """Show the next rows, and texts up to them."""

    def know(self, values: Mapping[str, float]) -> None:
        """Show values of the board's parameters."""

    def close(self) -> None:
        """End."""


def open_screen(target: str, program: str, typed: Callable[[str], None]) -> Screen:
    """Return the screen of a target; `typed` takes the typed lines. Raises `LabError`."""
    if target == "web":
        from hil.live.panel import PanelScreen

        return PanelScreen(program, typed)
    if target in ("foxglove", WITH_PARAMETERS):
        from hil.live.foxglove_server import FoxgloveScreen

        return FoxgloveScreen(typed if target == WITH_PARAMETERS else None)
    from hil.live.rerun_screen import RerunScreen

    return RerunScreen(target)


def run(target: str, program: str, rows: IO[bytes], say: Say) -> None:
    """Show what arrives until the stream ends."""
    screen = open_screen(target, program, lambda line: say(TYPED, line))
    say(READY, screen.address)
    taken = 0
    try:
        reader = pa.ipc.open_stream(rows)
        while True:
            batch, metadata = reader.read_next_batch_with_custom_metadata()
            if known := json.loads(metadata[PARAMETERS]):
                screen.know(known)
            screen.show_rows(pa.Table.from_batches([batch]), json.loads(metadata[EVENTS]))
            taken += batch.num_rows
            say(TAKEN, str(taken))
    except (StopIteration, pa.ArrowInvalid):  # the flight is over, or its process was killed
        pass
    finally:
        screen.close()


def main() -> int:
    """Run as a process; returns the exit code."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the flight
    with suppress(OSError):
        os.nice(NICE)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # captures what libraries print

    def say(word: str, text: str) -> None:
        with suppress(OSError):
            print(word, text, file=answers)

    try:
        run(sys.argv[1], sys.argv[2], sys.stdin.buffer, say)
    except LabError as error:
        say(FAILED, str(error))
        return 1
    except Exception as error:  # the flight goes on after any error, which is reported
        missing = why_missing(error) if isinstance(error, ImportError) else ""
        say(FAILED, f"--view {sys.argv[1]}: {missing}" if missing else f"{type(error).__name__}: {error}")
        return 1
    finally:
        with suppress(OSError):
            answers.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
