"""Motion capture of a real laboratory: where its frame lies, which system it is, and what the station makes of it."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from firmware_py.geometry import to_euler_zyx
from ground_station.config import CaptureConfig
from ground_station.errors import MocapError
from ground_station.frame_rate import FrameRate
from ground_station.sources.address import find_source, override
from ground_station.sources.alignment import Alignment
from hil.config import load_config

QUARTER = math.pi / 2

length = st.floats(-10, 10)
lengths = st.tuples(length, length, length)
angle = st.floats(-math.pi, math.pi)


# Frames


def test_the_tunnel_is_moved_and_turned_in_the_system_s_frame() -> None:
    unturned = (1.0, 0.0, 0.0, 0.0)
    p, q = Alignment(CaptureConfig(axes="y-up")).to_world((1.0, 2.0, 3.0), unturned)
    assert (p, q) == ((1.0, -3.0, 2.0), unturned)
    p, _ = Alignment(CaptureConfig(axes="z-up", origin=(10.0, 20.0, 30.0))).to_world(
        (11.0, 22.0, 33.0), unturned
    )
    assert p == (1.0, 2.0, 3.0)
    p, q = Alignment(CaptureConfig(axes="z-up", yaw=QUARTER)).to_world((1.0, 2.0, 3.0), unturned)
    assert p == pytest.approx((2.0, -1.0, 3.0))  # the tunnel's x axis is the system's y axis
    assert to_euler_zyx(q) == pytest.approx((0.0, 0.0, -QUARTER))
    p, q = Alignment(CaptureConfig(axes="z-up", body_offset=(1.0, 2.0, 3.0), body_yaw=QUARTER)).to_world(
        (0, 0, 0), unturned
    )
    assert p == (1.0, 2.0, 3.0)
    assert to_euler_zyx(q) == pytest.approx((0.0, 0.0, QUARTER))


def test_motive_s_default_up_axis_is_y() -> None:
    assert Alignment(CaptureConfig(system="optitrack")).axes == "y-up"
    assert Alignment(CaptureConfig(system="vicon")).axes == "z-up"
    assert Alignment(CaptureConfig(system="optitrack", axes="z-up")).axes == "z-up"


@pytest.mark.long
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
    ("optitrack", {"system": "optitrack"}),
])  # fmt: skip
def test_the_command_line_overrides_what_it_names(text: str, changes: dict[str, object]) -> None:
    assert override(text, ROOM) == ROOM.model_copy(update=changes)


@pytest.mark.parametrize("text", [
    "optitrack:", "optitrack:h:0", "optitrack:h,body=", "optitrack:h,x", "virtual:1",
    "vicon", "vicon:h,multicast", "qualisys:", "vrpn:h:x", "phasespace:h", "",
])  # fmt: skip
def test_an_invalid_source_is_refused(text: str) -> None:
    with pytest.raises(MocapError, match="expected optitrack"):
        find_source(text, CaptureConfig())


def test_qualisys_has_one_port() -> None:
    with pytest.raises(MocapError, match="22222"):
        find_source("qualisys:h:22223", CaptureConfig())


@pytest.mark.parametrize("text", ["optitrack:h:1511", "vicon:h:802", "vrpn:h:3884", "qualisys:h"])
def test_a_port_may_be_named_where_the_client_takes_one(text: str) -> None:
    find_source(text, CaptureConfig()).close()


def test_a_stream_of_another_rate_is_reported_once() -> None:
    def told(*periods_us: int, expected_us: int = 5000) -> list[str]:
        rate, t_us, lines = FrameRate(expected_us, 50.0, 400_000), 7, []
        for period_us in periods_us:
            t_us += period_us
            lines.append(rate.on_frame(t_us))
        return [line for line in lines if line]

    assert told(*[5000] * 3000) == told(*[5500] * 3000) == told(*[4500] * 3000) == []
    assert len(told(*[5501] * 3000)) == len(told(*[4499] * 3000)) == 1
    assert told(*[400] * 280, 1_400_000, *[5000] * 3000) == []  # a burst and a stall
    assert len(told(*[10_000] * 1000)) == len(told(*[4000] * 3000)) == 1
    assert told(*[22_000] * 300, expected_us=22_000) == []  # a tenth fewer than the corrections
    (slower,) = told(*[23_000] * 300, expected_us=23_000)
    assert slower == "motion capture: a frame every 23.0 ms: 43, not 50 corrections leave per second"
    (faster,) = told(*[10_000] * 1000)
    assert "every 10.0 ms, not every 5.0 ms as set by mocap.period_us: 50 corrections leave" in faster
    (slower,) = told(*[40_000] * 1000)
    assert "25, not 50 corrections leave per second" in slower
    assert told(*[10_000] * 1000, expected_us=10_000) == []
    assert told(*[40_000] * 1000, expected_us=40_000) == [
        "motion capture: a frame every 40.0 ms: 25, not 50 corrections leave per second"
    ]
    assert told(*[400_000] * 20, expected_us=400_000) == [
        "motion capture: a frame every 400.0 ms: no corrections leave, see tracker.reacquire_us = 400000"
    ]


# The command
