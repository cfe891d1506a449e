"""The MAVLink frames of a link in both directions, as a telemetry log of ground stations: each after its time.

A record is eight bytes, microseconds, big-endian, and one whole frame as received or sent; damaged received
frames are omitted. Records are in the order of their times, although a received frame is noted when it is decoded. The
file is complete to about two seconds when the process dies.
"""

from heapq import heappop, heappush
from math import inf
from pathlib import Path

FRAME_LOG = "link.tlog"  # in a run folder
FLUSH_PERIOD_US = 1_000_000  # no frame is noted so late


class FrameLog:
    """`epoch_us`: the time written for the instant 0, since 1970 where that is known. Raises `OSError`."""

    def __init__(self, path: Path, epoch_us: int = 0) -> None:
        self._file = path.open("wb")
        self._epoch_us = epoch_us
        self._waiting: list[tuple[int, int, bytes]] = []  # a heap of times, numbers and frames
        self._noted = 0
        self._flushed_us = 0

    def note(self, t_us: int, frame: bytes) -> None:
        """Take a frame that was sent or received at `t_us`; does nothing after `close`."""
        if self._file.closed:
            return
        heappush(self._waiting, (t_us, self._noted, frame))
        self._noted += 1
        if t_us - self._flushed_us >= FLUSH_PERIOD_US:
            self._write(before_us=self._flushed_us)
            self._flushed_us = t_us
            self._file.flush()

    def close(self) -> None:
        """Write the frames that wait, and close the file."""
        try:
            self._write(before_us=inf)
        finally:
            self._file.close()

    def _write(self, before_us: float) -> None:
        while self._waiting and self._waiting[0][0] < before_us:
            t_us, _, frame = heappop(self._waiting)
            self._file.write((self._epoch_us + t_us).to_bytes(8, "big") + frame)
