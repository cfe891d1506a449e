"""A rerun recording on the timeline of one flight: `from_release`, or `from_start` while the release is unknown."""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from hil.laboratory.files.recorder import RELEASE_US, release_of, stored_in

FROM_RELEASE, FROM_START = "from_release", "from_start"
Times = NDArray[np.float64]  # (N,) [us] of the log


def timeline_of(metadata: Mapping[bytes, bytes] | None) -> tuple[str, int]:
    """Return the timeline of a log and its zero in the log's time [us]."""
    known = metadata or {}
    if RELEASE_US in known or ":" not in stored_in(known, "request").get(
        "link", ""
    ):  # in lockstep it is planned
        return FROM_RELEASE, release_of(known)
    return FROM_START, 0


class RecordingTrack:
    """Writes to a recording, with times of the flight's log."""

    def __init__(self, recording: rr.RecordingStream, schema: pa.Schema, below: str = "") -> None:
        """`below`: the beginning of all paths, with a slash at its end."""
        self._recording, self._below = recording, below
        self._timeline, self._zero_us = timeline_of(schema.metadata)
        recording.set_log_time_enabled(False)

    def static(self, path: str, content: Any) -> None:
        """Log what is true at all times."""
        self._recording.log(self._below + path, content, static=True)

    def at(self, t_us: int, path: str, content: Any) -> None:
        """Log what begins at an instant of the log."""
        self._recording.set_time(self._timeline, duration=np.timedelta64(t_us - self._zero_us, "us"))
        self._recording.log(self._below + path, content)

    def send(self, path: str, times_us: Times, columns: Iterable[Any]) -> None:
        """Log one row of columns per instant."""
        if len(times_us) == 0:
            return
        since = (times_us - self._zero_us).astype("timedelta64[us]")
        self._recording.send_columns(
            self._below + path, [rr.TimeColumn(self._timeline, duration=since)], columns
        )

    def curve(self, path: str, times_us: Times, values: NDArray[np.float64]) -> None:
        """Log the points of a plot's curves, (N,) or (N, curves)."""
        self.send(f"plot/{path}", times_us, rr.Scalars.columns(scalars=values))

    def mark(self, name: str, times_us: Times) -> None:
        """Log marks on the zero line of the position's plot."""
        self.curve(mark_path(name), times_us, np.zeros(len(times_us)))


def mark_path(name: str) -> str:
    """Return the path of a kind of mark below `/plot`."""
    return f"position/marks/{name.replace(' ', '_')}"


def rgba(colour: str, opacity: int = 255) -> int:
    """Return `#rrggbb` as rerun packs it."""
    return int(colour[1:], 16) << 8 | opacity


def rgba_array(colours: Iterable[str], opacity: int = 255) -> NDArray[np.uint32]:
    """Return several colours as rerun packs them."""
    return np.array([rgba(colour, opacity) for colour in colours], np.uint32)
