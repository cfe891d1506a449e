"""`floaty new`: what it makes flies and tests at once, in the clone and where the package is installed as a wheel."""

import subprocess
import sys
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest

import hil
from hil.api import request_of
from hil.laboratory.experiments import find_experiment
from hil.laboratory.files.recorder import load_log
from hil.laboratory.files.result import read_result
from support.command import Cli
from support.full_disk import small_files
from support.installed_wheel import install, run

pytestmark = pytest.mark.usefixtures("empty_folder")

ROOT = Path(hil.__file__).parent.parent
FILES = [
    ".gitignore", "README.md", "conftest.py", "controller.py", "experiments.py", "profile.toml", "pyproject.toml",
    "tests/test_flight.py",
]  # fmt: skip


def files_in(folder: Path) -> list[str]:
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_a_project_has_everything_that_a_flight_and_a_test_need(cli: Cli) -> None:
    assert cli("new", "deep/My Law") == 0
    project = Path("deep/My Law")
    assert files_in(project) == sorted(FILES)
    assert "cd deep/My Law; floaty fly hover --profile profile.toml" in cli.out
    about = tomllib.loads((project / "pyproject.toml").read_text())["project"]
    assert about["name"] == "my-law"
    assert about["dependencies"] == [], "a requirement by a name that anybody may register"
    assert all("{{" not in (project / name).read_text(encoding="utf-8") for name in FILES)
    assert find_experiment(f"{project}/experiments.py:figure_eight").duration_s == 12.0


@pytest.mark.long
def test_pytest_without_the_laboratory_is_one_line(cli: Cli) -> None:
    assert cli("new", "law") == 0
    code = "import sys; sys.modules['firmware_py'] = None; import pytest; sys.exit(pytest.main(['-p', 'no:floaty']))"
    ran = subprocess.run([sys.executable, "-c", code], cwd="law", capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (pytest.ExitCode.USAGE_ERROR, "")
    assert ran.stderr.strip().startswith(
        f"ERROR: {sys.executable} has no laboratory (floaty-hil): run the pytest of"
    )
    assert ran.stderr.strip().count("\n") == 0


@pytest.mark.long
def test_files_that_an_editor_begins_with_the_mark_of_utf8_are_read(cli: Cli) -> None:
    assert cli("new", "law") == 0
    for path in (Path("law/profile.toml"), Path("law/controller.py"), Path("law/experiments.py")):
        path.write_text(path.read_text(encoding="utf-8"), encoding="utf-8-sig")
    assert cli("check", "law/controller.py") == 0
    request = request_of("law/experiments.py:figure_eight", profile="law/profile.toml")
    assert request.config.logic.controller.endswith("law/controller.py")


def test_an_empty_folder_becomes_a_project(cli: Cli) -> None:
    Path("law").mkdir()
    assert cli("new", "law") == 0
    assert files_in(Path("law")) == sorted(FILES)


def test_this_folder_becomes_a_project(cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert cli("new", ".") == 0
    assert 'name = "here"' in Path("pyproject.toml").read_text()


@pytest.mark.parametrize(
    ("folder", "told"),
    [
        ("taken", "floaty: new taken: it exists and is not empty; choose a folder that is new or empty\n"),
        ("file", "floaty: new file: it exists and is not empty; choose a folder that is new or empty\n"),
        ("---", "floaty: new ---: a project's name, its folder's, has letters a to z or digits\n"),
        ("file/law", "floaty: new file/law: Not a directory\n"),
    ],
)
def test_an_impossible_folder_is_one_line(cli: Cli, tmp_path: Path, folder: str, told: str) -> None:
    Path("taken").mkdir()
    Path("taken/controller.py").write_text("years of work")
    Path("file").touch()
    assert cli("new", "--", folder) == 2
    assert cli.err == told
    assert files_in(tmp_path) == ["file", "taken/controller.py"]
    assert Path("taken/controller.py").read_text() == "years of work"


@pytest.mark.long
@pytest.mark.parametrize("command", [("new",), ("deploy", "write")])
def test_after_a_full_disk_the_same_folder_can_be_written(cli: Cli, command: tuple[str, ...]) -> None:
    with small_files(1500):
        assert "mine: File too large" in cli.refusal(*command, "mine")
    assert cli(*command, "mine") == 0


@pytest.mark.long
@pytest.mark.parametrize("kind", ["--robot", "--tilt-rotor"])
def test_a_project_of_a_robot_flies_and_its_tests_pass(
    kind: str, cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert cli("new", kind, "ball") == 0
    assert files_in(Path("ball")) == sorted({*FILES, "robot.py"} - {"experiments.py", "pyproject.toml"})
    monkeypatch.chdir("ball")
    assert cli("fly", "hover", "--profile", "profile.toml", "--duration", "3") == 0
    assert read_result(Path("runs/hover-1")).program.robot  # the hash of the robot that flew
    assert Path("runs/hover-1/report.html").is_file()
    assert ("robot.tilt_left" in load_log(Path("runs/hover-1")).column_names) == (kind == "--tilt-rotor")
    assert "2 passed" in run(tmp_path / "ball", sys.executable, "-m", "pytest").stdout


@pytest.mark.long
def test_a_project_passes_tests(cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert cli("new", "law") == 0
    monkeypatch.chdir("law")
    assert cli("fly", "hover", "--profile", "profile.toml", "--duration", "3") == 0
    flown = read_result(Path("runs/hover-1"))
    assert flown.program.logic  # the hash of the controller that flew
    assert "logic.integral" in load_log(Path("runs/hover-1")).column_names
    assert [verdict.metric for verdict in flown.verdicts][:3] == ["lost", "in_box", "within_6cm_y"]
    assert "4 passed" in run(tmp_path / "law", sys.executable, "-m", "pytest").stdout


@pytest.mark.long
def test_a_project_outside_the_clone_flies_tests_checks_and_exports_with_the_wheel(tmp_path: Path) -> None:
    run(ROOT, sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path)
    (wheel,) = tmp_path.glob("floaty_hil-*.whl")
    programs, packages = install(wheel, tmp_path)
    python, command = programs / "python", programs / "floaty"
    assert run(tmp_path, python, "-c", "import hil; print(hil.__file__)").stdout.startswith(str(packages))

    run(tmp_path, command, "new", "law")
    project = tmp_path / "law"
    run(project, command, "fly", "hover", "--profile", "profile.toml", "--duration", "5")
    run(project, python, "-m", "pytest", "-q", "--junitxml=junit.xml")
    properties = [
        (one.attrib["name"], one.attrib["value"])
        for one in ElementTree.parse(project / "junit.xml").iter("property")
    ]
    assert ("floaty.hash", read_result(project / "runs" / "hover-1").hash) in properties
    checked = run(
        project, command, "deploy", "check", "hover", "--profile", "profile.toml", "--duration", "0.5",
        "--targets", "c-O2",
    ).stdout  # fmt: skip
    assert "no bit differs" in checked
    run(project, command, "deploy", "write", "app", "--profile", "profile.toml")
    assert any("integral" in path.read_text() for path in (project / "app").rglob("*.c"))
