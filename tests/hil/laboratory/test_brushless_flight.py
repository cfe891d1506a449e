"""The Crazyflie 2.1 Brushless' own firmware, unmodified, flies by DSHOT: the ELF that FLOATY_BRUSHLESS_ELF names."""

import os
from pathlib import Path

import pytest

from hil.api import Request, fly
from hil.emulator.crazyflie.log_table import log_table
from hil.errors import LabError
from hil.laboratory.experiments.position import HOVER
from hil.laboratory.fault_kinds import KINDS
from support.flights import check_calibrated, check_hover, served_image
from support.stm32_firmware import build, flash_binary

ELF = os.environ.get("FLOATY_BRUSHLESS_ELF", "")
needs_image = pytest.mark.skipif(
    not ELF, reason="FLOATY_BRUSHLESS_ELF names no build of platform cf21bl: no Brushless was flown"
)
PROFILE = "crazyflie-brushless"
ARM = bytes((0xD0, 1, 1))


@pytest.mark.parametrize(("profile", "device", "told"), [
    ("crazyflie", "C21B", "elf: built for boards of device type C21B, .* is CF21; --profile crazyflie"),
    (PROFILE, "CF21", "elf: built for boards of device type CF21, .* is C21B; --profile crazyflie"),
    (PROFILE, "CF99", "built for boards of device type unknown here, but this robot's is C21B$"),
    (PROFILE, "C21B", r"no log variable supervisor\.info"),  # the next thing that it lacks
])  # fmt: skip
def test_firmware_of_another_board_is_one_clear_line(
    profile: str, device: str, told: str, tmp_path: Path
) -> None:
    image = str(build(flags=("-g", f'-DDEVICE_TYPE="{device}"')))
    with pytest.raises(LabError, match=told):
        fly("hover", tmp_path / "run", profile=profile, board=image)


@pytest.mark.long
@pytest.mark.parametrize(
    ("device_type", "expected"),
    [
        ("CB11", "built for a Crazyflie Bolt, whose IMU on SPI and ESCs for PWM are not modelled"),
        ("RR10", "built for a Roadrunner (platform tag), whose radio for positioning is not modelled"),
        ("CF21\\0Flapper (CF 2.1)", "built for a Flapper, whose servos, ESCs and"),
    ],
)
@pytest.mark.parametrize("named", [True, False])
def test_firmware_of_a_board_that_is_not_modelled_says_what_is_missing(
    device_type: str, expected: str, named: bool, tmp_path: Path
) -> None:
    elf = build(flags=("-g", f'-DDEVICE_TYPE="{device_type}"'))
    (tmp_path / "bolt.bin").write_bytes(flash_binary(elf))
    with pytest.raises(LabError) as caught:
        fly("hover", tmp_path / "a", profile="crazyflie", board=str(elf if named else tmp_path / "bolt.bin"))
    assert expected in str(caught.value)


def test_flies_only_from_an_image() -> None:
    with pytest.raises(LabError, match=r"^profile crazyflie-brushless: its robot flies with .* --board FILE"):
        Request.of(HOVER, profile=PROFILE)


@needs_image
@pytest.mark.parametrize("controller", [1, 2, 3], ids=["pid", "mellinger", "indi"])
def test_takes_off_holds_and_lands_with_each_controller(controller: int, tmp_path: Path) -> None:
    """INDI follows its goal a second late, and the firmware stops the motors when the goal has landed: so slowly."""
    settings = {"pilot.parameters.stabilizer.controller": controller, "pilot.land_s": 5.0}
    run = fly("hover", tmp_path / "run", profile=PROFILE, board=ELF, overrides=settings, duration_s=15.0)
    check_hover(run, 2.02)  # [V] of Bitcraze's curve at a quarter of 39.3 g


@needs_image
@pytest.mark.parametrize("experiment", ["hover", "y-square", "figure-eight"])
def test_experiments_hold_their_limits(experiment: str, tmp_path: Path) -> None:
    result = fly(experiment, tmp_path / "run", profile=PROFILE, board=ELF).result
    assert [str(verdict) for verdict in result.verdicts if not verdict.holds] == []


@needs_image
@pytest.mark.parametrize("kind", ["motor.weak.1", "motor.stop.2", "motor.stuck.3"])
def test_hover_with_a_failed_motor_is_lost_where_that_is_stated(kind: str, tmp_path: Path) -> None:
    run = fly("hover", tmp_path / "run", profile=PROFILE, board=ELF, duration_s=12.0, faults=[f"{kind}@4"])
    assert (run.result.outcome == "lost") == (KINDS[kind].outcome == "lost"), run.result.cause


@needs_image
def test_armed_motors_idle_and_the_firmware_knows_their_speeds() -> None:
    with served_image(ELF, PROFILE) as server:
        robot = server.served.robot
        robot.packet_received(1_000_000, ARM)
        server.lab.end_at(2_000_000)
        server.lab.run()
        table = {v.name: v for v in log_table(robot.firmware.image, robot.firmware.chip)}
        check_calibrated(table)
        if "motor.m1_rpm" not in table:
            pytest.skip("FLOATY_BRUSHLESS_ELF is older than 2026.08: it does not ask for the motors' speeds")
        speeds = [table[f"motor.m{motor}_rpm"].read() for motor in (1, 2, 3, 4)]
        assert speeds == pytest.approx(robot.body.rpm.tolist(), rel=0.01)
        assert min(speeds) > 1000
        assert max(speeds) < 3500
        assert robot.firmware.chip.state.esc[0].refused == 0
