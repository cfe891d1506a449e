"""The stock firmware flies by its decks, without cameras: its own drivers find, test and read the emulated chips."""

import json
import os
from pathlib import Path

import pytest

from hil.api import column, fly
from hil.emulator.crazyflie.log_table import log_table
from hil.errors import LabError
from hil.laboratory.experiments.position import HOVER
from hil.laboratory.request import Request
from support.flights import served_image

ELF = os.environ.get("FLOATY_STOCK_ELF", "")
needs_image = pytest.mark.skipif(
    not ELF, reason="FLOATY_STOCK_ELF names no build of Bitcraze's firmware: no deck was read by its drivers"
)
PROFILE = "crazyflie-decks"


def test_decks_without_the_firmware_that_drives_them_are_one_clear_line(tmp_path: Path) -> None:
    image = tmp_path / "cf2.elf"
    image.write_bytes(b"")
    line = r"^robot.decks = flow2: the drivers are in the Crazyflie's own firmware; --profile crazyflie --board FILE$"
    for board in ("c", str(image)):
        with pytest.raises(LabError, match=line):
            Request.of(HOVER, overrides=['robot.decks=["flow2"]'], board=board)
    Request.of(HOVER, overrides=['robot.decks=["flow2"]'], board=str(image), profile="crazyflie")


@needs_image
def test_takes_off_holds_and_lands_by_its_decks_alone(tmp_path: Path) -> None:
    run = fly("hover", tmp_path / "run", profile=PROFILE, board=ELF, duration_s=20.0)
    assert run.result.outcome == "completed"
    assert [str(verdict) for verdict in run.result.verdicts if not verdict.holds] == []
    log = run.log
    assert column(log, "truth.z").max() > 0.9
    assert column(log, "truth.z")[-1] < 0.02
    events = (tmp_path / "run" / "events.jsonl").read_text(encoding="utf-8")
    console = [json.loads(line)["text"] for line in events.splitlines()]
    for wanted in (
        "DECK_CORE: 2 deck(s) found", "PMW: Motion chip id: 0x49:0xB6", "DECK_CORE: Deck 0 test [OK].",
        "DECK_CORE: Deck 1 test [OK].", "SYS: Self test passed!",
    ):  # fmt: skip
        assert wanted in console


@needs_image
def test_without_decks_and_without_poses_it_does_not_hold_its_place(tmp_path: Path) -> None:
    settings = {"pilot.poses": False, "robot.decks": []}
    run = fly("hover", tmp_path / "run", profile=PROFILE, board=ELF, duration_s=10.0, overrides=settings)
    assert not all(verdict.holds for verdict in run.result.verdicts)


@needs_image
def test_drivers_read_the_walls_and_the_floor_where_they_are() -> None:
    with served_image(ELF, PROFILE) as server:
        served = server.served
        served.robot.body.put_back((0.6, -0.5, 1.0))
        server.lab.end_at(1_600_000)
        server.lab.run()
        firmware = served.robot.firmware
        table = {variable.name: variable for variable in log_table(firmware.image, firmware.chip)}
        seen = {
            name: table[f"range.{name}"].read() * 1e-3
            for name in ("front", "back", "left", "right", "up", "zrange")
        }
        wanted = {"front": 1.4, "back": 2.6, "left": 2.5, "right": 1.5, "up": 1.5, "zrange": 1.0}
        assert seen == pytest.approx(wanted, abs=0.03)
        for name in ("bcFlow2", "bcMultiranger"):
            assert firmware.flashed is not None
            assert firmware.flashed.parameters[f"deck.{name}"].read() == 1
