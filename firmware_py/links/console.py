"""The console: lines of text on port 0, in pieces of at most 30 bytes, to other links and to the debug pins.

Refused requests are reported there: each kind at once, and repetitions as one line per period with a count.
"""

from collections.abc import Callable, Iterator
from typing import Final

from firmware_py.board import Board
from firmware_py.links.crtp_stack import CrtpStack, Task
from firmware_py.rtos import Kernel, Queue
from firmware_py.wire.crtp import MAX_DATA, PORT_CONSOLE, Packet, encode

LINE_QUEUE = 40  # a task dump at once
LINE_LIMIT = 200  # letters


class Console:
    """Takes lines from anywhere on board; its task sends them when no other task is ready."""

    def __init__(self, stack: CrtpStack, board: Board) -> None:
        self._stack = stack
        self._board = board
        self.listeners: list[Callable[[str], object]] = []  # of other links
        self._lines: Queue[str] = stack.kernel.create_queue(LINE_QUEUE, "console")
        stack.kernel.create_task("CONSOLE", 0, self._task)

    def write(self, line: str) -> None:
        """Queue a line without its end. A plain call, so that code that cannot wait can use it.

        A task calls `yield_if_pending` after it.
        """
        self._board.debug_write(line)
        self._lines.send_nowait(line)
        for listen in self.listeners:
            listen(line)

    def _task(self) -> Task:
        while True:
            line = yield from self._lines.receive()
            for piece in pieces((line or "")[:LINE_LIMIT] + "\n"):
                yield from self._stack.kernel.work(self._stack.cost.crtp_us)
                yield from self._stack.deliver(encode(Packet(PORT_CONSOLE, 0, piece)))


def pieces(text: str) -> Iterator[bytes]:
    """Yield the UTF-8 bytes of `text` in pieces of at most 30, cut only between characters."""
    piece = b""
    for character in text:
        encoded = character.encode("utf-8", "replace")
        if len(piece) + len(encoded) > MAX_DATA:
            yield piece
            piece = b""
        piece += encoded
    yield piece


PERIOD_US: Final = 10_000_000


class Notices:
    """Limits the lines per kind. The caller keeps the number of kinds small: clients' input is not part of a kind."""

    def __init__(self, kernel: Kernel, write: Callable[[str], None]) -> None:
        self._kernel = kernel
        self._write = write
        self._reported_us: dict[str, int] = {}
        self._withheld: dict[str, int] = {}

    def refuse(self, kind: str, line: str) -> None:
        """Report a refused request, or count it when its kind was reported less than a period ago."""
        now_us = self._kernel.now_us
        if now_us - self._reported_us.get(kind, -PERIOD_US) < PERIOD_US:
            self._withheld[kind] = self._withheld.get(kind, 0) + 1
            return
        withheld = self._withheld.pop(kind, 0)
        self._reported_us[kind] = now_us
        self._write(f"{line} ({withheld} more before)" if withheld else line)
