"""`floaty serve` as a process of its own: what Motive says there, and flights that need nothing but what it says."""

import socket
import time
from pathlib import Path

import pytest

from ground_station.config import CaptureConfig
from ground_station.sources.address import find_source
from support.mavproxy_program import MavProxy, mavproxy_here
from support.serving import PATIENCE_S, Served, serve

HOVER = 0.1  # off home at most [m]; the paper hovers within centimetres


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
def test_mavproxy_flies_the_robot_from_motive_s_poses(tmp_path: Path) -> None:
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


def assert_still_flying(lab: Served, duration_s: float) -> None:
    """Nothing is lost in this time."""
    with pytest.raises(AssertionError, match="no line"):
        lab.wait_for("lost", duration_s)
