"""Laws of every `ground_station.mocap.MocapSource` that sees a body move about, of which no two poses are alike.

What connects to a Motive through the package `motioncapture` does so in real time, all else on a simulated clock.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from ground_station.clock import clock_us
from ground_station.config import CaptureConfig
from ground_station.mocap import MocapFrame, MocapSource
from ground_station.sources.motioncapture_client import MotioncaptureSource
from ground_station.sources.optitrack import OptitrackSource
from ground_station.sources.replay import COLUMNS, MocapLog, RecordingSource, ReplaySource
from support.motive_bench import MotiveBench, StationClock, moving, needs, seen

FRAMES = 20
PATIENCE_S = 20.0
PERIOD_US, AGE_US = 5_000, 20_000
PLACES = np.array([seen(number).p_WB for number in range(1, 4000)])  # some 20 s of a Motive


@contextmanager
def replay(folder: Path) -> Iterator[MocapSource]:
    path = folder / "seen.csv"
    rows = [",".join(COLUMNS)]
    for number in range(1, 2 * FRAMES + 1):
        frame, t_us = seen(number), PERIOD_US * number
        rows.append(",".join(map(repr, (t_us + AGE_US, t_us, *frame.p_WB, *frame.q_WB, 1))))
    path.write_text("\n".join(rows) + "\n")
    yield ReplaySource(path)


@contextmanager
def recorded(folder: Path) -> Iterator[MocapSource]:
    """What is recorded while it is replayed; such a source is open when it is made."""
    with replay(folder) as source:
        source.open()
        source.notices()
        log = MocapLog(folder / "again.csv")
        yield RecordingSource(source, log.write)
        log.close()


@contextmanager
def optitrack(folder: Path) -> Iterator[MocapSource]:
    with pytest.MonkeyPatch.context() as monkeypatch:
        lab = MotiveBench()
        StationClock(monkeypatch).turns = lab.turn
        yield OptitrackSource(CaptureConfig(host="127.0.0.1", port=lab.motive.port, body="floaty"))
        lab.motive.close()


@contextmanager
def motioncapture(folder: Path) -> Iterator[MocapSource]:
    with moving() as lab:
        where = {"hostname": "localhost", "interface_ip": "127.0.0.1", "port_command": str(lab.motive.port)}
        yield MotioncaptureSource("optitrack", where, CaptureConfig(system="vicon", axes="y-up"))


@pytest.fixture(
    params=[
        replay,
        recorded,
        optitrack,
        pytest.param(motioncapture, marks=[pytest.mark.realtime, needs("motioncapture")]),
    ]
)
def source(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[MocapSource]:
    """A source that is not connected, and closed in the end."""
    with request.param(tmp_path) as source:
        yield source
        source.close()


def received(source: MocapSource) -> list[MocapFrame]:
    frames = [source.receive(PATIENCE_S) for _ in range(FRAMES)]
    assert None not in frames, f"no frame within {PATIENCE_S} s"
    return [frame for frame in frames if frame is not None]


def numbers(frames: list[MocapFrame]) -> list[int]:
    """Which of the poses of the body the frames have; poses travel as float32."""
    found = []
    for frame in frames:
        distances = np.abs(PLACES - frame.p_WB).max(axis=1)
        assert distances.min() < 1e-6
        found.append(int(distances.argmin()))
    return found


def test_frames_come_once_in_order_and_after_their_exposure(source: MocapSource) -> None:
    source.open()
    frames = received(source)
    now_us = clock_us()
    assert all(frame.valid for frame in frames)
    order = numbers(frames)
    assert order == sorted(set(order))
    assert all(frame.t_us < now_us for frame in frames)


def test_opening_is_reported_once_in_single_lines(source: MocapSource) -> None:
    source.open()
    notices = source.notices()
    assert len(notices) == 1
    assert notices[0].startswith("mocap ")
    assert source.notices() == []
    assert "\n" not in notices[0] + source.summary()


def test_closing_twice_or_before_opening_is_harmless(source: MocapSource) -> None:
    source.close()
    source.open()
    received(source)
    source.close()
    source.close()


def test_a_source_that_is_opened_again_delivers_again(source: MocapSource) -> None:
    for _ in range(3):
        source.open()
        assert len(received(source)) == FRAMES
        source.close()


@pytest.mark.realtime
def test_without_a_timeout_nothing_waits(source: MocapSource) -> None:
    """Who has no time gets at once what lies there, which is nothing or a frame."""
    source.open()
    begin_us = clock_us()
    for _ in range(FRAMES):
        source.receive(0.0)
    assert clock_us() - begin_us < 1_000_000
