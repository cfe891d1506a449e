"""Motion capture of a real laboratory: where its frame lies, which system it is, and what the station makes of it."""

import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from serving import serve
from test_motioncapture import moving

from firmware_py.geometry import to_euler_zyx
from firmware_py.wire.telemetry import Sample
from ground_station.errors import MocapError
from ground_station.frame_rate import FrameRate
from ground_station.latency import LinkLatency
from ground_station.live import FAILSAFE, LiveStation
from ground_station.mocap import MocapFrame
from ground_station.sources.address import find_source, override
from ground_station.sources.alignment import Alignment
from ground_station.sources.config import CaptureConfig
from ground_station.sources.replay import read_frames
from ground_station.station import GroundStation, StationConfig
from ground_station.trajectory import Goal, Hold
from hil.config import load_config

LONG = bool(os.environ.get("FLOATY_LONG"))
FLOATY = (sys.executable, "-m", "hil.cli")
QUARTER = math.pi / 2

length = st.floats(-10, 10)
lengths = st.tuples(length, length, length)
angle = st.floats(-math.pi, math.pi)


# Frames


def test_the_tunnel_is_moved_and_turned_in_the_system_s_frame() -> None:
    unturned = (1.0, 0.0, 0.0, 0.0)
    p, q = Alignment(CaptureConfig(axes="y-up")).to_world((1.0, 2.0, 3.0), unturned)
    assert (p, q) == ((1.0, -3.0, 2.0), unturned)
    p, _ = Alignment(CaptureConfig(origin=(10.0, 20.0, 30.0))).to_world((11.0, 22.0, 33.0), unturned)
    assert p == (1.0, 2.0, 3.0)
    p, q = Alignment(CaptureConfig(yaw=QUARTER)).to_world((1.0, 2.0, 3.0), unturned)
    assert p == pytest.approx((2.0, -1.0, 3.0))  # the tunnel's x axis is the system's y axis
    assert to_euler_zyx(q) == pytest.approx((0.0, 0.0, -QUARTER))
    p, q = Alignment(CaptureConfig(body_offset=(1.0, 2.0, 3.0), body_yaw=QUARTER)).to_world(
        (0, 0, 0), unturned
    )
    assert p == (1.0, 2.0, 3.0)
    assert to_euler_zyx(q) == pytest.approx((0.0, 0.0, QUARTER))


def test_y_is_up_by_default_where_motive_says_so() -> None:
    assert Alignment(CaptureConfig(system="optitrack")).axes == "y-up"
    assert Alignment(CaptureConfig(system="vicon")).axes == "z-up"
    assert Alignment(CaptureConfig(system="optitrack", axes="z-up")).axes == "z-up"


@given(lengths, angle, lengths, angle, lengths, st.integers(0, 2**32 - 1))
def test_every_alignment_is_the_chain_of_homogeneous_transforms(
    origin: tuple[float, float, float], yaw: float, offset: tuple[float, float, float], body_yaw: float,
    p: tuple[float, float, float], seed: int,
) -> None:  # fmt: skip
    """Against 4 x 4 matrices: T_WB = T_CW^-1 T_CM T_MD T_CM^-1 T_DB."""
    attitude = Rotation.random(rng=seed)
    p_W, q_W = Alignment(
        CaptureConfig(axes="y-up", origin=origin, yaw=yaw, body_offset=offset, body_yaw=body_yaw)
    ).to_world(p, tuple(attitude.as_quat(scalar_first=True).tolist()))

    def transform(rotation: Rotation, at: tuple[float, float, float]) -> np.ndarray:
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = rotation.as_matrix(), at
        return matrix

    up = transform(Rotation.from_euler("x", 90, degrees=True), (0, 0, 0))
    tunnel = transform(Rotation.from_euler("z", yaw), origin)
    robot = transform(Rotation.from_euler("z", body_yaw), offset)
    expected = np.linalg.inv(tunnel) @ up @ transform(attitude, p) @ np.linalg.inv(up) @ robot
    assert transform(Rotation.from_quat(q_W, scalar_first=True), p_W) == pytest.approx(expected, abs=1e-9)


# Which system


def test_a_laboratory_is_a_profile_of_five_lines(tmp_path: Path) -> None:
    profile = tmp_path / "lab.toml"
    profile.write_text(
        'base = "floaty"\n[capture]\nsystem = "optitrack"\nhost = "192.168.1.5"\norigin = [0.3, -1.2, 2.0]\n'
    )
    capture = load_config(str(profile)).capture
    assert (capture.system, capture.host, capture.origin) == ("optitrack", "192.168.1.5", (0.3, -1.2, 2.0))


ROOM = CaptureConfig(
    system="optitrack", host="room", port=1600, multicast=True, body="floaty", axes="z-up", yaw=0.5, origin=(1, 2, 3)
)  # fmt: skip


@pytest.mark.parametrize(("text", "changes"), [
    ("optitrack", {}),
    ("optitrack,y-up", {"axes": "y-up"}),
    ("optitrack:10.0.0.1", {"host": "10.0.0.1", "port": None}),
    ("optitrack:10.0.0.1:1510,body=wand", {"host": "10.0.0.1", "port": 1510, "body": "wand"}),
    ("vicon:h", {"system": "vicon", "host": "h", "port": None, "multicast": False, "axes": None}),
    ("vrpn:h:3884,y-up", {"system": "vrpn", "host": "h", "port": 3884, "multicast": False, "axes": "y-up"}),
    ("virtual", {"system": "virtual", "port": None, "multicast": False, "axes": None}),
    ("virtual:7", {"system": "virtual", "port": 7, "multicast": False, "axes": None}),
])  # fmt: skip
def test_the_command_line_overrides_what_it_names(text: str, changes: dict[str, object]) -> None:
    assert override(text, ROOM) == ROOM.model_copy(update=changes)


@pytest.mark.parametrize("text", [
    "optitrack", "optitrack:", "optitrack:h:0", "optitrack:h,body=", "optitrack:h,x", "virtual:", "virtual:x",
    "virtual:1,2", "virtual,body=x", "vicon", "vicon:h,multicast", "qualisys:", "vrpn:h:x", "phasespace:h", "",
])  # fmt: skip
def test_what_names_no_source_is_refused(text: str) -> None:
    with pytest.raises(MocapError, match="expected virtual"):
        find_source(text, CaptureConfig())


def test_qualisys_has_one_port() -> None:
    with pytest.raises(MocapError, match="22222"):
        find_source("qualisys:h:22223", CaptureConfig())


def test_a_stream_with_another_rate_than_the_profile_s_is_told_once() -> None:
    def told(*periods_us: int) -> list[str]:
        rate, t_us, lines = FrameRate(5000), 7, []
        for period_us in periods_us:
            t_us += period_us
            lines.append(rate.on_frame(t_us))
        return [line for line in lines if line]

    assert told(*[5000] * 3000) == told(*[5400] * 3000) == []
    assert told(*[400] * 280, 1_400_000, *[5000] * 3000) == []  # a burst and a stall
    assert len(told(*[10_000] * 1000)) == len(told(*[4000] * 3000)) == 1
    assert "every 10.0 ms, not every 5.0 ms" in told(*[10_000] * 1000)[0]


# The station


class SlowLink:
    """A board that takes its time to connect, which is when `open` asks whether to give up."""

    uri = "slow"
    latency = LinkLatency("air", 0, measured=False)
    supervisor_state = FAILSAFE
    sent = 0

    def open(self, give_up: Callable[[], bool]) -> None:
        for _ in range(12):
            time.sleep(0.1)
            assert not give_up()

    def received(self) -> list[tuple[int, bytes]]:
        return []

    def start_telemetry(self, now_us: int) -> None: ...

    def send(self, now_us: int, frame: MocapFrame, goal: Goal) -> None:
        self.sent += 1

    def receive(self, now_us: int, data: bytes) -> list[Sample]:
        return []

    def notices(self) -> list[str]:
        return []

    def summary(self) -> str:
        return ""

    def check(self) -> None: ...

    def mute(self) -> None: ...

    def close(self) -> None: ...


def test_while_the_board_connects_the_cameras_are_served() -> None:
    said: list[str] = []
    with moving() as lab:
        source = find_source(f"optitrack:127.0.0.1:{lab.motive.port}", CaptureConfig())
        source.open()
        end = time.monotonic() + 1.5
        link = SlowLink()
        ground = GroundStation(link, Hold(Goal((0.0, 0.0, 1.15), 0.0)), None, StationConfig())
        LiveStation(link, ground, source, FrameRate(5000), said.append, lambda: time.monotonic() > end).run()
        source.close()
    assert 10 < link.sent < 20  # of 0.3 s, not of the 1.5 s before
    assert not any("frames" in line for line in said)


def station(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [*FLOATY, "station", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize(("arguments", "message"), [
    (("--mocap", "replay:/nowhere"), "--mocap replay:/nowhere: /nowhere: No such file or directory"),
    (("--mocap", "kinect:h"), "--mocap kinect:h: expected virtual[:PORT], optitrack:HOST"),
    (("--set", "capture.system=optitrak"), "capture.system = 'optitrak': input should be 'virtual', 'optitrack'"),
    (("--set", "capture.system=qualisys", "--set", "capture.port=1"), "capture.system = qualisys: qualisys: its client"),
    (("--mocap", "virtual:0"), "--mocap virtual:0: expected virtual"),
])  # fmt: skip
def test_what_cannot_be_is_one_line_and_exit_code_two(arguments: tuple[str, ...], message: str) -> None:
    shown = station("--link", "udp://127.0.0.1:1", *arguments)
    assert shown.returncode == 2
    assert message in shown.stderr
    assert "Traceback" not in shown.stderr


@pytest.mark.skipif(not LONG, reason="20 s: FLOATY_LONG=1")
def test_a_flight_is_recorded_and_its_record_flown_again(tmp_path: Path) -> None:
    profile, frames = tmp_path / "lab.toml", tmp_path / "frames.csv"
    with serve("--mavlink", "pty", "--natnet-port", "0", "--poses", "0", what="lab") as lab:
        link = "mavlink:" + lab.line("mavlink ")[0]
        port = lab.line("motive ")[0].split(":")[2]
        profile.write_text(
            f'base = "floaty"\n[capture]\nsystem = "optitrack"\nport = {port}\nbody = "floaty"\n'
        )
        shown = station(
            "--link", link, "--profile", str(profile), "--duration", "5", "--record", str(frames), "--log",
            str(tmp_path / "telemetry.csv"),
        )  # fmt: skip
        assert shown.returncode == 0, shown.stdout + shown.stderr
        recorded = read_frames(frames)
        assert len(recorded) > 800
        assert max(abs(frame.p_WB[2] - 1.15) for _, frame in recorded) < 0.1
        begin_s = time.monotonic()
        shown = station("--link", link, "--mocap", f"replay:{frames}")
        assert shown.returncode == 0, shown.stdout + shown.stderr
        assert f"the recording is over: {len(recorded)} frames" in shown.stdout
        assert time.monotonic() - begin_s > (recorded[-1][0] - recorded[0][0]) * 1e-6
        assert len(read_frames(tmp_path / "telemetry.csv")) > 100
        shown = station("--link", link, "--mocap", f"replay:{tmp_path}")
        assert "a frame every" in shown.stdout  # telemetry has 50 a second
