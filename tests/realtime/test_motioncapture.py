"""Vicon, Qualisys and VRPN through the package `motioncapture` in its own process: poses, and all that goes wrong."""

import contextlib
import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise

import pytest
from scipy.spatial.transform import Rotation

from ground_station.clock import clock_us
from ground_station.config import CaptureConfig
from ground_station.errors import MocapError
from ground_station.mocap import MocapFrame, MocapSource
from ground_station.sources.address import find_source
from ground_station.sources.motioncapture_client import MotioncaptureSource
from support.motive_bench import MotiveBench, moving, needs, seen
from support.qualisys_server import qualisys_server
from support.serving import PATIENCE_S
from support.vrpn_server import vrpn_server


@contextlib.contextmanager
def opened(source: MotioncaptureSource) -> Iterator[MotioncaptureSource]:
    try:
        source.open()
        yield source
    finally:
        source.close()


def received(source: MocapSource, count: int, timeout_s: float = PATIENCE_S) -> list[MocapFrame]:
    deadline = time.monotonic() + timeout_s
    frames: list[MocapFrame] = []
    while len(frames) < count:
        assert time.monotonic() < deadline, f"{len(frames)} frames within {timeout_s} s"
        if (frame := source.receive(0.1)) is not None:
            frames.append(frame)
    return frames


def await_notice(source: MocapSource, words: str, timeout_s: float = PATIENCE_S) -> list[MocapFrame]:
    """The frames until a notice has these words."""
    deadline, frames = time.monotonic() + timeout_s, []
    while not any(words in notice for notice in source.notices()):
        assert time.monotonic() < deadline, words
        if (frame := source.receive(0.02)) is not None:
            frames.append(frame)
    return frames


def await_loss(source: MocapSource) -> None:
    """Take the frames that were under way, until the first in which the body was not seen."""
    deadline = time.monotonic() + PATIENCE_S
    while (frame := source.receive(0.1)) is None or frame.valid:
        assert time.monotonic() < deadline


def from_motive(lab: MotiveBench, **options: object) -> MotioncaptureSource:
    """The backend of the package that can be tried here, which follows the same rules as those that cannot."""
    settings = {"hostname": "localhost", "interface_ip": "127.0.0.1", "port_command": str(lab.motive.port)}
    capture = CaptureConfig(system="vicon", axes="y-up", latency_us=7000).model_copy(update=options)
    return MotioncaptureSource("optitrack", settings, capture)


@needs("motioncapture")
def test_poses_come_through_the_package_s_own_process_and_a_killed_one_comes_back() -> None:
    hidden: list[bool] = []
    with moving(lambda: bool(hidden)) as lab, opened(from_motive(lab, body="floaty")) as source:
        assert source.notices() == ["mocap optitrack at 127.0.0.1, body floaty, y-up, age assumed: 7.0 ms"]
        frames = received(source, 20)
        assert all(7000 <= clock_us() - frame.t_us < 2_000_000 for frame in frames)
        assert all(frame.arrived_us == frame.t_us + 7000 for frame in frames)
        assert any(frame.valid for frame in frames)
        for frame in frames:  # those that have come, as the virtual Motive drew them
            if frame.valid:
                assert min(math.dist(frame.p_WB, seen_p) for seen_p in drawn(lab.number)) < 1e-6
        hidden.append(True)
        await_loss(source)
        assert not any(frame.valid for frame in received(source, 20))
        hidden.clear()
        assert os.getsid(process_of(source)) != os.getsid(0)  # Ctrl-C does not reach it
        os.kill(process_of(source), signal.SIGKILL)
        assert_one_notice(source, "motion capture: no frames; calling the server again")
        await_notice(source, "frames arrive again")
        assert any(frame.valid for frame in received(source, 20))


def drawn(count: int) -> list[tuple[float, float, float]]:
    return [seen(number).p_WB for number in range(1, count + 2)]


def process_of(source: MotioncaptureSource) -> int:
    assert source._process is not None
    return source._process.pid


def assert_one_notice(source: MocapSource, text: str) -> None:
    notices: list[str] = []
    deadline = time.monotonic() + 0.9
    while time.monotonic() < deadline:
        source.receive(0.02)
        notices += source.notices()
    assert notices == [text]


@needs("motioncapture")
def test_a_wrong_body_is_one_line_with_those_that_are_seen() -> None:
    told = r"^127\.0\.0\.1: no body 'flouty'; there are: floaty\Z"
    with moving() as lab, pytest.raises(MocapError, match=told):
        from_motive(lab, body="flouty").open()


@needs("motioncapture")
def test_vrpn_poses_come_from_a_server_over_its_own_protocol() -> None:
    silent: list[bool] = []

    def poses(number: int) -> dict[str, tuple[float, ...]]:
        pose = (number * 1e-3, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5)
        return {"wand": pose} if silent else {"wand": pose, "floaty": pose}

    with vrpn_server(["wand", "floaty"], poses) as port:
        source = find_source(f"vrpn:localhost:{port},body=floaty", CaptureConfig())
        assert isinstance(source, MotioncaptureSource)
        with opened(source):
            frames = received(source, 50)
            assert all(frame.valid and frame.p_WB[1:] == (2.0, 3.0) for frame in frames)
            assert frames[0].q_WB == (0.5, 0.5, -0.5, 0.5)
            assert all(a.p_WB[0] < b.p_WB[0] for a, b in pairwise(frames))
            silent.append(True)
            assert all(frame.valid for frame in await_notice(source, "no frames"))
            assert source.receive(0.1) is None  # VRPN does not say that a body is lost: it says nothing
            silent.clear()
            await_notice(source, "frames arrive again")


@needs("motioncapture")
def test_qualisys_poses_come_from_a_server_over_its_own_protocol() -> None:
    state: list[str] = []

    def pose(number: int) -> tuple[float, ...] | None:
        if "stopped" in state:
            return None
        return (math.nan,) * 6 if "hidden" in state else (number * 1.0, 2000.0, 3000.0, 10.0, 20.0, 30.0)

    with qualisys_server("floaty", pose):
        source = find_source("qualisys:localhost,body=floaty", CaptureConfig())
        assert isinstance(source, MotioncaptureSource)
        with opened(source):
            frames = received(source, 50)
            assert all(frame.valid and frame.p_WB[1:] == (2.0, 3.0) for frame in frames)
            expected = Rotation.from_euler("XYZ", (10, 20, 30), degrees=True)  # QTM's own convention
            assert frames[0].q_WB == pytest.approx(expected.as_quat(scalar_first=True), abs=1e-6)
            state.append("hidden")
            await_loss(source)
            assert not any(frame.valid for frame in received(source, 10))
            state.append("stopped")
            await_notice(source, "no frames")
            state.clear()
            await_notice(source, "frames arrive again")


@needs("motioncapture")
def test_a_server_that_is_not_there_is_one_line_within_six_seconds() -> None:
    begin_s = time.monotonic()
    with pytest.raises(MocapError, match=r"^127\.0\.0\.1: .*22222\Z"):
        find_source("qualisys:127.0.0.1", CaptureConfig()).open()
    with pytest.raises(MocapError, match=r"^nowhere\.invalid: .*known\Z"):
        find_source("vicon:nowhere.invalid", CaptureConfig()).open()
    assert time.monotonic() - begin_s < 3
    with pytest.raises(MocapError, match=r"^127\.0\.0\.1: no frames of a vrpn server\Z"):
        find_source("vrpn:127.0.0.1:9", CaptureConfig()).open()
    assert time.monotonic() - begin_s < 9


@needs("motioncapture")
def test_an_orphaned_process_ends() -> None:
    """Vicon's connect() goes on for ever, and lets no signal handler of Python's run."""
    command = [
        sys.executable, "-m", "ground_station.sources.motioncapture_process", "vicon", "hostname=127.0.0.1",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        assert process.wait(PATIENCE_S) == -signal.SIGALRM
    finally:
        process.kill()
