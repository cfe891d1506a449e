"""Refused requests on the console: each kind at once, and while it goes on one line per period with a count."""

from collections.abc import Callable
from typing import Final

from firmware_py.rtos import Kernel

PERIOD_US: Final = 10_000_000


class Notices:
    """Limits the lines per kind. The caller keeps the number of kinds small: what a client sends is not part of it."""

    def __init__(self, kernel: Kernel, say: Callable[[str], None]) -> None:
        self._kernel = kernel
        self._say = say
        self._said_us: dict[str, int] = {}
        self._withheld: dict[str, int] = {}

    def refuse(self, kind: str, line: str) -> None:
        """Report a refused request, or count it when one of its kind was reported less than a period ago."""
        now_us = self._kernel.now_us
        if now_us - self._said_us.get(kind, -PERIOD_US) < PERIOD_US:
            self._withheld[kind] = self._withheld.get(kind, 0) + 1
            return
        withheld = self._withheld.pop(kind, 0)
        self._said_us[kind] = now_us
        self._say(f"{line} ({withheld} more before)" if withheld else line)
