"""Flights with a controller and an estimator of the user's own, on every board; the laws that ship."""

import json
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from firmware_py.wire.supervisor import State
from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.files.result import Result
from hil.laboratory.metrics import column
from hil.pictures.report import write_report
from support.flights import hover
from support.own_logic import AS_BUILT_IN, ESTIMATOR, LAW, make_project
from support.paths import ROOT


@pytest.mark.long
def test_modules_that_compute_what_the_core_does_make_the_same_flight(tmp_path: Path) -> None:
    profile = make_project(tmp_path, AS_BUILT_IN, ESTIMATOR)
    usual, own = (
        hover(tmp_path / "usual", duration_s=0.5),
        hover(tmp_path / "own", profile=str(profile), duration_s=0.5),
    )
    assert own.hash == usual.hash
    assert len(own.program.logic) == 64
    assert json.loads((tmp_path / "own" / "result.json").read_text())["logic"] == own.program.logic
    assert usual.program.logic == ""


@pytest.mark.long
def test_the_law_in_the_documentation_flies(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "howto" / "own-logic.md").read_text(encoding="utf-8")
    law = dedent(text.split("## A control law")[1].split("\n`control_law`")[0])
    own = hover(
        tmp_path / "own", profile=str(make_project(tmp_path, law, "", "gain_z = 4.0")), duration_s=0.5
    )
    assert own.passed
    assert np.abs(column(load_log(own.folder), "logic.integral")).max() > 0.0


@pytest.fixture(scope="module")
def failed(tmp_path_factory: pytest.TempPathFactory) -> Result:
    """A flight whose law divides nothing by nothing after 80 ticks."""
    folder = tmp_path_factory.mktemp("failed")
    profile = make_project(folder, LAW)
    return hover(folder / "run", "logic.after=80", "logic.gain_iy=0.5", profile=str(profile), duration_s=0.5)


@pytest.mark.long
def test_a_law_that_puts_out_nan_is_a_failed_flight_that_names_it(failed: Result) -> None:
    assert failed.outcome == "error"
    assert not failed.passed
    assert failed.cause is not None
    assert failed.cause.startswith("own controller not finite at 1.3")
    content = json.loads((failed.folder / "result.json").read_text())
    assert (content["outcome"], content["cause"], content["passed"]) == ("error", failed.cause, False)
    texts = [(event["source"], event["text"]) for event in load_events(failed.folder)]
    assert ("board", "supervisor: failsafe, controller not finite") in texts
    assert ("lab", failed.cause.split(";")[0]) in texts
    log = load_log(failed.folder)
    failsafe = column(log, "supervisor.state") == State.FAILSAFE
    assert 10 < failsafe.sum() < 50
    flaps = column(log, *(f"control.flap_{number}" for number in (1, 2, 3, 4)))
    assert flaps[failsafe] == pytest.approx(np.tile([0.436332, -0.436332], (failsafe.sum(), 2)), abs=1e-6)
    assert np.isfinite(flaps).all()


@pytest.mark.long
def test_a_law_with_an_endless_loop_is_a_failed_flight_that_names_file_and_line(tmp_path: Path) -> None:
    old = "    memory.ticks = i32(memory.ticks + 1)\n"
    loop = "    for i in range(memory.ticks * 4000000):\n        memory.hidden = memory.hidden + DT\n"
    law = LAW.replace(old, old + loop)
    result = hover(tmp_path / "run", profile=str(make_project(tmp_path, law)), duration_s=0.1, board="c")
    line = law[: law.index("    for i in range(memory")].count("\n") + 1
    assert result.outcome == "error"
    assert result.cause is not None
    where = f"controller.py:{line}: the loop up to 4000000 exceeds the 672000 cycles of a call at "
    assert where in result.cause
    assert any(event["source"] == "lab" and where in event["text"] for event in load_events(result.folder))


@pytest.mark.long
def test_own_logic_s_log_is_recorded_and_drawn(failed: Result) -> None:
    log = load_log(failed.folder)
    own = {field.name: field.metadata[b"unit"] for field in log.schema if field.name.startswith("logic.")}
    errors = {f"logic.errors{axis}": b"m" for axis in (1, 2, 3)}
    assert own == {"logic.integral": b"m s", **errors, "logic.ticks": b""}
    flying = column(log, "supervisor.state") == State.FLYING
    assert column(log, "logic.errors1")[flying] == pytest.approx(-column(log, "estimate.x")[flying], abs=1e-6)
    assert np.abs(column(log, "logic.integral")).max() > 0.0
    assert "Own logic" in write_report(failed.folder).read_text()


@pytest.mark.long
@pytest.mark.parametrize("board", ["python", "cortex-m4"])
def test_a_flight_on_another_board_is_bit_identical(failed: Result, tmp_path: Path, board: str) -> None:
    again = hover(
        tmp_path, *failed.request.overrides, profile=failed.request.profile, duration_s=0.5, board=board
    )
    assert again.hash == failed.hash
    assert again.cause == failed.cause


@pytest.mark.long
@pytest.mark.parametrize("profile", ["original", "lqr"])
def test_shipped_laws_hover_within_limits_and_alike_on_every_board(tmp_path: Path, profile: str) -> None:
    assert hover(tmp_path / "whole", profile=profile).passed
    results = [
        hover(tmp_path / board, profile=profile, board=board, duration_s=4.0)
        for board in ("python", "c", "cortex-m4")
    ]
    assert len({result.hash for result in results}) == 1
