"""Every frame that a source delivered, as CSV that `replay` plays again: one row each, without loss.

The file is complete to about a second when the process dies. A disk that is full ends the record, not the flight.
"""

from contextlib import suppress
from pathlib import Path
from typing import TextIO

from ground_station.clock import clock_us
from ground_station.mocap import MocapFrame, MocapSource

FLUSH_PERIOD_US = 1_000_000
COLUMNS = (
    "arrival [us]", "mocap.t [us]", "mocap.x [m]", "mocap.y [m]", "mocap.z [m]",
    "mocap.qw", "mocap.qx", "mocap.qy", "mocap.qz", "mocap.valid",
)  # fmt: skip


class RecordingSource:
    """A source, open already, whose frames are written to `path` as they are handed on; raises `OSError`."""

    def __init__(self, source: MocapSource, path: Path) -> None:
        self._source = source
        self._path = path
        self._notices: list[str] = []
        self._flush_us = 0
        self._file: TextIO | None = path.open("w", encoding="utf-8", newline="\n")
        self._file.write(",".join(COLUMNS) + "\n")

    def open(self) -> None:
        """Connect again and continue the file; raises `MocapError`, `OSError`."""
        self._source.open()
        if self._file is None:
            self._file = self._path.open("a", encoding="utf-8", newline="\n")

    def receive(self, timeout_s: float) -> MocapFrame | None:
        """The next frame, None when none comes in time."""
        frame = self._source.receive(timeout_s)
        if frame is not None and self._file is not None:
            try:
                self._write(self._file, frame, clock_us())
            except OSError as error:
                self._end(self._file, error)
        return frame

    def notices(self) -> list[str]:
        """Lines for the user since the last call."""
        notices, self._notices = self._notices, []
        return self._source.notices() + notices

    def summary(self) -> str:
        """A few words on its state."""
        return self._source.summary()

    def close(self) -> None:
        """Disconnect and close the file."""
        self._source.close()
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):
                file.close()

    def _write(self, file: TextIO, frame: MocapFrame, now_us: int) -> None:
        numbers = (repr(value) for value in (*frame.p_WB, *frame.q_WB))  # the shortest that reads back alike
        file.write(f"{now_us},{frame.t_us},{','.join(numbers)},{int(frame.valid)}\n")
        if now_us >= self._flush_us:
            file.flush()
            self._flush_us = now_us + FLUSH_PERIOD_US

    def _end(self, file: TextIO, error: OSError) -> None:
        with suppress(OSError):
            file.close()
        self._notices.append(f"{self._path}: {error.strerror or error}; frames are not recorded any more")
        self._file = None
