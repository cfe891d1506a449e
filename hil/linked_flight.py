"""A flight over a real link, in real time: the board in its tunnel here, `floaty station` in another process.

The station is the one that flies a real board. It sees the virtual dongle, the UDP port or a serial port (a pty), and
gets poses from a virtual Motive, as in the laboratory, or from the cameras without one. The robot is released when the
board has flown in its holder for a second.
"""

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

from firmware_py.firmware import Firmware
from ground_station.mocap_udp import PosePublisher
from ground_station.trajectory import Goal
from hil.board_server import BoardServer
from hil.channels import flight_channels
from hil.clock import Clock
from hil.config import LabConfig
from hil.dongle_plugin import VARIABLE
from hil.errors import LabError
from hil.experiments import Experiment
from hil.harness import RECORD_PERIOD_US, RECORD_PHASE_US, Outcome
from hil.recorder import Channel, Recorder
from hil.serial_server import Address
from hil.virtual_motive import Streaming

SITE = Path(__file__).parent / "dongle_site"
RELEASE_TIMEOUT_US = 60_000_000  # for the station to start, connect, and fly in the holder
STATION_EXIT_TIMEOUT_US = 15_000_000
PROGRESS_ROWS = 25
OUTPUT_MAX = 65_536  # bytes of the station that are read at once
SERIAL = "mavlink:"
NATNET, VIRTUAL = "natnet", "virtual"
MOCAP = (NATNET, VIRTUAL)  # a virtual Motive; poses as `floaty board serve` sends them
BODY = "floaty"  # to Motive
ALIGNED = [
    f"--set=capture.{value}"
    for value in ("origin=[0,0,0]", "yaw=0", "body_offset=[0,0,0]", "body_yaw=0", "multicast=false")
]  # whatever the profile says of the real cameras
STANDING = "hover"  # other goals move by the clock of the release, which the station does not know


class LinkedFlight:
    """Like `hil.harness.Flight`, for `radio://…` (as the board's own URI), `udp://127.0.0.1:PORT` or `mavlink:PATH`.

    `mocap` is one of `MOCAP`; `arguments` are those of the station's command line that say which profile it has.
    """

    def __init__(
        self,
        config: LabConfig,
        experiment: Experiment,
        duration_s: float,
        seed: int,
        telemetry_path: Path,
        uri: str,
        mocap: str,
        arguments: Sequence[str],
    ) -> None:
        if experiment.name != STANDING:
            raise LabError(f"--link {uri}: only {STANDING} can be flown over a link")
        self.recorder: Recorder | None = None
        self.lost: str | None = None
        self.end_us = RELEASE_TIMEOUT_US + round(duration_s * 1e6)
        self._duration_us = round(duration_s * 1e6)
        self._server = BoardServer(config, 1, seed, self._note, mavlink=uri.startswith(SERIAL))
        self._board = self._server.boards[0]
        self._heard = 0  # bytes of the station's output
        self._said = ""  # its last line
        self._released = self._gave_up = self._over = False
        self._progress: Callable[[int], None] | None = None
        self._trajectory = experiment.trajectory(Goal(config.flight.home, 0.0), 0)
        uri, self._environment = self._serve(uri, config.serial.baud)
        self._poses: PosePublisher | None = None
        self._command = [
            sys.executable, "-m", "hil.cli", "station", "--link", uri, "--mocap", self._serve_poses(mocap),
            "--trajectory", experiment.name, "--log", str(telemetry_path), *arguments, *ALIGNED,
        ]  # fmt: skip

    def _serve(self, uri: str, baud: int) -> tuple[str, dict[str, str]]:
        """Open the side of the board that a URI means; returns the station's URI and what its environment needs."""
        if uri == self._board.uri:
            paths = [str(SITE), os.environ.get("PYTHONPATH", "")]
            server = self._server.serve_radio(0)
            return uri, {"PYTHONPATH": os.pathsep.join(filter(None, paths)), VARIABLE: server}
        if uri.startswith(SERIAL):
            (master,) = self._server.serve_mavlink([_pty(uri)])
            return f"{SERIAL}{master},{baud}", {}
        prefix, _, port = uri.rpartition(":")
        if prefix == "udp://127.0.0.1" and port.isdigit() and 0 < int(port) < 65536:
            self._server.serve_udp(int(port))
            return uri, {}
        raise LabError(
            f"--link {uri}: expected radio, mavlink, {self._board.uri}, udp://127.0.0.1:PORT, mavlink:pty or mavlink:PATH"
        )

    def _serve_poses(self, mocap: str) -> str:
        """Let the cameras see the robot; returns the station's source of poses."""
        if mocap == NATNET:
            motive = self._server.serve_motive(Streaming(0, (4, 1), multicast=False))
            return f"optitrack:127.0.0.1:{motive.port},body={BODY},y-up"
        port = _free_port()
        self._poses = PosePublisher(port)
        self._board.publish(self._poses.send)
        return f"virtual:{port}"

    @property
    def now_us(self) -> int:
        """The present instant of the simulation."""
        return self._server.events.now_us

    @property
    def clock(self) -> Clock:
        """The wall clock's."""
        return self._server.clock

    @property
    def firmware(self) -> Firmware:
        """The firmware that runs now: a reboot brings another one."""
        return self._board.parts()[2]

    def write_schedule(self, folder: Path) -> None:
        """Write nothing: the scheduler is traced in lockstep only."""

    def channels(self) -> tuple[Channel, ...]:
        """Return what there is to record; of radio and UDP nothing is counted."""
        plant, board, firmware = self._board.parts()
        channels = flight_channels(plant, board, firmware, self._trajectory, lambda: self._board.free)
        if self._board.line is None:
            return channels
        from hil.serial_line import serial_channel  # needs pymavlink

        return (*channels, serial_channel(self._board.line, firmware, None))

    def run(self, progress: Callable[[int], None] | None = None) -> Outcome:
        """Fly to the end, the crash, or Ctrl-C; raises `LabError` when the station gives up."""
        self._progress = progress
        first_us = self.now_us // RECORD_PERIOD_US * RECORD_PERIOD_US + RECORD_PERIOD_US
        self._server.events.at(first_us + RECORD_PHASE_US, self._record)
        with tempfile.TemporaryFile("wb+") as output:
            self._output = output
            self._station = subprocess.Popen(
                self._command, env={**os.environ, **self._environment}, stdout=output, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip
            interrupted = False
            try:
                self._server.run(lambda: self._over)
            except KeyboardInterrupt:
                interrupted = True
            end_us, gave_up = self.now_us, self._gave_up
            code = self._end_station()
            self._listen()
        if gave_up and not interrupted:
            raise LabError(f"the station ended with {code}: {self._said or 'no output'}")
        return Outcome(end_us, self.lost, interrupted)

    def _record(self, now_us: int) -> None:
        """Take a row, and notice the release and the end."""
        if self._over:
            return
        self._server.events.at(now_us + RECORD_PERIOD_US, self._record)
        self.lost = self._board.look(now_us)
        if self.recorder is not None:
            self.recorder.row(now_us)
        if now_us // RECORD_PERIOD_US % PROGRESS_ROWS == 0:
            self._listen()
            if self._progress is not None:
                self._progress(now_us)
        if not self._released and self._board.free:
            self._released = True
            self.end_us = now_us + self._duration_us
        self._gave_up = self._station.poll() is not None or (
            not self._released and now_us >= RELEASE_TIMEOUT_US
        )
        self._over = self._gave_up or self.lost is not None or now_us >= self.end_us

    def _listen(self) -> None:
        """Note what the station said since the last time."""
        fresh = os.pread(self._output.fileno(), OUTPUT_MAX, self._heard)
        lines = fresh[: fresh.rfind(b"\n") + 1]
        self._heard += len(lines)
        for line in lines.decode(errors="replace").splitlines():
            self._said = line
            self._note(f"station: {line}")

    def _end_station(self) -> int:
        """Let the station leave in order, with the board still there, or kill it."""
        self._station.terminate()
        deadline_us = self.now_us + STATION_EXIT_TIMEOUT_US
        try:
            self._server.run(lambda: self._station.poll() is not None or self.now_us >= deadline_us)
        finally:
            self._station.kill()
        return self._station.wait()

    def _note(self, text: str) -> None:
        if self.recorder is not None:
            self.recorder.note(self.now_us, "lab", text)

    def close(self) -> None:
        """Close what the flight itself opened."""
        if self._poses is not None:
            self._poses.close()
        self._server.close()


def _pty(uri: str) -> Address:
    """Return the pty of `mavlink:pty` or `mavlink:PATH`, where nothing may be yet: a line needs two ends."""
    path = uri.removeprefix(SERIAL)
    if path == "pty":
        return Address("pty")
    if not path.startswith(("/", ".")) or "," in path:
        raise LabError(
            f"--link {uri}: expected mavlink, mavlink:pty or mavlink:PATH with a name for a new pty"
        )
    if Path(path).exists():
        raise LabError(
            f"--link {uri}: {path} exists; a new pty gets that name. The board behind a line that is there is flown with "
            f"floaty station --link {uri}"
        )
    return Address("pty", path=Path(path))


def _free_port() -> int:
    """Return a UDP port of the loopback interface that nobody uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
