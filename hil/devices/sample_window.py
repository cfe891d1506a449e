"""The gyro samples that are under way to a board in the loop: how many may be, in which packets, and what is repeated.

The loop's delay is bounded by this window, not by what queues on the way would hold: with `WINDOW` samples that the board
has not taken the plant has to wait, and with `PACKETS` packets that it has not acknowledged the next one waits, and gets
longer. What was lost is sent again, with all behind it. `firmware_py.wire.core_port` has the board's half.
"""

from collections import deque
from collections.abc import Sequence
from itertools import islice

from firmware_py.wire.core_port import SAMPLES_MAX, Looped, encode_samples

# samples: the ten between two steps of the controller, and twenty for which the tuned hover holds its limits
WINDOW = 30
PACKETS = 4
SAMPLES_MIN = 4  # in a packet, 250 packets a second, and one more for each that is under way
REPEAT_US = 50_000  # without news of what was sent


class SampleWindow:
    """Counts samples from 0. `used`: that the board has taken; `batch`: in the last packet; `repeated`: packets again."""

    def __init__(self) -> None:
        self.count = self.used = 0
        self.batch = SAMPLES_MIN
        self.repeated = 0
        self._samples: deque[Sequence[int]] = deque()  # that are not acknowledged
        self._sent = 0  # number of the next one to send
        self._ends: deque[int] = deque()  # of the packets under way
        self._lost = 0  # as the board has counted
        self._news_us = 0

    @property
    def full(self) -> bool:
        """Whether the board has to take some before there are more."""
        return self.count - self.used >= WINDOW

    def put(self, sample: Sequence[int]) -> None:
        """Take the next sample, three counts."""
        self._samples.append(sample)
        self.count += 1

    def hear(self, told: Looped, now_us: int) -> bool:
        """Take in what the board has; whether it has taken more of it than before."""
        taken = told.used - self.used & 0xFFFF
        acknowledged = self.count - len(self._samples)
        more = told.received - acknowledged & 0xFFFF
        if taken > self.count - self.used or more > len(self._samples):
            return False  # an older packet, or one before the first sample
        self.used += taken
        for _ in range(more):
            self._samples.popleft()
        acknowledged += more
        while self._ends and self._ends[0] <= acknowledged:
            self._ends.popleft()
        if more:
            self._news_us = now_us
        self._sent = max(self._sent, acknowledged)
        if told.lost != self._lost:
            self._lost = told.lost
            self._repeat()
        return taken > 0

    def packet(self, now_us: int) -> bytes | None:
        """Return the data of the packet that is to be sent now, if there is one."""
        if self._ends and now_us - self._news_us >= REPEAT_US:
            self._repeat()
        under_way = len(self._ends)
        wanted = min(SAMPLES_MIN + under_way, SAMPLES_MAX)
        if under_way >= PACKETS or self.count - self._sent < wanted:
            return None
        begin = self._sent - self.count + len(self._samples)
        data, self.batch = encode_samples(self._sent, list(islice(self._samples, begin, begin + SAMPLES_MAX)))
        if not self._ends:
            self._news_us = now_us
        self._sent += self.batch
        self._ends.append(self._sent)
        return data

    def _repeat(self) -> None:
        self.repeated += len(self._ends)
        self._ends.clear()
        self._sent = self.count - len(self._samples)
