"""Vicon, Qualisys and VRPN, through the package `motioncapture` in a separate process (`motioncapture_process`).

That package hides the cameras' time stamps: the exposure is the arrival less `capture.latency_us`. From VRPN it takes at
most 100 poses a second. A process that has ended, because no frame arrived or it was killed, is restarted until
frames arrive.
"""

import math
import os
import subprocess
import sys

from ground_station.clock import clock_us, readable
from ground_station.config import CaptureConfig
from ground_station.errors import MocapError
from ground_station.mocap import MocapFrame
from ground_station.sources.alignment import Alignment, choose_body
from ground_station.sources.motioncapture_process import Arrival, Body, decode_line
from ground_station.sources.silence import Silence
from ground_station.unused import Reason, Unused

CONNECT_TIMEOUT_US = 5_500_000  # the process gives up after 5 s without a frame
SETTLE_US = 1_000_000  # after the first frame, in which all bodies should have been seen
RESTART_US = 2_000_000  # a start takes 0.2 s of a processor
OLDEST_US = 1_000_000  # an older arrival waited in the pipe
LINE_MAX = 65_536

_MODULE = "ground_station.sources.motioncapture_process"


def settings_of(capture: CaptureConfig) -> dict[str, str]:
    """Return the arguments of `motioncapture.connect`."""
    return {"hostname": capture.host if capture.port is None else f"{capture.host}:{capture.port}"}


class MotioncaptureSource:
    """Follows one body of a system that `motioncapture` knows as `system`."""

    def __init__(self, system: str, settings: dict[str, str], capture: CaptureConfig) -> None:
        self._system = system
        arguments = [f"{key}={value}" for key, value in settings.items()]
        self._command = [sys.executable, "-m", _MODULE, system, *arguments]
        self._capture = capture
        self._alignment = Alignment(capture)
        self._body = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._restart_us = 0
        self._buffer = b""
        self._lines: list[bytes] = []  # complete ones, the next one last
        self._pose: Body | None = None
        self._age_us = 0
        self._lost = 0  # frames without a pose
        self._malformed = 0
        self._notices: list[str] = []
        self._silence = Silence(self._notices)

    def open(self) -> None:
        """Find the server and the body; raises `MocapError` within 6 s."""
        try:
            self._body = self._find()
        except MocapError as error:
            self.close()
            raise MocapError(f"{self._capture.host}: {error}") from None
        assumed = f"age assumed: {self._capture.latency_us / 1000:.1f} ms"
        self._notices.append(
            f"mocap {self._system} at {self._capture.host}, body {self._body}, {self._alignment.axes}, {assumed}"
        )

    def _find(self) -> str:
        """Return the body's name; of several the wanted one is taken as soon as it is seen, a single one after a while."""
        names: dict[str, None] = {}
        self._start()
        now_us = clock_us()
        deadline_us, settled_us = now_us + CONNECT_TIMEOUT_US, math.inf
        while now_us < min(deadline_us, settled_us) and self._capture.body not in names:
            arrival = self._next(min(0.1, (deadline_us - now_us) * 1e-6))
            now_us = clock_us()
            if isinstance(arrival, str):
                raise MocapError(arrival)
            if self._process is None:
                break
            if arrival is not None:
                names |= dict.fromkeys(arrival.bodies)
                settled_us = min(settled_us, now_us + SETTLE_US)
                self._silence.on_frame(now_us)
        if settled_us == math.inf:
            raise MocapError(f"no frames of a {self._system} server")
        return choose_body(self._capture.body, list(names))

    def receive(self, timeout_s: float) -> MocapFrame | None:
        deadline_us = clock_us() + round(timeout_s * 1e6)
        while True:
            now_us = clock_us()
            if self._process is None and now_us >= self._restart_us:
                self._start()
            arrival = self._next(max(0, deadline_us - now_us) * 1e-6)
            if arrival is None:
                self._silence.lasts(now_us)
            frame = self._on_arrival(arrival, clock_us()) if isinstance(arrival, Arrival) else None
            if frame is not None or clock_us() >= deadline_us:
                return frame

    def notices(self) -> list[str]:
        notices = self._notices.copy()
        self._notices.clear()
        return notices

    def summary(self) -> str:
        return f"mocap {self._age_us / 1000:.1f} ms old (assumed), {self._lost} lost, {self._malformed} malformed"

    def close(self) -> None:
        """End the process."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()
        self._buffer, self._lines = b"", []

    def _on_arrival(self, arrival: Arrival, now_us: int) -> MocapFrame | None:
        """Return the frame, None if it is VRPN's of another body."""
        body = arrival.bodies.get(self._body)
        if body is None and self._system == "vrpn":
            return None  # VRPN reports each body separately
        self._silence.on_frame(now_us)
        arrived_us = min(arrival.t_us, now_us)
        t_us = arrived_us - self._capture.latency_us
        waited_us = now_us - arrived_us
        if waited_us > OLDEST_US:
            return self._without_pose(t_us, (Reason.MISTIMED, (waited_us * 1e-6,)))
        if body is None:
            return self._without_pose(t_us, (Reason.ABSENT, ()))
        repeated, self._pose = body == self._pose, body
        if repeated:  # every measured pose differs from the last
            return self._without_pose(t_us, (Reason.FROZEN, ()))
        self._age_us = now_us - t_us
        x, y, z, qw, qx, qy, qz = body
        p_WB, q_WB = self._alignment.to_world((x, y, z), (qw, qx, qy, qz))
        return MocapFrame(t_us, p_WB, q_WB, valid=True, arrived_us=arrived_us)

    def _without_pose(self, t_us: int, unused: Unused) -> MocapFrame:
        self._lost += 1
        return MocapFrame(t_us, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), valid=False, unused=unused)

    def _start(self) -> None:
        # In a separate session, because Ctrl-C is for the station.
        self._process = subprocess.Popen(
            self._command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, start_new_session=True
        )

    def _next(self, timeout_s: float) -> Arrival | str | None:
        """Return the process's next line, None when none arrives in time, it has ended, or the line is unreadable."""
        if not self._lines:
            self._read(timeout_s)
        if not self._lines:
            return None
        try:
            return decode_line(self._lines.pop())
        except MocapError:
            self._malformed += 1
            return None

    def _read(self, timeout_s: float) -> None:
        """Wait for bytes and split them into lines."""
        pipe = self._process.stdout if self._process is not None else None
        ready = readable([pipe] if pipe is not None else [], timeout_s)
        if pipe is None or not ready:
            return
        data = os.read(pipe.fileno(), LINE_MAX)
        if not data:
            self.close()
            self._restart_us = clock_us() + RESTART_US
            return
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        self._lines = lines[::-1]
        if len(self._buffer) > LINE_MAX:
            self._buffer = b""
            self._malformed += 1
