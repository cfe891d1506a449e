"""The outputs of a real flight: a write that fails ends its output and nothing else."""

import contextlib
import errno
import os
import sys
from pathlib import Path

import pytest

from firmware_py.wire.telemetry import BLOCKS, Sample
from ground_station.latency import LatencyBudget
from ground_station.links.frame_log import FrameLog
from ground_station.mocap import MocapFrame
from ground_station.records import STANDARD_OUTPUT, Records
from ground_station.sources.replay import MocapLog
from ground_station.telemetry_log import TelemetryLog
from ground_station.trajectory import Goal
from support.full_disk import small_files

HOME = Goal((0.0, 0.0, 1.15), 0.0)
FULL = "No space left on device; no more is written to it"


def write_all(records: Records, folder: Path, count: int) -> None:
    """Write to every kind of file, as a flight does, and close it."""
    frames = FrameLog(folder / "frames")
    telemetry = TelemetryLog(folder / "telemetry")
    poses = MocapLog(folder / "poses")
    note = records.guarded("frames", frames.note)
    sample = records.guarded("telemetry", telemetry.write)
    pose = records.guarded("poses", poses.write)
    for number in range(count):
        note(number * 10_000, bytes(40))
        values = (0.0,) * len(BLOCKS[0].variables)
        sample(number * 10_000, Sample(BLOCKS[0], number * 10, values), HOME, None, None, LatencyBudget())
        pose(MocapFrame(number, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), True))
    for name, log in (("frames", frames), ("telemetry", telemetry), ("poses", poses)):
        records.attempt(name, log.close)


@pytest.mark.parametrize("count", [3, 3000])  # a disk that refuses the last bytes, or that is full in flight
def test_a_full_disk_ends_each_file_with_one_line(tmp_path: Path, count: int) -> None:
    records = Records()
    with small_files(100):
        write_all(records, tmp_path, count)
    notices = records.notices()
    assert sorted(notices) == [
        f"{name}: File too large; no more is written to it" for name in ("frames", "poses", "telemetry")
    ]
    assert records.incomplete


def test_an_output_that_fails_ends_no_other(tmp_path: Path) -> None:
    records = Records()
    broken, kept = FrameLog(Path("/dev/full")), FrameLog(tmp_path / "kept")
    for number in range(5):
        records.write("broken", broken.note, number * 1_000_000, bytes(20))
        records.write("kept", kept.note, number * 1_000_000, bytes(20))
    records.attempt("broken", broken.close)
    records.attempt("kept", kept.close)
    assert records.notices() == [f"broken: {FULL}"]
    assert (records.failed("broken"), records.failed("kept")) == (True, False)
    assert (tmp_path / "kept").stat().st_size == 5 * 28


def test_frames_are_on_disk_before_they_are_much_more_than_two_seconds_old(tmp_path: Path) -> None:
    frames = FrameLog(tmp_path / "frames")
    for number in range(40):
        frames.note(number * 250_000, b"seen")
        written = (tmp_path / "frames").stat().st_size // 12
        assert number - 9 <= written <= number
    frames.close()


def test_frames_are_in_the_order_of_their_times_though_received_ones_are_noted_later(tmp_path: Path) -> None:
    frames = FrameLog(tmp_path / "frames", epoch_us=7)
    times = [number * 300_000 for number in range(20)]
    for t_us in times:  # sent, and received before the one that was sent last
        frames.note(t_us, b"sent")
        frames.note(max(0, t_us - 900_000), b"came")
    frames.close()
    frames.note(0, b"late")
    data = (tmp_path / "frames").read_bytes()
    found = [int.from_bytes(data[at : at + 8], "big") for at in range(0, len(data), 12)]
    assert found == sorted(7 + time for t_us in times for time in (t_us, max(0, t_us - 900_000)))


def test_all_is_complete_where_all_could_be_written(tmp_path: Path) -> None:
    records = Records()
    write_all(records, tmp_path, 100)
    assert not records.incomplete
    assert records.notices() == []


def closed_pipe() -> int:
    read, write = os.pipe()
    os.close(read)
    return write


@pytest.mark.parametrize(
    ("opened", "why"),
    [(lambda: os.open("/dev/full", os.O_WRONLY), "No space left on device"), (closed_pipe, "Broken pipe")],
)
def test_a_standard_output_that_fails_is_one_line_and_nothing_raises(
    opened: object, why: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert callable(opened)
    with os.fdopen(opened(), "w") as output:  # closing it would raise what is not written
        monkeypatch.setattr(sys, "stdout", output)
        records = Records()
        for number in range(3):
            records.print_text(f"line {number}")
        print("what others print", flush=True)
    line = f"{STANDARD_OUTPUT}: {why}; no more is written to it"
    assert records.notices() == [line]
    assert capsys.readouterr().err == f"{line}\n"


def test_nothing_is_written_behind_a_gap_but_an_output_is_still_closed() -> None:
    records, written = Records(), []

    def write(number: int) -> None:
        if number == 1:
            raise OSError(errno.ENOSPC, "full")
        written.append(number)

    for number in range(4):
        records.write("file", write, number)
    records.attempt("file", write, 9)
    assert (written, records.notices()) == (
        [0, 9],
        ["file: No space left on device; no more is written to it"],
    )


def test_a_standard_output_that_nobody_reads_stops_no_flight_and_its_lines_are_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    read, write = os.pipe()
    os.set_blocking(read, False)
    with os.fdopen(read, "rb", buffering=0) as reader, os.fdopen(write, "w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        records = Records()
        for count in (3, 2):
            os.set_blocking(write, False)
            with contextlib.suppress(BlockingIOError):
                while os.write(write, bytes(4096)):
                    pass
            os.set_blocking(write, True)
            for _ in range(count):
                records.print_text("unread")
            while reader.read(65536):
                pass
            records.print_text("read")
            missing = b"%d lines are missing here: nobody read the output\n" % count
            assert reader.read(1000) == missing + b"read\n"
    assert records.incomplete
    assert records.notices() == []


def test_a_program_without_a_standard_output_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)  # as Python starts with a closed one
    records = Records()
    records.print_text("connected")
    assert not records.incomplete


def test_frames_of_one_instant_stay_in_their_order(tmp_path: Path) -> None:
    frames = FrameLog(tmp_path / "frames")
    for t_us, frame in ((5, b"b"), (5, b"a"), (3, b"d"), (5, b"c")):
        frames.note(t_us, frame)
    frames.close()
    content = (tmp_path / "frames").read_bytes()
    assert [content[at : at + 9][8:] for at in range(0, len(content), 9)] == [b"d", b"b", b"a", b"c"]
