"""A real flight outlives a full disk, a standard output that fails and a lost terminal, on every link."""

import os
import pty
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pytest

from ground_station.records import INCOMPLETE
from hil.laboratory.files.recorder import load_events
from support.full_disk import SMALL_KB, small_disk
from support.serving import FLOATY, PATIENCE_S, Served, serve, station

ENDS: dict[str, tuple[str, ...]] = {
    "radio": ("--radio", "--radio-port", "0"),
    "udp": ("--udp", "0"),
    "mavlink pty": ("--mavlink", "pty"),
    "mavlink tcp": ("--mavlink", "tcp:0"),
}
AFTERWARDS_S = 2.0  # that the flight outlives the disk
PAGE = 4096  # bytes, with which a file grows
LEFT = "the board is in failsafe, flaps at hover"


@pytest.fixture(scope="module", params=ENDS)
def lab(request: pytest.FixtureRequest) -> Iterator[Served]:
    """A served board with one kind of link."""
    with serve(*ENDS[request.param], motive=True) as served:
        yield served


def uri_of(lab: Served) -> str:
    if any(line.startswith("mavlink ") for line in lab.lines):
        return "mavlink:" + lab.line("mavlink ")[0].replace("tcp:", "socket://")
    return next(line.split()[1] for line in lab.lines if line.startswith(("radio ", "udp ")))


@contextmanager
def flying(
    lab: Served, disk: Path, *options: str | Path, output: int = subprocess.PIPE
) -> Iterator["subprocess.Popen[bytes]"]:
    """A flight whose files are on `disk`, from when it flies and the disk is full."""
    uri = uri_of(lab)
    files = ["--record", disk / "frames.csv"] + (["--tlog", disk / "tlog"] if "mavlink" in uri else [])
    command = [*FLOATY, "station", "--link", uri, "--mocap", lab.motive, *files, *options]
    lab.forget()
    with small_disk(disk) as limited:
        process = subprocess.Popen(
            [*limited, *map(str, command)], env=lab.environment, stdout=output, stderr=subprocess.PIPE
        )
        try:
            lab.wait_for("supervisor: flying", PATIENCE_S)
            deadline = time.monotonic() + PATIENCE_S
            while not is_full(disk):
                assert time.monotonic() < deadline
                assert process.poll() is None
                time.sleep(0.1)
            time.sleep(AFTERWARDS_S)
            yield process
        finally:
            process.kill()
            print(*process.communicate())  # shown where a test fails


def is_full(disk: Path) -> bool:
    """Whether no more fits on it, or into the largest file."""
    space = os.statvfs(disk)
    largest = max(path.stat().st_size for path in disk.iterdir())
    return min(space.f_bavail * space.f_frsize, 1024 * SMALL_KB - largest) < PAGE


@pytest.mark.long
def test_a_full_disk_ends_the_files_and_not_the_flight(lab: Served, tmp_path: Path) -> None:
    disk = tmp_path / "small"
    with flying(lab, disk, "--log", disk / "log.csv") as flown:
        assert flown.poll() is None
        flown.send_signal(signal.SIGINT)
        shown, errors = (data.decode() for data in flown.communicate(timeout=PATIENCE_S))
    assert (flown.returncode, errors) == (INCOMPLETE, "")
    assert LEFT in shown
    ended = [line.split(": ")[0] for line in shown.splitlines() if "no more is written" in line]
    assert f"{disk / 'frames.csv'}" in ended
    assert len(ended) == len(set(ended))


def broken_output(lab: Served) -> tuple[int, str]:
    """Return a standard output that fails, and why: a full disk, or a program that reads no more."""
    if any(line.startswith("radio ") or "tcp:" in line for line in lab.lines):
        return os.open("/dev/full", os.O_WRONLY), "No space left on device"
    read, write = os.pipe()
    os.close(read)
    return write, "Broken pipe"


@pytest.mark.long
def test_with_a_full_disk_and_no_standard_output_a_flight_is_flown_to_its_end(
    lab: Served, tmp_path: Path
) -> None:
    disk = tmp_path / "small"
    output, why = broken_output(lab)
    with flying(lab, disk, "--out", disk / "run", output=output) as flown:
        os.close(output)
        flown.send_signal(signal.SIGINT)
        _, errors = flown.communicate(timeout=PATIENCE_S)
        assert (disk / "run" / "events.jsonl").is_file()
    assert errors.decode() == f"standard output: {why}; no more is written to it\n"
    assert flown.returncode == INCOMPLETE
    lab.wait_for("supervisor: failsafe", PATIENCE_S)


@pytest.mark.parametrize("numbers", [(signal.SIGTERM,), (signal.SIGHUP, signal.SIGHUP)])
def test_a_signal_ends_a_real_flight_in_order(numbers: Sequence[signal.Signals], tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    with serve("--udp", "0", motive=True) as lab, station(lab, uri_of(lab), "--log", log) as flown:
        flown.wait_for("supervisor: flying", PATIENCE_S)
        for number in numbers:
            flown.process.send_signal(number)
        flown.wait_for(LEFT, PATIENCE_S)
        assert flown.process.wait(PATIENCE_S) == 0
    assert log.read_text().endswith("\n")


def test_a_terminal_that_is_closed_ends_a_real_flight_in_order(tmp_path: Path) -> None:
    """The window of a terminal is closed: its programs get SIGHUP, and can neither read nor write any more."""
    folder = tmp_path / "run"
    with serve("--udp", "0", motive=True) as lab:
        child, terminal = pty.fork()
        if child == 0:
            os.execve(
                FLOATY[0],
                [*FLOATY, "station", "--link", uri_of(lab), "--mocap", lab.motive, "--out", str(folder)],
                {**lab.environment, "TERM": "xterm"},
            )
        lab.wait_for("supervisor: flying", PATIENCE_S)
        deadline = time.monotonic() + PATIENCE_S
        while b"flying" not in os.read(terminal, 65536):
            assert time.monotonic() < deadline
        os.close(terminal)
        lab.wait_for("supervisor: failsafe", PATIENCE_S)
        while (ended := os.waitpid(child, os.WNOHANG)) == (0, 0):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    assert os.waitstatus_to_exitcode(ended[1]) in (130, INCOMPLETE)
    texts = [event["text"] for event in load_events(folder)]
    assert LEFT in texts
    assert texts[-1] == "interrupted by the user"
    assert (folder / "result.json").is_file()
