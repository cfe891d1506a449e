"""Motion capture of a real laboratory: where its frame lies, which system it is, other processes, records and replays."""

import contextlib
import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from qualisys_server import qualisys_server
from scipy.spatial.transform import Rotation
from serving import serve
from test_virtual_motive import Laboratory, needs
from vrpn_server import vrpn_server

from firmware_py.geometry import to_euler_zyx
from firmware_py.wire.telemetry import Sample
from ground_station.clock import clock_us
from ground_station.errors import MocapError
from ground_station.frame_rate import FrameRate
from ground_station.live import FAILSAFE, LiveStation
from ground_station.mocap import MocapFrame, MocapSource
from ground_station.sources.address import find_source, override
from ground_station.sources.alignment import Alignment
from ground_station.sources.capture_lines import Arrival, decode_line, encode_arrival, encode_error
from ground_station.sources.config import CaptureConfig
from ground_station.sources.motioncapture_client import MotioncaptureSource, settings_of
from ground_station.sources.record import RecordingSource
from ground_station.sources.replay import TELEMETRY_COLUMNS, ReplaySource, read_frames
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


# Lines of the other process


names = st.text(max_size=10)
body = st.tuples(*[st.floats()] * 7)


@given(st.integers(0, 2**63 - 1), st.dictionaries(names, body, max_size=3))
@settings(max_examples=50)
def test_a_line_says_what_was_seen(t_us: int, bodies: dict[str, tuple[float, ...]]) -> None:
    line = encode_arrival(Arrival(t_us, bodies))
    assert line.count("\n") == 1
    decoded = decode_line(line.encode())
    assert isinstance(decoded, Arrival)
    assert repr(decoded) == repr(Arrival(t_us, bodies))  # NaN is as NaN here


def test_a_line_says_why_no_more_will_come() -> None:
    assert decode_line(encode_error("no\nway").encode()) == "no\nway"


json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=12,
)


@given(st.binary(max_size=60) | json.map(lambda value: repr(value).replace("'", '"').encode()))
def test_no_bytes_of_the_other_process_do_harm(line: bytes) -> None:
    with contextlib.suppress(MocapError):
        decode_line(line)


@pytest.mark.parametrize(
    "line", [b"[" * 100_000, b"[" + b"9" * 5000 + b", {}]", b'[1, {"a": [1e999]}]', b"[true]"]
)
def test_extreme_lines_are_refused(line: bytes) -> None:
    with pytest.raises(MocapError, match="not a line"):
        decode_line(line)


# The other process


@contextlib.contextmanager
def opened(source: MotioncaptureSource) -> Iterator[MotioncaptureSource]:
    try:
        source.open()
        yield source
    finally:
        source.close()


def received(source: MocapSource, count: int, timeout_s: float = 10.0) -> list[MocapFrame]:
    deadline = time.monotonic() + timeout_s
    frames: list[MocapFrame] = []
    while len(frames) < count:
        assert time.monotonic() < deadline, f"{len(frames)} frames within {timeout_s} s"
        if (frame := source.receive(0.1)) is not None:
            frames.append(frame)
    return frames


def await_notice(source: MocapSource, words: str, timeout_s: float = 10.0) -> list[MocapFrame]:
    """The frames until a notice has these words."""
    deadline, frames = time.monotonic() + timeout_s, []
    while not any(words in notice for notice in source.notices()):
        assert time.monotonic() < deadline, words
        if (frame := source.receive(0.02)) is not None:
            frames.append(frame)
    return frames


@contextlib.contextmanager
def moving(stands: Callable[[], bool] = lambda: False) -> Iterator[Laboratory]:
    """A Motive that streams in a thread, without the body while it `stands`."""
    lab, stop = Laboratory(), threading.Event()

    def pump() -> None:
        while not stop.wait(0.005):
            lab.expose(valid=not stands())
            lab.answer()

    thread = threading.Thread(target=pump)
    thread.start()
    try:
        yield lab
    finally:
        stop.set()
        thread.join()
        lab.motive.close()


def from_motive(lab: Laboratory, **options: object) -> MotioncaptureSource:
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
        assert any(frame.valid for frame in frames)
        for frame in frames:  # those that have come, as the virtual Motive drew them
            if frame.valid:
                assert min(math.dist(frame.p_WB, seen_p) for seen_p in drawn(lab.number)) < 1e-6
        hidden.append(True)
        time.sleep(0.2)
        received(source, 60)
        assert not any(frame.valid for frame in received(source, 20))
        hidden.clear()
        assert os.getsid(process_of(source)) != os.getsid(0)  # Ctrl-C does not reach it
        os.kill(process_of(source), signal.SIGKILL)
        assert_one_notice(source, "motion capture: no frames; calling the server again")
        await_notice(source, "frames again")
        assert any(frame.valid for frame in received(source, 20))


def drawn(count: int) -> list[tuple[float, float, float]]:
    from test_virtual_motive import seen

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
            await_notice(source, "frames again")


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
            time.sleep(0.1)
            received(source, 30)
            assert not any(frame.valid for frame in received(source, 10))
            state.append("stopped")
            await_notice(source, "no frames")
            state.clear()
            await_notice(source, "frames again")


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


@pytest.fixture
def stand_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., MotioncaptureSource]:
    """A source whose process finds a module of this text in place of the package."""

    def make(text: str, body: str = "") -> MotioncaptureSource:
        (tmp_path / "motioncapture.py").write_text(text)
        monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{Path(__file__).parent.parent}")
        capture = CaptureConfig(system="qualisys", body=body)
        return MotioncaptureSource(capture.system, settings_of(capture), capture)

    return make


CAMERAS = """
import os, time
from types import SimpleNamespace as Thing
import numpy as np

class connect:
    number = 0
    def __init__(self, system, settings):
        assert settings == {"hostname": "127.0.0.1"} and system == "qualisys"
    def waitForNextFrame(self):
        time.sleep(0.005)
        self.number += 1
    @property
    def rigidBodies(self):
        return self.bodies(self.number)
    def body(self, x, w=1.0):
        return Thing(position=np.array([x, 2.0, 3.0]), rotation=Thing(w=w, x=0.0, y=0.0, z=0.0))
    def bodies(self, number):
        return {"one": self.body(float(number))}
"""
GOOD_BODIES = CAMERAS[CAMERAS.index("        return {") :]


def test_a_missing_package_is_one_line_that_says_how_to_get_it(
    stand_in: Callable[..., MotioncaptureSource],
) -> None:
    with pytest.raises(
        MocapError, match=r"No module named 'motioncapture': pip install 'floaty-hil\[mocap\]'"
    ):
        stand_in("raise ImportError(\"No module named 'motioncapture'\")").open()


def test_of_several_bodies_one_must_be_named(stand_in: Callable[..., MotioncaptureSource]) -> None:
    two = "        return {'one': self.body(0.0), 'two': self.body(1.0)} if number > 9 else {'one': self.body(0.0)}\n"
    with pytest.raises(MocapError, match="body=NAME is missing; there are: one, two"):
        stand_in(CAMERAS.replace(GOOD_BODIES, two)).open()


def test_what_is_no_pose_is_never_one(stand_in: Callable[..., MotioncaptureSource]) -> None:
    """Twenty frames each: good, lost, the same over and over, not a number, not a rotation, good."""
    cases = """
        return [{"one": self.body(float(number))}, {"two": self.body(1.0)}, {"one": self.body(5.0)},
                {"one": self.body(float("nan"))}, {"one": self.body(float(number), 2.0)}][number // 20 % 5]
"""
    with opened(stand_in(CAMERAS.replace(GOOD_BODIES, cases), "one")) as source:  # takes the first one
        frames = received(source, 118)
    valid = [number for number, frame in enumerate(frames, 2) if frame.valid]
    assert valid == [*range(2, 20), 40, *range(100, 120)]


def test_garbage_on_the_pipe_is_counted(stand_in: Callable[..., MotioncaptureSource]) -> None:
    """The standard output was moved away: the module finds the pipe by trying."""
    garbage = """
    def waitForNextFrame(self):
        time.sleep(0.005)
        self.number += 1
        if self.number < 20:
            os.write(3, os.urandom(20_000) + b"[1, {}]\\n[[[\\n" + b"x" * 70_000 + b"\\n")
"""
    with opened(stand_in(CAMERAS + garbage, "one")) as source:
        assert all(frame.valid for frame in received(source, 30))
        malformed = int(source.summary().split()[-2])
    assert malformed > 40


@needs("motioncapture")
def test_a_process_that_nobody_looks_after_ends_by_itself() -> None:
    """Vicon's connect() goes on for ever, and lets no signal handler of Python's run."""
    command = [
        sys.executable,
        "-m",
        "ground_station.sources.motioncapture_process",
        "vicon",
        "hostname=127.0.0.1",
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        assert process.wait(10.0) == -signal.SIGALRM
    finally:
        process.kill()


# Records and replays


FRAMES_SEEN = [
    MocapFrame(1_000_000 + 5000 * number, (0.1 * number, -1 / 3, 1e-17), (0.5, -0.5, 0.1 + 0.2, 1e-300), number % 3 != 0)
    for number in range(1, 41)
]  # fmt: skip


class Played:
    """A source that has these frames, at once."""

    def __init__(self, frames: list[MocapFrame]) -> None:
        self._frames = frames[::-1]

    def open(self) -> None: ...

    def receive(self, timeout_s: float) -> MocapFrame | None:
        return self._frames.pop() if self._frames else None

    def notices(self) -> list[str]:
        return ["played"]

    def summary(self) -> str:
        return "played"

    def close(self) -> None: ...


def record(path: Path, frames: list[MocapFrame]) -> RecordingSource:
    recording = RecordingSource(Played(frames), path)
    assert [recording.receive(0.0) for _ in frames] == frames
    return recording


def test_a_record_is_what_was_delivered_bit_by_bit(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    begin_us = clock_us()
    record(path, FRAMES_SEEN).close()
    read = read_frames(path)
    assert [frame for _, frame in read] == FRAMES_SEEN
    assert all(begin_us <= arrival_us <= clock_us() for arrival_us, _ in read)


def test_a_record_that_was_cut_short_ends_with_its_last_whole_frame(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    record(path, FRAMES_SEEN).close()
    path.write_bytes(path.read_bytes()[:-3])
    assert [frame for _, frame in read_frames(path)] == FRAMES_SEEN[:-1]


def test_a_full_disk_ends_the_record_but_not_the_flight() -> None:
    recording = RecordingSource(Played(FRAMES_SEEN), Path("/dev/full"))
    assert [recording.receive(0.0) for _ in FRAMES_SEEN] == FRAMES_SEEN
    recording.close()
    told = "/dev/full: No space left on device; frames are not recorded any more"
    assert recording.notices() == ["played", told]


def test_a_replay_keeps_the_pace_and_the_age_and_ends(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    rows = [f"{100_000 + 20_000 * n},{93_000 + 20_000 * n},1,2,3,1,0,0,0,1\n" for n in range(10)]
    record(path, []).close()
    path.write_text(path.read_text() + "".join(rows))
    source = ReplaySource(path)
    source.open()
    assert source.receive(0.0) is None  # not begun
    time.sleep(0.05)
    arrivals = []
    while not source.over:
        if (frame := source.receive(0.007)) is not None:
            arrivals.append((clock_us(), frame.t_us))
    assert len(arrivals) == 10
    assert all(now_us - t_us >= 7000 for now_us, t_us in arrivals)
    assert all(b[1] - a[1] == 20_000 for a, b in pairwise(arrivals))
    assert source.receive(0.0) is None
    assert source.notices()[-1] == "the recording is over: 10 frames"


def test_telemetry_is_replayed_each_frame_once(tmp_path: Path) -> None:
    """Rows before the first frame, and rows between which no frame came."""
    angles = (0.1, -0.2, 0.3)
    rows = [("0.02", *["nan"] * 7)]
    rows += [
        (f"{0.02 * n:.6f}", f"{0.01 + 0.04 * (n // 2):.6f}", "1", "2", "3", *map(str, angles))
        for n in (2, 3, 4)
    ]
    (tmp_path / "telemetry.csv").write_text(
        "\n".join(",".join(row) for row in (TELEMETRY_COLUMNS, *rows)) + "\n"
    )
    read = read_frames(tmp_path / "telemetry.csv")
    assert [(arrival_us, frame.t_us) for arrival_us, frame in read] == [(40_000, 50_000), (80_000, 90_000)]
    assert Rotation.from_quat(read[0][1].q_WB, scalar_first=True).as_euler("ZYX")[::-1] == pytest.approx(
        angles
    )
    source = ReplaySource(tmp_path)
    source.open()
    assert source.notices() == [f"mocap {tmp_path}, 2 frames in 0.0 s"]


GOOD = "1,2,3,4,5,1,0,0,0,1\n"


@pytest.mark.parametrize(("rows", "message"), [
    ("", "no frames"),
    ("1,2\n", "line 2: "),
    ("1,2,3,4,five,1,0,0,0,1\n", "line 2: could not convert string to float: 'five'"),
    (GOOD + "1,inf,3,4,5,1,0,0,0,1\n", "line 3: inf us is no time"),
    ("1e300,2,3,4,5,1,0,0,0,1\n", "line 2: 1e300 us is no time"),
    (GOOD + GOOD.replace("1", "0", 1), "frames go back in time, from 1 to 0 us"),
])  # fmt: skip
def test_a_bad_record_is_one_line(tmp_path: Path, rows: str, message: str) -> None:
    path = tmp_path / "frames.csv"
    record(path, []).close()
    path.write_text(path.read_text() + rows)
    with pytest.raises(MocapError) as caught:
        read_frames(path)
    assert str(caught.value).startswith(f"{path}: {message}")


@given(rows=st.binary(max_size=200), header=st.sampled_from([b"", b"arrival [us],mocap.t [us]\n", None]))
@settings(max_examples=200)
def test_no_file_does_harm(
    tmp_path_factory: pytest.TempPathFactory, rows: bytes, header: bytes | None
) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "frames.csv"
    record(path, []).close()
    path.write_bytes((path.read_bytes() if header is None else header) + rows)
    with contextlib.suppress(MocapError):
        read_frames(path)


# The station


class SlowLink:
    """A board that takes its time to connect, which is when `open` asks whether to give up."""

    uri = "slow"
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
