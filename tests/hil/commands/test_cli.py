"""The command line as a user meets it: exit codes, one-line errors, files where it says they are."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from firmware_py.extras import install_command
from hil.errors import LabError
from hil.laboratory.recorder import load_log
from hil.live.window import DISPLAYS
from support.command import Cli
from support.serving import FLOATY

pytestmark = pytest.mark.usefixtures("empty_folder")


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
def test_a_failed_limit_is_exit_code_one(cli: Cli) -> None:
    code = cli("fly", "hover", "--set", "tunnel.speed=7", "--out", "crash")
    assert code == 1
    assert "lost" in cli.out


UDP = ("--link", "udp://127.0.0.1:1")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["fly", "hovver"], "experiment 'hovver': unknown; did you mean hover?"),
        (["fly", "hover", "--duration", "-1"], "--duration -1"),
        (["fly", "hover", "--duration", "nan"], "--duration nan"),
        (["fly", "hover", "--duration", "soon"], "'soon' is not a valid float"),
        (["design", "--angle", "nan"], "'--angle': nan is not in the range 0<=x<=70"),
        (["design", "--write", "mine.txt"], "--write mine.txt: a profile's name ends in .toml"),
        (
            ["station", "--link", "udp://127.0.0.1:9", "--duration", "nan"],
            "'--duration': nan is not in the range x>0",
        ),
        (["fly", "hover", "--seed", "-1"], "-1"),
        (["fly", "hover", "--profile", "flaoty"], "did you mean floaty?"),
        (["fly", "hover", "--set", "controller.gain_z=nan"], "controller.gain_z = nan"),
        (["fly", "hover", "--set", "controler.gain_z=1"], "did you mean controller?"),
        (["fly", "hover", "--out", "/proc/floaty/run"], "--out /proc/floaty/run: cannot be written"),
        (["fly", "hover", "--seeds", "2", "--view"], "--seeds 2"),
        (["design", "--profile", "crazyflie"], "takes robots of flat plates; this one's body is crazyflie"),
        (
            ["drag-model", "--profile", "crazyflie"],
            "takes robots of flat plates; this one's body is crazyflie",
        ),
        (["deploy", "write", "app", "--profile", "crazyflie"], "own firmware, not with the app"),
        (["station", *UDP, "--tlog", "t.tlog"], "--tlog t.tlog: --link udp://127.0.0.1:1: only mavlink:"),
        (["station", *UDP, "--out", "a", "--log", "b"], "--log b: --out a has a telemetry.csv"),
        (["param", "list", "--link", "usb://1"], "usb://1: expected radio://"),
        (["fly", "hover", "--seeds", "2", "--perfetto"], "--seeds 2"),
        (["fly", "hover", "--gdb", "3333"], "--gdb 3333: needs one flight with an image as --board"),
        (["serve", "--gdb", "3333"], "--gdb 3333: needs one board and an image as --board"),
        (["fly", "hover", "--bogus"], "No such option"),
        (["serve", "--baud", "9600"], "--baud: now --set serial.baud=N"),
        (["deploy", "export", "app"], "deploy export: now floaty deploy write DIR"),
        (["fly"], "Missing argument"),
        (["report", "nowhere"], "nowhere"),
        (["report", "\x1b]0;x\x07"], r"\x1b]0;x\x07"),
        (["view", "nowhere"], "nowhere"),
        (["view", __file__], "expected a run folder"),
        (["flyy"], "No such command"),
        (["study", "latensy"], "study 'latensy': unknown; did you mean latency?"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_two(cli: Cli, arguments: list[str], message: str) -> None:
    assert message in cli.refusal(*arguments)


def test_list_names_experiments_and_profiles(cli: Cli) -> None:
    assert cli("list") == 0
    shown = cli.out
    assert shown.startswith("hover  ")
    assert {"as-flown", "design-best", "floaty (default)", "lqr"} <= set(
        shown.partition("profiles: ")[2].partition("\n")[0].split(", ")
    )


@pytest.mark.long
def test_perfetto_writes_its_trace(cli: Cli) -> None:
    assert cli("fly", "hover", "--duration", "0.5", "--perfetto", "--out", "run") == 0
    assert "run/flight.perfetto-trace" in cli.out
    assert Path("run/flight.perfetto-trace").stat().st_size > 10_000


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


HEAVY = {
    "numpy", "scipy", "pandas", "pyarrow", "numba", "pydantic", "rerun", "matplotlib", "jinja2", "cflib", "pymavlink",
    "control", "dask", "distributed", "unicorn", "prompt_toolkit",
}  # fmt: skip


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


def test_a_command_imports_no_other() -> None:
    code = "from hil.commands.app import main; import sys; sys.argv = ['floaty', 'new', '-h']; main()"
    code = f"import atexit, sys; atexit.register(lambda: print('DESIGN', 'hil.commands.design' in sys.modules)); {code}"
    shown = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert shown.endswith("DESIGN False\n")


def test_listing_the_studies_loads_neither_an_extra_nor_what_draws() -> None:
    code = "import hil.studies.catalogue, sys; print(*{'scipy.optimize', 'control', 'matplotlib'} & {*sys.modules})"
    found = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert found.stdout.strip() == ""


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
