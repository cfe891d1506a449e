"""Hardware events in the order of simulated time: one heap, integer microseconds.

An event is a callback and its planned instant. Events at the same instant run in the order of planning, at most
`EVENTS_AT_ONE_INSTANT`: time would never advance if a callback planned itself at its own instant. The beat is the event
that repeats most. It is memory, so that C can run it by itself up to the heap's next event.
"""

from collections.abc import Callable
from heapq import heappop, heappush, heapreplace
from typing import Final

from firmware_py.rtos.memory import NEVER_US, Beat

Callback = Callable[[int], object]  # receives the planned instant [us]

EVENTS_AT_ONE_INSTANT: Final = 10_000  # a hover needs 4


NOTHING: Final[tuple[int, int, int, Callback]] = (NEVER_US, 0, 0, int)  # in an empty heap


class EndlessInstantError(Exception):
    """The events of one instant are endless; the text names the callback and the instant."""


class EventQueue:
    """The planned events of the hardware. `other_us`: the earliest planned instant but for the beat, or None."""

    __slots__ = (
        "_at_this_instant", "_beat_callback", "_beat_order", "_beat_us", "_heap", "_planned", "beat", "now_us", "other_us",
    )  # fmt: skip

    def __init__(self) -> None:
        self._heap: list[tuple[int, int, int, Callback]] = []  # instant, order, period or 0
        self.beat = Beat.allocate()
        self._beat_us, self._beat_order, self._planned = (
            self.beat.cell(name) for name in ("next_us", "order", "planned")
        )
        self._beat_us[0] = NEVER_US
        self._beat_callback: Callback = int
        self._at_this_instant = 0  # events that ran at `now_us`
        self.other_us: int | None = None
        self.now_us = 0

    @property
    def next_us(self) -> int | None:
        """The earliest planned instant, or None."""
        beat_us, other_us = self._beat_us[0], self.other_us
        if other_us is not None and other_us < beat_us:
            return other_us
        return None if beat_us == NEVER_US else beat_us

    def set_beat(self, period_us: int, start_us: int, callback: Callback) -> None:
        """Plan `callback` like `every`, as the beat if there is none yet."""
        if self._beat_us[0] != NEVER_US:
            self.every(period_us, start_us, callback)
        else:
            self._beat_callback, beat = callback, self.beat.fields
            beat.period_us, beat.next_us, beat.order = period_us, start_us, self._next_order()

    def at(self, time_us: int, callback: Callback) -> None:
        """Plan `callback(time_us)`. Raises `ValueError` for a past instant."""
        self._plan(time_us, 0, callback)

    def every(self, period_us: int, start_us: int, callback: Callback) -> None:
        """Plan `callback` for `start_us` and every `period_us` after it, for ever."""
        if period_us <= 0:
            raise ValueError(f"a period of {period_us} us: it must be above 0")
        self._plan(start_us, period_us, callback)

    def run(self, now_us: int, leave_beat: bool = False) -> None:
        """Run everything due by `now_us`, including what the callbacks plan until then.

        Raises `EndlessInstantError` if that does not end. `leave_beat`: leave a beat that is the last event due.
        """
        heap, beat_us = self._heap, self._beat_us
        try:
            while True:
                time_us, order, period_us, callback = heap[0] if heap else NOTHING
                beats = (beat_us[0], self._beat_order[0]) < (time_us, order)
                if beats:
                    time_us, callback = beat_us[0], self._beat_callback
                if time_us > now_us or (beats and leave_beat and (not heap or heap[0][0] > now_us)):
                    break
                if time_us != self.now_us:
                    self.now_us, self._at_this_instant = time_us, 0
                self._at_this_instant += 1
                if self._at_this_instant > EVENTS_AT_ONE_INSTANT:
                    raise self._endless(callback)
                if beats:
                    beat_us[0] += self.beat.fields.period_us
                    self._beat_order[0] = self._next_order()
                elif period_us:
                    heapreplace(heap, (time_us + period_us, self._next_order(), period_us, callback))
                else:
                    heappop(heap)
                callback(time_us)
            if now_us != self.now_us:
                self.now_us, self._at_this_instant = now_us, 0
        finally:
            self.other_us = heap[0][0] if heap else None

    def _endless(self, callback: Callback) -> EndlessInstantError:
        name = getattr(callback, "__qualname__", repr(callback))
        return EndlessInstantError(
            f"{name} at {self.now_us * 1e-6:.6f} s of simulated time: more than {EVENTS_AT_ONE_INSTANT} events at one "
            "instant; plan the next one later"
        )

    def _plan(self, time_us: int, period_us: int, callback: Callback) -> None:
        if time_us < self.now_us:
            raise ValueError(f"event at {time_us} us: it is already {self.now_us} us")
        heappush(self._heap, (time_us, self._next_order(), period_us, callback))
        self.other_us = self._heap[0][0]

    def _next_order(self) -> int:
        self._planned[0] += 1
        return self._planned[0]
