"""The ground station over cflib: a peer that is no board, and a board that reboots in flight."""

import csv
import socket
from pathlib import Path

import pytest
from cflib.utils.power_switch import PowerSwitch

from support.plugged_dongle import plug
from support.serving import CAMERAS, PATIENCE_S, serve, started, station
from support.telemetry_rows import is_whole


@pytest.mark.parametrize(
    "answer", [None, b"\xf1" + b"Something else    ".ljust(30, b"\0")], ids=["silent", "alien"]
)
def test_a_foreign_peer_is_one_line_after_some_seconds(answer: bytes | None) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        peer.bind(("127.0.0.1", 0))
        peer.settimeout(PATIENCE_S)
        uri = f"udp://127.0.0.1:{peer.getsockname()[1]}"
        with started("station", "--link", uri, "--mocap", CAMERAS) as typed:
            _, client = peer.recvfrom(64)
            if answer is not None:
                peer.sendto(answer, client)
            assert typed.process.wait(PATIENCE_S) == 2
            typed.listen()
    (line,) = [line for line in typed.lines if not line.startswith("mocap ")]
    problem = "no answer within 4 s" if answer is None else "wrong protocol"
    assert line.startswith(f"floaty: --link {uri}: {problem}")


def test_it_flies_reconnects_after_a_reboot_and_leaves_the_board_in_failsafe(tmp_path: Path) -> None:
    losses = ("--set=radio.uplink_loss=0.1", "--set=radio.downlink_loss=0.1")
    log = tmp_path / "telemetry.csv"
    with serve("--radio", "--radio-port", "0", *losses, motive=True) as served:
        (uri,) = served.radio_uris
        with station(served, uri, "--log", log) as typed:
            served.wait_for("board 1: released", PATIENCE_S)
            plug(served)
            served.forget()
            switch = PowerSwitch(uri)
            switch.stm_power_down()
            switch.stm_power_up()
            switch.close()
            typed.wait_for("lost: .*connecting again", PATIENCE_S)
            served.wait_for("board 1: released", PATIENCE_S)
            served.forget()
            assert typed.interrupt() == 0
            served.wait_for("failsafe, silence", PATIENCE_S)
    assert typed.lines[-1] == "the board is in failsafe, flaps at hover"
    assert sum(line.startswith("connected to ") for line in typed.lines) == 2
    with log.open() as file:
        rows = list(csv.DictReader(file))
    flown = [row for row in rows if row["supervisor.state []"] == "2"]
    assert len(flown) > 100
    complete = [row for row in flown if is_whole(row)]
    assert len(complete) / len(flown) > 0.9
    assert max(abs(float(row["stateEstimate.x [m]"])) for row in complete) < 0.2
    told = [(float(row["pm.vbat [V]"]), float(row["system.load [%]"])) for row in flown]
    for values, low, high in zip(zip(*told, strict=True), (3.0, 1.0), (4.3, 60.0), strict=True):
        known = [value for value in values if value == value]
        assert len(known) > 0.5 * len(flown) / 25
        assert low < min(known) <= max(known) < high
