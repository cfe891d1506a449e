"""The laboratory from Python: what docs/howto/python.md shows, and what else a program may rely on."""

import json
import math
import re
import subprocess
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import hil
from hil import Along, Experiment, Kind, LabError, Metric, Request, Run, fly, knob, load_run
from hil.api import Swarm, command_of, request_of
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.files.recorder import load_log
from support.command import Cli
from support.examples import run_examples

PAGE = Path(hil.__file__).parent.parent / "docs" / "howto" / "python.md"
SHORT = 0.3  # [s]


@pytest.fixture(autouse=True)
def in_an_empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    # A page's own kind, which it replaces, ends with the test.
    monkeypatch.setitem(KINDS, "mocap.slow", KINDS["push.y"])


@pytest.mark.long
def test_the_examples_of_the_page_work(monkeypatch: pytest.MonkeyPatch) -> None:
    names = run_examples(PAGE, monkeypatch)
    assert set(names["late"]) == {0, 60}
    assert Path("push.pdf").read_bytes().startswith(b"%PDF")
    assert b"/Type3" not in Path("push.pdf").read_bytes()
    assert Path("runs/figure-eight-1/report.html").stat().st_size > 10_000
    late = json.loads(Path("later/result.json").read_text())
    assert late["faults"] == ["mocap.slow@0.5:3=0.02", "mocap.slow@2:1=0.05"]
    assert late["metrics"]["age_mean"] > 0.06


def test_every_name_of_the_package_is_there_and_no_other() -> None:
    assert all(hasattr(hil, name) for name in hil.__all__)
    with pytest.raises(AttributeError, match="no attribute 'flyy'"):
        _ = hil.flyy  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    folder = tmp_path_factory.mktemp("api") / "run"
    return fly("hover", folder, duration_s=SHORT, faults=["push.y@0.1=3"])


@pytest.mark.long
def test_a_run_is_read_again_as_it_was_flown(run: Run) -> None:
    again = load_run(run.folder)
    assert repr(again.result) == repr(run.result)
    assert again.experiment is EXPERIMENTS["hover"]
    assert again.log.equals(run.log)
    (begun,) = (event["text"] for event in run.events if "begins" in event["text"])
    assert begun == "fault push.y@0.1=3 begins"
    assert set(run.paths) >= {"log.parquet", "result.json", "events.jsonl", "telemetry.csv"}


def test_the_table_counts_seconds_from_the_release(run: Run) -> None:
    frame = run.to_pandas()
    assert frame.index.name == "s"
    at_release = frame["flight.free"].to_numpy().argmax()
    assert frame.index[at_release] == pytest.approx(0.0, abs=0.011)
    assert frame.index[-1] == pytest.approx(SHORT, abs=0.011)
    assert (run.units["t"], run.units["truth.z"], run.unit_of("rms_x")) == ("us", "m", "m")


@pytest.mark.long
def test_the_progress_of_a_flight_rises_to_one(capsys: pytest.CaptureFixture[str]) -> None:
    shares: list[float] = []
    fly("hover", duration_s=1.0, progress=shares.append)
    assert shares == sorted(shares)
    assert len(shares) > 4
    assert shares[-1] == 1.0
    fly("hover", duration_s=SHORT, progress=True)
    assert capsys.readouterr().err.endswith("hover, seed 1: 100% of 0.3 s\n")


def test_what_a_run_shows_names_the_failed_limit_and_the_folder() -> None:
    run = fly(replace(EXPERIMENTS["hover"], limits={"rms_x": 1e-9, "lost": 0.0}), duration_s=SHORT)
    assert "rms_x = " in repr(run)
    assert "(limit <= 1e-07 cm); runs/hover-1>" in repr(run)
    shown = run._repr_html_()
    assert "<b>failed</b>: hover, seed 1: completed, " in shown
    assert re.search(r"<td>rms_x</td><td>[\d.]+ cm</td><td>&lt;= 1e-07 cm</td><td>FAILS</td>", shown)
    assert "<td>max_x</td>" in shown, "a metric without a limit"
    assert "<p>runs/hover-1</p>" in shown
    assert "report.html" not in run._repr_html_()
    run.paths["result.json"].with_name("report.html").touch()
    assert '<p><a href="runs/hover-1/report.html">runs/hover-1/report.html</a></p>' in run._repr_html_()


@pytest.mark.long
def test_a_request_is_flown_as_it_is() -> None:
    request = Request.of(EXPERIMENTS["hover"], seed=3, duration_s=SHORT)
    assert fly(request).hash == fly("hover", seed=3, duration_s=SHORT, folder="other").hash
    with pytest.raises(LabError, match="a Request has its options already: seed"):
        fly(request, seed=4)


@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, marks=pytest.mark.long),
        pytest.param(
            {"seed": 9, "overrides": ["servo.trim[1]=-4000", "imu.gyro_noise=0.01"]}, marks=pytest.mark.long
        ),
        pytest.param(
            {"faults": ["push.y@0.1=1", "mocap.dropout@0.1:0.1"], "profile": "as-flown", "link": "mavlink"},
            marks=pytest.mark.long,
        ),
    ],
)
def test_the_command_of_a_request_flies_it_again_bit_for_bit(cli: Cli, options: dict[str, object]) -> None:
    request = request_of("yaw-step", duration_s=SHORT, **options)  # type: ignore[arg-type]
    flown = fly(request, "one")
    command = command_of(request)
    assert command is not None
    cli(*shell_words(command)[1:], "--out", "two")
    assert load_run("two").hash == flown.hash


def test_the_command_of_a_request_has_all_that_differs_from_defaults() -> None:
    usual = command_of(request_of("yaw-step"))
    assert usual == "floaty fly yaw-step --seed 1"
    command = command_of(
        request_of(
            "yaw-step", seed=2, duration_s=0.1, profile="as-flown", link="mavlink", overrides=["servo.trim=[1, 2, 3, 4]"],
            faults=["push.y@0=1", "push.z@0:0.05=2"],
        )
    )  # fmt: skip
    assert command == (
        "floaty fly yaw-step --seed 2 --duration 0.1 --profile as-flown --set 'servo.trim=[1, 2, 3, 4]' "
        "--fault push.y@0=1 --fault push.z@0:0.05=2 --link mavlink"
    )
    assert command_of(request_of("hover", board="python")) == "floaty fly hover --seed 1 --board python"


def shell_words(command: str) -> list[str]:
    """Return the words that a shell makes of a command."""
    shown = subprocess.run(
        ["sh", "-c", f"printf '%s\\n' {command}"], capture_output=True, text=True, check=True
    )
    return shown.stdout.splitlines()


def test_an_experiment_without_a_file_has_no_command() -> None:
    hover = EXPERIMENTS["hover"]
    assert command_of(Request.of(replace(hover, duration_s=5.0))) is None
    assert command_of(Request.of(Experiment("mine", "", 1.0, {}))) is None
    assert command_of(request_of("hover", trajectory=Along(lambda t: (0.0, 0.0, 0.0)))) is None


@pytest.mark.long
def test_an_own_metric_has_its_unit_and_a_value_also_where_it_was_not_measured() -> None:
    tilt = Metric("rad", "max", "tilt")
    mine = Experiment("mine", "", SHORT, {"tilt": 1.0}, metrics={"tilt": tilt})
    run = fly(mine)
    assert math.isnan(run.metrics["tilt"])
    assert not run.passed
    assert run.unit_of("tilt") == "rad"
    assert load_run(run.folder).unit_of("tilt") == "rad"
    assert load_run(run.folder).experiment is None


@pytest.mark.long
def test_the_notebook_flies_sweeps_and_plots() -> None:
    cells = json.loads((PAGE.parents[1] / "tutorials" / "fly-sweep-plot.ipynb").read_text(encoding="utf-8"))[
        "cells"
    ]
    names: dict[str, Any] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    moved_cm = names["moved_cm"]
    assert moved_cm == sorted(moved_cm), "the harder the push, the farther"
    assert moved_cm[-1] > 10 > moved_cm[0]
    (line, _) = names["figure"].axes[0].lines
    assert line.get_ydata() == pytest.approx(moved_cm)


def test_names_and_values_are_short_in_a_notebook() -> None:
    assert dir(hil) == sorted(hil.__all__)
    kind = Kind("late", "s", 0.02, 0.0, 0.5, (knob(lambda robot: robot.mocap, "more_latency_us", max),))
    request = Request.of(EXPERIMENTS["hover"], faults=["push.y@1=0.5"], duration_s=2.0)
    assert repr(request) == "<Request hover, seed 1, duration 2.0 s, fault push.y@1=0.5>"
    assert repr(request.experiment).startswith("<Experiment hover, ")
    for value in (request.experiment, kind, hil.Goal((0.0, 0.0, 1.0), 0.0), hil.Metric("m", "max", "far")):
        assert len(repr(value)) < 160
        assert " at 0x" not in repr(value)


def test_a_plot_has_one_axis_per_unit_and_refuses_what_the_log_lacks(run: Run) -> None:
    figure = run.plot("truth.y", "truth.vy", "goal.y", "estimator.pose_age_us", size=(4.0, 5.0))
    position, speed, age = figure.axes
    assert tuple(figure.get_size_inches()) == (4.0, 5.0)
    assert [line.get_label() for line in position.lines[:2]] == ["truth.y", "goal.y"]
    assert position.lines[0].get_ydata() == pytest.approx(run.log.column("truth.y").to_numpy())
    labels = [axes.get_ylabel() for axes in (position, speed, age)]
    assert labels == ["position [m]", "velocity [m/s]", "time [s]"]
    assert {"held", "fault"} <= {text.get_text() for text in figure.legends[0].get_texts()}
    (customary,) = run.plot("truth.y", units="customary").axes
    assert customary.lines[0].get_ydata() == pytest.approx(100 * position.lines[0].get_ydata())
    for units, names in (("customary", ("cm", "deg", "deg")), ("SI", ("m", "rad", "rad"))):
        shown = [axes.get_ylabel() for axes in run.plot(units=units).axes]
        parts = ("position error", "attitude error", "flaps")
        assert shown == [f"{part} [{unit}]" for part, unit in zip(parts, names, strict=True)]
    with matplotlib.rc_context({"lines.linewidth": 3.0, "figure.figsize": (2.0, 3.0), "axes.grid": False}):
        thick = run.plot("truth.y")
    assert thick.axes[0].lines[0].get_linewidth() == 3.0
    assert tuple(thick.get_size_inches()) == (2.0, 3.0)
    with pytest.raises(LabError, match=r"column 'truth\.yy': the log has none"):
        run.plot("truth.yy")


def test_angles_are_columns_although_the_log_has_quaternions(run: Run) -> None:
    w, x, y, z = (run.log.column(f"truth.q{name}").to_numpy() for name in "wxyz")
    expected = Rotation.from_quat(np.stack((x, y, z, w), axis=1)).as_euler("ZYX")[:, ::-1]
    angles = [run.log.column(f"truth.{name}").to_numpy() for name in ("roll", "pitch", "yaw")]
    assert np.abs(expected).max() > 0.05
    assert np.stack(angles, axis=1) == pytest.approx(expected, abs=1e-9)
    assert run.units["truth.roll"] == "rad"
    assert "truth.roll" not in load_log(run.folder).column_names
    assert run.plot("truth.roll").axes[0].get_ylabel() == "angle [rad]"


def test_a_former_module_names_its_place() -> None:
    formers = [f"hil.{room}" for rooms in hil.MOVED.values() for room in rooms] + ["hil.devices.imu"]
    for former in formers:
        with pytest.raises(ModuleNotFoundError) as told:
            import_module(former)
        name, _, now, _ = str(told.value).split()
        assert name in former
        import_module(now)
        assert hil.__file__ != import_module(now).__file__


@pytest.mark.parametrize(("robots", "limit", "words"), [
    ((True, True), True, "all limits hold"), ((True, False, False), True, "robot 2; robot 3"),
    ((False, True), False, "robot 1; too near"),
])  # fmt: skip
def test_a_swarm_names_the_robots_that_failed_by_their_folders_numbers(
    robots: tuple[bool, ...], limit: bool, words: str
) -> None:
    class Limit(SimpleNamespace):
        def __str__(self) -> str:
            return "too near"

    result: Any = SimpleNamespace(
        robots=tuple(SimpleNamespace(passed=one) for one in robots), verdicts=(Limit(holds=limit),), folder="f",
        request=SimpleNamespace(title="t"),
    )  # fmt: skip
    assert repr(Swarm(result)) == f"<t: {words}; f>"


@pytest.mark.parametrize("out", [None, Path("cov")])
def test_a_flight_writes_the_coverage_that_it_was_asked_for(
    out: Path | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = Request.of(EXPERIMENTS["hover"])
    written: list[Path] = []
    monkeypatch.setattr("hil.api.fly_into", lambda *what, **how: "result")
    monkeypatch.setattr("hil.pictures.exports.coverage.write_coverage", written.append)
    run = fly(replace(request, bench=replace(request.bench, coverage=out)))
    assert (run.result, written) == ("result", [out] * (out is not None))
