"""The MAVLink frames of a link in both directions, as a telemetry log of ground stations: each after its time.

A record is eight bytes, microseconds, big-endian, and one whole frame as received or sent; damaged received
frames are omitted. The file is complete to about a second when the process dies.
"""

from pathlib import Path

FRAME_LOG = "link.tlog"  # in a run folder
FLUSH_PERIOD_US = 1_000_000


class FrameLog:
    """`epoch_us`: the time written for the instant 0, since 1970 where that is known. Raises `OSError`."""

    def __init__(self, path: Path, epoch_us: int = 0) -> None:
        self._file = path.open("wb")
        self._epoch_us = epoch_us
        self._flushed_us = 0

    def note(self, t_us: int, frame: bytes) -> None:
        """Write a frame that was sent or received at `t_us`; does nothing after `close`."""
        if self._file.closed:
            return
        self._file.write((self._epoch_us + t_us).to_bytes(8, "big") + frame)
        if t_us - self._flushed_us >= FLUSH_PERIOD_US:
            self._flushed_us = t_us
            self._file.flush()

    def close(self) -> None:
        self._file.close()
