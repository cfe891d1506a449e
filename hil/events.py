"""Hardware events in the order of simulated time: one heap, integer microseconds.

An event is a callback and its planned instant. Events at the same instant run in the order of planning, at most
`EVENTS_AT_ONE_INSTANT`: time would never advance if a callback planned itself at its own instant.
"""

from collections.abc import Callable
from heapq import heappop, heappush, heapreplace
from typing import Final

Callback = Callable[[int], object]  # receives the planned instant [us]

EVENTS_AT_ONE_INSTANT: Final = 10_000  # a hover needs 4


class EndlessInstantError(Exception):
    """The events of one instant are endless; the text names the callback and the instant."""


class EventQueue:
    """The planned events of the hardware. `next_us`: the earliest planned instant, or None."""

    __slots__ = ("_at_this_instant", "_heap", "_order", "next_us", "now_us")

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, Callback]] = []  # instant, order, period or 0
        self._order = 0
        self._at_this_instant = 0  # events that ran at `now_us`
        self.next_us: int | None = None
        self.now_us = 0

    def at(self, time_us: int, callback: Callback) -> None:
        """Plan `callback(time_us)`. Raises `ValueError` for a past instant."""
        self._plan(time_us, 0, callback)

    def every(self, period_us: int, start_us: int, callback: Callback) -> None:
        """Plan `callback` for `start_us` and every `period_us` after it, for ever."""
        if period_us <= 0:
            raise ValueError(f"a period of {period_us} us: it must be above 0")
        self._plan(start_us, period_us, callback)

    def run(self, now_us: int) -> None:
        """Run everything due by `now_us`, including what the callbacks plan until then.

        Raises `EndlessInstantError` if that does not end.
        """
        heap = self._heap
        try:
            while heap and heap[0][0] <= now_us:
                time_us, _, period_us, callback = heap[0]
                if time_us != self.now_us:
                    self.now_us, self._at_this_instant = time_us, 0
                self._at_this_instant += 1
                if self._at_this_instant > EVENTS_AT_ONE_INSTANT:
                    raise self._endless(callback)
                if period_us:
                    self._order += 1
                    heapreplace(heap, (time_us + period_us, self._order, period_us, callback))
                else:
                    heappop(heap)
                callback(time_us)
            if now_us != self.now_us:
                self.now_us, self._at_this_instant = now_us, 0
        finally:
            self.next_us = heap[0][0] if heap else None

    def _endless(self, callback: Callback) -> EndlessInstantError:
        name = getattr(callback, "__qualname__", repr(callback))
        return EndlessInstantError(
            f"{name} at {self.now_us * 1e-6:.6f} s of simulated time: more than {EVENTS_AT_ONE_INSTANT} events at one "
            "instant; plan the next one later"
        )

    def _plan(self, time_us: int, period_us: int, callback: Callback) -> None:
        if time_us < self.now_us:
            raise ValueError(f"event at {time_us} us: it is already {self.now_us} us")
        self._order += 1
        heappush(self._heap, (time_us, self._order, period_us, callback))
        self.next_us = self._heap[0][0]
