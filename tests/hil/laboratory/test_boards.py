"""Flights on the other boards: the exported C, and its machine code on the emulated Cortex-M4, against Python's."""

import json
from pathlib import Path

import pytest

from hil.config import load_config
from hil.errors import LabError
from hil.laboratory import request
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import load_log
from hil.laboratory.files.result import Result
from hil.laboratory.lockstep import image_at
from support.flights import hover
from support.stm32_firmware import build

DURATION_S, RELEASE = 1.5, "flight.release_us=100000"


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> Result:
    return hover(tmp_path_factory.mktemp("usual"), RELEASE, board="c", duration_s=DURATION_S)


@pytest.mark.long
@pytest.mark.parametrize("board", ["python", "cortex-m4"])
def test_a_flight_on_another_board_has_the_same_records(tmp_path: Path, usual: Result, board: str) -> None:
    result = hover(tmp_path, RELEASE, board=board, duration_s=DURATION_S)
    assert load_log(tmp_path).equals(load_log(usual.folder))  # truth, estimate, counts and all the rest
    assert result.hash == usual.hash
    assert json.loads((tmp_path / "result.json").read_text())["board"] == board


@pytest.mark.long
def test_the_costs_of_the_profile_are_what_the_machine_code_takes(tmp_path: Path, usual: Result) -> None:
    result = hover(tmp_path, board="cortex-m4", duration_s=DURATION_S)
    assert usual.usage is None
    assert result.usage is not None
    cpu, entries = load_config().cpu, result.usage.entries
    estimator_us = entries["estimate"].worst_us + entries["file_pose"].worst_us
    assert estimator_us == pytest.approx(cpu.estimator_us, rel=0.1)  # another version of ziglang may differ
    assert entries["control"].worst_us == pytest.approx(cpu.controller_us, rel=0.2)
    steps = entries["estimate"].calls
    assert steps == entries["control"].calls == round((DURATION_S + 1) * 100)
    assert (
        json.loads((tmp_path / "result.json").read_text())["usage"]["entries"]["estimate"]["calls"] == steps
    )


@pytest.mark.long
def test_measured_costs_are_the_processor_time_of_the_tasks(tmp_path: Path) -> None:
    result = hover(
        tmp_path, "cpu.measured=true", "cpu.estimator_us=0", "cpu.controller_us=0", board="cortex-m4",
        duration_s=DURATION_S,
    )  # fmt: skip
    assert result.passed
    assert result.usage is not None
    entries = result.usage.entries
    spent = {task.name: task.run_time_us for task in result.tasks}
    steps = entries["estimate"].calls
    estimator_us = (entries["estimate"].cycles + entries["file_pose"].cycles) / 168
    assert estimator_us <= spent["KALMAN"] <= estimator_us + steps  # each call is rounded up
    assert (
        entries["control"].cycles / 168 - 10 <= spent["STABILIZER"] <= entries["control"].cycles / 168 + steps
    )


@pytest.mark.long
def test_the_report_shows_what_the_board_takes(tmp_path: Path) -> None:
    from hil.pictures.report import write_report

    hover(tmp_path, board="cortex-m4", duration_s=DURATION_S)
    page = write_report(tmp_path).read_text(encoding="utf-8")
    assert "<td>cortex-m4</td>" in page
    assert "instructions" in page


@pytest.mark.long
def test_the_emulated_chip_is_compiled_only_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("unicorn", "cffi", "ziglang"):
        pytest.importorskip(package)
    image = str(build())
    monkeypatch.setenv("FLOATY_CACHE_DIR", str(tmp_path / "cache"))
    places = set()
    for number in range(2):
        folder = tmp_path / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        places.add(image_at(image, None).library)
        assert list(folder.iterdir()) == []
    (library,) = places
    assert library.is_relative_to(tmp_path / "cache")


@pytest.mark.parametrize(("link", "board", "expected"), [
    ("radio", "c", []),
    ("mavlink", "python", [("--link mavlink", "mavlink", "pymavlink")]),
    ("mavlink:pty", "c", [("--link mavlink:pty", "mavlink", "pymavlink", "serial")]),
    ("udp://127.0.0.1:1", "c", [("--link udp://127.0.0.1:1", "radio", "cflib")]),
    ("radio", "usb://0", [("--board usb://0", "radio", "cflib")]),
    ("mavlink", "cortex-m4", [("--link mavlink", "mavlink", "pymavlink"),
        ("--board cortex-m4", "deploy", "unicorn", "elftools", "ziglang")]),
    ("radio", __file__, [(f"--board {__file__}", "deploy", "unicorn", "cffi", "elftools")]),
])  # fmt: skip
def test_each_link_and_board_needs_its_own_packages(
    monkeypatch: pytest.MonkeyPatch, link: str, board: str, expected: list[tuple[str, ...]]
) -> None:
    needed: list[tuple[str, ...]] = []
    monkeypatch.setattr(request, "require", lambda *what: needed.append(what))
    request.Bench(link, board).check()
    assert needed == expected


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name, one in EXPERIMENTS.items() if one.faults])
def test_a_shorter_flight_leaves_out_its_experiment_s_later_faults_but_not_the_user_s(name: str) -> None:
    short = request.Request.of(EXPERIMENTS[name], duration_s=0.01)
    assert len(short.planned_faults) == len(EXPERIMENTS[name].faults)
    with pytest.raises(LabError, match=r"push\.y@9"):
        request.Request.of(EXPERIMENTS[name], duration_s=0.01, faults=("push.y@9=1",))
