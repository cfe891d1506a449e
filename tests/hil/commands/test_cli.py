"""The command line as a user meets it: exit codes, one-line errors, files where it says they are."""

import json
import os
import re
import signal
import subprocess
import sys
import sysconfig
import tomllib
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import pytest

import hil
from firmware_py.extras import EXTRAS, install_command, why_missing
from hil import fly, load_run
from hil.commands.app import COMMANDS, GROUPS, MOVED, app
from hil.commands.fly import fly as fly_command
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.files.recorder import load_log
from hil.laboratory.request import Bench, Options
from hil.live.window import DISPLAYS
from support.command import Cli
from support.serving import FLOATY

pytestmark = pytest.mark.usefixtures("empty_folder")

ROOT = Path(hil.__file__).parents[1]
# Packages of packages, those of the pytest plugin, and one for mypy.
WITH_OTHERS = {
    "PIL", "libusb_package", "pydantic_core", "rerun_bindings", "usb", "hypothesis", "pytest", "_typeshed",
}  # fmt: skip


@pytest.mark.long
def test_fly_writes_everything_and_prints_where(cli: Cli, tmp_path: Path) -> None:
    assert cli("fly", "hover", "--duration", "3", "--seed", "5") == 0
    folder = tmp_path / "runs" / "hover-5"
    expected = {
        "log.parquet", "events.jsonl", "telemetry.csv", "schedule.parquet", "result.json", "flight.rrd", "report.html",
    }  # fmt: skip
    assert {path.name for path in folder.iterdir()} == expected
    shown = cli.out
    assert "within_6cm_x" in shown
    assert "runs/hover-5/report.html" in shown
    assert re.search(r"completed; \d+ times real time; \d+\.\d s from start to end; hash \w{16}\n", shown)
    assert json.loads((folder / "result.json").read_text())["passed"] is True


@pytest.mark.long
def test_a_flight_that_leaves_its_baseline_is_compared_with_it(cli: Cli) -> None:
    fly_it = ("fly", "hover", "--duration", "0.4")
    fly("hover", "before", duration_s=0.4)
    assert cli(*fly_it, "--baseline", "before", "--out", "same") == 0
    assert cli.out.endswith("within 10 % of before\n")
    assert cli(*fly_it, "--baseline", "before", "--out", "pushed", "--fault", "push.y@0.1=0.3") == 1
    assert load_run("pushed").passed
    assert re.search(
        r"rms_y .* cm .*first difference: row .*left before by more than 10 %: rms_y", cli.out, re.DOTALL
    )
    for wrong in (("--baseline", "nowhere"), ("--baseline", "before", "--seeds", "2")):
        assert wrong[1] in cli.refusal(*fly_it, *wrong)


def test_pages_are_found_by_topic_and_by_words(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    assert cli("docs") == 0
    assert re.search(r"^tests +Your own tests$", cli.out, re.MULTILINE)
    assert cli("docs", "howto/tests.md") == 0
    page = cli.out
    assert page == (ROOT / "docs/howto/tests.md").read_text("utf-8")
    assert cli("docs", "own", "logic") == 0
    assert cli.out.startswith("# Your own logic\n")
    assert cli("docs", "Hypothesis", "shrink") == 0
    assert re.match(r"tests  Your own tests\n    .*\n    .* Sizes shrink ", cli.out)
    assert "floaty docs TOPIC prints a page" not in cli.out
    assert cli("docs", "air-time") == 0, "hyphens are spaces"
    assert "did you mean tests?" in cli.refusal("docs", "tesst")
    launched: list[str] = []
    monkeypatch.setattr(click, "launch", lambda path: launched.append(path) or len(launched) - 1)
    assert (cli("docs", "tests", "--open"), cli.out) == (0, "")
    assert "no program opens it here" in cli.refusal("docs", "tests", "--open")


def test_the_help_lists_daily_commands_before_rare_ones(cli: Cli) -> None:
    assert cli("--help") == 0
    headings = [line for line in cli.out.splitlines() if re.fullmatch(r"\w.*:", line)]
    assert headings == ["Options:", *(f"{heading}:" for heading in GROUPS)], "every command is in a group"
    listed = re.findall(r"^  ([\w-]+)  ", cli.out.partition("Every day:")[2], re.MULTILINE)
    assert sorted(listed) == sorted(COMMANDS)
    assert listed[0] == "fly"


def test_list_names_experiments_and_profiles(cli: Cli) -> None:
    assert cli("list") == 0
    shown = cli.out
    assert shown.startswith("hover  ")
    assert {"as-flown", "design-best", "floaty (default)", "lqr"} <= set(
        shown.partition("profiles: ")[2].partition("\n")[0].split(", ")
    )


@pytest.mark.long
def test_seeds_fly_in_other_processes_with_the_same_hash(cli: Cli) -> None:
    assert cli("fly", "hover", "--duration", "1", "--seed", "4", "--seeds", "2") == 0
    assert "2 seeds: 2 hold all limits, 0 lost" in cli.out
    assert cli("fly", "hover", "--duration", "1", "--seed", "4", "--out", "here") == 0
    elsewhere, here = (json.loads(Path(p, "result.json").read_text()) for p in ("runs/hover-4", "here"))
    assert elsewhere["hash"] == here["hash"]


def rows_on_disk() -> int:
    try:
        return int(load_log(Path("run")).num_rows)
    except LabError:
        return 0


def start(*arguments: str) -> "subprocess.Popen[str]":
    """Start the command and wait until a second of the flight is on disk."""
    process = subprocess.Popen(
        [*FLOATY, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    while rows_on_disk() < 100:
        assert process.poll() is None, process.stdout.read()
    return process


@pytest.mark.long
def test_a_killed_flight_can_still_be_reported(cli: Cli, tmp_path: Path) -> None:
    process = start("fly", "hover", "--realtime", "--duration", "600", "--out", "run")
    process.kill()
    process.communicate(timeout=60)
    assert not Path("run/log.parquet").exists()
    assert load_log(tmp_path / "run").num_rows >= 100
    assert cli("report", "run") == 0


@pytest.mark.long
@pytest.mark.parametrize(
    ("arguments", "module", "extra"),
    [
        (["fly", "hover", "--link", "mavlink"], "pymavlink", "mavlink"),
        (["fly", "hover", "--link", "mavlink:pty"], "pymavlink", "mavlink"),
        (["fly", "hover", "--link", "mavlink:pty"], "serial", "mavlink"),
        (["fly", "hover", "--link", "radio://0/80/2M/E7E7E7E7E7"], "cflib", "radio"),
        (["fly", "hover", "--link", "udp://127.0.0.1:19850"], "cflib", "radio"),
        (["fly", "hover", "--board", "radio://0/80/2M/E7E7E7E7E7"], "cflib", "radio"),
        (["fly", "hover", "--board", "cortex-m4"], "unicorn", "deploy"),
        (["fly", "hover", "--board", "cortex-m4"], "elftools", "deploy"),
        (["fly", "hover", "--board", "cortex-m4"], "ziglang", "deploy"),
        (["fly", "hover", "--board", __file__], "unicorn", "deploy"),
        (["serve", "--mavlink", "pty"], "pymavlink", "mavlink"),
        (["identify", "runs/hover-1"], "scipy", "identify"),
        (["tune"], "control", "design"),
        (["design"], "control", "design"),
        (["design", "optimise"], "scipy", "design"),
        (["paper"], "scipy", "design"),
    ],
)
def test_a_missing_package_is_one_line_before_anything_is_flown_or_deleted(
    cli: Cli, arguments: list[str], module: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("runs/hover-1").mkdir(parents=True)
    Path("runs/hover-1/log.parquet").write_bytes(b"an older flight")
    monkeypatch.setitem(sys.modules, module, None)
    assert cli.refusal(*arguments).endswith(f": {module} is missing: {install_command(extra)}\n")
    assert Path("runs/hover-1/log.parquet").is_file()


IMPORTED = re.compile(r"^ *(?:import|from) (\w+)[\w.]*(?: import .*| as \w+)?$", re.MULTILINE)


@pytest.mark.long
def test_every_package_of_an_extra_has_its_line_when_it_is_missing() -> None:
    ours = ("firmware_py", "ground_station", "hil")
    files = [file for one in ours for file in (ROOT / one).rglob("*.py") if "__pycache__" not in file.parts]
    named = {name for file in files for name in IMPORTED.findall(file.read_text(encoding="utf-8"))}
    foreign = named.difference(ours, sys.stdlib_module_names, WITH_OTHERS)
    assert foreign >= {"numpy", "rerun", "unicorn"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = {re.split(r"[^\w-]", one)[0] for one in project["dependencies"]}
    assert foreign - EXTRAS.keys() <= required
    for module, extra in EXTRAS.items():
        of_extra = " ".join(project["optional-dependencies"][extra]).lower().replace("-", "_")
        assert {"google": "perfetto"}.get(module, module.lower()) in of_extra
        assert (
            why_missing(ImportError(name=f"{module}.part"))
            == f"{module} is missing: {install_command(extra)}"
        )
    assert why_missing(ImportError(name="hil.gone")) == ""


# Commands that load a package late; the others are above.
LATE = [
    ("view runs/hover-1", "rerun"), ("view runs/hover-1 --view web", "rerun"), ("fly hover --perfetto", "perfetto"),
    ("fly hover --perfetto", "google"), ("fly hover --view web", "tornado"), ("serve --view foxglove", "foxglove"),
    ("fly hover --view connect:127.0.0.1:1", "rerun"), ("fly hover --view foxglove", "foxglove"),
    ("export runs/hover-1 --mcap", "foxglove"), ("export runs/hover-1 --video", "av"),
    ("export runs/hover-1 --tlog", "pymavlink"), ("policy x.onnx --out p", "onnx"), ("study latency", "scipy"),
    ("policy x.safetensors --out p", "safetensors"), ("campaign table", "SALib"), ("deploy check", "unicorn"),
    ("campaign table --cluster tcp://127.0.0.1:1", "distributed"), ("station --link udp://127.0.0.1:1", "cflib"),
    ("station --link mavlink:/dev/null", "serial"), ("param list --link udp://127.0.0.1:1", "cflib"),
    ("station --link udp://127.0.0.1:1 --mocap vicon:127.0.0.1", "motioncapture"),
    ("board doctor udp://127.0.0.1:1", "cflib"), ("deploy flash x.bin --uri radio://0/80/2M/E7E7E7E7E7", "cflib"),
]  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("command", "module"), LATE)
def test_a_package_that_is_loaded_late_has_its_line_too(command: str, module: str, tmp_path: Path) -> None:
    """In processes of their own, so that nothing is loaded yet; those that they start miss it as well."""
    fly("hover", duration_s=0.05)
    for name in ("x.onnx", "x.safetensors", "x.bin"):
        Path(name).touch()
    (tmp_path / "without").mkdir()
    (tmp_path / "without/sitecustomize.py").write_text(f"import sys\nsys.modules[{module!r}] = None\n")
    path = os.pathsep.join((str(tmp_path / "without"), str(ROOT)))
    ended = subprocess.run(
        [*FLOATY, *command.split()],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 2, ended.stderr
    line = ended.stderr.splitlines()[-1]
    assert re.match(rf"floaty: .*\b{module}\b.*-m pip install ", line), ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.long
@pytest.mark.parametrize(
    "command",
    ["list", "--help", "fly hover --duration 0.05", "report runs/hover-1", "export runs/hover-1 --csv", "new mine"],
)  # fmt: skip
def test_an_output_that_is_full_is_one_line_after_the_work(
    cli: Cli, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    fly("hover", duration_s=0.05)
    (Path("runs/hover-1") / "report.html").unlink(missing_ok=True)
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert cli.refusal(*command.split()) == "floaty: standard output: No space left on device\n"
    written = {"fly": "runs/hover-1/result.json", "report": "runs/hover-1/report.html"}
    written |= {"export": "runs/hover-1/flight.csv", "new": "mine/controller.py"}
    assert Path(written.get(command.split()[0], ".")).exists()


def test_an_output_whose_reader_has_ended_is_as_in_other_programs(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with open(writer, "w") as broken:
        monkeypatch.setattr(sys, "stdout", broken)
        assert (cli("list"), cli.err) == (128 + signal.SIGPIPE, "")
    monkeypatch.setattr(sys, "stdout", None)
    assert (cli("list"), cli.err) == (0, "")


NOBODY = 54_321  # a user without a name, a home folder or a cache


@pytest.mark.long
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can become another user")
def test_a_user_without_a_name_and_a_home_flies_beside_the_folders_of_others() -> None:
    with TemporaryDirectory() as place:  # pytest's own folders are closed to others
        own, temporary = Path(place, "own"), Path(place, "tmp")
        for folder in (own, temporary, temporary / f"_jinja2-cache-{NOBODY}", temporary / f"floaty-{NOBODY}"):
            folder.mkdir()
        for folder, mode in ((Path(place), 0o755), (own, 0o777), (temporary, 0o1777)):
            folder.chmod(mode)

        paths = os.pathsep.join((str(ROOT), sysconfig.get_paths()["purelib"]))
        environment = {"PATH": os.defpath, "TMPDIR": str(temporary), "PYTHONPATH": paths}

        def ran(python: str, *arguments: str) -> subprocess.CompletedProcess[str]:
            return subprocess.run(
                (python, *arguments), user=NOBODY, group=NOBODY, extra_groups=[], cwd=own, env=environment,
                capture_output=True, text=True, check=False,
            )  # fmt: skip

        def reaches(python: str) -> bool:
            try:
                return ran(python, "-c", "import numpy, hil").returncode == 0
            except OSError:
                return False

        system = f"/usr/bin/python{sys.version_info.major}.{sys.version_info.minor}"
        python = next(filter(reaches, (sys.executable, system)), None)
        if python is None:
            pytest.skip(f"other users reach neither {sys.executable} nor {system}")
        flown = ran(python, "-m", "hil.commands", "fly", "hover", "--duration", "0.1", "--out", "run")
        assert flown.returncode in (0, 1), flown.stderr
        assert "Traceback" not in flown.stderr
        assert (own / "run/report.html").is_file()
        assert {path.name for path in own.iterdir()} == {"run"}


HEAVY = {
    "numpy", "scipy", "pandas", "pyarrow", "pydantic", "rerun", "matplotlib", "jinja2", "cflib", "pymavlink",
    "control", "dask", "distributed", "unicorn", "prompt_toolkit",
}  # fmt: skip


@pytest.mark.long
def test_no_help_loads_what_is_slow_to_load() -> None:
    """Of every command and command of a group; each imports only its own file."""
    code = f"""
import sys
import click
from hil.commands.app import app

def show(command, *names):
    context = click.Context(command, info_name=names[-1])
    assert command.get_help(context)
    for name in command.list_commands(context) if isinstance(command, click.Group) else ():
        show(command.get_command(context, name), *names, name)

show(app, "floaty")
print(*sorted({HEAVY!r} & {{*sys.modules}}))
"""
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert found.stdout.strip() == ""


def test_every_field_of_a_bench_is_an_option_of_the_api_and_of_fly() -> None:
    names = {one.name for one in fields(Bench)}
    assert names <= Options.__annotations__.keys()
    assert names <= {one.name for one in fly_command.params}


OPTION = re.compile(r"(?<![\w-])--[a-z][a-z0-9-]*")
KEY = re.compile(r"--set[ =](?!section)([a-z]+)\.([a-z0-9_]+)=")
OTHER_PROGRAMS = {
    "--help", "--version", "--settings",  # of `python -m ground_station`
    "--editable", "--master",  # of uv, of MAVProxy
    "--dirty", "--porcelain", "--branch", "--no-ahead-behind", "--untracked-files", "--no-optional-locks",  # git
    "--bind", "--new", "--port", "--serve-web", "--web-viewer-port", "--server-memory-limit",  # rerun
}  # fmt: skip


@pytest.mark.long
def test_every_option_and_key_that_a_text_names_exists() -> None:
    plugin = ROOT / "hil" / "testing" / "plugin.py"
    known = OTHER_PROGRAMS | MOVED.keys() | set(OPTION.findall(plugin.read_text(encoding="utf-8")))
    groups: list[click.Group] = [app]
    for group in groups:
        context = click.Context(group)
        commands = [group.get_command(context, name) for name in group.list_commands(context)]
        groups += [one for one in commands if isinstance(one, click.Group)]
        parameters = [parameter for one in commands if one is not None for parameter in one.params]
        known |= {option for one in parameters for option in (*one.opts, *one.secondary_opts)}
    texts = {
        path: path.read_text(encoding="utf-8")
        for package in ("firmware_py", "ground_station", "hil")
        for path in (ROOT / package).rglob("*.py")
    }
    assert {one for text in texts.values() for one in OPTION.findall(text)} - known == set()
    config = load_config()
    for path, text in texts.items():
        for section, key in KEY.findall(text):
            assert hasattr(getattr(config, section), key), (path, section, key)


@pytest.mark.long
def test_a_command_imports_no_other() -> None:
    code = "from hil.commands.app import main; import sys; sys.argv = ['floaty', 'new', '-h']; main()"
    code = f"import atexit, sys; atexit.register(lambda: print('DESIGN', 'hil.commands.design' in sys.modules)); {code}"
    shown = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert shown.endswith("DESIGN False\n")


@pytest.mark.long
def test_a_module_loads_what_it_needs_alone() -> None:
    """One after the other in one process, each without what it need not load."""
    steps = {
        "import hil": "numpy pydantic hil.api",
        "import hil.testing.plugin": "numpy hil.api hypothesis",
        "import hil.laboratory.experiments": "matplotlib",
        "hil.fly": "matplotlib cflib rerun",
        "import hil.research.studies.catalogue": "scipy.optimize control matplotlib",
    }
    code = "import sys\n" + "".join(
        f"{step}\nprint({step!r}, *{{*{late.split()}}} & {{*sys.modules}})\n" for step, late in steps.items()
    )
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert found.stdout.splitlines() == list(steps)


@pytest.mark.parametrize("option", ["--board", "--link"])
def test_an_older_run_is_kept_where_no_board_answers(cli: Cli, option: str) -> None:
    Path("runs/hover-1").mkdir(parents=True)
    Path("runs/hover-1/result.json").write_bytes(b"of an older flight")
    assert cli("fly", "hover", option, "radio://7/80/2M/E7E7E7E7E7") == 2
    assert "radio://7" in cli.err
    assert [path.name for path in Path("runs/hover-1").iterdir()] == ["result.json"]


@pytest.mark.long
def test_without_rerun_the_flight_flies_and_names_it(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    for module in ("hil.pictures.viewer", "hil.pictures.viewer.recording"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    assert cli("fly", "hover", "--duration", "0.5", "--out", "run") == 0
    assert "view" in cli.err
    assert not Path("run/flight.rrd").exists()
    assert Path("run/report.html").exists()


@pytest.mark.long
@pytest.mark.parametrize("view", [["--view", "--realtime"], ["--view", "wbe"]])
def test_a_viewer_that_fails_is_one_line(cli: Cli, view: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in DISPLAYS:
        monkeypatch.delenv(name, raising=False)
    assert cli("fly", "hover", *view, "--out", "run") == 2
    (line,) = [line for line in cli.err.splitlines() if line.startswith("floaty: ")]
    assert "--view web" in line or "--view wbe: expected" in line
    assert not Path("run").exists()


@pytest.mark.long
def test_programs_that_a_command_starts_import_nothing_from_the_current_folder(empty_folder: Path) -> None:
    for name in ("json", "multiprocessing", "numpy", "hil"):
        (empty_folder / f"{name}.py").write_text("open('executed', 'w')", encoding="utf-8")
    command = [Path(sys.executable).with_name("floaty"), "fly", "hover", "--seeds", "2", "--duration", "0.1"]
    subprocess.run(command, capture_output=True, check=False)
    assert len(list(Path("runs").glob("hover-*/result.json"))) == 2
    assert not Path("executed").exists()
