"""`floaty serve` as a process of its own: what Motive says there, and flights that need nothing but what it says."""

import re
import select
import socket
import threading
import time
from pathlib import Path

import pytest

from ground_station.config import CaptureConfig
from ground_station.sources.address import find_source
from support.mavproxy_program import MavProxy, mavproxy_here
from support.serving import PATIENCE_S, Served, serve, station

HOVER = 0.1  # off home at most [m]; the paper hovers within centimetres
AGE_MS = 5.0  # off the cameras' latency at most: the loopback interface and a busy machine


@pytest.mark.parametrize("up", ["y", "z"])
def test_whichever_axis_points_up_the_printed_address_shows_the_robot_in_its_holder(up: str) -> None:
    with serve("--udp", "0", "--set", f"capture.axes={up}-up", motive=True) as lab:
        assert lab.motive.endswith(",z-up") == (up == "z")
        receiver = find_source(lab.motive, CaptureConfig())
        receiver.open()
        frame, deadline = None, time.monotonic() + PATIENCE_S
        while (frame is None or not frame.valid) and time.monotonic() < deadline:
            frame = receiver.receive(0.1)
        receiver.close()
    assert frame is not None
    assert frame.p_WB == pytest.approx((0.0, 0.0, 1.15), abs=0.05)


def is_taken(port: int) -> bool:
    """Whether another program has a UDP port of the loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return True
    return False


@mavproxy_here
def test_mavproxy_flies_the_robot_from_what_motive_says(tmp_path: Path) -> None:
    """Its optitrack module knows no ports but 1510 and 1511."""
    if any(map(is_taken, (1510, 1511))):
        pytest.skip("MAVProxy's optitrack IS NOT TESTED: another program has UDP port 1510 or 1511")
    with serve("--mavlink", "pty", "--set", "capture.port=1510", motive=True) as lab:
        proxy = MavProxy(lab.line("mavlink ")[0], tmp_path)
        proxy.sees("Detected vehicle 1:1")
        for line in ("module load optitrack", "optitrack set multicast False", "optitrack set msg_intvl_ms 18",
                     "optitrack start"):  # fmt: skip
            proxy.type(line)
        lab.wait_for("board 1: released", PATIENCE_S)
        assert_still_flying(lab, 2.0)
        pose = [message for message in proxy.heard() if message.get_type() == "LOCAL_POSITION_NED"][-1]
        proxy.kill()
    assert [pose.x, pose.y, pose.z] == pytest.approx([0.0, 0.0, -1.15], abs=HOVER)


class Network:
    """Between a station and Motive, in a thread: some packets come twice, cut short or late; `cut` stops Motive's."""

    def __init__(self, motive: int) -> None:
        self.cut = False
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
        here, there = self._sockets
        here.bind(("127.0.0.1", 0))
        there.connect(("127.0.0.1", motive))
        self.port: int = here.getsockname()[1]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._carry, args=(here, there))
        self._thread.start()

    def _carry(self, here: socket.socket, there: socket.socket) -> None:
        station, count, late = None, 0, b""
        while not self._stop.is_set():
            for ready in select.select((here, there), (), (), 0.1)[0]:
                data, address = ready.recvfrom(65_536)
                if ready is here:
                    station = address
                    there.send(data)
                elif not self.cut and station is not None:
                    count += 1
                    packets = {3: [data[:-7]], 5: [data, data], 7: [], 8: [data, late]}.get(
                        count % 10, [data]
                    )
                    late = data
                    for packet in packets:
                        here.sendto(packet, station)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        for each in self._sockets:
            each.close()


def test_a_station_in_another_process_flies_and_flies_again_when_motive_is_back() -> None:
    with serve("--mavlink", "pty", motive=True) as lab:
        uri = "mavlink:" + lab.line("mavlink ")[0]
        network = Network(int(lab.motive.split(":")[2]))
        try:
            with station(lab, uri, mocap=f"optitrack:127.0.0.1:{network.port}") as typed:
                lab.wait_for("board 1: released", PATIENCE_S)
                shown = typed.wait_for("^pose ", PATIENCE_S)
                assert not any("lost" in line for line in lab.lines)
                lab.forget()
                network.cut = True
                typed.wait_for("^motion capture: no frames; calling the server again$", PATIENCE_S)
                lab.wait_for("failsafe, silence", PATIENCE_S)
                network.cut = False
                typed.wait_for("^motion capture: frames again after", PATIENCE_S)
                lab.wait_for("supervisor: flying", PATIENCE_S)
                assert typed.interrupt() == 0
                lab.wait_for("failsafe, silence", PATIENCE_S)
        finally:
            network.close()
    age = re.fullmatch(
        r"pose (\S+) ms old on board \(99 %: \S+\): camera 20.0 \+ processing 18.0 \+ network \S+ \+ station \S+ "
        r"\+ serial \S+",
        shown,
    )
    assert age is not None, shown
    assert float(age[1]) == pytest.approx(40.0, abs=AGE_MS)
    assert not any("Traceback" in line for line in typed.lines)


def assert_still_flying(lab: Served, duration_s: float) -> None:
    """Nothing is lost in this time."""
    with pytest.raises(AssertionError, match="no line"):
        lab.wait_for("lost", duration_s)
