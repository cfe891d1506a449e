"""Experiments of one's own: found in files and packages, flown like those that ship, refused in one line."""

import hashlib
import json
import re
import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from ground_station.trajectory import Along, Goal
from hil import fly, load_run
from hil.api import command_of
from hil.errors import LabError
from hil.laboratory.experiment import Experiment, Source
from hil.laboratory.experiments import EXPERIMENTS, find_again, find_experiment
from hil.laboratory.experiments.own import in_file, load_file
from hil.laboratory.fault_kinds import KINDS, Kind, declare
from hil.laboratory.faults import parse
from hil.laboratory.files.recorder import load_log
from hil.laboratory.files.result import read_result
from hil.laboratory.request import Request
from hil.pictures.report import write_report
from hil.research.campaigns.jobs import Job, Plan, fly_job
from hil.servers.linked import linked_flight
from support.command import Cli

pytestmark = pytest.mark.usefixtures("empty_folder")

HEAD = "from hil import Along, Experiment, Fault, Kind, Metric, declare\n"
PLAIN = 'Experiment("mine", "a summary", 0.3, {"lost": 0.0}%s)'
HOME = Goal((0.0, 0.0, 1.15), 0.5)


def write(text: str, path: str = "mine.py") -> None:
    Path(path).write_text(HEAD + text, encoding="utf-8")


# Trajectories


def test_a_function_of_time_moves_the_goal_from_home_after_the_release() -> None:
    course = Along(lambda t: (t, 2.0 * t, -4.0 * t))(Goal((0.0, 0.0, 1.25), 0.5), 1_000_000)
    assert course.at(999_999) == Goal((0.0, 0.0, 1.25), 0.5)
    assert course.at(1_250_000) == Goal((0.25, 0.5, 0.25), 0.5)
    turning = Along(lambda t: np.array([0.0, 0.0, 0.0, t]))(HOME, 0)
    assert turning.at(250_000) == Goal(HOME.p_WG, 0.75)


# Files


@pytest.mark.long
def test_an_experiment_of_a_file_is_flown_and_its_run_names_the_file_and_its_hash() -> None:
    write(
        "def measure(flight): return {'rows': flight.num_rows}\n"
        "wide = "
        + PLAIN
        % ", Along(lambda t: (0.0, t, 0.0)), measure=measure, metrics={'rows': Metric('', 'min', 'how many')}"
        + "\n"
    )
    result = fly("mine.py:wide").result
    source = result.request.experiment.source
    assert source == in_file("mine.py:wide").source
    assert source is not None
    assert source.reference == str(Path("mine.py:wide").absolute())
    assert result.metrics["rows"] == 30.0
    log = load_log(Path("runs/mine-1"))
    assert json.loads(log.schema.metadata[b"request"])["source"]["sha256"] == source.sha256
    assert log.column("goal.y")[-1].as_py() == pytest.approx(0.3, abs=0.02)
    assert find_again("mine", source) is not None
    write("wide = " + PLAIN.replace("0.3", "0.4") % "")
    assert find_again("mine", source) is None


@pytest.mark.long
def test_experiments_of_a_file_fly_in_other_processes_with_the_same_hash(cli: Cli) -> None:
    Path("neighbour.py").write_text("REACH = 0.05\n")
    write(
        "from neighbour import REACH\nwide = " + PLAIN % ", Along(lambda t: (0.0, REACH * t, 0.0))", "mine.py"
    )
    write("other = " + PLAIN % "", "other.py")
    assert cli("list", "other.py") == 0
    Path("other.py").unlink()  # what nobody flies is no matter
    assert cli("fly", "mine.py:wide", "--seeds", "2") == 0
    assert cli("fly", "mine.py:wide", "--seed", "2", "--out", "here") == 0
    assert read_result(Path("here")).hash == read_result(Path("runs/mine-2")).hash


@pytest.mark.parametrize(
    "changed", ["", HEAD + "other = " + PLAIN % "", HEAD + "wide = " + PLAIN % "" + "  # later"]
)
def test_a_file_that_changes_between_the_flights_of_a_sweep_is_named(changed: str) -> None:
    write("wide = " + PLAIN % "")
    job = Plan.of([Job(0, "mine.py:wide", {}, {})]).job(0)
    Path("mine.py").write_text(changed, encoding="utf-8")
    with pytest.raises(LabError, match=r"mine\.py:wide: its file has changed since the first flight"):
        fly_job(job)


def test_a_file_is_executed_once_for_every_content() -> None:
    write("wide = " + PLAIN % "")
    assert (
        load_file("experiment", Path("mine.py"))[0]
        is load_file("experiment", Path("../", Path.cwd().name, "mine.py"))[0]
    )
    first = in_file("mine.py:wide")
    write("wide = " + PLAIN.replace("0.3", "0.5") % "")
    assert (first.duration_s, in_file("mine.py:wide").duration_s) == (0.3, 0.5)


def test_the_only_experiment_of_a_file_needs_no_name() -> None:
    write("wide = " + PLAIN % "")
    assert in_file("mine.py").reference == str(Path("mine.py:wide").absolute())


@pytest.mark.long
@pytest.mark.parametrize(
    ("text", "name", "told"),
    [
        ("wide = " + PLAIN % "", ":wied", "no experiment 'wied' in it; did you mean wide?"),
        ("wide = " + PLAIN % "", ":experiment", "no experiment 'experiment' in it; there is wide"),
        ("a = " + PLAIN % "" + "\nb = a", "", "which one?; there are a, b"),
        ("", ":wide", "no experiment 'wide' in it; there is none"),
        ("wide = (", ":wide", "mine.py:2: '(' was never closed"),
        ("\nimport nowhere", ":wide", "mine.py:3: ModuleNotFoundError: No module named 'nowhere'"),
        ("def f(): return 1 / 0\nf()", ":wide", "mine.py:2: ZeroDivisionError: division by zero"),
        ("wide = " + PLAIN % ", faults=(Fault('pusch.y', 1, 1, 1),)", ":wide", "mine.py:2: fault 'pusch.y': unknown kind"),
        ("wide = " + PLAIN % ", faults=(Fault('push.y', 1, 1, 99),)", ":wide", "mine.py:2: fault push.y: size 99: expected"),
        ("import sys\nsys.exit(0)", ":wide", "mine.py:3: SystemExit: 0"),
        ("wide = " + PLAIN % ", faults=(Fault('push.y', 0.3, 1, 2),)", ":wide",
         "mine.py:2: experiment mine: fault push.y@0.3:1=2: the flight ends 0.3 s after the release"),
        ("wide = Experiment('a', '', 1.0, {'rms_x': float('nan')})", ":wide", "limit on 'rms_x' = nan: expected a number"),
        ("wide = Experiment('a/b', '', 1.0, {})", ":wide", "mine.py:2: experiment 'a/b': a name has letters"),
        ("wide = Experiment('a', '', 0.0, {})", ":wide", "mine.py:2: experiment a: duration_s = 0.0: expected seconds"),
        ("wide = " + PLAIN % ", metrics={'rms_x': Metric('m', 'max', '')}", ":wide", "metric rms_x: every flight has one"),
        ("wide = Experiment('a', '', 1.0, {'rms_q': 1})", ":wide", "limit on 'rms_q': no such metric; did you mean rms_"),
        ("wide = Experiment('a', '', 1.0, {'spede': 1}, metrics={'speed': Metric('', 'max', '')})", ":wide", "mean speed?"),
        ("wide = " + PLAIN % ", settings=('tunnel.sped=8',)", ":wide", "did you mean speed?"),
        ("wide = " + PLAIN % ", Along(lambda t: (0.0, 0.0))", ":wide", "trajectory at 0 s: (0.0, 0.0): expected x, y, z"),
        ("wide = " + PLAIN % ", Along(lambda t: (0.0, 9.0 * t, 0.0))", ":wide", "at 0.06 s: a goal outside the flow"),
        ("wide = " + PLAIN % ", Along(lambda t: wied)", ":wide", "mine.py:2: NameError: name 'wied' is not defined"),
        ("wide = " + PLAIN % ", pictures=('yaw',)", ":wide", "picture 'yaw': there are yaw-step"),
        ("wide = " + PLAIN % ", measure=lambda flight: {'tempo': 1}", ":wide", "measure returned 'tempo', which `metrics`"),
        ("wide = " + PLAIN % ", measure=lambda flight: 1", ":wide", "experiment mine: measure: 'int' object"),
        ("wide = " + PLAIN % ", measure=lambda flight: {}[0]", ":wide", "experiment mine: measure: mine.py:2: KeyError: 0"),
        ("wide = " + PLAIN % ", draw=lambda flight: 1 / 0", ":wide", "experiment mine: draw: mine.py:2: ZeroDivisionError"),
        ("wide = " + PLAIN % ", draw=lambda flight: 1", ":wide", "experiment mine: draw returned 1: expected a matplotlib"),
        ("declare('push.y', Kind('', '', 1.0, 0.0, 2.0, ()))", ":wide", "fault kind push.y: the laboratory has one"),
        ("declare('a@b', Kind('', '', 1.0, 0.0, 2.0, ()))", ":wide", "mine.py:2: fault kind 'a@b': a name has letters"),
        ("declare('a.b', Kind('', '', 3.0, 0.0, 2.0, ()))", ":wide", "mine.py:2: fault kind a.b: size 3 in 0..2"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_one_line_and_exit_code_two(cli: Cli, text: str, name: str, told: str) -> None:
    write(text)
    assert told in cli.refusal("fly", f"mine.py{name}")


def test_a_file_that_is_not_there_is_one_line(cli: Cli) -> None:
    assert cli("fly", "nowhere.py:wide") == 2
    assert cli.err == "floaty: experiment nowhere.py: No such file or directory\n"


def test_the_experiments_of_a_file_are_listed(cli: Cli) -> None:
    write("wide = " + PLAIN % "")
    assert cli("list", "mine.py") == 0
    assert cli.out == "mine.py:wide  a summary\n"


# Kinds of faults


@pytest.mark.long
def test_an_own_kind_of_fault_acts_is_listed_and_shown(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "wind.both", KINDS["push.y"])  # is replaced, and ends with the test
    write(
        "from hil.laboratory.fault_kinds import KINDS\n"
        "knobs = (*KINDS['wind.side_x'].knobs, *KINDS['wind.side_y'].knobs)\n"
        "declare('wind.both', Kind('both', 'm/s', 0.2, -5.0, 5.0, knobs))\n"
        "wide = " + PLAIN % ", faults=(Fault('wind.both', 0.1, 0.1, 0.3),)"
    )
    assert cli("fly", "mine.py:wide", "--fault", "wind.both@0.1=0.2") == 0
    assert read_result(Path("runs/mine-1")).request.faults == ("wind.both@0.1:0.1=0.3", "wind.both@0.1=0.2")
    assert "wind.both" in Path("runs/mine-1/report.html").read_text(encoding="utf-8")
    assert cli("list", "mine.py", "--faults") == 0
    assert re.search(r"^wind\.both +0\.2 m/s +-5\.\.5 +to the end +both", cli.out, re.MULTILINE)
    monkeypatch.delitem(KINDS, "wind.both")
    write_report(Path("runs/mine-1"))
    assert "without its own kinds of faults (wind.both), which need the experiment" in Path(
        "runs/mine-1/report.html"
    ).read_text("utf-8")


def test_an_own_kind_may_be_declared_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(KINDS, "push.mine", KINDS["push.y"])
    declare("push.mine", Kind("", "", 1.0, 0.0, 2.0, KINDS["push.y"].knobs))
    declare("push.mine", Kind("", "", 1.0, 0.0, 5.0, KINDS["push.y"].knobs))
    assert parse("push.mine@1=4").size == 4.0


# Run folders

TRAP = "from pathlib import Path\nPath('executed').touch()\n"
DRAWN = (
    "from matplotlib.figure import Figure\n"
    "def draw(flight):\n    figure = Figure()\n    figure.gca().set_title('drawn by mine')\n    return figure\n"
    "def measure(flight): return {'rows': flight.num_rows}\n"
    "wide = "
    + PLAIN
    % ", measure=measure, metrics={'rows': Metric('', 'min', 'how many')}, draw=draw, pictures=('airspeed',)"
)


@pytest.fixture
def flown() -> Path:
    """The run folder of an experiment whose file, as its profile's modules, leaves a file when it is executed."""
    write(DRAWN)
    run = fly("mine.py:wide", seed=3)
    assert not Path("executed").exists()
    text = Path("mine.py").read_text(encoding="utf-8") + "\n" + TRAP
    Path("mine.py").write_text(text, encoding="utf-8")
    Path("trap.py").write_text(TRAP, encoding="utf-8")
    Path("trap.toml").write_text(
        'base = "floaty"\n[logic]\ncontroller = "trap.py"\n[robot]\nbody = "trap.py"\n'
    )
    # As somebody else might write it: the hash is that of the present file.
    path = run.folder / "result.json"
    result = json.loads(path.read_text(encoding="utf-8"))
    result["source"]["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    result["profile"] = str(Path("trap.toml").absolute())
    path.write_text(json.dumps(result), encoding="utf-8")
    return run.folder


@pytest.mark.long
def test_reading_a_run_executes_nothing_that_it_names(flown: Path, cli: Cli) -> None:
    """Nor do `report` and `compare`, below."""
    for command in (
        ("runs",), ("export", flown, "--csv", "--mcap", "--tlog"), ("identify", flown),
        ("identify", flown, "--profile-out", "out.toml"),
    ):  # fmt: skip
        cli(*command)
        assert not Path("executed").exists(), command


def test_loading_a_run_executes_nothing_that_it_names(flown: Path) -> None:
    run = load_run(flown)
    assert (run.experiment, run.metrics["rows"]) == (None, 30.0)
    assert len(run.to_dataset().t_us) > 0
    assert run.request.config.logic.controller.endswith("trap.py")
    assert command_of(run.request) is None
    assert not Path("executed").exists()
    with pytest.raises(LabError, match=r"^experiment mine: its code was not executed; load_run"):
        fly(run.request)
    assert not Path("executed").exists()


def test_a_report_shows_what_needs_no_code_and_names_the_option_for_the_rest(flown: Path, cli: Cli) -> None:
    assert cli("report", str(flown)) == 0
    reference = str(Path("mine.py:wide").absolute())
    (line,) = cli.err.splitlines()
    assert line.startswith(f"{flown}: without its own picture, which need")
    assert f"--experiment {reference}" in line
    page = (flown / "report.html").read_text(encoding="utf-8")
    assert f"--experiment {reference}" in page
    assert 'id="airspeed"' in page
    assert not Path("executed").exists()
    assert 'id="mine"' not in page


def test_what_the_user_names_is_executed(flown: Path, cli: Cli) -> None:
    assert cli("report", str(flown), "--experiment", "mine.py:wide") == 0
    assert Path("executed").exists()
    assert cli.err == ""
    assert 'id="mine"' in (flown / "report.html").read_text(encoding="utf-8")
    run = load_run(flown, "mine.py:wide")
    assert run.experiment == find_experiment("mine.py:wide")
    with pytest.raises(LabError, match=r"^experiment hover: .*mine-3 is a flight of mine$"):
        load_run(flown, "hover")


@pytest.mark.long
def test_two_flights_of_unequal_length_are_compared_without_code_or_with_what_the_user_names(
    flown: Path, cli: Cli
) -> None:
    fly("hover", "hover", duration_s=0.1)
    assert cli("compare", "hover", str(flown)) == 1
    assert cli.err.startswith("without the own metrics of this span, which need the experiment's code: ")
    assert not Path("executed").exists()
    assert cli("compare", "hover", str(flown), "--experiment", "mine.py:wide") == 1
    assert cli.err == ""
    assert re.search(r"rows +│ +– +│ +10 ", cli.out)


# Packages


def install(text: str, entry: str = "wide-eight = eights.flights:wide", folder: str = "site") -> None:
    """Put a package `eights` with experiments where Python finds it."""
    package = Path(folder, "eights")
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "flights.py").write_text(HEAD + text, encoding="utf-8")
    info = Path(folder, "eights-1.2.dist-info")
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: eights\nVersion: 1.2\n")
    (info / "entry_points.txt").write_text(f"[floaty.experiments]\n{entry}\n")


@pytest.fixture
def site(monkeypatch: pytest.MonkeyPatch, empty_folder: Path) -> None:
    monkeypatch.syspath_prepend(str(Path("site").absolute()))
    for name in ("eights", "eights.flights"):
        monkeypatch.delitem(sys.modules, name, raising=False)


@pytest.mark.long
@pytest.mark.usefixtures("site")
def test_an_installed_experiment_is_listed_with_its_package_and_flown_by_name(cli: Cli) -> None:
    install("wide = " + PLAIN % "")
    assert cli("list") == 0
    (line,) = [line for line in cli.out.splitlines() if line.startswith("wide-eight")]
    assert line.split(maxsplit=1)[1] == "a summary (eights 1.2)"
    result = fly("wide-eight").result
    flown = result.request.experiment
    assert flown.source is not None
    assert (flown.source.reference, flown.source.package) == ("wide-eight", "eights 1.2")
    assert len(flown.source.sha256) == 64
    assert find_again(flown.name, flown.source) == find_experiment("wide-eight")
    with pytest.raises(LabError, match="did you mean wide-eight"):
        find_experiment("wide-eigth")


@pytest.mark.usefixtures("site")
@pytest.mark.parametrize(
    ("text", "entry", "told"),
    [
        ("1 / 0", "wide-eight = eights.flights:wide", "flights.py:2: ZeroDivisionError: division by zero"),
        ("", "wide-eight = eights.flights:wide", "module 'eights.flights' has no attribute 'wide'"),
        ("wide = 1", "wide-eight = eights.flights:wide", "eights.flights:wide is 1: expected an Experiment"),
        ("", "wide-eight = eights.nowhere:wide", "No module named 'eights.nowhere'"),
    ],
)
def test_a_broken_package_is_one_line_and_hides_no_other(cli: Cli, text: str, entry: str, told: str) -> None:
    install(text, entry)
    error = cli.refusal("fly", "wide-eight")
    assert error.startswith("floaty: experiment wide-eight of eights 1.2: ")
    assert told in error
    assert cli("list") == 0
    shown = cli.out
    assert told in shown
    assert "hover  " in shown


@pytest.mark.usefixtures("site")
def test_an_installed_experiment_is_found_by_the_name_of_its_entry_and_has_the_hash_of_its_file() -> None:
    install("wide = " + PLAIN % "")
    found = find_experiment("wide-eight")
    digest = hashlib.sha256(Path("site/eights/flights.py").read_bytes()).hexdigest()
    assert (found.name, found.source) == ("mine", Source("wide-eight", digest, "eights 1.2"))
    assert find_again("mine", found.source) == found


@pytest.mark.usefixtures("site")
def test_an_experiment_that_ships_goes_before_an_installed_one() -> None:
    install("wide = " + PLAIN % "", "hover = eights.flights:wide")
    assert find_experiment("hover") is EXPERIMENTS["hover"]


# Over links


@pytest.mark.parametrize(
    "experiment",
    [
        Experiment("mine", "", 1.0, {}),
        Experiment("hover", "", 1.0, {}, Along(lambda t: (0.0, 0.0, 0.0))),
        Experiment("wide", "", 1.0, {}, Along(lambda t: (0.0, 0.0, 0.0)), source=Source("mine.py:wide", "")),
    ],
)
def test_a_separate_station_is_not_sent_unknown_trajectories(experiment: Experiment, tmp_path: Path) -> None:
    write("wide = " + PLAIN % "")
    request = Request.of(experiment, link="udp://127.0.0.1:19850")
    with pytest.raises(LabError, match="its trajectory must stand in a file or a package"):
        linked_flight(request, tmp_path / "telemetry.csv", ExitStack())


def test_each_file_imports_the_module_that_is_beside_it(tmp_path: Path) -> None:
    """Two projects have files of the same names; the first one is read again after the second."""
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "beside_own.py").write_text(f"NAME = {name!r}\n")
        (tmp_path / name / "own.py").write_text("from beside_own import NAME\n")
    found = [load_file("--experiment", tmp_path / name / "own.py")[0].NAME for name in ("first", "second")]
    (tmp_path / "first" / "own.py").write_text("from beside_own import NAME\nagain = NAME\n")
    found.append(load_file("--experiment", tmp_path / "first" / "own.py")[0].again)
    assert found == ["first", "second", "first"]
    places = [str(tmp_path / name) for name in ("first", "second")]
    assert [path for path in sys.path if path in places] == places


def test_a_file_named_like_a_module_that_is_no_user_s_does_not_take_its_place(tmp_path: Path) -> None:
    (tmp_path / "json.py").write_text("")
    (tmp_path / "own.py").write_text("import json\n")
    assert load_file("--experiment", tmp_path / "own.py")[0].json is json
    assert sys.modules["json"] is json
