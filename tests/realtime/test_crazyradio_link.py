"""The ground station over cflib: `floaty station` and `floaty fly --link` as a user starts them."""

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import cflib.crtp
import libusb_package
import pytest
from cflib.crtp.radiodriver import RadioManager
from cflib.utils.power_switch import PowerSwitch

from hil.servers.dongle_plugin import VARIABLE, Backend
from support.serving import CAMERAS, Served, serve
from support.telemetry_rows import is_whole

FLOATY = (sys.executable, "-m", "hil.commands")
URI = "radio://0/80/2M/E7E7E7E7E7"
PATIENCE_S = 40.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def station(environment: dict[str, str], *arguments: str) -> "subprocess.CompletedProcess[str]":
    command = [*FLOATY, "station", *arguments]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)


def without_dongle() -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": "", VARIABLE: "127.0.0.1:9"}


def with_absent_dongle() -> dict[str, str]:
    from hil.servers.linked import SITE

    return {**without_dongle(), "PYTHONPATH": str(SITE)}


def refused(shown: "subprocess.CompletedProcess[str]", begin_s: float, message: str) -> None:
    assert time.monotonic() - begin_s < 10.0
    assert shown.returncode == 2
    assert message in shown.stderr
    assert shown.stderr.startswith("floaty: ")
    assert [line for line in shown.stdout.splitlines() if not line.startswith("mocap ")] == []
    assert shown.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--link", URI], "Cannot find a Crazyradio Dongle"),
        (["--link", "radio://0/80/3M/E7E7E7E7E7"], "radio://0/80/3M/E7E7E7E7E7: expected radio://"),
        (["--link", "udp://127.0.0.1"], "udp://127.0.0.1: expected radio://"),
        (["--link", "carrier-pigeon://coop"], "expected radio://"),
        (["--link", URI, "--mocap", "vicon"], "--mocap vicon: expected optitrack:HOST"),
        (["--link", URI, "--trajectory", "loop"], "experiment 'loop': unknown"),
        (["--link", URI, "--log", "/nowhere/log.csv"], "--log /nowhere/log.csv: there is no folder /nowhere"),
    ],
)
def test_what_cannot_work_is_one_line_within_ten_seconds(arguments: list[str], message: str) -> None:
    begin_s = time.monotonic()
    if "--mocap" not in arguments:
        arguments = [*arguments, "--mocap", CAMERAS]
    refused(station(with_absent_dongle(), *arguments), begin_s, message)


@pytest.mark.parametrize(
    "answer", [None, b"\xf1" + b"Something else    ".ljust(30, b"\0")], ids=["silent", "alien"]
)
def test_a_peer_that_is_no_board_is_one_line_within_ten_seconds(answer: bytes | None) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(PATIENCE_S)
        uri = f"udp://127.0.0.1:{peer.getsockname()[1]}"
        begin_s = time.monotonic()
        command = [*FLOATY, "station", "--link", uri, "--mocap", CAMERAS]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        _, client = peer.recvfrom(64)
        if answer is not None:
            peer.sendto(answer, client)
        out, error = process.communicate(timeout=60)
    shown = subprocess.CompletedProcess(command, process.returncode, out, error)
    refused(shown, begin_s, f"{uri}: {'no answer within 4 s' if answer is None else 'wrong protocol'}")


def test_a_port_without_a_board_is_one_line_within_ten_seconds() -> None:
    begin_s = time.monotonic()
    uri = f"udp://127.0.0.1:{free_port()}"
    refused(station(without_dongle(), "--link", uri, "--mocap", CAMERAS), begin_s, uri)


def start_station(served: Served, uri: str, *arguments: str) -> Served:
    command = [*FLOATY, "station", "--link", uri, "--mocap", served.motive, *arguments]
    return Served(
        subprocess.Popen(command, env=served.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    )


def finish(station: Served) -> int:
    """Press Ctrl-C and read to the end."""
    station.process.send_signal(signal.SIGINT)
    out, _ = station.process.communicate(timeout=30)
    station.lines += out.decode().splitlines()
    return station.process.returncode


def test_it_flies_reconnects_after_a_reboot_and_leaves_the_board_in_failsafe(tmp_path: Path) -> None:
    losses = ("--set=radio.uplink_loss=0.1", "--set=radio.downlink_loss=0.1")
    with serve("--radio", "--radio-port", "0", *losses, motive=True) as served:
        log = tmp_path / "telemetry.csv"
        station = start_station(served, URI, "--log", str(log))
        try:
            served.wait_for("board 1: released", PATIENCE_S)
            backend = Backend(served.environment[VARIABLE])
            libusb_package.get_libusb1_backend = lambda: backend
            RadioManager._radios.clear()
            if not cflib.crtp.CLASSES:
                cflib.crtp.init_drivers()
            served.forget()
            switch = PowerSwitch(URI)
            switch.stm_power_down()
            switch.stm_power_up()
            switch.close()
            station.wait_for("lost: .*connecting again", PATIENCE_S)
            served.wait_for("board 1: released", PATIENCE_S)
            served.forget()
            assert finish(station) == 0
            served.wait_for("failsafe, silence", PATIENCE_S)
        finally:
            station.process.kill()
            station.process.wait()
    assert station.lines[-1] == "the board is in failsafe, flaps at hover"
    assert sum(line.startswith("connected to ") for line in station.lines) == 2
    with log.open() as file:
        rows = list(csv.DictReader(file))
    flown = [row for row in rows if row["supervisor.state []"] == "2"]
    assert len(flown) > 100
    errors = [abs(float(row["stateEstimate.x [m]"])) for row in flown]
    assert max(errors) < 0.2
    complete = [row for row in flown if is_whole(row)]
    assert len(complete) / len(flown) > 0.9
    told = [(float(row["pm.vbat [V]"]), float(row["system.load [%]"])) for row in flown]
    for values, low, high in zip(zip(*told, strict=True), (3.0, 1.0), (4.3, 60.0), strict=True):
        known = [value for value in values if value == value]
        assert len(known) > 0.5 * len(flown) / 25
        assert low < min(known) <= max(known) < high


def fly(folder: Path, *arguments: str) -> dict[str, object]:
    """Fly seed 2, which stays well within the limits whenever it is released; that depends on the machine."""
    command = [*FLOATY, "fly", "hover", "--seed", "2", "--out", str(folder), *arguments]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert shown.returncode == 0, shown.stdout + shown.stderr
    return json.loads((folder / "result.json").read_text())


def test_the_complete_laboratory_flies_hover_within_its_limits(tmp_path: Path) -> None:
    """Motive, station process and virtual dongle for 10 s; the limits leave a busy machine room, the ages less."""
    result = fly(tmp_path / "run", "--link", URI, "--duration", "10")
    assert result["passed"]
    assert result["metrics"]["flown"] == pytest.approx(10.0, abs=0.1)
    assert 0.1 < result["real_time_factor"] < 1.1
    assert len((tmp_path / "run" / "telemetry.csv").read_text().splitlines()) > 300
    ages_ms = {stage["name"]: stage["mean_us"] / 1000 for stage in result["ages"]}
    assert list(ages_ms) == ["pose", "camera", "processing", "network", "station", "radio"]
    assert (ages_ms["camera"], ages_ms["processing"]) == pytest.approx((20.0, 18.0), abs=0.1)
    assert 38.5 < ages_ms["pose"] < 50.0
    said = [json.loads(line)["text"] for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    budgets = [line for line in said if line.startswith("pose ")]
    assert budgets
    assert all("camera 20.0 + processing 18.0" in line and "assumed" not in line for line in budgets)
    assert not any("Traceback" in line or "connecting again" in line for line in said)
    assert "<h2>Age of the poses</h2>" in (tmp_path / "run" / "report.html").read_text()


def test_hover_holds_its_limits_when_a_third_of_the_packets_is_lost(tmp_path: Path) -> None:
    """On a profile that describes other cameras than the virtual ones."""
    losses = ("--set=radio.uplink_loss=0.3", "--set=radio.downlink_loss=0.3")
    cameras = (
        "system=optitrack",
        "multicast=true",
        "body=robot",
        "axes=z-up",
        "origin=[1,2,0]",
        "yaw=1",
        "body_yaw=1",
    )
    others = [f"--set=capture.{setting}" for setting in cameras]
    assert fly(tmp_path / "run", "--link", URI, "--duration", "8", *losses, *others)["passed"]


def test_hover_over_udp_holds_its_limits(tmp_path: Path) -> None:
    link = ("--link", f"udp://127.0.0.1:{free_port()}")
    result = fly(tmp_path / "run", *link, "--duration", "8")
    assert result["passed"]
    assert [stage["name"] for stage in result["ages"]][-1] == "udp"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--link", "radio://0/81/2M/E7E7E7E7E7"], "expected radio, mavlink, radio://0/80/2M/E7E7E7E7E7"),
        (["--link", URI, "--seeds", "2"], "--seeds is for flights in lockstep"),
    ],
)
def test_fly_refuses_a_link_that_leads_nowhere(tmp_path: Path, arguments: list[str], message: str) -> None:
    command = [*FLOATY, "fly", "hover", "--out", str(tmp_path / "run"), *arguments]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert shown.returncode == 2
    assert message in shown.stderr
    assert len(shown.stderr.strip().splitlines()) == 1
