"""A robot of the user's own: a body in a file flies; every mistake in it is one line."""

import json
from pathlib import Path

import numpy as np
import pytest

from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.bodies import make_body
from hil.laboratory.faults import parse
from hil.laboratory.files.recorder import load_log, stored_in
from hil.laboratory.files.result import Result
from hil.laboratory.metrics import column, free_flight
from hil.pictures import video
from hil.pictures.report import write_report
from hil.pictures.scene import turn_of
from hil.research.identify.record import _flown_with, profile_of
from hil.world.scene import VisualModel
from support.command import Cli
from support.flights import hover
from support.paths import ROOT

PROJECT = ROOT / "hil" / "commands" / "robot_project"
HEAD = "from hil import RigidBody\nclass Robot(RigidBody):\n    mass, inertia = 0.1, (1e-3, 1e-3, 1e-3)\n"
FLOATING = HEAD + "    def wrench(self, wind_B):\n        return (0.0, 0.0, 0.981), (0.0, 0.0, 0.0)\n"


def project(folder: Path, robot: str = "") -> str:
    """Write the project of `floaty new --robot` with another robot.py, and return its profile; all share one controller."""
    profile = (PROJECT / "profile.toml.in").read_text(encoding="utf-8")
    profile = profile.replace('"controller.py"', f'"{PROJECT / "controller.py.in"}"')
    (folder / "profile.toml").write_text(profile, encoding="utf-8")
    robot = robot or (PROJECT / "robot.py.in").read_text(encoding="utf-8")
    (folder / "robot.py").write_text(robot, encoding="utf-8")
    return str(folder / "profile.toml")


def made(folder: Path, robot: str) -> str:
    """Return the line that refuses a robot."""
    config = load_config(project(folder, robot))
    with pytest.raises(LabError) as refused:
        make_body(config, np.random.default_rng(1), (0.0, 0.0, 1.15))
    text = str(refused.value)
    assert "\n" not in text
    return text.replace(f"{folder}/", "")


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Result:
    folder = tmp_path_factory.mktemp("ball")
    return hover(folder / "run", profile=project(folder), duration_s=2.0)


def test_the_ball_of_a_new_project_hovers(flown: Result) -> None:
    assert flown.outcome == "completed"
    assert flown.metrics["rms_z"] < 0.03
    assert len(flown.program.robot) == 64
    assert json.loads((flown.folder / "result.json").read_text())["robot"] == flown.program.robot


@pytest.mark.long
def test_its_log_has_its_motion_and_no_flaps(flown: Result) -> None:
    log = free_flight(load_log(flown.folder))
    assert column(log, "truth.z").mean() == pytest.approx(1.15, abs=0.03)
    assert column(log, "flow.z").mean() == pytest.approx(10.0, abs=0.5)
    assert column(log, "battery.power").min() >= 2.3
    assert not [name for name in log.column_names if name.startswith(("truth.flap", "force."))]


def test_what_is_identified_from_its_flights_changes_its_profile(flown: Result, tmp_path: Path) -> None:
    assert profile_of(flown.folder) == flown.request.profile != "floaty"
    assert profile_of(tmp_path / "telemetry.csv") == "floaty"
    assert _flown_with(flown.folder)[1:] == (
        True,
        pytest.approx(1e-6 * flown.request.config.flight.release_us),
    )


def test_a_body_in_free_fall_falls_as_galileo_found(tmp_path: Path) -> None:
    robot = FLOATING.replace("0.981)", "0.0)")
    body = make_body(load_config(project(tmp_path, robot)), np.random.default_rng(1), (0.0, 0.0, 1.15))
    body.hold()
    body.advance(100_000)
    assert body.specific_force_B == pytest.approx([0.0, 0.0, 9.81])
    body.release()
    body.advance(300_000)
    assert body.p_WB[2] == pytest.approx(1.15 - 0.5 * 9.81 * 0.2**2, abs=1e-6)
    assert body.specific_force_B == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    assert body.lost is None
    body.put_back((0.0, 0.0, 1.0))
    assert body.state.tolist() == [0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_it_may_be_heavier_than_designed_but_has_no_constants_of_floaty(tmp_path: Path) -> None:
    def falls(*overrides: str) -> float:
        config = load_config(project(tmp_path, FLOATING), overrides)
        body = make_body(config, np.random.default_rng(1), (0.0, 0.0, 1.15))
        body.advance(1_000)
        return float(body.specific_force_B[2])

    assert falls() == pytest.approx(9.81)
    assert falls("plant.mass_factor=1.25") == pytest.approx(9.81 / 1.25)
    with pytest.raises(LabError, match=r"plant\.constant_factors and plant\.drag_factor act on floaty only"):
        falls("plant.constant_factors={yaw_u3=1.1}")


@pytest.mark.parametrize("decks", [(), ("flow2",), ("flow2", "multiranger")])
def test_a_crazyflie_is_as_heavy_as_itself_and_its_decks(decks: tuple[str, ...]) -> None:
    config = load_config("crazyflie")
    robot = config.robot.model_copy(update={"decks": decks})
    body = make_body(config.model_copy(update={"robot": robot}), np.random.default_rng(1), (0.0, 0.0, 1.0))
    body.push((1.0, 0.0, 0.0))
    body.advance(1_000)
    mass = {"flow2": 1.6e-3, "multiranger": 2.3e-3}  # [kg] Bitcraze's
    expected = config.quadrotor.mass + sum(mass[name] for name in decks)
    assert 1.0 / body.acceleration_W[0] == pytest.approx(expected, rel=1e-3)  # type: ignore[attr-defined]


@pytest.mark.parametrize("factor", [1.0, 1.25])
def test_a_torque_turns_it_and_a_push_moves_it(tmp_path: Path, factor: float) -> None:
    robot = FLOATING.replace("(0.0, 0.0, 0.0)", "(0.0, 0.0, 1e-3)")
    config = load_config(project(tmp_path, robot), [f"plant.inertia_factor={factor}"])
    body = make_body(config, np.random.default_rng(1), (0.0, 0.0, 1.15))
    body.push((0.0, 0.2, 0.0))
    body.advance(500_000)
    assert body.omega_B == pytest.approx([0.0, 0.0, 0.5 / factor])
    assert body.p_WB == pytest.approx([0.0, 0.5 * 2.0 * 0.25, 1.15], abs=1e-6)


@pytest.mark.parametrize(
    ("robot", "line"),
    [
        ("x = 1", "no Robot in it; expected a class Robot, made of RigidBody"),
        ("class Robot(", "robot.py:1: '(' was never closed"),
        ("def Robot(*_): return 3", "int has no state, p_WB, q_WB"),
        (FLOATING.replace("0.1,", "-1,"), "Robot.mass = -1: expected a number above 0"),
        (FLOATING.replace("(1e-3, 1e-3, 1e-3)", "1e-3"), "Robot.inertia = 0.001: expected 3 numbers above 0"),
        (
            FLOATING.replace("(0.0, 0.0, 0.981)", "(0.0, 0.981)"),
            "Robot.wrench returned ((0.0, 0.981), (0.0, 0.0, 0.0)): expected force and torque, each "
            "of three numbers",
        ),
        (FLOATING.replace("0.981", "1 / 0"), "robot.py:5: ZeroDivisionError: division by zero"),
        (HEAD, "Robot has no method wrench"),
        (FLOATING + "\n    def power(self):\n        return 'much'\n", "Robot.power is 'much': expected a number"),
        (FLOATING + "\n    logged = {'mass': ('a b', '')}\n", "Robot.mass is 0.1: expected 2 numbers"),
        (FLOATING + "\n    logged = {'mass': ('a', ''), 'radius': ('a', '')}\n", "Robot logs robot.a 2 times"),
        (FLOATING + "\n    outputs = ((1, 1), (1, 3))\n", "Robot.outputs = ((1, 1), (1, 3)): expected four"),
        (FLOATING + "\n    outputs = ((1, 1),) * 4\n", "Robot.outputs = ((1, 1), (1, 1), (1, 1), (1, 1)): expected four"),
        (FLOATING + "\n    outputs = ((1, 4), (1, 1), (1, 2), (1, 3))\n", "Robot.outputs = ((1, 4),"),
        (FLOATING + "\n    outputs = ((14, 1), (1, 1), (1, 2), (1, 3))\n", "Robot.outputs = ((14, 1),"),
        (FLOATING + "\n    outputs = 6\n", "Robot.outputs = 6: expected four (timer, channel), of the board's M1 to M4"),
        (FLOATING + "\n    parts = 3\n", "Robot.parts = 3: expected (ball(..), box(..), Part(..))"),
        (FLOATING + "\n    logged = {'spin': ('a', '')}\n", "'Robot' object has no attribute 'spin'"),
    ],
)  # fmt: skip
def test_a_mistake_in_the_file_is_one_line(robot: str, line: str, tmp_path: Path) -> None:
    text = made(tmp_path, robot)
    assert text.startswith(f"robot.body = robot.py: {line}")
    assert not text.endswith(" s"), "it is no instant of a flight"


def test_a_missing_file_and_an_unknown_name_are_one_line(tmp_path: Path) -> None:
    profile = project(tmp_path)
    (tmp_path / "robot.py").unlink()
    with pytest.raises(LabError, match=r"robot\.body = .*robot\.py: No such file or directory"):
        make_body(load_config(profile), np.random.default_rng(1), (0.0, 0.0, 1.15))
    with pytest.raises(
        LabError, match=r"robot\.body = flaoty: neither a body \(did you mean floaty\?\) nor a path"
    ):
        make_body(load_config("floaty", ["robot.body=flaoty"]), np.random.default_rng(1), (0.0, 0.0, 1.15))


@pytest.mark.parametrize(
    ("value", "cause"),
    [
        ("float('nan')", "Robot.wrench returned force [0.0, 0.0, nan] N, torque [0.0, 0.0, 0.0] N m"),
        ("1e300", "Robot.wrench returned force [0.0, 0.0, 1e+300] N, torque [0.0, 0.0, 0.0] N m"),
        ("1 / 0", "robot.py:5: ZeroDivisionError: division by zero"),
        ("float('nan')", "Robot.power returned nan: expected watts"),
    ],
)
def test_a_body_that_fails_in_flight_is_lost_with_the_cause(value: str, cause: str, tmp_path: Path) -> None:
    failing = f"{{}} if self.time_s < 0.2 else {value}"
    robot = FLOATING.replace("0.981", failing.format("0.981"))
    if "power" in cause:
        robot = FLOATING + f"\n    def power(self):\n        return {failing.format('1.0')}\n"
    profile = project(tmp_path, robot)
    result = hover(tmp_path / "run", "flight.release_us=100000", profile=profile, duration_s=0.2)
    assert result.outcome == "lost"
    assert str(result.cause).startswith(f"{cause} at 0.2")


def test_a_body_that_has_failed_is_clamped_where_it_is(tmp_path: Path) -> None:
    robot = FLOATING.replace("0.981", "1.5 if self.time_s < 0.2 else 1 / 0")
    body = make_body(load_config(project(tmp_path, robot)), np.random.default_rng(1), (0.0, 0.0, 1.15))
    body.advance(300_000)
    place = body.state.tolist()
    assert place[2] > 1.2
    assert str(body.lost).endswith("division by zero at 0.20 s")
    body.advance(600_000)
    assert body.state.tolist() == place
    assert body.specific_force_B == pytest.approx([0.0, 0.0, 9.81])
    body.release()
    assert body.specific_force_B == pytest.approx([0.0, 0.0, 0.0]), "nothing pushes it any more"


def test_an_error_in_a_body_s_file_outranks_where_it_was_lost_before(tmp_path: Path) -> None:
    robot = FLOATING.replace("0.981", "5.0 if self.time_s < 1.0 else 1 / 0")
    body = make_body(load_config(project(tmp_path, robot)), np.random.default_rng(1), (0.0, 0.0, 1.15))
    body.advance(900_000)
    assert str(body.lost).startswith("left the flow: 0.85 m above")
    body.advance(1_100_000)
    assert str(body.lost).endswith("division by zero at 1.00 s")


def test_the_tutorial_shows_the_robot_that_a_new_project_has() -> None:
    text = (PROJECT / "robot.py.in").read_text(encoding="utf-8")
    assert f"```python\n{text}```" in (ROOT / "docs/tutorials/your-own-robot.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 80


def test_a_fault_of_floatys_parts_is_refused_for_another_body(tmp_path: Path) -> None:
    with pytest.raises(LabError, match=r"servo\.stuck\.1@1.*acts on a part of floaty only"):
        hover(tmp_path / "run", profile=project(tmp_path), duration_s=2.0, faults=[parse("servo.stuck.1@1")])


@pytest.mark.long
def test_faults_of_the_air_cameras_and_battery_act_on_it(tmp_path: Path) -> None:
    faults = [parse("wind.fan@0.2:0.3=0.5"), parse("mocap.dropout@0.2:0.1"), parse("battery.sag@0.2=0.5")]
    result = hover(
        tmp_path / "run", "markers.enabled=true", profile=project(tmp_path), duration_s=0.6, faults=faults
    )
    log = free_flight(load_log(result.folder))
    assert (column(log, "markers.visible") > 0).all()
    assert column(log, "markers.error").max() < 0.005
    seconds = 1e-6 * (column(log, "t") - column(log, "t")[0])
    assert column(log, "flow.z")[(seconds > 0.25) & (seconds < 0.45)].mean() == pytest.approx(5.0, abs=0.4)
    assert column(log, "battery.voltage")[-1] < column(log, "battery.voltage")[0] - 0.4
    write_report(result.folder)  # with close-ups of the faults


@pytest.mark.long
def test_its_report_and_scene_show_what_it_describes(flown: Result) -> None:
    write_report(flown.folder)
    page = (flown.folder / "report.html").read_text(encoding="utf-8")
    assert "What your own robot logs of itself." in page
    assert "along_x" in page
    assert "True angle of each flap" not in page
    look = VisualModel.read(stored_in(load_log(flown.folder).schema.metadata, "look"))
    assert [part.name for part in look.parts] == ["ball"]
    picture = np.asarray(next(video.frames(load_log(flown.folder))))
    assert (picture[:, : video.SIDE] == (200, 204, 208)).all(axis=2).sum() > 1000  # the ball, pale


TILTING = """
    parts = (
        replace(box((0.02, 0.2, 0.02)), name="nacelle", place=(0.15, 0.0, 0.0), axis=(0.0, 1.0, 0.0), angle="robot.tilt"),
    )
    logged = {"tilt": ("tilt", "rad")}
    tilt = 0.0
    def actuate(self, duration):
        self.tilt += 2.0 * duration
"""


@pytest.mark.long
def test_a_part_with_an_angle_turns_with_its_column(tmp_path: Path) -> None:
    head = "from dataclasses import replace\nfrom hil.world.scene import box\n"
    run = hover(tmp_path / "run", profile=project(tmp_path, head + FLOATING + TILTING), duration_s=0.5)
    log = load_log(run.folder)
    (part,) = VisualModel.read(stored_in(log.schema.metadata, "look")).parts
    tilt = column(log, "robot.tilt")
    assert tilt[-1] - tilt[0] == pytest.approx(2e-6 * (column(log, "t")[-1] - column(log, "t")[0]), abs=0.01)
    assert turn_of(part, log)[-1] == pytest.approx([np.cos(tilt[-1] / 2), 0.0, np.sin(tilt[-1] / 2), 0.0])


WEAK = """
    strength = 1.0
    logged = {"strength": ("strength", "")}

declare("own.weak", Kind("factor on the lift", "", 0.8, 0.0, 1.5, (
    Knob(lambda robot: robot.body.strength, lambda robot, value: setattr(robot.body, "strength", value), lambda a, b: a * b),
), body="robot.py"))
"""


@pytest.mark.long
def test_a_robot_s_own_fault_acts_on_it_alone(cli: Cli, tmp_path: Path) -> None:
    robot = (
        "from hil import Kind, Knob, declare\n" + FLOATING.replace("0.981)", "0.981 * self.strength)") + WEAK
    )
    profile = project(tmp_path, robot)
    fault = ("--fault", "own.weak@0.1:0.2=0.9", "--out", tmp_path / "run")
    assert cli("fly", "hover", "--profile", profile, "--duration", "0.5", *fault) == 0
    log = load_log(tmp_path / "run")
    since = 1e-6 * (column(log, "t") - column(log, "t")[column(log, "flight.free") > 0.5][0])
    during = (since > 0.11) & (since < 0.29)
    assert set(column(log, "robot.strength")[during]) == {0.9}
    assert set(column(log, "robot.strength")[(since < 0.09) | (since > 0.31)]) == {1.0}
    assert cli("fly", "hover", "--duration", "0.5", "--fault", "own.weak@0.1") == 2
    assert "acts on a part of robot.py only; this flight is one of floaty" in cli.err
    (tmp_path / "robot.py").write_text(
        robot.replace("robot.body.strength,", "robot.body.strenght,"), encoding="utf-8"
    )
    assert (
        cli("fly", "hover", "--profile", profile, "--fault", "own.weak@0.1", "--out", tmp_path / "wrong") == 2
    )
    assert "fault own.weak: robot.py:" in cli.err
    assert "no attribute 'strenght'" in cli.err
