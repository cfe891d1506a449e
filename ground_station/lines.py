"""Lines on a terminal. What a board, a link or a camera system sends cannot control the terminal."""

import sys
from typing import TextIO


def visible(text: object) -> str:
    r"""Return a text with its control characters, line ends too, as escapes like \x1b."""
    shown = str(text)
    if shown.isprintable():
        return shown
    return "".join(
        one if one.isprintable() else one.encode("unicode_escape").decode("ascii") for one in shown
    )


def print_line(text: object, stream: TextIO | None = None) -> None:
    """Print one line, by default on the standard output, and flush it: a program may read it. Raises `OSError`."""
    stream = stream or sys.stdout
    line = visible(text)
    if stream is not None and stream.encoding:  # escape what the terminal cannot show
        line = line.encode(stream.encoding, "backslashreplace").decode(stream.encoding)
    print(line, file=stream, flush=True)
