"""A flight over a real link, in real time: the robot in its tunnel here, `floaty station` in another process.

The station is the program that flies a real board. It uses the virtual dongle, the UDP port or a serial port (a pty), and
gets its poses from a virtual Motive, as in the laboratory. The robot is released when the board has flown in its holder
for a second; this starts the experiment's script and faults, and the station's trajectory.
"""

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from ground_station.links.frame_log import FRAME_LOG
from ground_station.trajectory import Goal, Trajectory
from hil.board.clock import Paced
from hil.board.image_settings import to_set
from hil.errors import LabError
from hil.laboratory.experiments import find_again
from hil.laboratory.files.ages import STATION_CLOCK, with_goals_sent
from hil.laboratory.files.recorder import Correct
from hil.laboratory.flight import Flight
from hil.laboratory.laboratory import WARM_UP_US, Laboratory
from hil.laboratory.lockstep import executor_of
from hil.laboratory.request import Request
from hil.laboratory.robot import Site
from hil.servers.dongle_plugin import VARIABLE
from hil.servers.dongle_server import HOST
from hil.servers.motive import Streaming, name_of
from hil.servers.serial_server import Address
from hil.servers.served_robot import ServedRobot
from hil.servers.server import HOLD_US, LaunchClamp, open_motive
from hil.world.body import Channel, Quantity

SITE = Path(__file__).parent / "dongle_site"
RELEASE_TIMEOUT_US = 60_000_000  # for the station to start, connect, and fly in the holder
STATION_EXIT_TIMEOUT_US = 15_000_000
LISTEN_PERIOD_US = 250_000
OUTPUT_MAX = 65_536  # bytes of the station's output read at once
SERIAL = "mavlink:"
ALIGNED = [
    f"--set=capture.{value}"
    for value in ("origin=[0,0,0]", "yaw=0", "body_offset=[0,0,0]", "body_yaw=0", "multicast=false")
]  # overrides the profile's real cameras


class StationProcess:
    """`hil.laboratory.flight.Line` to `floaty station`, which it starts when the flight begins.

    `uri` is `radio://…` (the board's own), `udp://127.0.0.1:PORT` or `mavlink:PATH`; `arguments` select the profile on
    the station's command line.
    """

    def __init__(
        self, telemetry: Path, arguments: Sequence[str], request: Request, site: Site, lab: Laboratory
    ) -> None:
        assert isinstance(lab.clock, Paced)
        config, uri = site.config, request.bench.link
        self._say = site.note
        self._served = ServedRobot(1, site, partial(site.note, "lab"), uri.startswith(SERIAL))
        self.robot = self._served.robot
        self._readers = lab.clock.readers
        self._experiment = request.experiment
        self.correct: Correct | None = partial(with_goals_sent, telemetry)
        self._home = Goal(config.flight.home, 0.0)
        self._release_us: int | None = None  # the robot is held
        self._next_listen_us = 0
        self._heard = 0  # bytes of the station's output
        self._said = ""  # its last line
        station_uri, self._environment = self._serve(uri, config.serial.baud)
        motive = self._motive = open_motive(Streaming(0, (4, 1), multicast=False), self.robot, lab.clock)
        self._command = [
            sys.executable, "-m", "hil.commands", "station", request.experiment.reference, "--link", station_uri,
            "--mocap", f"optitrack:127.0.0.1:{motive.port},body={name_of(1)},y-up",
            "--start", str(HOLD_US * 1e-6), "--log", str(telemetry),
            *(("--tlog", str(telemetry.with_name(FRAME_LOG))) if uri.startswith(SERIAL) else ()), *arguments, *ALIGNED,
        ]  # fmt: skip
        self._output = tempfile.TemporaryFile("wb+")  # noqa: SIM115 - closed with the line
        self._typed = tempfile.TemporaryFile("wb+")  # noqa: SIM115 - likewise
        self._station: subprocess.Popen[bytes] | None = None
        flashed = self.robot.firmware.flashed
        if flashed is not None:  # an operator sets these; the laboratory's own board has them already
            lines = [f"set {name} {value!r}\n" for name, value in to_set(flashed.parameters, config)]
            self._typed.write("".join(lines).encode())
            self._typed.flush()

    def _serve(self, uri: str, baud: int) -> tuple[str, dict[str, str]]:
        """Open the board's end of a URI; return the station's URI and its environment variables."""
        if uri == self._served.uri:
            paths = [str(SITE), os.environ.get("PYTHONPATH", "")]
            server = f"{HOST}:{self._served.serve_radio(0, self._readers)}"
            return uri, {"PYTHONPATH": os.pathsep.join(filter(None, paths)), VARIABLE: server}
        if uri.startswith(SERIAL):
            master = self._served.serve_mavlink(_pty(uri), self._readers)
            return f"{SERIAL}{master},{baud}", {}
        prefix, _, port = uri.rpartition(":")
        if prefix == "udp://127.0.0.1" and re.fullmatch(r"[0-9]{1,5}", port) and 0 < int(port) < 65536:
            self._served.serve_udp(int(port), self._readers)
            return uri, {}
        raise LabError(
            f"--link {uri}: expected radio, mavlink, {self._served.uri}, udp://127.0.0.1:PORT, mavlink:pty or mavlink:PATH"
        )

    @property
    def trajectory(self) -> Trajectory:
        """The goals that the station should send; its telemetry has those it really sent."""
        return self

    def at(self, t_us: int) -> Goal:
        """Return the goal at a laboratory time."""
        if self._release_us is None:
            return self._home
        return self._experiment.trajectory(self._home, self._release_us).at(t_us)

    def begin(self, release: Callable[[int], None]) -> None:
        """Plan the robot's release for when its board has flown in the holder."""

        def let_go(now_us: int) -> None:
            self._release_us = now_us
            release(now_us)

        LaunchClamp(self.robot, let_go)

    def channels(self) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
        """Return the counters of line and board; the station keeps its own record."""
        line = self._served.channels() if self.robot.uart or self._served.udp else ()
        return line, (Channel("int64", Paced.wall_us, (Quantity((STATION_CLOCK,), "us"),)),)

    def steer(self, trajectory: Trajectory) -> None:
        raise LabError("the goal is that of the ground station, a program of its own: steer it there")

    def command(self, now_us: int, packet: bytes) -> None:
        self.robot.packet_received(now_us, packet)

    def listen(self, receive: Callable[[int, bytes], object]) -> None:
        raise LabError("the ground station is a program of its own: set parameters there")

    def new_messages(self, now_us: int) -> list[tuple[str, str]]:
        """Raise `LabError` when the station has ended, or nothing flies for too long; return its output."""
        if now_us < WARM_UP_US:
            return []
        station = self._running_station()
        if station.poll() is not None:
            self._give_up(f"the station ended with {station.returncode}")
        if self._release_us is None and now_us >= RELEASE_TIMEOUT_US:
            self._give_up(f"no flight within {RELEASE_TIMEOUT_US * 1e-6:.0f} s")
        if now_us < self._next_listen_us:
            return []
        self._next_listen_us = now_us + LISTEN_PERIOD_US
        return self._listen()

    def _running_station(self) -> subprocess.Popen[bytes]:
        """Return the station's process; it starts once the laboratory runs, whose compilation may take time."""
        if self._station is None:
            self._typed.seek(0)
            self._station = subprocess.Popen(
                self._command, env={**os.environ, **self._environment}, stdin=self._typed, stdout=self._output,
                stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        return self._station

    def _give_up(self, why: str) -> None:
        for source, text in self._listen():
            self._say(source, text)
        raise LabError(f"{why}: {self._said or 'no output'}")

    def _listen(self) -> list[tuple[str, str]]:
        """Return the station's output since the last call."""
        fresh = os.pread(self._output.fileno(), OUTPUT_MAX, self._heard)
        lines = fresh[: fresh.rfind(b"\n") + 1]
        self._heard += len(lines)
        texts = lines.decode(errors="replace").splitlines()
        self._said = texts[-1] if texts else self._said
        return [("station", text) for text in texts]

    def finish(self, lab: Laboratory) -> None:
        """Let the station end in order while the board still runs, or kill it."""
        station = self._running_station()

        def progress(now_us: int) -> None:
            if station.poll() is not None:
                lab.stop()

        station.terminate()
        lab.end_at(lab.now_us + STATION_EXIT_TIMEOUT_US)
        try:
            lab.run(progress)
        finally:
            self._kill()
        for source, text in self._listen():
            self._say(source, text)

    def _kill(self) -> None:
        if self._station is not None:
            self._station.kill()
            self._station.wait()

    def close(self) -> None:
        self._kill()
        self._output.close()
        self._typed.close()
        self._served.close()
        self._motive.close()


def linked_flight(request: Request, telemetry: Path | None, stack: ExitStack) -> Flight:
    """Return a flight over a real link, always paced; released when its board flies.

    Raises `LabError` if the station's process cannot find the experiment's trajectory.
    """
    experiment = request.experiment
    found = find_again(experiment.name, experiment.source)
    if found is None or found.trajectory != experiment.trajectory:
        raise LabError(
            f"--link {request.bench.link}: experiment {experiment.name}: its trajectory must stand in a file or a "
            "package, where the ground station's process finds it"
        )
    arguments = ["--profile", request.profile, *(f"--set={override}" for override in request.overrides)]
    assert telemetry is not None
    line_of = partial(StationProcess, telemetry, arguments)
    return Flight(request, Paced(), line_of, executor_of(request, stack))


def _pty(uri: str) -> Address:
    """Return the pty of `mavlink:pty` or `mavlink:PATH`, which must not exist: a line needs two ends."""
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
