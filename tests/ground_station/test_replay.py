"""Frames of motion capture on disk: recorded without loss, played at their pace, and files that are none."""

import contextlib
import tempfile
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ground_station.clock import clock_us
from ground_station.errors import MocapError
from ground_station.mocap import MocapFrame
from ground_station.sources.replay import (
    TELEMETRY_COLUMNS,
    MocapLog,
    RecordingSource,
    ReplaySource,
    read_frames,
)

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


def record(path: Path, frames: list[MocapFrame]) -> MocapLog:
    log = MocapLog(path)
    recording = RecordingSource(Played(frames), log.write)
    assert [recording.receive(0.0) for _ in frames] == frames
    return log


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


def test_the_record_on_disk_is_at_most_a_second_old(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "frames.csv"
    log = MocapLog(path)
    recording = RecordingSource(Played(FRAMES_SEEN), log.write)
    for number in range(len(FRAMES_SEEN)):  # few bytes: no buffer is ever full
        monkeypatch.setattr("ground_station.sources.replay.clock_us", lambda now_us=number * 500_000: now_us)
        recording.receive(0.0)
        # not closed, as after a crash
        written_us = [arrival_us for arrival_us, _ in read_frames(path)]
        assert written_us[-1] >= number * 500_000 - 1_000_000
    log.close()


@given(st.floats(0.001, 0.1))
def test_a_replay_hands_on_each_frame_when_it_is_due_by_its_own_clock(timeout_s: float) -> None:
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        now_us = [7_000_000]

        def wait(duration_s: float) -> None:
            now_us[0] += max(1, round(duration_s * 1e6))

        patch.setattr("ground_station.sources.replay.clock_us", lambda: now_us[0])
        patch.setattr("ground_station.sources.replay.wait", wait)
        path = Path(folder) / "frames.csv"
        record(path, []).close()
        rows = [
            f"{100_000 + 20_000 * n},{93_000 + 20_000 * n},1,2,3,1,0,0,0,{n % 3 % 2}\n" for n in range(10)
        ]
        path.write_text(path.read_text() + "".join(rows))
        source = ReplaySource(path)
        for _ in range(2):
            source.open()
            assert source.receive(0.0) is None  # the caller only polls
            now_us[0] += 3_000_000
            assert source.summary() == "mocap 0 of 10 replayed"
            arrivals, valid, begun_us = [], [], now_us[0]
            while not source.over:
                if (frame := source.receive(timeout_s)) is not None:
                    arrivals.append((now_us[0] - begun_us, frame.t_us - begun_us))
                    valid.append(frame.valid)
            assert source.receive(timeout_s) is None
            assert source.notices()[-1] == "the recording is over: 10 frames"
            assert source.summary() == "mocap 10 of 10 replayed"
            assert [t_us for _, t_us in arrivals] == [20_000 * n - 7_000 for n in range(10)]
            assert valid == [n % 3 == 1 for n in range(10)]
            due = [20_000 * n for n in range(10)]
            assert [arrival_us for arrival_us, _ in arrivals] == pytest.approx(due, abs=20)


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
    (GOOD + "1,inf,3,4,5,1,0,0,0,1\n", "line 3: inf us is not a time"),
    ("1e300,2,3,4,5,1,0,0,0,1\n", "line 2: 1e300 us is not a time"),
    (GOOD + GOOD.replace("1", "0", 1), "frames go back in time, from 1 to 0 us"),
])  # fmt: skip
def test_a_bad_record_is_one_line(tmp_path: Path, rows: str, message: str) -> None:
    path = tmp_path / "frames.csv"
    record(path, []).close()
    path.write_text(path.read_text() + rows)
    with pytest.raises(MocapError) as caught:
        read_frames(path)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_frames_may_arrive_at_one_instant_and_at_any_that_a_float_counts(tmp_path: Path) -> None:
    path = tmp_path / "frames.csv"
    record(path, []).close()
    path.write_text(path.read_text() + GOOD + GOOD + GOOD.replace("1", str(2**53), 1))
    assert [arrival_us for arrival_us, _ in read_frames(path)] == [1, 1, 2**53]


@pytest.mark.long
@given(rows=st.binary(max_size=200), header=st.sampled_from([b"", b"arrival [us],mocap.t [us]\n", None]))
@settings(max_examples=200)
def test_any_file_loads(tmp_path_factory: pytest.TempPathFactory, rows: bytes, header: bytes | None) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "frames.csv"
    record(path, []).close()
    path.write_bytes((path.read_bytes() if header is None else header) + rows)
    with contextlib.suppress(MocapError):
        read_frames(path)
