"""What a real flight writes, and the one rule for it: files, run folder, standard output.

The first write that fails ends that output, with one line for the user. The flight continues, its end is orderly, and
the exit code `INCOMPLETE` reports that something is missing. A standard output that nobody reads, like that of a pager or
a connection that hangs, does not stop the flight either: its lines are dropped and counted.
"""

import os
import sys
from collections.abc import Callable
from typing import ParamSpec

from ground_station.clock import is_writable
from ground_station.lines import print_line

INCOMPLETE = 3  # exit code
STANDARD_OUTPUT = "standard output"

P = ParamSpec("P")


class Records:
    """The outputs of one flight, each by its name: a path, or the standard output."""

    def __init__(self) -> None:
        self._failed: set[object] = set()
        self._notices: list[str] = []
        self._dropped = 0  # lines of the standard output
        self._reported = 0  # of them

    @property
    def incomplete(self) -> bool:
        """Whether anything is missing in any output."""
        return bool(self._failed or self._dropped)

    def failed(self, name: object) -> bool:
        """Return whether an output has failed."""
        return name in self._failed

    def write(self, name: object, write: Callable[P, object], *what: P.args, **more: P.kwargs) -> None:
        """Write to an output, unless it has failed before."""
        if name not in self._failed:
            self.attempt(name, write, *what, **more)

    def attempt(self, name: object, write: Callable[P, object], *what: P.args, **more: P.kwargs) -> None:
        """Write to an output even if it has failed before, as closing does; an `OSError` ends it."""
        try:
            write(*what, **more)
        except OSError as error:
            self._fail(name, error)

    def guarded(self, name: object, write: Callable[P, object]) -> Callable[P, None]:
        """Return `write` under the rule."""
        return lambda *what, **more: self.write(name, write, *what, **more)

    def print_text(self, text: object) -> None:
        """Print a line on the standard output, unless nobody reads it."""
        if not is_writable(sys.stdout):
            self._dropped += 1
            return
        if self._dropped > self._reported:
            missing, self._reported = self._dropped - self._reported, self._dropped
            self.write(
                STANDARD_OUTPUT, print_line, f"{missing} lines are missing here: nobody read the output"
            )
        self.write(STANDARD_OUTPUT, print_line, text)

    def notices(self) -> list[str]:
        """Return lines for the user since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def _fail(self, name: object, error: OSError) -> None:
        if name in self._failed:
            return
        self._failed.add(name)
        why = os.strerror(error.errno) if error.errno else error
        line = f"{name}: {why}; no more is written to it"
        self._notices.append(line)
        if name == STANDARD_OUTPUT:
            _discard_output()
            self.attempt("standard error", print_line, line, sys.stderr)


def _discard_output() -> None:
    """Lead the standard output nowhere: Python would write what it still holds, and fail again, at its end."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)
