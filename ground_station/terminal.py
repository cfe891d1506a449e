"""Lines typed while a station flies: with history and completion at a terminal, line by line from a pipe.

A thread reads, so that the flight never waits. The only file that uses prompt_toolkit.
"""

import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress

from prompt_toolkit import PromptSession
from prompt_toolkit.completion import WordCompleter
from prompt_toolkit.patch_stdout import patch_stdout

LINES = 1000  # waiting to be fetched
READ_SIZE = 4096
CLOSE_TIMEOUT_S = 1.0


class Terminal:
    """Reads standard input from now on; `words` returns the possible completions."""

    def __init__(self, words: Callable[[], Sequence[str]]) -> None:
        self._lines: queue.Queue[str] = queue.Queue(LINES)
        self._closing = False
        self._session: PromptSession[str] | None = None
        try:
            descriptor = sys.stdin.fileno()
        except (AttributeError, OSError, ValueError):  # there is no standard input
            return
        read = self._read
        if os.isatty(descriptor):
            if not _in_foreground(descriptor):  # a background process that reads is stopped
                return
            if sys.stdout is not None and sys.stdout.isatty():
                completer = WordCompleter(lambda: list(words()), WORD=True)
                self._session = PromptSession(completer=completer, complete_while_typing=False)
                read = self._prompt
        self._thread = threading.Thread(target=read, args=(descriptor,), name="terminal", daemon=True)
        self._thread.start()

    def lines(self) -> list[str]:
        """Return the lines typed since the last call."""
        lines: list[str] = []
        with suppress(queue.Empty):
            while True:
                lines.append(self._lines.get_nowait())
        return lines

    def close(self) -> None:
        self._closing = True
        if self._session is None:
            return
        app = self._session.app
        if app.loop is not None and app.is_running:
            app.loop.call_soon_threadsafe(self._leave)
        self._thread.join(CLOSE_TIMEOUT_S)

    def _leave(self) -> None:
        assert self._session is not None
        with suppress(Exception):  # a line was just finished: the next prompt ends at once
            self._session.app.exit(exception=EOFError)

    def _leave_if_closing(self) -> None:
        if self._closing:
            self._leave()

    def _put(self, line: str) -> None:
        with suppress(queue.Full):
            self._lines.put_nowait(line)

    def _read(self, descriptor: int) -> None:
        """Read a pipe until its end; not through `sys.stdin`, because a waiting thread would keep its lock for ever."""
        rest = b""
        while data := os.read(descriptor, READ_SIZE):
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                self._put(line.decode(errors="replace"))
        if rest:
            self._put(rest.decode(errors="replace"))

    def _prompt(self, descriptor: int) -> None:
        assert self._session is not None
        with patch_stdout():  # output appears above the line that is being typed
            while not self._closing:
                try:
                    self._put(self._session.prompt("> ", pre_run=self._leave_if_closing))
                except KeyboardInterrupt:  # typed here, meant for the program
                    signal.raise_signal(signal.SIGINT)
                except EOFError:
                    return


def _in_foreground(descriptor: int) -> bool:
    with suppress(AttributeError, OSError):  # no such thing on this system
        return os.tcgetpgrp(descriptor) == os.getpgrp()
    return True
