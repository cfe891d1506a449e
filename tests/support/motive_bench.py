"""A virtual Motive that sees one body move, without a plant; and what its clients should see."""

import contextlib
import importlib.util
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from ground_station.mocap import MocapFrame
from ground_station.sources import optitrack
from ground_station.unused import Reason
from hil.board.markers import NO_POINTS, Sighting
from hil.servers.dongle_server import Readers
from hil.servers.motive import Streaming, Up, VirtualMotive
from hil.world.config import GeometryConfig, NetConfig
from hil.world.floaty.drawing import marker_places
from support.serving import PATIENCE_S

FROM_MOTIVE = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # columns: Motive's axes in the world
PERIOD_S = 0.005
LATENCY_US = 38_000
PLACES = marker_places(GeometryConfig(), NetConfig())
NO_POSE = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))  # Motive looks at the frame's


def seen(number: int) -> MocapFrame:
    """The pose of the body in a frame: all over the place."""
    rng = np.random.default_rng(number)
    q = rng.standard_normal(4)
    q /= np.linalg.norm(q)
    return MocapFrame(number, tuple(rng.uniform(-1, 1, 3).tolist()), tuple(q.tolist()), valid=True)


def sighted(number: int, tracked: bool = True) -> Sighting:
    """What is seen of the markers in a frame: anything, anywhere."""
    rng = np.random.default_rng(number)
    points, ghosts = rng.uniform(-1, 1, (8, 3)), rng.uniform(-1, 1, (number % 3, 3))
    shown = rng.random(8) < 0.7
    residuals = 0.01 * rng.random(8) * shown
    return Sighting(points, shown, residuals, ghosts, 0.001 * number, NO_POSE if tracked else None)


class MotiveBench:
    """A Motive that sees one body move, without a plant."""

    def __init__(
        self, version: tuple[int, int] = (4, 1), multicast: bool = False, markers: bool = False, up: Up = "y"
    ) -> None:
        self.readers: Readers = {}
        places = PLACES if markers else NO_POINTS
        self.motive = VirtualMotive(Streaming(0, version, multicast, up), 1, self.readers, places)
        self.number = 0
        self.markers = markers

    def expose(self, valid: bool = True, reason: Reason = Reason.NOT_TRACKED) -> None:
        self.number += 1
        frame = seen(self.number)
        shown = MocapFrame(7_000_000, frame.p_WB, frame.q_WB, valid, unused=(reason, ()))
        sighting = sighted(self.number, valid) if self.markers else None
        self.motive.stream_frame(1, shown, 7_000_000 + LATENCY_US, sighting)

    def answer(self) -> None:
        """Answer what clients have asked by now."""
        while ready := select.select(self.readers, (), (), 0)[0]:
            for reader in ready:
                self.readers[reader](0)

    def turn(self) -> None:
        """Answer and stream a frame."""
        self.answer()
        self.expose()

    def run(self, stopping: Callable[[], bool]) -> None:
        """Expose at 200 Hz and answer."""
        deadline = time.monotonic() + PATIENCE_S
        while not stopping():
            assert time.monotonic() < deadline, f"{PATIENCE_S} s have gone by"
            self.expose()
            select.select(self.readers, (), (), PERIOD_S)
            self.answer()


class StationClock:
    """A simulated clock of a client of NatNet: its server has a turn when the client would wait in vain."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_us = 50_000_000
        self.turns: Callable[[], None] = lambda: None
        monkeypatch.setattr(optitrack, "clock_us", lambda: self.now_us)
        monkeypatch.setattr(optitrack, "readable", self.readable)

    def readable(self, sockets: list[socket.socket], timeout_s: float) -> list[socket.socket]:
        ready = select.select(sockets, (), (), 0)[0]
        if not ready and timeout_s:
            self.turns()
            ready = select.select(sockets, (), (), 0)[0]
            self.now_us += 300 if ready else round(timeout_s * 1e6)
        return ready


def needs(client: str) -> pytest.MarkDecorator:
    """Skip where a client is not installed."""
    missing = importlib.util.find_spec(client) is None
    return pytest.mark.skipif(missing, reason=f"{client} IS NOT TESTED: `make clients` installs it")


@contextlib.contextmanager
def moving(stands: Callable[[], bool] = lambda: False, multicast: bool = False) -> Iterator[MotiveBench]:
    """A Motive that streams in a thread, without the body while it `stands`."""
    lab, stop = MotiveBench(multicast=multicast), threading.Event()

    def pump() -> None:
        while not stop.wait(0.005):
            lab.expose(valid=not stands())
            lab.answer()

    thread = threading.Thread(target=pump)
    thread.start()
    try:
        yield lab
    finally:
        stop.set()
        thread.join()
        lab.motive.close()
