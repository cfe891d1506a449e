"""A flight whose ground station is another process: how it is started, what it says, and when it is given up."""

import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from socket import socket
from typing import Any

import pytest

from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.request import Request
from hil.servers import linked
from hil.servers.dongle_plugin import VARIABLE
from hil.servers.linked import LISTEN_PERIOD_US, RELEASE_TIMEOUT_US, WARM_UP_US, linked_flight

with socket() as free:
    free.bind(("127.0.0.1", 0))
    UDP = f"udp://127.0.0.1:{free.getsockname()[1]}"
TYPED = b"second\n"
TALK = "import sys; print('first'); print(sys.stdin.read(), end='cut', flush=True); "


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def line_of(stack: ExitStack, folder: Path, link: str, program: str = "", **options: Any) -> Any:
    """Return the line of a linked flight, whose station is a program in Python."""
    request = Request.of(EXPERIMENTS["yaw-step"], link=link, **options)
    flight = stack.enter_context(closing(linked_flight(request, folder / "telemetry.csv", stack)))
    line: Any = flight.line
    line.lab, line.flight = flight.lab, flight
    line.started_by = line._command
    line._command = [sys.executable, "-c", program]
    line._typed.write(TYPED)
    line._typed.flush()
    return line


def heard(line: Any, now_us: int) -> list[tuple[str, str]]:
    texts: list[tuple[str, str]] = []
    while len(texts) < 2:
        line._next_listen_us = 0
        texts += line.new_messages(now_us)
    assert line.new_messages(now_us + LISTEN_PERIOD_US - 1) == []
    return texts


@pytest.mark.parametrize(
    "link", ["radio://0/80/2M/E7E7E7E7E7", UDP, "mavlink:pty"], ids=["radio", "udp", "mavlink"]
)
def test_the_station_gets_its_link_its_cameras_and_the_profile(
    stack: ExitStack, tmp_path: Path, link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "user")
    line = line_of(stack, tmp_path, link, overrides=("controller.gain_r=0.08",))
    words = line.started_by
    shown, serial, log = words[6], link.startswith("mavlink"), tmp_path / "telemetry.csv"
    mocap = f"optitrack:127.0.0.1:{line._motive.port},body=floaty,y-up"
    assert words == [
        sys.executable, "-m", "hil.commands", "station", "yaw-step", "--link", shown, "--mocap", mocap, "--start", "1.0",
        "--log", f"{log}", *(["--tlog", f"{tmp_path / 'link.tlog'}"] if serial else []), "--profile", "floaty",
        *(f"--set={one}" for one in EXPERIMENTS["yaw-step"].settings), "--set=controller.gain_r=0.08",
        "--set=capture.origin=[0,0,0]", "--set=capture.yaw=0",
        "--set=capture.body_offset=[0,0,0]", "--set=capture.body_yaw=0", "--set=capture.multicast=false",
    ]  # fmt: skip
    assert shown.startswith("mavlink:/dev/pts/" if serial else link)
    assert shown.endswith(f",{load_config().serial.baud}") is serial
    assert (VARIABLE in line._environment) is link.startswith("radio")
    found = line._environment.get("PYTHONPATH", "user")  # the first `sitecustomize` on it counts
    assert found == (f"{linked.SITE}:user" if link.startswith("radio") else "user")


def test_a_station_without_a_search_path_of_the_user_s_imports_nothing_from_its_folder(
    stack: ExitStack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)
    line = line_of(stack, tmp_path, "radio://0/80/2M/E7E7E7E7E7")
    assert line._environment["PYTHONPATH"] == str(linked.SITE), "an empty part is the current folder"


@pytest.mark.parametrize(
    ("link", "told"),
    [
        ("udp://127.0.0.1:0", "expected radio, mavlink, radio://0/80/2M/E7E7E7E7E7, udp://127.0.0.1:PORT"),
        ("udp://127.0.0.1:65536", "expected radio, mavlink"), ("udp://127.0.0.1:000001", "expected radio, mavlink"),
        ("udp://127.0.0.2:6000", "expected radio, mavlink"), ("radio://0/80/2M/E7E7E7E7E8", "expected radio, mavlink"),
        ("mavlink:line", "expected mavlink, mavlink:pty or mavlink:PATH with a name for a new pty"),
        ("mavlink:./a,b", "expected mavlink, mavlink:pty or mavlink:PATH with a name for a new pty"),
        ("mavlink:/dev/null", "/dev/null exists; a new pty gets that name. The board behind a line that is there"),
    ],
)  # fmt: skip
def test_a_link_with_no_end_here_is_refused(stack: ExitStack, tmp_path: Path, link: str, told: str) -> None:
    with pytest.raises(LabError, match=f"^--link {link}: {told}"):
        line_of(stack, tmp_path, link)


def test_whole_lines_of_the_station_are_heard_once_after_the_warm_up(
    stack: ExitStack, tmp_path: Path
) -> None:
    line = line_of(stack, tmp_path, UDP, TALK + "sys.stdin.close(); import time; time.sleep(60)")
    assert line.new_messages(WARM_UP_US - 1) == []
    assert line._station is None, "it starts when the laboratory runs"
    assert heard(line, WARM_UP_US) == [("station", "first"), ("station", "second")]
    assert line.new_messages(RELEASE_TIMEOUT_US - 1) == []
    with pytest.raises(LabError, match=r"^no flight within 60 s: second$"):
        line.new_messages(RELEASE_TIMEOUT_US)
    line._release_us = RELEASE_TIMEOUT_US - 1
    assert line.new_messages(RELEASE_TIMEOUT_US) == []


@pytest.mark.parametrize(("program", "said"), [(TALK, "second"), ("", "no output")])
def test_a_station_that_ends_is_given_up_with_its_last_line(
    stack: ExitStack, tmp_path: Path, program: str, said: str
) -> None:
    line = line_of(stack, tmp_path, UDP, f"{program}raise SystemExit(3)")
    line._running_station().wait()
    with pytest.raises(LabError, match=rf"^the station ended with 3: {said}$"):
        line.new_messages(WARM_UP_US)


def test_the_goal_is_at_home_until_the_release_and_its_own_parts_cannot_be_steered(
    stack: ExitStack, tmp_path: Path
) -> None:
    line = line_of(stack, tmp_path, UDP)
    home = line.trajectory.at(10_000_000)
    assert home.yaw == 0.0
    line._release_us = 2_000_000
    assert line.trajectory.at(2_999_999) == home
    assert line.trajectory.at(3_000_000).yaw == pytest.approx(1.919862, abs=1e-6)
    with pytest.raises(LabError, match="steer it there"):
        line.steer(None)
    with pytest.raises(LabError, match="set parameters there"):
        line.listen(print)


LEAVES = """
import signal, sys

def leave(number, frame):
    print("leaving")
    sys.exit(0)

signal.signal(signal.SIGTERM, leave)
print("ready")
print("set", flush=True)
signal.pause()
"""
STAYS = LEAVES.replace("sys.exit(0)", "sys.stdout.flush()").replace(
    "signal.pause()", "while True: signal.pause()"
)


@pytest.mark.parametrize(("program", "code"), [(LEAVES, 0), (STAYS, -9)], ids=["leaves", "stays"])
def test_a_station_may_end_in_order_and_is_killed_after_a_while(
    stack: ExitStack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, code: int
) -> None:
    monkeypatch.setattr(linked, "STATION_EXIT_TIMEOUT_US", 60_000_000 if code == 0 else 200_000)
    line, said = line_of(stack, tmp_path, UDP, program), list[tuple[str, str]]()
    line._say = lambda *note: said.append(note)
    heard(line, WARM_UP_US)
    line.lab.end_at(10_000)
    line.lab.run()
    line.flight.over = True  # as `Flight.end` has it: it listens no more
    line.finish(line.lab)
    assert line._station.returncode == code
    assert said == [("station", "leaving")] or code  # a killed one may not have come to say it
    assert line.lab.now_us == 210_000 if code else line.lab.now_us < 60_000_000


def test_the_release_begins_the_trajectory_and_the_counters_are_those_of_the_link(
    stack: ExitStack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clamps: list[Any] = []
    monkeypatch.setattr(linked, "LaunchClamp", lambda robot, let_go: clamps.append((robot, let_go)))
    counted = {}
    for link in (UDP, "mavlink:pty", "radio://0/80/2M/E7E7E7E7E7"):
        line, released = line_of(stack, tmp_path, link), list[int]()
        line.begin(released.append)
        robot, let_go = clamps.pop()
        assert robot is line.robot
        let_go(7_000_000)
        assert (released, line._release_us) == ([7_000_000], 7_000_000)
        board, clock = line.channels()
        counted[link.partition(":")[0]] = [
            quantity.names for channel in board for quantity in channel.quantities
        ]
        assert [quantity.unit for quantity in clock[0].quantities] == ["us"]
    assert counted["radio"] == []
    assert "link.unanswered" in counted["udp"][0]
    assert counted["udp"] != counted["mavlink"] != []
