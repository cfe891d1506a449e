"""A real build of the Crazyflie firmware with the exported app flies: the ELF that FLOATY_CF2_ELF names, byte for byte."""

import json
import os
import shutil
import sys
import zipfile
from pathlib import Path

import pytest

pytest.importorskip("unicorn")
pytest.importorskip("cffi")

from hil.commands.tables import print_result
from hil.emulator.stm32f405.chip import declared
from hil.errors import LabError
from hil.laboratory.experiments import find_experiment
from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.files.result import Result
from hil.laboratory.lockstep import image_at
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.laboratory.schedule import load_schedule, runs
from hil.pictures.compare import load_flown
from hil.research.studies.two_boards import two_boards
from support.flights import hover

ELF = os.environ.get("FLOATY_CF2_ELF", "")
flies = pytest.mark.skipif(
    not ELF, reason="FLOATY_CF2_ELF names no build of the Crazyflie firmware: no image was flown"
)
HOVER = find_experiment("hover")


def flown(folder: Path, duration_s: float, *faults: str, board: str = ELF) -> Result:
    return hover(folder, duration_s=duration_s, faults=faults, board=board)


def said(folder: Path) -> list[str]:
    return [event["text"] for event in load_events(folder)]


@pytest.mark.long
@flies
def test_the_image_hovers_within_all_limits_and_twice_alike(tmp_path: Path) -> None:
    first, second = (flown(tmp_path / name, 4.0) for name in ("a", "b"))
    assert first.outcome == "completed"
    assert first.passed, [verdict for verdict in first.verdicts if not verdict.passed]
    assert first.hash == second.hash
    assert "FLOATY: supervisor: flying" in said(tmp_path / "a")
    tasks = {one.task for one in runs(load_schedule(tmp_path / "a"))}
    assert {"STABILIZE", "SENSORS", "IDLE"} <= tasks


@pytest.mark.long
@flies
def test_the_image_falls_into_its_failsafe_when_poses_stop_and_recovers(tmp_path: Path) -> None:
    result = flown(tmp_path, 4.0, "radio.cut@1:1.5")
    assert result.outcome == "completed"
    # From 0.5 s after the last pose to the first one afterwards.
    assert 0.8 < result.metrics["failsafe"] < 1.2
    assert "FLOATY: supervisor: flying" in said(tmp_path)


@flies
def test_an_image_with_the_app_flies_no_crazyflie(tmp_path: Path) -> None:
    with pytest.raises(LabError, match=r"the image has Floaty's app, which drives servos"):
        hover(tmp_path / "run", profile="crazyflie", board=ELF)


@pytest.mark.long
@flies
def test_the_image_answers_a_push_as_the_python_board_does(tmp_path: Path) -> None:
    binary = flown(tmp_path / "binary", 4.0, "push.y@1=1")
    python = flown(tmp_path / "python", 4.0, "push.y@1=1", board="c")
    assert binary.metrics["max_y"] == pytest.approx(python.metrics["max_y"], abs=0.01)
    ages = [
        load_log(tmp_path / board).column("estimator.pose_age_us").to_numpy()[-100:].mean()
        for board in ("binary", "python")
    ]
    assert ages[0] == pytest.approx(ages[1], abs=10_000)


@pytest.mark.long
@flies
def test_the_image_s_difference_from_the_python_board_is_measured(tmp_path: Path) -> None:
    for name, board in (("python", "c"), ("binary", ELF)):
        flown(tmp_path / name, 1.0, board=board)
    found = two_boards(*(load_flown(tmp_path / name) for name in ("python", "binary")))
    assert found.first is not None
    assert found.first.why == "boot time"
    assert [cause.split(":")[0] for cause in found.causes] == [
        "boot time", "sensor start", "task phases", "radio", "long microsecond",
    ]  # fmt: skip
    assert found.causes[-1].endswith("lasts 1.0000 | 1.0119 us")  # 85 cycles of 84 MHz


@pytest.mark.long
@flies
def test_an_experiments_settings_reach_the_image_before_its_release(tmp_path: Path) -> None:
    request = Request.of(find_experiment("yaw-step"), board=ELF)
    result = fly(request, tmp_path)
    assert result.passed, [verdict for verdict in result.verdicts if not verdict.holds]
    events = load_events(tmp_path)
    (told,) = (event for event in events if event["text"].startswith("set over the radio: "))
    assert "RandConsts.openMin -0.192" in told["text"]
    assert told["t_us"] < request.config.flight.release_us
    assert not any("keeps its own" in event["text"] for event in events)


@pytest.mark.parametrize("kind", ["elf", "bin", "zip"])
def test_an_image_without_the_app_is_flown_and_recorded_with_its_tasks_and_reported(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from hil.board import image_firmware
    from support.stm32_firmware import build, flash_binary

    monkeypatch.setattr(image_firmware, "WARM_UP_US", 120_000)
    board = elf = build("clang", ("-g", "-DUSUAL_PLACES", "-fno-strict-aliasing"))
    if kind == "bin":
        board = tmp_path / "cf2.bin"
        board.write_bytes(flash_binary(elf))
    elif kind == "zip":
        board = tmp_path / "firmware-cf2-2025.09.zip"
        with zipfile.ZipFile(board, "w") as file:
            part = {"platform": "cf2", "target": "stm32", "type": "fw", "release": "2025.09"}
            file.writestr("manifest.json", json.dumps({"version": 1, "files": {"cf2.bin": part}}))
            file.writestr("cf2.bin", flash_binary(elf))
    request = Request.of(HOVER, duration_s=0.1, board=str(board), overrides=("flight.release_us=50000",))
    result = fly(request, tmp_path / "run")
    assert (result.outcome, result.cause) == ("completed", None)
    print_result(result)
    printed = capsys.readouterr().out
    assert "the image lacks Floaty's app: the servos move only if its own code moves them" in printed
    assert (f"{board.name}: took cf2.bin, release 2025.09 for platform cf2" in printed) == (kind == "zip")
    assert ("no symbols: tasks, log variables and parameters are found" in printed) == (kind != "elf")
    assert {"REPORT", "SPIN-0", "SPIN-1"} <= {task.name for task in result.tasks}
    names = [f"cpu.{task.name}" for task in result.tasks]
    log = load_log(tmp_path / "run")
    assert [name for name in log.column_names if name.startswith("cpu.")] == names
    assert {one.task for one in runs(load_schedule(tmp_path / "run"))} <= {task.name for task in result.tasks}


@pytest.mark.parametrize("link", ["radio://0/80/2M/E7E7E7E7E7", "udp://127.0.0.1:19850"])
def test_an_image_is_reached_over_radio_and_udp(link: str) -> None:
    assert not Request.of(HOVER, link=link, board=str(Path(__file__))).bench.in_lockstep


def test_an_elf_beside_another_board_is_refused() -> None:
    with pytest.raises(LabError, match=r"--elf x\.elf: goes with an image as --board, not with c"):
        Request.of(HOVER, elf=Path("x.elf"))


@pytest.mark.parametrize("package", ["unicorn", "cffi"])
def test_without_a_package_images_are_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    from support.stm32_firmware import build

    elf = build("clang")
    declared.cache_clear()
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(LabError, match=rf"--board .*: {package} is missing"):
        image_at(str(elf), None)


def test_without_a_compiler_images_fail_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from firmware_py.export import compilers
    from support.stm32_firmware import build

    def missing(name: str) -> str:
        raise compilers.PackageNotFoundError(name)

    elf = build("clang")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compilers, "version", missing)
    with pytest.raises(LabError, match=r"--board .*: the compiler ziglang is missing"):
        flown(tmp_path / "run", 1.0, board=str(elf))
    shutil.rmtree(tmp_path / "run")
