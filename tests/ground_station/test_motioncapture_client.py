"""Vicon, Qualisys and VRPN by the lines of their process: what becomes of a frame, when it starts again."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import IO

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_py.extras import install_command
from ground_station.config import CaptureConfig
from ground_station.errors import MocapError
from ground_station.mocap import MocapFrame
from ground_station.sources import motioncapture_client
from ground_station.sources.motioncapture_client import MotioncaptureSource, settings_of
from ground_station.sources.motioncapture_process import Arrival, decode_line, encode_arrival, encode_error
from ground_station.unused import Reason
from support.paths import ROOT

names = st.text(max_size=10)
body = st.tuples(*[st.floats()] * 7)
POSE = (1.0, 2.0, 3.0, 0.5, -0.5, 0.5, 0.5)
LATENCY_US = 7_000


@pytest.mark.long
@given(st.integers(0, 2**63 - 1), st.dictionaries(names, body, max_size=3))
@settings(max_examples=50)
def test_a_line_reports_a_pose(t_us: int, bodies: dict[str, tuple[float, ...]]) -> None:
    line = encode_arrival(Arrival(t_us, bodies))
    assert line.count("\n") == 1
    decoded = decode_line(line.encode())
    assert isinstance(decoded, Arrival)
    assert repr(decoded) == repr(Arrival(t_us, bodies))  # NaN is as NaN here


def test_a_line_reports_the_end() -> None:
    assert encode_error("no\nway").count("\n") == 1
    assert decode_line(encode_error("no\nway").encode()) == "no\nway"


json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=8) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=12,
)


@pytest.mark.long
@given(st.binary(max_size=60) | json.map(lambda value: repr(value).replace("'", '"').encode()))
def test_no_bytes_of_the_other_process_do_harm(line: bytes) -> None:
    with suppress(MocapError):
        decode_line(line)


@pytest.mark.parametrize("line", [
    b"[" * 100_000, b"[" + b"9" * 5000 + b", {}]", b'[1, {"a": [1e999]}]', b"[true]", b"[-1, {}]", b"[%d, {}]" % 2**63,
    b'[1, {"a": [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1]}]', b'[1, {"a": [0.0, 0.0, 0.0, 1.0, 0.0, 0.0]}]', b"[1, {}, 1]",
])  # fmt: skip
def test_extreme_lines_are_refused(line: bytes) -> None:
    with pytest.raises(MocapError, match="not a line"):
        decode_line(line)


class Process:
    """The process of the package: a pipe, whose end `kill` and `wait` note."""

    def __init__(self) -> None:
        reading, writing = os.pipe()
        self.stdout: IO[bytes] = os.fdopen(reading, "rb", buffering=0)
        self.pipe = os.fdopen(writing, "wb", buffering=0)
        self.ended: list[str] = []

    def kill(self) -> None:
        self.ended.append("kill")

    def wait(self) -> None:
        self.ended.append("wait")


class System:
    """A capture system on a simulated clock: each time the source waits, `sent` has the next bytes, or nothing comes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_us = 50_000_000
        self.sent: Iterator[bytes | None] = iter(())
        self.processes: list[Process] = []
        self.started: list[tuple[list[str], dict[str, object]]] = []
        monkeypatch.setattr(motioncapture_client, "clock_us", lambda: self.now_us)
        monkeypatch.setattr(motioncapture_client, "readable", self.readable)
        monkeypatch.setattr(subprocess, "Popen", self.start)

    def start(self, command: list[str], **options: object) -> Process:
        self.started.append((command, options))
        self.processes.append(Process())
        return self.processes[-1]

    def readable(self, pipes: list[IO[bytes]], timeout_s: float) -> list[IO[bytes]]:
        data = next(self.sent, None) if pipes else None
        if data is None:
            self.now_us += max(1000, round(1e6 * timeout_s))
            return []
        if data:
            self.processes[-1].pipe.write(data)
        else:
            self.processes[-1].pipe.close()
        self.now_us += 1000
        return pipes

    def line(self, age_us: int = 0, **bodies: tuple[float, ...]) -> bytes:
        return encode_arrival(Arrival(self.now_us + 1000 - age_us, bodies)).encode()

    def frame(
        self, source: MotioncaptureSource, age_us: int = 0, **bodies: tuple[float, ...]
    ) -> MocapFrame | None:
        self.sent = iter((self.line(age_us, **bodies),))
        return source.receive(0.1)


@pytest.fixture
def system(monkeypatch: pytest.MonkeyPatch) -> Iterator[System]:
    system = System(monkeypatch)
    yield system
    for process in system.processes:
        process.pipe.close()
        process.stdout.close()


def source_of(name: str = "qualisys", body: str = "floaty", axes: str = "z-up") -> MotioncaptureSource:
    capture = CaptureConfig(system=name, host="cave", body=body, axes=axes, latency_us=LATENCY_US)  # type: ignore[arg-type]
    return MotioncaptureSource(name, settings_of(capture), capture)


def opened(system: System, name: str = "qualisys") -> MotioncaptureSource:
    source = source_of(name)
    system.sent = iter((system.line(floaty=POSE),))
    source.open()
    source.notices()
    return source


def test_the_process_gets_the_system_and_its_address_in_a_session_of_its_own(system: System) -> None:
    source = source_of("vicon")
    system.sent = iter((system.line(floaty=POSE),))
    source.open()
    assert source.notices() == ["mocap vicon at cave, body floaty, z-up, age assumed: 7.0 ms"]
    command, options = system.started[0]
    assert command == [
        sys.executable,
        "-m",
        "ground_station.sources.motioncapture_process",
        "vicon",
        "hostname=cave",
    ]
    assert (options["stdin"], options["start_new_session"]) == (subprocess.DEVNULL, True)
    assert settings_of(CaptureConfig(system="vrpn", host="a", port=4)) == {"hostname": "a:4"}
    for _ in range(2):
        source.close()
        assert system.processes[0].ended == ["kill", "wait"]
        assert system.processes[0].stdout.closed


def test_of_several_bodies_the_wanted_one_is_taken_at_once_and_a_single_one_after_a_second(
    system: System,
) -> None:
    def find(body: str, *seen: dict[str, tuple[float, ...]] | None) -> tuple[str, float]:
        source, begin_us = source_of(body=body), system.now_us
        system.sent = iter([None if bodies is None else system.line(**bodies) for bodies in seen])
        try:
            source.open()
            (line,) = source.notices()
        except MocapError as error:
            line = str(error)
            assert system.processes[-1].ended == ["kill", "wait"]
        else:
            source.close()
        return line, (system.now_us - begin_us) * 1e-6

    one, two = {"one": POSE}, {"two": POSE}
    line, took_s = find("two", one, {}, two, one)
    assert ("body two" in line, took_s) == (True, pytest.approx(0.003))
    line, took_s = find("", one, {}, None, None, None, one)
    assert ("body one" in line, took_s) == (True, pytest.approx(1.0, abs=0.11))
    assert find("", one, two)[0] == "cave: body=NAME is missing; there are: one, two"
    assert find("six", one, two)[0] == "cave: no body 'six'; there are: one, two"
    line, took_s = find("two")
    assert (line, took_s) == ("cave: no frames of a qualisys server", pytest.approx(5.5, abs=0.01))


def test_what_the_process_says_or_its_end_ends_the_search(system: System) -> None:
    for data, line in (
        (encode_error("no such computer").encode(), "cave: no such computer"),
        (b"", "cave: no frames of a qualisys server"),
    ):
        system.sent, begin_us = iter((data,)), system.now_us
        with pytest.raises(MocapError) as caught:
            source_of().open()
        assert (str(caught.value), system.now_us - begin_us) == (line, 1000)


def test_a_pose_is_as_old_as_assumed_and_in_the_axes_of_the_world(system: System) -> None:
    source = opened(system)
    frame = system.frame(source, 2000, other=POSE, floaty=POSE)
    assert frame is not None
    assert (frame.p_WB, frame.q_WB, frame.valid) == (POSE[:3], POSE[3:], True)
    assert (frame.t_us, frame.arrived_us) == (system.now_us - 2000 - LATENCY_US, system.now_us - 2000)
    assert source.summary() == "mocap 9.0 ms old (assumed), 0 lost, 0 malformed"
    ahead = system.frame(source, -5000, floaty=(2.0, *POSE[1:]))  # its clock is ours: it cannot be
    assert ahead is not None
    assert ahead.arrived_us == system.now_us
    turned = source_of(axes="y-up")
    system.sent = iter((system.line(floaty=POSE),))
    turned.open()
    frame = system.frame(turned, floaty=POSE)
    assert frame is not None
    assert frame.p_WB == pytest.approx((1.0, -3.0, 2.0))


def test_a_frame_without_a_new_pose_in_time_has_its_reason(system: System) -> None:
    source = opened(system)
    other = (0.0, *POSE[1:])

    def unused(age_us: int = 0, **bodies: tuple[float, ...]) -> object:
        frame = system.frame(source, age_us, **bodies)
        assert frame is not None
        return None if frame.valid else frame.unused[0]

    assert [unused(floaty=pose) for pose in (POSE, POSE, other, POSE)] == [None, Reason.FROZEN, None, None]
    assert unused(wand=POSE) is Reason.ABSENT
    assert [unused(age_us, floaty=other) for age_us in (1_000_001, 1_000_000)] == [Reason.MISTIMED, None]
    assert source.summary().endswith("3 lost, 0 malformed")


def test_vrpn_reports_each_body_by_itself(system: System) -> None:
    source = opened(system, "vrpn")
    system.sent = iter([system.line(wand=POSE), system.line(floaty=POSE)])
    frame = source.receive(0.1)
    assert frame is not None
    assert frame.valid
    assert system.frame(source, wand=POSE) is None
    assert source.summary().endswith("0 lost, 0 malformed")


def test_lines_may_arrive_in_pieces_and_garbage_is_counted(system: System) -> None:
    source = opened(system)
    lines = [system.line(floaty=(float(number), *POSE[1:])) for number in range(3)]
    system.sent = iter(
        [lines[0][:20], lines[0][20:] + lines[1] + lines[2][:5], lines[2][5:], b"[[[\n", b"x" * 65_000]
    )
    frames = [source.receive(0.1) for _ in range(3)]
    assert [frame.p_WB[0] for frame in frames if frame is not None] == [0.0, 1.0, 2.0]
    assert source.receive(0.3) is None
    assert source.summary().endswith("1 malformed")
    system.sent = iter([b"x" * 600, b"\n", system.line(floaty=POSE)])  # an endless line is dropped
    frame = source.receive(0.1)
    assert frame is not None
    assert source.summary().endswith("3 malformed")


def test_a_process_that_ended_is_started_again_after_two_seconds_and_again(system: System) -> None:
    source = opened(system)
    for count in (2, 3):
        system.sent, ended_us = iter((b'[7, {"floaty"', b"")), system.now_us + 2000
        assert source.receive(1.0) is None
        assert system.processes[-1].ended == ["kill", "wait"]
        while len(system.processes) < count:
            assert source.receive(0.02) is None
        assert system.now_us - ended_us == pytest.approx(2_000_000, abs=41_000)
        frame = system.frame(source, floaty=(float(count), *POSE[1:]))
        assert frame is not None
        calls, again = source.notices()
        assert calls == "motion capture: no frames; calling the server again"
        assert again.startswith("motion capture: frames arrive again after ")
    assert source.summary().endswith("0 malformed")


STAND_IN = """
import math, os, signal
from types import SimpleNamespace as Thing
import numpy as np

class connect:
    number = 0
    def __init__(self, system, settings):
        assert settings == {"hostname": "127.0.0.1:3883"}
        self.left_s = [math.ceil(signal.getitimer(signal.ITIMER_REAL)[0])]
        print("chatter")
        os.write(2, b"more chatter")
    def waitForNextFrame(self):
        self.left_s.append(math.ceil(signal.alarm(3)))
        self.number += 1
        if self.number > 3:
            raise RuntimeError("gone\\nfor good")
    @property
    def rigidBodies(self):
        place = np.array([self.number, *self.left_s[-2:]], float)
        return {} if self.number == 2 else {"one": Thing(position=place, rotation=Thing(w=1.0, x=2.0, y=3.0, z=4.0))}
"""


@pytest.fixture
def lines(tmp_path: Path) -> Callable[..., list[Arrival | str]]:
    """What the process says with a module of this text in place of the package."""

    def run(text: str, system: str) -> list[Arrival | str]:
        (tmp_path / "motioncapture.py").write_text(text)
        ran = subprocess.run(
            [sys.executable, "-m", "ground_station.sources.motioncapture_process", system, "hostname=localhost:3883"],
            env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}, capture_output=True, check=True,
        )  # fmt: skip
        assert ran.stderr == b""
        return [decode_line(line) for line in ran.stdout.splitlines()]

    return run


@pytest.mark.long
@pytest.mark.parametrize("system", ["vicon", "vrpn"])
def test_the_process_sends_frames_and_why_it_ends_and_lives_five_seconds_without(
    lines: Callable[..., list[Arrival | str]], system: str
) -> None:
    *frames, end = lines(STAND_IN, system)
    assert end == "gone"
    rotation = (1.0, 2.0, 3.0, 4.0)
    expected = [{"one": (1.0, 5.0, 5.0, *rotation)}, {}, {"one": (3.0, 5.0, 5.0, *rotation)}]
    if system == "vrpn":  # has no frames: a poll without a result is none, and does not prolong its life
        expected = [expected[0], {"one": (3.0, 5.0, 3.0, *rotation)}]
    assert [frame.bodies for frame in frames if isinstance(frame, Arrival)] == expected


@pytest.mark.long
def test_why_the_process_cannot_begin_is_one_line(lines: Callable[..., list[Arrival | str]]) -> None:
    text = "raise ImportError(\"No module named 'motioncapture'\")"
    assert lines(text, "vicon") == [f"No module named 'motioncapture': {install_command('mocap')}"]
    text = "def connect(system, settings): raise OSError(113, 'No route to host')"
    assert lines(text, "vicon") == ["No route to host"]
