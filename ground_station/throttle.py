"""Repeated lines for the user: one of each kind at most every five seconds."""

from collections.abc import Hashable

REPEAT_US = 5_000_000


class Throttle:
    """Admits a line of each kind; the caller keeps the number of kinds small."""

    def __init__(self) -> None:
        self._admitted_us: dict[Hashable, int] = {}

    def admits(self, kind: Hashable, now_us: int) -> bool:
        """Return whether a line of this kind is due, which then counts as printed."""
        last_us = self._admitted_us.get(kind)
        if last_us is not None and now_us - last_us < REPEAT_US:
            return False
        self._admitted_us[kind] = now_us
        return True
