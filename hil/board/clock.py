"""Clocks: simulated time runs freely, or follows the wall clock step by step. The only file that sleeps."""

import os
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from ground_station.clock import readable

PROCESS = Path("/proc/self/stat")
START_TIME = 19  # index of the field after the process's name, in ticks since the machine's boot

Readers = dict[socket.socket | int, Callable[[int], None]]


class Clock(Protocol):
    """Waits until the time of a simulated event."""

    paced: bool

    @property
    def stood_still_us(self) -> int:
        """The total pause of simulated time because the machine was too slow."""

    def start(self, now_us: int) -> None:
        """Start the clock at the simulated instant."""

    def wait_until(self, now_us: int) -> int:
        """Wait for a simulated time, or for an earlier one with input from outside; return the one reached."""

    def serve(self, now_us: int) -> None:
        """Read the input from outside, at the time that `wait_until` returned."""

    def notices(self) -> list[str]:
        """Return the lines for the user since the last call."""

    def pause(self, wait: Callable[[], None]) -> None:
        """Pause simulated time while `wait` runs."""


class FreeRunning:
    """Never waits."""

    paced = False
    stood_still_us = 0

    def start(self, now_us: int) -> None:
        """Do nothing: it never waits."""

    def wait_until(self, now_us: int) -> int:
        return now_us

    def serve(self, now_us: int) -> None:
        """Do nothing: there is no input from outside."""

    def notices(self) -> list[str]:
        """Return nothing: it cannot be late."""
        return []

    def pause(self, wait: Callable[[], None]) -> None:
        wait()


class Paced:
    """One simulated second per real second.

    Small delays are caught up. More than `STALL_US` is a stall: simulated time continues without catching up, because
    outside clients would otherwise get a burst of past data, and a line reports the pause. Time starts at a multiple of
    `STALL_US` of the wall clock and stalls for multiples of it, so that cameras in several processes expose together.
    `readers` are called with the time when their socket or file descriptor is readable.

    Clocks of several processes stand still together: each writes its total to its own place in the shared `pauses`, and
    pauses so that none is more than `APART_US` behind the longest. With less room than that, the hitch of one process
    would stop all of them.
    """

    paced = True

    SLACK_US = 1000  # do not sleep for less than this
    STALL_US = 20_000
    APART_US = 100_000  # a multiple of STALL_US
    NOTICE_PERIOD_US = 1_000_000  # of simulated time between lines

    def __init__(self, pauses: "memoryview[int] | None" = None, index: int = 0) -> None:
        self._pauses, self._index = memoryview(bytearray(8)).cast("q") if pauses is None else pauses, index
        self.readers: Readers = {}
        self._readable: list[socket.socket | int] = []
        self._served_us = 0  # the latest instant
        self._start_ns: int | None = None  # at simulated time 0
        self._reported_us = 0  # reported pause
        self._next_notice_us = 0

    def start(self, now_us: int) -> None:
        self._served_us = now_us
        multiple_ns = self.STALL_US * 1000
        self._start_ns = -((now_us * 1000 - time.monotonic_ns()) // multiple_ns) * multiple_ns

    @property
    def stood_still_us(self) -> int:
        """The total pause of simulated time because the machine was too slow."""
        return self._pauses[self._index]

    def shift(self, by_us: int) -> None:
        """Shift simulated time on the wall clock, later if positive."""
        if self._start_ns is not None:
            self._start_ns += by_us * 1000

    def late_us(self, now_us: int) -> int:
        """Return how late a simulated time is; only after `start`."""
        return self.now_us() - now_us

    def now_us(self) -> int:
        """Return the simulated time by the wall clock; only after `start`."""
        return self.wall_us() - self.began_us

    @property
    def began_us(self) -> int:
        """The wall clock at simulated time 0; 0 before `start`."""
        return 0 if self._start_ns is None else self._start_ns // 1000

    @staticmethod
    def wall_us() -> int:
        """Return the wall clock [us], the same for all processes of this computer."""
        return time.monotonic_ns() // 1000

    def ahead_us(self, now_us: int) -> int:
        """Return the time until a simulated instant, 0 when it is due; the first call sets the start."""
        if self._start_ns is None:
            self.start(now_us)
        late_us = self.late_us(now_us)
        pause_us = max(0, max(self._pauses) - self.APART_US - self.stood_still_us)
        if late_us - pause_us > self.STALL_US:
            pause_us += (late_us - pause_us) // self.STALL_US * self.STALL_US
        if pause_us:
            self.shift(pause_us)
            self._pauses[self._index] += pause_us
        return max(0, pause_us - late_us)

    def wait_until(self, now_us: int) -> int:
        """Sleep until the wall clock reaches the time, or a reader has input."""
        ahead_us = self.ahead_us(now_us)
        if self.readers:
            self._readable = readable(self.readers, ahead_us * 1e-6)
        elif ahead_us > self.SLACK_US:
            time.sleep(ahead_us * 1e-6)
        if self._readable:
            now_us = min(now_us, max(self._served_us, self.now_us()))
        self._served_us = now_us
        return now_us

    def serve(self, now_us: int) -> None:
        """Call the readers that have input."""
        for reader in self._readable:
            if reader in self.readers:  # not closed by another one
                self.readers[reader](now_us)
        self._readable = []

    def standstill_us(self, now_us: int) -> int:
        """Return how long simulated time stood still up to a simulated instant, with the stall that it is in."""
        late_us = self.late_us(now_us) if self._start_ns is not None else 0
        return self.stood_still_us + max(late_us // self.STALL_US * self.STALL_US, 0)

    def pause(self, wait: Callable[[], None]) -> None:
        began_us = self.wall_us()
        wait()
        self.shift(self.wall_us() - began_us)

    def notices(self) -> list[str]:
        """Return the lines for the user since the last call, at most one per simulated second."""
        fresh_us = self.stood_still_us - self._reported_us
        if fresh_us == 0 or self.now_us() < self._next_notice_us:
            return []
        self._reported_us = self.stood_still_us
        self._next_notice_us = self.now_us() + self.NOTICE_PERIOD_US
        return [f"this machine was too slow: time stood still for {fresh_us / 1000:.0f} ms"]


def process_age_s() -> float:
    """Return this process's age; NaN if the system does not report its start."""
    try:
        figures = PROCESS.read_text().rpartition(")")[2].split()
    except OSError:
        return float("nan")
    return time.clock_gettime(time.CLOCK_BOOTTIME) - int(figures[START_TIME]) / os.sysconf("SC_CLK_TCK")


class Pace:
    """Simulated over real time, from the first `start_when_due` at or after an instant; before that, from the start."""

    def __init__(self, from_us: int) -> None:
        self._from_us: int | None = from_us
        self._us, self._ns = 0, time.monotonic_ns()

    def start_when_due(self, now_us: int) -> None:
        """Start counting when it is time."""
        if self._from_us is not None and now_us >= self._from_us:
            self._from_us = None
            self._us, self._ns = now_us, time.monotonic_ns()

    def factor(self, now_us: int) -> float:
        """Return the factor up to now."""
        return (now_us - self._us) * 1e3 / (time.monotonic_ns() - self._ns)
