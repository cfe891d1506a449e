"""A real flight outlives a full disk, a standard output that fails and a lost terminal, on every link."""

import os
import pty
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from ground_station.records import INCOMPLETE
from hil.laboratory.recorder import load_events
from support.full_disk import small_disk
from support.serving import FLOATY, PATIENCE_S, Served, serve, station

ENDS: dict[str, tuple[str, ...]] = {
    "radio": ("--radio", "--radio-port", "0"),
    "udp": ("--udp", "0"),
    "mavlink pty": ("--mavlink", "pty"),
    "mavlink tcp": ("--mavlink", "tcp:0"),
}
DURATION_S = 6.0
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


def typed(lab: Served, disk: Path, *arguments: str | Path) -> list[str]:
    """A flight whose files are on `disk`: the command."""
    uri = uri_of(lab)
    files = ["--record", disk / "frames.csv"] + (["--tlog", disk / "tlog"] if "mavlink" in uri else [])
    options = ("--link", uri, "--mocap", lab.motive, "--duration", str(DURATION_S), *files, *arguments)
    return [*FLOATY, "station", *map(str, options)]


@pytest.mark.long
def test_a_full_disk_ends_the_files_and_not_the_flight(lab: Served, tmp_path: Path) -> None:
    with small_disk(tmp_path / "small") as limited:
        disk = tmp_path / "small"
        begin_s = time.monotonic()
        shown = subprocess.run(
            [*limited, *typed(lab, disk, "--log", disk / "log.csv")],
            env=lab.environment, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        assert time.monotonic() - begin_s > DURATION_S
    assert (shown.returncode, shown.stderr) == (INCOMPLETE, "")
    assert LEFT in shown.stdout
    ended = [line.split(": ")[0] for line in shown.stdout.splitlines() if "no more is written" in line]
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
    lab.forget()
    begin_s = time.monotonic()
    with small_disk(disk) as limited:
        flown = subprocess.run(
            [*limited, *typed(lab, disk, "--out", disk / "run")],
            env=lab.environment, stdout=output, stderr=subprocess.PIPE, text=True, timeout=PATIENCE_S, check=False,
        )  # fmt: skip
        os.close(output)
        assert time.monotonic() - begin_s > DURATION_S
        assert flown.returncode == INCOMPLETE, flown.stderr
        assert flown.stderr == f"standard output: {why}; no more is written to it\n"
        assert (disk / "run").is_dir()
    lab.wait_for("supervisor: flying", PATIENCE_S)
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
