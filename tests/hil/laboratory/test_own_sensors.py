"""Sensors of a user's own robot: what own logic reads of them, on every board, and every mistake as one line."""

import hashlib
from pathlib import Path

import numpy as np
import pytest

from firmware_py.export.crazyflie import write_app
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.files.recorder import load_log
from hil.laboratory.metrics import column
from support.command import Cli
from support.crazyflie_app import App, build_app
from support.examples import blocks
from support.flights import hover
from support.paths import ROOT

PAGE = ROOT / "docs" / "tutorials" / "your-own-robot.md"
PROJECT = ROOT / "hil" / "commands" / "robot_project"
RANGING, RANGED = (
    next(text for _, text in blocks(PAGE) if text.startswith(f"# {name}.py"))
    for name in ("ranging", "ranged")
)
FLOW = """
    def flow(self):
        x, y, _ = self.v_WB.tolist()
        return x, y
"""


def project(folder: Path, robot: str = RANGING, law: str = RANGED) -> str:
    """Write the tutorial's ball with a range finder, or with another robot and law; return its profile.

    The same law is one file for all, which is translated once.
    """
    controller = folder.parent / f"law-{hashlib.sha256(law.encode()).hexdigest()[:8]}" / "controller.py"
    controller.parent.mkdir(exist_ok=True)
    controller.write_text(law, encoding="utf-8")
    (folder / "robot.py").write_text((PROJECT / "robot.py.in").read_text(encoding="utf-8"), encoding="utf-8")
    (folder / "ranging.py").write_text(robot, encoding="utf-8")
    names = (('"robot.py"', '"ranging.py"'), ('"controller.py"', f'"{controller}"'))
    profile = changed((PROJECT / "profile.toml.in").read_text(encoding="utf-8"), *names)
    (folder / "profile.toml").write_text(profile, encoding="utf-8")
    return str(folder / "profile.toml")


def changed(text: str, *changes: tuple[str, str]) -> str:
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.mark.long
def test_own_logic_flies_by_what_its_sensor_measures(tmp_path: Path) -> None:
    run = hover(tmp_path / "run", "logic.height=1.2", profile=project(tmp_path), duration_s=2.5)
    log = load_log(run.folder)
    arrived, truth, seen = (column(log, name) for name in ("sensor.range", "truth.z", "logic.range"))
    assert run.outcome == "completed", run.cause
    assert truth[-1] == pytest.approx(1.2, abs=0.03)
    assert np.nanmax(np.abs(arrived - truth)) < 0.01
    late = np.flatnonzero(np.isfinite(seen))
    assert set(seen[late].tolist()) <= set(arrived[np.isfinite(arrived)].tolist())


@pytest.mark.parametrize("board", ["python", pytest.param("cortex-m4", marks=pytest.mark.long)])
def test_a_sensor_is_read_alike_on_every_board(tmp_path: Path, board: str) -> None:
    usual, other = (
        hover(tmp_path / b, "flight.release_us=200000", profile=project(tmp_path), duration_s=0.2, board=b)
        for b in ("c", board)
    )
    assert usual.hash == other.hash


@pytest.mark.long
def test_noise_delay_and_dropout_are_those_of_the_profile(tmp_path: Path) -> None:
    law = (PROJECT / "controller.py.in").read_text(encoding="utf-8")  # which does not read it
    run = hover(
        tmp_path / "run", "sensors.range.noise=0.02", "sensors.range.delay_us=50000", "sensors.range.dropout=0.3",
        profile=project(tmp_path, law=law), duration_s=3.0,
    )  # fmt: skip
    log = load_log(run.folder)
    t, arrived, truth = (column(log, name) for name in ("t", "sensor.range", "truth.z"))
    free = column(log, "flight.free") > 0.5
    assert np.isnan(arrived[free]).mean() == pytest.approx(0.3, abs=0.06)
    then = np.interp(t - 50_000, t, truth)
    error = (arrived - then)[free & np.isfinite(arrived)]
    assert error.std() == pytest.approx(0.02, rel=0.12)
    assert abs(error.mean()) < 0.003
    first = int(np.flatnonzero(np.isfinite(arrived))[0])
    assert t[first] >= 50_000


@pytest.mark.long
def test_several_numbers_are_an_array_and_both_modules_may_read_a_sensor(tmp_path: Path) -> None:
    robot = (
        changed(RANGING, ('{"range": ("range", "m")}', '{"range": ("range", "m"), "flow": ("vx vy", "m/s")}'))
        + FLOW
    )
    law = changed(
        RANGED,
        ("import Sensed", "import F32s, Sensed"),
        ('Sensed("m")]', 'Sensed("m")]\n    flow: Annotated[F32s, 2, Sensed("m/s")]'),
        ("    allocate(", "    if finite(sensed.flow[1]):\n        control.u[0] += sensed.flow[1]\n    allocate("),
    )  # fmt: skip
    run = hover(tmp_path / "run", profile=project(tmp_path, robot, law), duration_s=0.3)
    log = load_log(run.folder)
    assert {"sensor.vx", "sensor.vy", "logic.flow1", "logic.flow2", "logic.range"} <= set(log.column_names)
    seen = column(log, "logic.flow2")
    assert set(seen[np.isfinite(seen)].tolist()) <= set(column(log, "sensor.vy").tolist())


def test_a_law_that_uses_a_missing_sample_ends_in_the_failsafe(tmp_path: Path) -> None:
    law = changed(RANGED, ("    if finite(sensed.range):\n        ez", "    ez"))
    profile = project(tmp_path, law=law)
    run = hover(tmp_path / "run", "sensors.range.dropout=0.2", profile=profile, duration_s=0.3)
    assert run.outcome == "error"
    assert "controller" in str(run.cause)


WRONG = (
    ((), (), ("sensors.rnge.noise=0.1",), "sensors.rnge: the robot has no such sensor"),
    ((), (), ("sensors.range.nose=0.1",), "sensors.range.nose = 0.1: unknown key (did you mean noise?)"),
    ((), (), ("sensors.range.dropout=2",), "sensors.range.dropout = 2: input should be less than or equal to 1"),
    ((), (("range: Ann", "rnge: Ann"), ("sensed.range", "sensed.rnge")), (), "sensed.rnge: the robot has no such sensor"),
    ((), (('Sensed("m")', 'Sensed("cm")'),), (), "sensed.range: 1 in cm; the robot measures 1 in m"),
    (
        (),
        (
            ("import Sensed", "import F32s, Sensed"), ("[f32, Sensed", "[F32s, 2, Sensed"),
            ("sensed.range", "sensed.range[0]"),
        ),
        (), "sensed.range: 2 in m; the robot measures 1 in m",
    ),
    ((), (('Annotated[f32, Sensed("m")]', "f32"),), (), "range: what a sensor measures is Annotated[f32, Sensed("),
    (
        (), (('f32, Sensed("m")', 'i32, Sensed("m")'), ("f32, kernel", "f32, i32, kernel")), (),
        "range: what a sensor measures is Annotated[f32, Sensed(",
    ),
    ((), (("    allocate(", "    sensed.range = f32(0.0)\n    allocate("),), (), "control_law writes sensed"),
    ((("def range", "def rang"),), (), (), "no attribute 'range'"),
    ((("return self.p_WB[2] - self.room.floor", "return self.p_WB"),), (), (), "Robot.range is"),
    ((("return self.p_WB[2] - self.room.floor", "return self.height"),), (), (), "no attribute 'height'"),
    ((('("range", "m")', '("range range", "m")'),), (), (), "logs sensor.range 2 times"),
)  # fmt: skip


@pytest.mark.parametrize(("robot", "law", "overrides", "told"), WRONG)
def test_a_mistake_is_one_line(
    tmp_path: Path, robot: tuple[tuple[str, str], ...], law: tuple[tuple[str, str], ...], overrides: tuple[str, ...],
    told: str,
) -> None:  # fmt: skip
    profile = project(tmp_path, changed(RANGING, *robot), changed(RANGED, *law))
    with pytest.raises(LabError) as refused:
        hover(tmp_path / "run", *overrides, profile=profile, duration_s=0.5)
    first, *more = str(refused.value).splitlines()
    assert told in first
    assert all("controller.py:" in line for line in more)


@pytest.mark.long
def test_a_shipped_robot_has_no_own_sensors(cli: Cli, tmp_path: Path) -> None:
    (tmp_path / "law.py").write_text(RANGED, encoding="utf-8")
    law = f"logic.controller={tmp_path / 'law.py'}"
    assert cli("fly", "hover", "--set", law, "--out", tmp_path / "run") == 2
    assert "sensed.range: the robot has no sensors of its own; its file declares them in `sensed`" in cli.err


def test_the_app_has_a_function_that_is_the_user_s(tmp_path: Path) -> None:
    config = load_config(project(tmp_path))
    app = tmp_path / "app"
    write_app(config, "ball", app)
    source = app / "src" / "own_sensors.c"
    text = source.read_text()
    assert "/* sensed->range = ..; */" in text
    source.write_text(changed(text, ("(void)sensed;", "sensed->range = 1.5f;")))
    write_app(config, "ball", app)
    assert "sensed->range = 1.5f;" in source.read_text()
    flown = App(build_app(app, config), tmp_path / "copy.so")
    assert np.isnan(flown.log("logic.range"))
    flown.boot()
    for step in range(1, 21):
        flown.step(step)
    assert flown.log("logic.range") == 1.5
