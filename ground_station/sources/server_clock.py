"""The clock of another computer, seen through messages: between which limits its offset to ours must lie.

A message that the server sent at s and that arrived at t says offset <= t - s; one that was asked for at a and answered
at s says offset >= a - s. The limits widen with time because clocks drift; the middle is the estimate.
"""

import math

DRIFT = 50e-6  # between two computers, at most; quartz


class ServerClock:
    """Maps ticks of the server to our microseconds."""

    def __init__(self, hz: int) -> None:
        self._hz = hz
        self._lower = -math.inf  # of our clock minus the server's [us]
        self._upper = math.inf
        self._at_us = 0

    def sent(self, ticks: int, now_us: int) -> None:
        """A message that the server sent at `ticks` has arrived."""
        self._limit(-math.inf, now_us - self._us(ticks), now_us)

    def answered(self, asked_us: int, ticks: int, now_us: int) -> None:
        """The request of `asked_us` has been answered at `ticks`."""
        self._limit(asked_us - self._us(ticks), now_us - self._us(ticks), now_us)

    def to_station_us(self, ticks: int) -> int:
        """The instant by our clock; without answers, late by the least latency of a message; call `sent` before."""
        offset = self._upper if self._lower == -math.inf else 0.5 * (self._lower + self._upper)
        return round(self._us(ticks) + offset)

    def _us(self, ticks: int) -> float:
        return ticks * 1e6 / self._hz

    def _limit(self, lower: float, upper: float, now_us: int) -> None:
        wider = DRIFT * (now_us - self._at_us)
        self._at_us = now_us
        self._lower = max(self._lower - wider, lower)
        self._upper = min(self._upper + wider, upper)
        if self._lower > self._upper:  # the server's clock was set
            self._lower, self._upper = lower, upper
