"""How far a remote clock is ahead of ours, from exchanges of time stamps. Times are whole microseconds.

We send our time, the other side returns it with its own. The remote instant lies somewhere in the round trip, so an exchange
knows the offset to plus or minus half of its round trip, and less well as it grows old, because clocks drift. Of the
last exchanges the most certain one counts. When two exchanges contradict each other, the remote clock was set
again, and only the newer one counts.
"""

from collections import deque
from dataclasses import dataclass

WINDOW = 16  # exchanges
DRIFT_PPM = 100  # of both clocks together: two crystals of 50 ppm
PENDING = 4  # requests that may be unanswered
LONGEST_US = 200_000  # round trip; a longer one is too uncertain
UNKNOWN_US = 100_000  # an offset that is known no better counts as unknown
SLACK_US = 1000  # some take their time stamps in whole milliseconds


@dataclass(frozen=True, slots=True)
class Exchange:
    """One answer."""

    t_us: int  # when it arrived, our clock
    offset_us: int  # remote clock less ours
    half_us: int  # half of the round trip

    def uncertainty_us(self, now_us: int) -> int:
        """How wrong the offset may be by now; all exchanges age alike."""
        return self.half_us + (now_us - self.t_us) * DRIFT_PPM // 1_000_000


class RemoteClock:
    """The clock of one partner. `exchanges` counts the answers that were of use."""

    def __init__(self) -> None:
        self.requests = 0
        self.exchanges = 0
        self._pending: deque[int] = deque(maxlen=PENDING)
        self._window: deque[Exchange] = deque(maxlen=WINDOW)
        self._best: Exchange | None = None

    def request(self, now_us: int) -> None:
        """Note that a request leaves now."""
        self.requests += 1
        self._pending.append(now_us)

    def answer(self, now_us: int, sent_us: int, remote_us: int) -> bool:
        """Take the answer to the request of `sent_us`; False when there was no such request, or when it took too long."""
        if sent_us not in self._pending:
            return False
        self._pending.remove(sent_us)
        round_trip_us = now_us - sent_us
        if round_trip_us > LONGEST_US:
            return False
        exchange = Exchange(now_us, remote_us - (sent_us + now_us) // 2, round_trip_us // 2)
        if any(_contradict(old, exchange) for old in self._window):
            self._window.clear()
        self._window.append(exchange)
        self._best = min(self._window, key=lambda old: old.uncertainty_us(now_us))
        self.exchanges += 1
        return True

    def offset_us(self, now_us: int) -> int | None:
        """Return how far the remote clock is ahead; None when it is not known."""
        best = self._best
        return None if best is None or best.uncertainty_us(now_us) > UNKNOWN_US else best.offset_us


def _contradict(old: Exchange, new: Exchange) -> bool:
    """Whether no clock that was left alone can explain both."""
    reach_us = new.half_us + old.uncertainty_us(new.t_us) + SLACK_US
    return abs(new.offset_us - old.offset_us) > reach_us
