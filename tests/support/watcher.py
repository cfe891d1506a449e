"""What a Motive says of the bodies of a server, kept with the time when it came."""

import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from ground_station.config import CaptureConfig
from ground_station.mocap import MocapFrame
from ground_station.sources.address import find_source
from support.serving import Served


class Watcher(threading.Thread):
    """Keeps what a Motive says of one body, with the time when it came."""

    def __init__(self, served: Served, name: str) -> None:
        super().__init__(daemon=True)
        self.frames: list[tuple[float, MocapFrame]] = []
        self.stop = threading.Event()
        self._source = find_source(f"{served.motive},body={name}", CaptureConfig())
        self._source.open()
        self.start()

    def run(self) -> None:
        while not self.stop.is_set():
            if (frame := self._source.receive(0.05)) is not None:
                self.frames.append((time.monotonic(), frame))
        self._source.close()

    def near(self, instant_s: float) -> np.ndarray:
        """Where the body was at a time."""
        seen = [(abs(t - instant_s), frame) for t, frame in self.frames if frame.valid]
        off_s, frame = min(seen, key=lambda one: one[0])
        assert off_s < 0.1
        return np.array(frame.p_WB)


@contextmanager
def watched(served: Served, names: Sequence[str]) -> Iterator[list[Watcher]]:
    watchers = [Watcher(served, name) for name in names]
    try:
        yield watchers
    finally:
        for watcher in watchers:
            watcher.stop.set()
        for watcher in watchers:
            watcher.join()
