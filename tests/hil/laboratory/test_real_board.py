"""`floaty fly --board LINK` and `floaty deploy check --targets LINK` with the exported app at the end of the link."""

from collections.abc import Callable
from pathlib import Path

import pytest

from ground_station.errors import LinkError
from ground_station.links import packets
from hil.laboratory.experiments import find_experiment
from hil.laboratory.files.recorder import load_log
from hil.laboratory.files.result import read_result
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from support.app_packets import AppPackets
from support.command import Cli
from support.crazyflie_app import App, build_app

URI = "udp://127.0.0.1:9"


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[Path], AppPackets]:
    """Puts an app at the end of every link."""

    def plug(library: Path) -> AppPackets:
        app = App(library, tmp_path / "copy.so")
        app.boot()
        link = AppPackets(app)
        monkeypatch.setattr(packets, "CflibPackets", lambda uri: link)
        return link

    monkeypatch.chdir(tmp_path)
    return plug


Plug = Callable[[Path], AppPackets]


def flown(folder: Path, duration_s: float, **arguments: object) -> str:
    return fly(Request.of(find_experiment("hover"), duration_s=duration_s, **arguments), folder).hash


@pytest.mark.long
def test_a_flight_on_a_board_has_the_hash_of_python(
    plugged: Plug, library: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = plugged(library)
    python = flown(tmp_path / "python", 0.3)
    assert flown(tmp_path / "board", 0.3, board=URI) == python
    assert link.closed == 1


@pytest.mark.long
@pytest.mark.parametrize("experiment", ["hover", "yaw-step"])
def test_experiments_are_equal_at_loss(plugged: Plug, library: Path, tmp_path: Path, experiment: str) -> None:
    plugged(library).mess = 0.1
    hashes = []
    for board in ("c", URI):
        hashes.append(fly(Request.of(find_experiment(experiment), board=board), tmp_path / "run").hash)
    assert hashes[0] == hashes[1]


@pytest.mark.long
def test_measured_cycles_are_the_tasks_processor_time(plugged: Plug, library: Path, tmp_path: Path) -> None:
    link = plugged(library)
    link.app.cycles.value = 168 * 700
    result = fly(
        Request.of(find_experiment("hover"), duration_s=0.2, overrides=("cpu.measured=true",), board=URI),
        tmp_path / "run",
    )
    entries = result.usage.entries
    spent_us = {task.name: task.run_time_us for task in result.tasks}
    assert spent_us["STABILIZER"] == 700 * (entries["control"].calls - 1)  # one while it boots
    assert spent_us["KALMAN"] == 700 * (entries["estimate"].calls + entries["file_pose"].calls)


@pytest.mark.long
@pytest.mark.parametrize(
    ("happens", "cause"),
    [("silent", "silent for 3 s"), ("reboots", "it has rebooted, or another program uses it")],
)
def test_a_board_that_fails_in_flight_ends_it_in_one_line_with_what_was_flown(
    plugged: Plug, library: Path, tmp_path: Path, happens: str, cause: str
) -> None:
    link = plugged(library)
    rebooted = App(library, tmp_path / "rebooted.so")
    rebooted.boot()

    def fail(now_us: int, flight: object) -> None:
        if now_us >= 1_200_000:
            link.silent, link.app = happens == "silent", rebooted if happens == "reboots" else link.app

    request = Request.of(find_experiment("hover"), duration_s=3.0, board=URI)
    result = fly(request, tmp_path / "run", progress=fail)
    assert (result.outcome, result.cause) == ("error", f"board {URI}: {cause}")
    assert load_log(tmp_path / "run").num_rows in range(120, 200)
    assert read_result(tmp_path / "run").cause == result.cause
    assert link.closed == 1


@pytest.mark.long
def test_the_check_compares_a_board_and_prints_measurements(cli: Cli, plugged: Plug, library: Path) -> None:
    plugged(library).app.cycles.value = 1234
    arguments = ("deploy", "check", "hover", "--duration", "0.3", "--targets", URI)
    assert cli(*arguments) == 0
    printed = " ".join(cli.out.split())
    assert f"130 ticks, c beside {URI}: no bit differs" in printed
    assert f"{URI}: cycles per call, mean and worst, as measured on the board" in printed
    assert "estimate 130 calls 1234 1234" in printed


@pytest.mark.long
def test_a_bit_error_in_the_app_is_found_with_call_and_field(cli: Cli, plugged: Plug, tmp_path: Path) -> None:
    plant = ("floaty_core.c", "control->count[flap] =", "control->count[flap] = 1 ^")
    plugged(build_app(tmp_path / "app", plant=plant))
    assert cli("deploy", "check", "hover", "--duration", "0.1", "--targets", URI) == 1
    printed = " ".join(cli.out.split())
    assert "DIFFERS first in tick 0, after control: Control.count[0]: 3" in printed
    assert f"{URI} DIFFERS" in printed


def test_a_check_whose_board_falls_silent_fails_in_one_line(
    cli: Cli, plugged: Plug, library: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    link = plugged(library)
    send, left = link.send, [400]

    def send_some(data: bytes) -> None:
        left[0] -= 1
        link.silent = left[0] < 0
        send(data)

    monkeypatch.setattr(link, "send", send_some)
    assert cli("deploy", "check", "hover", "--duration", "1", "--targets", URI) == 1
    assert f"hover, seed 1: error: board {URI}: silent for 3 s" in cli.out


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("fly", "hover", "--board", URI), f"floaty: --board {URI}: silent for 3 s"),
        (("fly", "hover", "--board", URI, "--seeds", "2"), "--seeds 2: a real board is in one flight at a time"),
        (("fly", "hover", "--board", "udp:nonsense"), "or the link to a real board"),
        (("fly", "hover", "--board", URI, "--link", "radio://0/80/2M"), "only c flies over a link"),
        (("deploy", "check", "--targets", URI), f"floaty: {URI}: silent for 3 s"),
        (("deploy", "check", "--targets", "udp"), "and no link to a board"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(
    cli: Cli, plugged: Plug, library: Path, arguments: tuple[str, ...], said: str
) -> None:
    plugged(library).silent = True
    assert cli(*arguments) == 2
    error = cli.err
    assert said in error
    assert "Traceback" not in error


@pytest.mark.parametrize("uri", ["usb://", "radio://0/80", "tcp://127.0.0.1:9"])
def test_a_uri_that_is_no_link_is_refused(uri: str) -> None:
    with pytest.raises(
        LinkError, match=r"expected radio://0/80/2M/E7E7E7E7E7, usb://0 or udp://127\.0\.0\.1:19850$"
    ):
        packets.CflibPackets(uri)
