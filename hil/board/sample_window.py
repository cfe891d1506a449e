"""The gyro samples in flight to a board in the loop: how many are allowed, their packets, and repetition.

This window bounds the loop's delay, not the queues of the link: the plant waits while the board has not taken `WINDOW`
samples. The next packet waits, and grows, while `PACKETS` packets are not acknowledged. Lost samples are sent again, with
all after them. `firmware_py.wire.core_port` has the board's half.
"""

from collections import deque
from collections.abc import Sequence
from itertools import islice

from firmware_py.wire.core_port import SAMPLES_MAX, Loop, encode_samples

# samples: the ten between two steps of the controller, and twenty for which the tuned hover holds its limits
WINDOW = 30
PACKETS = 4
SAMPLES_MIN = 4  # in a packet, 250 packets a second, and one more for each packet in flight
REPEAT_US = 50_000  # without an acknowledgement


class SampleWindow:
    """Counts samples from 0. `used`: taken by the board; `batch`: in the last packet; `repeated`: packets sent again."""

    def __init__(self) -> None:
        self.count = self.used = 0
        self.batch = SAMPLES_MIN
        self.repeated = 0
        self._samples: deque[Sequence[int]] = deque()  # not acknowledged
        self._sent = 0  # number of the next one to send
        self._ends: deque[int] = deque()  # of the packets in flight
        self._lost = 0  # as counted by the board
        self._news_us = 0

    @property
    def full(self) -> bool:
        """Whether the board must take samples before more are sent."""
        return self.count - self.used >= WINDOW

    def put(self, sample: Sequence[int]) -> None:
        """Take the next sample, three counts."""
        self._samples.append(sample)
        self.count += 1

    def on_report(self, report: Loop, now_us: int) -> bool:
        """Take a report of the board; return whether it has taken more samples."""
        taken = report.used - self.used & 0xFFFF
        acknowledged = self.count - len(self._samples)
        more = report.received - acknowledged & 0xFFFF
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
        if report.lost != self._lost:
            self._lost = report.lost
            self._repeat()
        return taken > 0

    def packet(self, now_us: int) -> bytes | None:
        """Return the data of the packet to send now, if any."""
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
