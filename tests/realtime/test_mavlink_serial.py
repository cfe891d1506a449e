"""`floaty station` on a serial line: what cannot work is one line, what is pulled out comes back, and it flies."""

import csv
import hashlib
import os
import re
import select
import socket
import subprocess
import threading
import time
import tty
import types
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pymavlink.dialects.v20.development as dialect
import pytest
import serial
from serial.rfc2217 import PortManager

from ground_station.clock import clock_us
from ground_station.config import LinkSettings
from ground_station.errors import LinkError
from ground_station.links.mavlink_serial import MavlinkSerialLink
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal
from support.serving import CAMERAS, FLOATY, PATIENCE_S, Served, serve, station
from support.telemetry_rows import is_whole

KEY = hashlib.sha256(b"floaty").hexdigest()
HOME = Goal((0.0, 0.0, 1.15), 0.0)
Talk = Callable[["Peer"], None]


def refused(link: str, message: str, *arguments: str) -> None:
    command = [*FLOATY, "station", "--link", link, "--mocap", CAMERAS, *arguments]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert shown.returncode == 2
    assert message in shown.stderr
    assert shown.stderr.startswith("floaty: ")
    assert [line for line in shown.stdout.splitlines() if not line.startswith("mocap ")] == []
    assert shown.stderr.count("\n") == 1


class Peer:
    """What is at the other end of a pty, on pymavlink's codec; `talk` is called every 20 ms."""

    def __init__(self, talk: Talk) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.uri = f"mavlink:{os.ttyname(slave)}"
        self._slave = slave
        self.heard: list[object] = []
        self.reads = True
        self.codec = dialect.MAVLink(self, srcSystem=1, srcComponent=1)
        self.codec.robust_parsing = True
        self._talk = talk
        self._stopping = False
        self._thread = threading.Thread(target=self._loop)
        self._thread.start()

    def write(self, data: bytes) -> None:
        os.write(self.master, data)

    def _loop(self) -> None:
        while not self._stopping:
            if self.reads and select.select((self.master,), (), (), 0.02)[0]:
                for message in self.codec.parse_buffer(os.read(self.master, 4096)) or ():
                    self.heard.append(message)
                    if self._talk is board and message.get_type() == "COMMAND_LONG":
                        self.codec.command_ack_send(message.command, 0)
            self._talk(self)

    def close(self) -> None:
        self._stopping = True
        self._thread.join()
        os.close(self._slave)
        os.close(self.master)


def beats(peer: Peer) -> None:
    peer.codec.heartbeat_send(0, 0, 1, 2, 4, 3)
    time.sleep(0.02)


def board(peer: Peer) -> None:
    beats(peer)


@pytest.fixture
def peers() -> Iterator[Callable[..., Peer]]:
    made: list[Peer] = []

    def make(*arguments: object) -> Peer:
        made.append(Peer(*arguments))
        return made[-1]

    yield make
    for peer in made:
        peer.close()


def link_to(peer: Peer) -> MavlinkSerialLink:
    return MavlinkSerialLink(peer.uri, LinkSettings(50.0, 0, 921_600))


# Sending


def fresh(k: int) -> MocapFrame:
    return MocapFrame(clock_us() - 40_000, (0.001 * k, 0.0, 1.15), (1.0, 0.0, 0.0, 0.0), True)


def wait_until(reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not reached():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_stuck_line_blocks_no_caller_and_is_lost(peers: Callable[..., Peer]) -> None:
    peer = peers(board)
    link = link_to(peer)
    link.open(lambda: False)
    peer.reads = False
    slowest_s = 0.0

    def send_until_it_is_lost() -> None:
        nonlocal slowest_s
        for k in range(60_000):
            begin_s = time.monotonic()
            link.send(clock_us(), fresh(k), HOME)
            slowest_s = max(slowest_s, time.monotonic() - begin_s)
            link.check()
            time.sleep(0.0005)

    with pytest.raises(LinkError, match="lost: Write timeout"):
        send_until_it_is_lost()
    assert slowest_s < 0.2  # and not the second for which the writer waited
    assert int(re.search(r"(\d+) late", link.summary())[1]) > 100
    link.close()


class Pty(serial.Serial):
    """A pty has no modem lines; the protocol asks for them."""

    cts = dsr = ri = cd = False

    def _update_rts_state(self) -> None: ...
    def _update_dtr_state(self) -> None: ...


@contextmanager
def rfc2217_server(device: str) -> Iterator[str]:
    """pyserial's own server of a serial port for one client."""
    port = Pty(device, timeout=0)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        stopping = threading.Event()

        def run() -> None:
            client, _ = listener.accept()
            with client, suppress(OSError):  # the station leaves first
                manager = PortManager(port, types.SimpleNamespace(write=client.sendall))
                while not stopping.is_set():
                    if select.select((client,), (), (), 0.005)[0]:
                        port.write(b"".join(manager.filter(client.recv(4096))))
                    client.sendall(b"".join(manager.escape(port.read(4096))))

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield f"rfc2217://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            stopping.set()
            thread.join()
            port.close()


@pytest.mark.filterwarnings("ignore:set:DeprecationWarning")  # pyserial's own
def test_a_remote_port_works_like_a_local_one(peers: Callable[..., Peer]) -> None:
    peer = peers(board)
    with rfc2217_server(peer.uri.removeprefix("mavlink:")) as url:
        link = MavlinkSerialLink(f"mavlink:{url}", LinkSettings(50.0, 0, 115_200))
        link.open(lambda: False)
        link.send(clock_us(), fresh(7), HOME)
        wait_until(lambda: any(message.get_type() == "ATT_POS_MOCAP" for message in list(peer.heard)))
        link.close()


# Flying


class Cable:
    """Between a served board and a device that can be pulled out: then its user gets an error."""

    def __init__(self, board: str, device: Path) -> None:
        self.device = device
        self._board = os.open(board, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._master: int | None = None
        self._lock = threading.Lock()
        self._stopping = False
        self.plug()
        self._thread = threading.Thread(target=self._loop)
        self._thread.start()

    def plug(self) -> None:
        with self._lock:
            self._master, slave = os.openpty()
            tty.setraw(slave)
            self.device.symlink_to(os.ttyname(slave))
            self._slave = slave

    def pull(self) -> None:
        with self._lock:
            self.device.unlink()
            os.close(self._master)
            os.close(self._slave)
            self._master = None

    def _loop(self) -> None:
        while not self._stopping:
            select.select((self._board,), (), (), 0.002)  # not the master, which `pull` may close meanwhile
            with self._lock, suppress(BlockingIOError):
                if self._master is None:
                    os.read(self._board, 65536)
                    continue
                for source, sink in ((self._board, self._master), (self._master, self._board)):
                    if select.select((source,), (), (), 0)[0]:
                        os.write(sink, os.read(source, 4096))

    def close(self) -> None:
        self._stopping = True
        self._thread.join()
        os.close(self._board)
        if self._master is not None:
            self.pull()


def end_of(served: Served) -> str:
    """What pyserial calls the end of a served line."""
    (master,) = served.line("mavlink ")
    return master.replace("tcp:", "socket://")


def test_a_pulled_cable_is_failsafe_on_board_and_the_flight_goes_on_when_it_is_back(tmp_path: Path) -> None:
    log = tmp_path / "telemetry.csv"
    with serve("--mavlink", "pty", motive=True) as served:
        cable = Cable(end_of(served), tmp_path / "ttyUSB0")
        try:
            with station(served, f"mavlink:{cable.device}", "--log", log) as ground:
                served.wait_for("board 1: released", PATIENCE_S)
                served.forget()
                cable.pull()
                ground.wait_for(rf"^mavlink:{cable.device}: lost: .*; connecting again$", PATIENCE_S)
                served.wait_for("supervisor: failsafe, silence", PATIENCE_S)
                ground.forget()
                served.forget()
                cable.plug()
                ground.wait_for("^connected to ", PATIENCE_S)
                served.wait_for("supervisor: flying", PATIENCE_S)
                ground.wait_for(" 0 bad  round trip ", PATIENCE_S)
                assert ground.interrupt() == 0
        finally:
            cable.close()
    assert ground.lines[-1] == "the board is in failsafe, flaps at hover"
    rows = flown(log)
    times_s = [float(row["ground.t [s]"]) for row in rows]
    gap = max(range(1, len(rows)), key=lambda k: times_s[k] - times_s[k - 1])
    assert times_s[gap] - times_s[gap - 1] > 0.5
    assert_steady(rows[:gap])
    assert_steady(rows[-100:])


def flown(log: Path) -> list[dict[str, str]]:
    with log.open() as file:
        return [row for row in csv.DictReader(file) if row["supervisor.state []"] == "2"]


def assert_steady(rows: list[dict[str, str]]) -> None:
    assert len(rows) > 20
    complete = [row for row in rows if is_whole(row)]
    assert len(complete) / len(rows) > 0.9
    assert max(abs(float(row["stateEstimate.x [m]"])) for row in complete) < 0.2
    ages_ms = sorted(float(row["locSrv.age [0.1 ms]"]) / 10 for row in complete)
    assert 38.0 < ages_ms[len(ages_ms) // 2] < 60.0  # 38 ms of motion capture and what the line needs


def test_it_flies_over_tcp_signed_at_57600_baud(tmp_path: Path) -> None:
    log = tmp_path / "telemetry.csv"
    profile = (f"--set=mavlink.signing_key={KEY}", "--set=serial.baud=57600")
    with serve("--mavlink", "tcp:0", *profile, motive=True) as served:
        with station(served, f"mavlink:{end_of(served)}", "--log", log, *profile) as ground:
            ground.wait_for("^57600 baud: uplink ", PATIENCE_S)
            served.wait_for("board 1: released", PATIENCE_S)
            ground.wait_for(" 0 lost, .* round trip ", PATIENCE_S)
            assert ground.interrupt() == 0
        refused(
            f"mavlink:{end_of(served)}", "system 1 answers no command within 4 s: does it want signed frames"
        )
    assert_steady(flown(log))
