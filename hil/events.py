"""Hardware events in the order of simulated time: one heap, integer microseconds.

An event is a callback and the instant it was planned for. Events at the same instant run in the order in
which they were planned.
"""

from collections.abc import Callable
from heapq import heappop, heappush, heapreplace

Callback = Callable[[int], object]  # receives the planned instant [us]


class EventQueue:
    """The planned events of the hardware. `next_us`: the earliest planned instant, None when there is none."""

    __slots__ = ("_heap", "_order", "next_us", "now_us")

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, Callback]] = []  # instant, order, period or 0
        self._order = 0
        self.next_us: int | None = None
        self.now_us = 0

    def at(self, time_us: int, callback: Callback) -> None:
        """Plan `callback(time_us)`; an instant that has passed is a `ValueError`."""
        self._plan(time_us, 0, callback)

    def every(self, period_us: int, start_us: int, callback: Callback) -> None:
        """Plan `callback` for `start_us` and every `period_us` after it, for ever."""
        if period_us <= 0:
            raise ValueError(f"a period of {period_us} us: it must be above 0")
        self._plan(start_us, period_us, callback)

    def run(self, now_us: int) -> None:
        """Run everything due by `now_us`, including what the callbacks plan until then."""
        heap = self._heap
        try:
            while heap and heap[0][0] <= now_us:
                self.now_us, _, period_us, callback = heap[0]
                if period_us:
                    self._order += 1
                    heapreplace(heap, (self.now_us + period_us, self._order, period_us, callback))
                else:
                    heappop(heap)
                callback(self.now_us)
            self.now_us = now_us
        finally:
            self.next_us = heap[0][0] if heap else None

    def _plan(self, time_us: int, period_us: int, callback: Callback) -> None:
        if time_us < self.now_us:
            raise ValueError(f"event at {time_us} us: it is already {self.now_us} us")
        self._order += 1
        heappush(self._heap, (time_us, self._order, period_us, callback))
        self.next_us = self._heap[0][0]
