"""The Crazyflie's own firmware, unmodified, flies a Crazyflie's body: the ELF that FLOATY_STOCK_ELF names, byte for byte."""

import json
import os
import zipfile
from math import degrees, radians
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from firmware_py.wire.supervisor import Cause, State
from hil.api import Request, column, fly
from hil.board.image_firmware import stock_signals
from hil.config import load_config
from hil.emulator.crazyflie.log_table import log_table
from hil.emulator.stm32f405.image import Image
from hil.errors import LabError
from hil.laboratory.experiments.position import HOVER
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.request import why_left
from support.flights import check_calibrated, check_hover, served_image

ELF = os.environ.get("FLOATY_STOCK_ELF", "")
needs_image = pytest.mark.skipif(
    not ELF, reason="FLOATY_STOCK_ELF names no build of Bitcraze's firmware: no Crazyflie was flown"
)
PROFILE = "crazyflie"


def test_flight_too_short_for_take_off_and_landing_is_refused(tmp_path: Path) -> None:
    image = tmp_path / "cf2.elf"
    image.write_bytes(b"")
    with pytest.raises(LabError, match=r"^--duration 6: take-off and landing alone take 7.3 s"):
        Request.of(HOVER, profile=PROFILE, board=str(image), duration_s=6.0)
    assert Request.of(HOVER, profile=PROFILE, board=str(image), duration_s=7.4).times is not None


def test_goals_stay_in_the_room() -> None:
    config = load_config(PROFILE)
    assert why_left(config, (0.0, 1.9, 1.0)) == ""
    assert "up to 2 m sideways and 2.5 m high" in why_left(config, (0.0, 2.1, 1.0))


def table(**values: float) -> dict[str, SimpleNamespace]:
    return {
        name.replace("__", "."): SimpleNamespace(read=lambda value=value: value)
        for name, value in values.items()
    }


def test_stock_log_variables_are_read_in_si_and_our_signs() -> None:
    signals = stock_signals(
        table(
            stateEstimate__x=1, stateEstimate__roll=10, stateEstimate__pitch=20, gyro__z=90, motor__m2=40000
        )
    )  # type: ignore[arg-type]
    assert signals.estimate[0] == 1.0
    assert signals.estimate[6] == pytest.approx(radians(10))
    assert signals.estimate[7] == pytest.approx(-radians(20))
    assert signals.estimate[11] == pytest.approx(radians(90))
    assert signals.estimate[1] != signals.estimate[1]  # unknown
    assert signals.count.tolist() == [0, 40000, 0, 0]
    assert signals.counters.size == signals.u.size == signals.flap.size == 0


@pytest.mark.parametrize(
    ("bits", "state", "cause"),
    [
        (0b0000_1110, State.WAITING, Cause.NONE),
        (0b0001_1110, State.FLYING, Cause.NONE),
        (0b0011_0010, State.FAILSAFE, Cause.NONE),
        (0b1001_0010, State.FAILSAFE, Cause.NONE),
        (0b0100_0000, State.FAILSAFE, Cause.EMERGENCY_STOP),
    ],
)
def test_bits_of_the_stock_supervisor_are_our_states(bits: int, state: State, cause: Cause) -> None:
    supervisor = stock_signals(table(supervisor__info=bits)).supervisor  # type: ignore[arg-type]
    assert (supervisor.state, supervisor.cause) == (state, cause)


@needs_image
@pytest.mark.parametrize("controller", range(1, 6), ids=["pid", "mellinger", "indi", "brescianini", "lee"])
def test_takes_off_holds_and_lands_with_each_controller(controller: int, tmp_path: Path) -> None:
    """INDI sinks a second behind its goal, and the firmware stops the motors when the goal has landed: so slowly."""
    settings = {"pilot.parameters.stabilizer.controller": controller, "pilot.land_s": 5.0}
    run = fly("hover", tmp_path / "run", profile=PROFILE, board=ELF, overrides=settings, duration_s=14.0)
    in_air = check_hover(run, 2.40)  # [V] of Bitcraze's curve at a quarter of the weight
    assert degrees(abs(column(run.log, "estimate.roll")[in_air]).max()) < 3.0


@needs_image
@pytest.mark.parametrize("experiment", ["y-square", "figure-eight"])
def test_follows_steps_and_a_figure_of_eight_within_its_limits(experiment: str, tmp_path: Path) -> None:
    result = fly(experiment, tmp_path / "run", profile=PROFILE, board=ELF).result
    assert [str(verdict) for verdict in result.verdicts if not verdict.holds] == []


@needs_image
@pytest.mark.parametrize("kind", ["bin", "zip"])
def test_a_release_without_symbols_flies_as_with_them(kind: str, tmp_path: Path) -> None:
    """Its cycles are almost those of the ELF: so is its flight."""
    code, board = Image(Path(ELF)).code, tmp_path / f"cf2.{kind}"
    if kind == "bin":
        board.write_bytes(code)
    else:
        with zipfile.ZipFile(board, "w", zipfile.ZIP_DEFLATED) as file:
            part = {"platform": "cf2", "target": "stm32", "type": "fw", "release": "test"}
            file.writestr("manifest.json", json.dumps({"version": 2, "files": {"cf2.bin": part}}))
            file.writestr("cf2.bin", code)
    named, unnamed = (
        fly("hover", tmp_path / name, profile=PROFILE, board=str(path), duration_s=8.0).result
        for name, path in (("elf", Path(ELF)), ("bin", board))
    )
    assert unnamed.passed, unnamed.failed
    assert named.image is not None
    assert unnamed.image is not None
    assert named.image.stack_free_bytes.keys() == unnamed.image.stack_free_bytes.keys()
    assert {task.name for task in named.tasks} == {task.name for task in unnamed.tasks}
    for metric in ("rms_x", "rms_y", "rms_z"):
        assert unnamed.metrics[metric] == pytest.approx(named.metrics[metric], abs=0.002)


@needs_image
@pytest.mark.parametrize(
    ("options", "failed"),
    [
        ({"duration_s": 8.0}, set()),
        ({"duration_s": 9.5, "overrides": {"pilot.take_off_s": 4.0}}, {"reached_box"}),
        ({"duration_s": 8.0, "faults": ["push.y@5.4:5.9=0.1"]}, {"off_path", "landed_off_axis"}),
    ],
    ids=["healthy", "slow take-off", "pushed while landing"],
)
def test_a_short_hover_is_judged_by_its_phases(
    options: dict[str, Any], failed: set[str], tmp_path: Path
) -> None:
    verdicts = fly("hover", tmp_path / "run", profile=PROFILE, board=ELF, **options).result.verdicts
    broken = {verdict.metric for verdict in verdicts if not verdict.holds}
    assert broken - {"attitude_max", "touch_down_speed", "uncontrolled"} == failed  # by release
    assert failed or not broken


@needs_image
@pytest.mark.parametrize("kind", ["motor.weak.1", "motor.stop.2", "motor.stuck.3"])
def test_hover_with_a_failed_motor_is_lost_where_that_is_stated(kind: str, tmp_path: Path) -> None:
    fault = f"{kind}@4"
    result = fly(
        "hover", tmp_path / "run", profile=PROFILE, board=ELF, duration_s=12.0, faults=[fault]
    ).result
    assert (result.outcome == "lost") == (KINDS[kind].outcome == "lost"), result.cause


@needs_image
def test_same_seed_has_the_same_hash_and_an_unknown_parameter_one_line(tmp_path: Path) -> None:
    one, other = (
        fly("hover", tmp_path / name, profile=PROFILE, board=ELF, duration_s=7.5).result.hash for name in "ab"
    )
    assert one == other
    with pytest.raises(
        LabError, match=r"^pilot.parameters.stabilizer.controler: the image has no such parameter"
    ):
        fly(
            "hover", tmp_path / "c", profile=PROFILE, board=ELF,
            overrides={"pilot.parameters.stabilizer.controler": 1},
        )  # fmt: skip


@needs_image
def test_served_robot_stands_on_the_floor_with_the_profiles_parameters_and_feels_its_height() -> None:
    with served_image(ELF, PROFILE) as server:
        served = server.served
        robot = served.robot
        assert robot.free
        assert robot.firmware.flashed is not None
        assert robot.firmware.flashed.parameters["stabilizer.estimator"].read() == 2
        assert robot.body.p_WB[2] == pytest.approx(0.0145, abs=1e-3)
        estimate = robot.firmware.signals.estimate
        assert estimate[:3] == pytest.approx(robot.body.p_WB, abs=0.02)  # by the poses
        table = {v.name: v for v in log_table(robot.firmware.image, robot.firmware.chip)}
        check_calibrated(table)
        heights = []
        for second, height in enumerate((0.0, 2.0)):
            robot.body.put_back((0.0, 0.0, height))
            end_us = (2 + second) * 1_000_000
            server.lab.end_at(end_us)
            server.lab.run()
            heights.append(table["baro.asl"].read())
        assert heights[0] == pytest.approx(0.0, abs=0.5)
        assert heights[1] - heights[0] == pytest.approx(2.0, abs=0.5)
