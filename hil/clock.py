"""How simulated time follows the wall clock: not at all, or step by step. The only file that sleeps."""

import time
from typing import Protocol


class Clock(Protocol):
    """Waits until a simulated instant may happen."""

    def wait_until(self, now_us: int) -> None:
        """Return when the simulated instant may happen."""
        ...


class FreeRunning:
    """Every instant may happen at once."""

    def wait_until(self, now_us: int) -> None:
        """Return at once."""


class Paced:
    """One simulated second per real second; it never skips, and remembers how late it was."""

    SLACK_US = 1000  # do not sleep for less than this

    def __init__(self) -> None:
        self.worst_lag_us = 0
        self._start_ns: int | None = None

    def wait_until(self, now_us: int) -> None:
        """Sleep until the wall clock has reached the instant; the first one sets the start."""
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns() - now_us * 1000
        ahead_us = now_us - (time.monotonic_ns() - self._start_ns) // 1000
        if ahead_us > self.SLACK_US:
            time.sleep(ahead_us * 1e-6)
        elif -ahead_us > self.worst_lag_us:
            self.worst_lag_us = -ahead_us
