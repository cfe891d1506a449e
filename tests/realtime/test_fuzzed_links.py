"""Random and structured-random bytes on every real link beside a robot in flight, and the link serves on.

The built-in station flies the robot on a wire that no client sees; a Motive server reports its position.
Requests that a client may rightly make are left out: see `support.random_requests`.
"""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cflib.crtp
import numpy as np
import pymavlink.dialects.v20.common as dialect
import pytest
import usb.core
from cflib.crazyflie.mem import MemoryElement
from cflib.drivers.crazyradio import Crazyradio

from firmware_py.wire import crtp
from ground_station.config import CaptureConfig
from ground_station.sources.optitrack import OptitrackSource
from support.cflib_client import CflibClient
from support.mavlink_client import STATION, codec
from support.mavlink_socket import GAIN, MavlinkSocket
from support.plugged_dongle import plug
from support.random_requests import harmless_message, random_packet, spoilt
from support.serving import PATIENCE_S, Served, serve

DURATION_S = 20.0
SETTLED_S = 2.0
PERIOD_S = 0.002
BATCH = 4  # packets of every sender per period: 2000 per second, 34 kB/s
HOME = np.array((0.0, 0.0, 1.15))
REFUSED = 500  # at the least, in that time
FURTHEST_M = 0.15  # what the lockstep test allows, too
QUEUED = 300  # packets: more than a board's queues hold
Send = Callable[[], object]


class Watch(threading.Thread):
    """Follows the robot through Motive until `stop`."""

    def __init__(self, served: Served) -> None:
        super().__init__()
        port = int(served.motive.split(":")[2].split(",")[0])
        self._source = OptitrackSource(CaptureConfig(system="optitrack", port=port, body="floaty"))
        self._source.open()
        self._stopping = threading.Event()
        self.furthest_m = 0.0
        self.frames = 0

    def run(self) -> None:
        while not self._stopping.is_set():
            frame = self._source.receive(0.1)
            if frame is not None and frame.valid:
                self.frames += 1
                self.furthest_m = max(self.furthest_m, float(np.abs(frame.p_WB - HOME).max()))
        self._source.close()

    def stop(self) -> None:
        self._stopping.set()
        self.join()


@contextlib.contextmanager
def flying(*arguments: str) -> Iterator[Served]:
    """A server whose station flies the robot."""
    with serve(*arguments, "--station", "--set", "markers.enabled=false", motive=True) as served:
        served.wait_for("board 1: released", PATIENCE_S)
        time.sleep(SETTLED_S)
        yield served


def fuzz(served: Served, *sends: Send) -> None:
    """Send for the whole duration; the robot stays where it is."""
    watch = Watch(served)
    watch.start()
    try:
        end_s = time.monotonic() + DURATION_S
        while time.monotonic() < end_s:
            for send in sends:
                send()
            time.sleep(PERIOD_S)
        time.sleep(SETTLED_S)  # what waits in sockets has arrived, and a session is over
    finally:
        watch.stop()
    served.listen()
    assert watch.frames > 50 * DURATION_S  # of 200
    assert watch.furthest_m < FURTHEST_M, served.lines[-5:]
    assert not any("lost" in line or "failsafe" in line or "put back" in line for line in served.lines)


def serves_cflib(uri: str, cache: Path) -> None:
    """Tables, parameters, log and memories answer a new client, and counters tell what the last one was refused."""
    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers()
    client = CflibClient(uri, cache).ready()
    try:
        assert client.set("extCtrl.z_P", 2.5) == 2.5
        counters = client.rows(1, 10, "crtp.malformed", "crtp.unserved")[0][1]
        assert min(counters.values()) > REFUSED
        assert client.rows(1, 10, "supervisor.state")[0][1]["supervisor.state"] == 2
        (eeprom,) = client.cf.mem.get_mems(MemoryElement.TYPE_I2C)
        client.answer(eeprom.update)
    finally:
        client.close()


def datagrams(served: Served, seed: int) -> tuple[socket.socket, Send]:
    """A UDP client that sends packets and takes what comes."""
    host, port = served.udp_uris[0].removeprefix("udp://").split(":")
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.connect((host, int(port)))
    client.setblocking(False)
    rng = np.random.default_rng(seed)

    def send() -> None:
        for _ in range(BATCH):
            with contextlib.suppress(BlockingIOError):
                client.send(random_packet(rng))
        with contextlib.suppress(BlockingIOError):
            while client.recv(64):
                pass

    return client, send


def test_udp_from_the_session_and_from_a_stranger(tmp_path: Path) -> None:
    with flying("--udp", "0") as served:
        peer, send_peer = datagrams(served, 1)
        stranger, send_stranger = datagrams(served, 2)
        with peer, stranger:
            peer.send(crtp.encode(crtp.Packet(crtp.PORT_LINK, 0, b"hello")))
            fuzz(served, send_peer, send_stranger)
        serves_cflib(served.udp_uris[0], tmp_path)
        served.wait_for("packets of others were ignored", PATIENCE_S)


def test_virtual_dongle(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    with flying("--radio", "--radio-port", "0") as served:
        plug(served)
        radio = Crazyradio()
        radio.set_channel(80)
        radio.set_data_rate(Crazyradio.DR_2MPS)
        answered = 0

        def send() -> None:
            nonlocal answered
            with contextlib.suppress(usb.core.USBError):
                answered += radio.send_packet(random_packet(rng)) is not None

        fuzz(served, send)
        assert answered > 50 * DURATION_S
        for _ in range(QUEUED):  # what the board still has to say
            radio.send_packet(b"\xff")
        radio.close()
        serves_cflib(served.radio_uris[0], tmp_path)


def on_line(master: str, seed: int) -> tuple[MavlinkSocket, Send]:
    """A client of the serial line that sends messages, spoilt messages and bytes, and takes what comes."""
    client = MavlinkSocket(master)
    rng, sender = np.random.default_rng(seed), codec(*STATION)

    def send() -> None:
        for _ in range(BATCH // 2):
            frame = bytes(harmless_message(rng).pack(sender))
            kind = rng.random()
            client.write(frame if kind < 0.7 else spoilt(rng, frame) if kind < 0.9 else rng.bytes(40))
        client.poll(0.0)
        client.received.clear()

    return client, send


@pytest.mark.parametrize(("end", "clients"), [("pty", 1), ("tcp:0", 2)], ids=["pty", "tcp and a stranger"])
def test_serial_line(end: str, clients: int) -> None:
    with flying("--mavlink", end) as served:
        (master,) = served.line("mavlink ")
        lines = [on_line(master, seed) for seed in range(4, 4 + clients)]
        fuzz(served, *(send for _, send in lines))
        for client, _ in lines:
            client.close()
        serves_mavlink(master)


def serves_mavlink(master: str) -> None:
    """Parameters, commands and streams answer a new client, and counters tell what the last one was refused."""
    client = MavlinkSocket(master)
    assert GAIN in client.parameters()
    assert client.set(GAIN, 2.5) == 2.5
    assert client.command(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, dialect.MAVLINK_MSG_ID_SYS_STATUS, 1e5) == 0
    status = client.wait("SYS_STATUS")
    assert status.errors_comm > REFUSED
    client.close()
