"""`floaty lab serve` as a process of its own: what Motive says there, and flights that need nothing but what it says."""

import json
import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from serving import Served, free_port, serve
from test_mavlink_clients import MavProxy, mavproxy_here
from test_virtual_motive import FROM_MOTIVE, needs

from ground_station.mocap_udp import PoseReceiver, decode_frame

START_S = 20.0
HOVER = 0.1  # off home at most [m]; the paper hovers within centimetres
AGE_MS = 5.0  # off the cameras' latency at most: the loopback interface and a busy machine


@needs("natnet")
def test_the_cameras_pose_is_what_a_client_gets() -> None:
    """Against the poses that the same cameras send to `--mocap virtual`; the noise makes each frame one of a kind.

    The body is tracked by markers here, with noise that Motive would refuse.
    """
    receiver = PoseReceiver(free_port())
    noise = ("--set", "markers.noise=0.02", "--set", "markers.max_error=1")
    with serve("--udp", "0", "--natnet-port", "0", "--poses", str(receiver.port), *noise, what="lab") as lab:
        port = lab.line("motive ")[0].split(":")[2]
        script = str(Path(__file__).with_name("natnet_clients.py"))
        command = [sys.executable, script, "natnet", port, "unicast", "50"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE)
        frames = []
        deadline = time.monotonic() + START_S
        while process.poll() is None and time.monotonic() < deadline:
            if (data := receiver.receive(0.1)) is not None:
                frames.append(decode_frame(data))
        process.kill()
        out, _ = process.communicate()
        markers = subprocess.run(
            [sys.executable, script, "natnet-markers", port, "unicast", "5"],
            capture_output=True,
            timeout=START_S,
        )
    receiver.close()
    assert_markers(markers.stdout)
    rows = [json.loads(line) for line in out.splitlines() if line.startswith(b"[")]
    assert len(rows) == 50
    places = np.array([frame.p_WB for frame in frames])
    for _, name, p, q, tracked in rows:
        assert (name, tracked) == ("floaty", True)
        distances = np.linalg.norm(places - FROM_MOTIVE @ p, axis=1)
        assert distances.min() < 1e-6
        R_WB = Rotation.from_quat(np.roll(frames[int(distances.argmin())].q_WB, -1)).as_matrix()
        assert FROM_MOTIVE @ Rotation.from_quat(q).as_matrix() @ FROM_MOTIVE.T == pytest.approx(
            R_WB, abs=1e-5
        )


def assert_markers(out: bytes) -> None:
    """The markers of each frame fit the model: as well as the frame itself says."""
    (described,), *rows = [json.loads(line) for line in out.splitlines() if line.startswith(b"[")]
    places = np.array([p for _, p in described])
    assert places.shape == (8, 3)
    assert len(rows) == 5
    for _, (error,), labelled, unlabelled in rows:
        assert ([occluded for *_, occluded, _ in labelled], unlabelled) == ([False] * 8, [])
        points = np.array([p for _, _, p, _, _ in labelled])
        around, model = points - points.mean(axis=0), places - places.mean(axis=0)
        turn, _ = Rotation.align_vectors(around, model)
        off = np.linalg.norm(around - turn.apply(model), axis=1)
        assert off == pytest.approx([residual for *_, residual in labelled], abs=1e-5)
        assert error == pytest.approx(off.mean(), abs=1e-5)


@needs("natnet")
def test_markers_can_be_taken_off() -> None:
    with serve(
        "--udp", "0", "--natnet-port", "0", "--poses", "0", "--set", "markers.enabled=false", what="lab"
    ) as lab:
        port = lab.line("motive ")[0].split(":")[2]
        script = str(Path(__file__).with_name("natnet_clients.py"))
        command = [sys.executable, script, "natnet-markers", port, "unicast", "1"]
        out = subprocess.run(command, capture_output=True, timeout=START_S).stdout
    described, (_, error, *markers) = [json.loads(line) for line in out.splitlines() if line.startswith(b"[")]
    assert (described, error, markers) == ([[]], [0.0], [[], []])


@mavproxy_here
def test_mavproxy_flies_the_robot_from_what_motive_says(tmp_path: Path) -> None:
    """Its optitrack module knows no port but 1510."""
    with serve("--mavlink", "pty", "--poses", "0", what="lab") as lab:
        proxy = MavProxy(lab.line("mavlink ")[0], tmp_path)
        proxy.sees("Detected vehicle 1:1")
        for line in ("module load optitrack", "optitrack set multicast False", "optitrack set msg_intvl_ms 18",
                     "optitrack start"):  # fmt: skip
            proxy.type(line)
        lab.wait_for("board 1: released", START_S)
        assert_still_flying(lab, 2.0)
        pose = [message for message in proxy.heard() if message.get_type() == "LOCAL_POSITION_NED"][-1]
        proxy.kill()
    assert [pose.x, pose.y, pose.z] == pytest.approx([0.0, 0.0, -1.15], abs=HOVER)


def test_a_station_in_another_process_flies_the_robot() -> None:
    with serve("--mavlink", "pty", "--natnet-port", "0", "--poses", "0", what="lab") as lab:
        uri = "mavlink:" + lab.line("mavlink ")[0]
        command = [sys.executable, "-m", "hil.cli", "station", "--link", uri]
        command += ["--mocap", lab.line("motive ")[0], "--duration", "6"]
        station = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        try:
            lab.wait_for("board 1: released", START_S)
            assert_still_flying(lab, 2.0)
            said, _ = station.communicate(timeout=START_S)
        finally:
            station.kill()
            station.wait()
    assert station.returncode == 0, said
    age = re.search(r"mocap (\S+) ms old", said)
    assert age is not None, said
    assert float(age[1]) == pytest.approx(38.0, abs=AGE_MS)


def assert_still_flying(lab: Served, duration_s: float) -> None:
    """Nothing is lost in this time."""
    with pytest.raises(AssertionError, match="no line"):
        lab.wait_for("lost", duration_s)


def test_a_taken_natnet_port_is_one_line_and_exit_code_two() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = str(taken.getsockname()[1])
        command = [sys.executable, "-m", "hil.cli", "lab", "serve", "--udp", "0", "--natnet-port", port]
        shown = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert shown.returncode == 2
    assert shown.stderr.strip().endswith(f"natnet port {port}: Address already in use")
