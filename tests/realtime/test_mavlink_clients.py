"""Unmodified ground tools against `floaty serve --mavlink`: MAVProxy and MAVSDK, each as a program of its own."""

import hashlib
import importlib.util
import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.mavlink_socket import GAIN, MavlinkSocket
from support.mavproxy_program import PATIENCE_S, MavProxy, mavproxy_here
from support.paths import SUPPORT
from support.serving import Served, free_port, serve

PROGRAM_S = 60.0  # for a program to do all that it shall
STEP_S = 2.0  # after which the robot is at a new goal

mavsdk_here = pytest.mark.skipif(
    importlib.util.find_spec("mavsdk") is None,
    reason="MAVSDK IS NOT TESTED: `make clients` (pip install mavsdk) installs it",
)


def address(end: str) -> str:
    """What to serve on, so that tests do not meet."""
    return {"pty": "pty", "udp": f"udp:{free_port()}", "tcp": "tcp:0"}[end]


@pytest.fixture(params=["pty", "udp", "tcp"])
def proxied(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Served, MavProxy]]:
    with serve("--mavlink", address(request.param)) as served:
        proxy = MavProxy(served.line("mavlink ")[0], tmp_path)
        yield served, proxy
        proxy.kill()


@mavproxy_here
def test_mavproxy_watches_tunes_and_commands(proxied: tuple[Served, MavProxy], tmp_path: Path) -> None:
    served, proxy = proxied
    proxy.sees("Detected vehicle 1:1")
    proxy.sees("Received ")
    proxy.type(f"param set {GAIN} 2.5")
    proxy.hears(lambda message: message.get_type() == "PARAM_VALUE" and message.param_value == 2.5)
    proxy.answers(f"param show {GAIN}", f"{GAIN:<16} 2.5")
    proxy.type("long MAV_CMD_REQUEST_MESSAGE 148")
    proxy.type("long MAV_CMD_NAV_LAND")
    proxy.sees("Got COMMAND_ACK: NAV_LAND: UNSUPPORTED")
    proxy.hears(lambda message: message.get_type() == "AUTOPILOT_VERSION")

    messages = proxy.heard()
    kinds = {message.get_type() for message in messages}
    assert {"HEARTBEAT", "ATTITUDE", "LOCAL_POSITION_NED", "SYS_STATUS", "AUTOPILOT_VERSION"} <= kinds
    values = {message.param_id: message for message in messages if message.get_type() == "PARAM_VALUE"}
    count = values[GAIN].param_count
    assert len(values) == count
    proxy.sees(f"Received {count} parameters")
    assert values[GAIN].param_value == 2.5
    saved = dict(line.split() for line in (tmp_path / "mav.parm").read_text().splitlines())
    assert set(saved) == set(values)
    proxy.kill()
    again = MavlinkSocket(served.line("mavlink ")[0])  # the board does not care that it has gone
    again.wait("HEARTBEAT")
    again.close()


@mavproxy_here
def test_mavproxy_controls_a_signed_board_with_the_key(tmp_path: Path) -> None:
    key = hashlib.sha256(b"floaty").hexdigest()
    with serve("--mavlink", address("pty"), "--set", f"mavlink.signing_key={key}") as served:
        proxy = MavProxy(served.line("mavlink ")[0], tmp_path)
        try:
            proxy.sees("Detected vehicle 1:1")  # it listens to who signs, and is not listened to
            proxy.type("long MAV_CMD_NAV_LAND")
            proxy.type("signing key floaty")
            proxy.sees("Received ")
            assert "NAV_LAND" not in proxy.screen.read_text()
            proxy.type(f"param set {GAIN} 2.0")
            proxy.hears(lambda message: message.get_type() == "PARAM_VALUE" and message.param_value == 2.0)
        finally:
            proxy.kill()


@pytest.fixture(params=["udp", "pty", "tcp"])
def url(request: pytest.FixtureRequest) -> Iterator[str]:
    """An end of a served board, in MAVSDK's words."""
    with serve("--mavlink", address(request.param)) as served:
        master = served.line("mavlink ")[0]
        if request.param == "pty":
            yield f"serial://{master}:921600"
        else:
            kind, host, port = master.split(":")
            yield {"udpin": "udpin", "tcp": "tcpout"}[kind] + f"://{host}:{port}"


@mavsdk_here
def test_mavsdk_reads_telemetry_and_tunes(url: str) -> None:
    script = SUPPORT / "mavsdk_client.py"
    command = [sys.executable, str(script), url, GAIN, "2.5"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=PROGRAM_S, check=False)
    assert ended.returncode == 0, ended.stderr + ended.stdout
    seen = json.loads(ended.stdout.splitlines()[-1])
    assert seen["system"] == 1
    assert seen["attitude_deg"] == pytest.approx([0, 0, 0], abs=5)  # held at home
    assert seen["quaternion"] == pytest.approx([1, 0, 0, 0], abs=0.05)
    assert len(seen["position"]) == 3
    assert 3.9 < seen["battery_V"] < 4.2  # charged, under load
    assert seen["odometry"] == pytest.approx(seen["position"], abs=0.5)  # of an estimator without poses
    assert seen["imu"] == pytest.approx([0, 0, -9.8], abs=3)  # in the flow
    assert seen["home"] == pytest.approx([0, 0, -1.15])
    assert abs(seen["height"]) < 1.0
    assert seen["velocity"] == pytest.approx([0, 0, 0], abs=0.5)
    assert min(seen["heading_deg"], 360 - seen["heading_deg"]) < 5
    assert (seen["in_air"], seen["landed_state"], seen["armed"]) == (False, "ON_GROUND", False)
    assert len(seen["floats"]) > 30
    assert seen["others"] == 0
    assert seen["before"] == seen["floats"][GAIN] != 2.5
    assert seen["after"] == 2.5


@mavsdk_here
def test_mavsdk_lets_units_fail_stops_and_reboots() -> None:
    with serve("--mavlink", address("udp"), "--station") as served:
        served.wait_for("released", PATIENCE_S)
        _, host, port = served.line("mavlink ")[0].split(":")
        command = [sys.executable, str(SUPPORT / "mavsdk_pilot.py"), f"udpin://{host}:{port}"]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=PROGRAM_S, check=False)
    assert ended.returncode == 0, ended.stderr + ended.stdout
    seen = json.loads(ended.stdout.splitlines()[-1])
    assert (seen["in_air"], seen["landed_state"]) == (True, "IN_AIR")
    assert seen["without poses"] == "disarmed"
    assert seen["with poses"] == "armed"
    assert seen["gps"] == "UNSUPPORTED"
    assert seen["clear mission"] == "UNSUPPORTED"
    assert seen["logs"] == "NO_LOGFILES"
    assert seen["unknown parameter"] == "DOES_NOT_EXIST"
    assert seen["parameter out of range"] == "VALUE_OUT_OF_RANGE"
    assert seen["arm after the stop"] == "COMMAND_DENIED"
    assert "not armed: emergency stop; reboot first" in seen["texts"]


@mavsdk_here
def test_mavsdk_flies_offboard_and_gets_no_missions() -> None:
    with serve("--mavlink", address("udp"), "--station") as served:
        served.wait_for("released", PATIENCE_S)
        _, host, port = served.line("mavlink ")[0].split(":")
        command = [sys.executable, str(SUPPORT / "mavsdk_offboard.py"), f"udpin://{host}:{port}"]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=2 * PROGRAM_S, check=False)
    assert ended.returncode == 0, ended.stderr + ended.stdout
    seen = json.loads(ended.stdout.splitlines()[-1])
    assert [name for name, there in seen["streams"].items() if not there] == []
    assert (seen["arm"], seen["start"], seen["stop"]) == ("done", "done", "done")
    assert (seen["mode in offboard"], seen["mode after"], seen["active"]) == ("OFFBOARD", "HOLD", True)
    for begin, end, *goal in seen["goals"]:
        there = [place for instant, *place in seen["places"] if begin + STEP_S <= instant < end]
        assert len(there) > 40
        assert (
            max(rms_m(axis, wanted) for axis, wanted in zip(zip(*there, strict=True), goal, strict=True))
            < 0.06
        )
    assert "target refused: it has a velocity, no position" in seen["texts"]
    assert (seen["raw mission"], seen["mission"]) == ("UNSUPPORTED", "UNSUPPORTED")
    assert seen["start mission"] == "DENIED"


def rms_m(values: tuple[float, ...], wanted: float) -> float:
    return math.sqrt(sum((value - wanted) ** 2 for value in values) / len(values))
