"""What users get is what they got: texts, files, pages, pictures and recordings of a fixed set of commands.

A change of a label, unit, order, colour or number shows here first. If one is meant, write the outputs anew and read
what `git diff` shows:

    make approve                      # one alone: PYTHONPATH=tests python tests/approved/test_outputs.py NAME

Of each kind, the first file is there in full, and a later one as a hash of its lines. Source code is a hash of its bytes.
"""

import difflib
import hashlib
import io
import math
import re
import runpy
import shlex
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from matplotlib.figure import Figure

from hil.commands import options
from hil.commands.app import app
from hil.laboratory.files.recorder import load_log
from hil.pictures.drawing import DPI
from hil.research.learn.envs import make_env
from hil.research.learn.tasks import TASKS
from support import described, disturbed, foreign_logs
from support.approved import skip_unless, tiers, versions
from support.command import floaty
from support.paths import ROOT

APPROVED = Path(__file__).parent
SCRIPTS = {
    "flights": """
        fly hover --duration 1.5 --perfetto --set markers.enabled=true
        fly yaw-step --duration 1.5 --seed 3 --fault push.x@0.2 --fault servo.stuck.1@0.6:0.2 --out runs/pushed
        fly hover --duration 1 --fault serial.cut@0.1:0.1 --link mavlink --out runs/cut
        fly hover --duration 1 --baseline runs/hover-1 --out runs/again
        runs
        compare runs/hover-1 runs/pushed
        replay runs/hover-1 --profile original
        report runs/pushed
        export runs/hover-1 --csv --mcap --tlog
        import runs/hover-1/flight.csv --out runs/imported
        fly hover --robots 2 --duration 0.6 --out runs/swarm
        fly hover --seeds 3 --duration 0.6 --workers 1 --out runs/seeds
        fly take-off-landing --duration 2 --out runs/take-off
    """,
    "disturbed": """
        fly gallery.py:EVERY --duration 1 --fault push.x@.1 --fault servo.stuck.3@.5:.3 --fault radio.loss@.5:.2=.5 --out a
        DISTURB a 1
        report a --experiment gallery.py:EVERY
        PLOT a
        export a --csv --mcap
        fly hover --duration 0.8 --link mavlink --profile original --out b
        DISTURB b 2
        report b
        export b --csv
        import b/flight.csv --out c
        DISTURB c 3
        report c
        compare a c --out ac
    """,
    "lists": """
        list
        list --faults
        docs
        HELP
    """,
    "projects": """
        new law
        new robot --robot
        new tilt --tilt-rotor
        check law/controller.py
        fly hover --profile law/profile.toml --duration 0.5 --out runs/law
        fly hover --profile robot/profile.toml --duration 0.5 --out runs/robot
        fly hover --profile tilt/profile.toml --duration 0.5
        deploy write app
        deploy write own --profile law/profile.toml
    """,
    "checked": """
        deploy check --duration 0.1 --targets c-O0
        deploy check take-off-landing --duration 0.1 --targets plain --fault push.y@0.05 --seed 2
    """,
    "tested": """
        PYTEST flown.py -k "not baseline"
        PYTEST flown.py -k seeds --floaty-keep=all --floaty-profile=floaty,lqr --floaty-seeds=3
        PYTEST flown.py -k "seeds or a_baseline" --floaty-update
        PYTEST flown.py -k baseline --floaty-keep=none --floaty-board=c
    """,
    "campaigns": """
        campaign small.toml --workers 1 --out campaign
        campaign small.toml --out campaign --shrink 1
        tune --vary controller.gain_yaw=0.5..1.5 --metric rms_x --duration 0.5 --flights 10 --workers 1 --runs tuned
    """,
    "identification": """
        fly identify-u3 --duration 100 --seeds 2 --workers 1 --out excited
        identify excited/identify-u3-1 --validate excited/identify-u3-2 --profile-out found.toml --out identified
    """,
    "paper": """
        paper --only hover --seeds 1 --no-studies --workers 1
    """,
    "study": """
        study design-updrafts --seeds 1 --workers 1
    """,
    "tuning": """
        tune --robots 10 --out gains.toml
    """,
    "imports": """
        import cfclient.csv --out cfclient
        import "units in brackets.csv" --out brackets
        import "neither, by size.csv" --out sizes
        import "measured beside estimated.csv" "a quaternion.csv"
        import log00 --out card
        import bag.mcap --out bag
        report bag
        fly hover --duration 0.6 --link mavlink --set markers.enabled=true --out flown
        export flown --mcap --tlog --csv
        import flown/flight.mcap --out mcap
        import flown/flight.tlog --out tlog
        import cfclient.csv --map mine.toml --out mapped
        import flown/flight.csv --map tlog/map.toml --out wrong
        import flown/log.parquet --like flown --out liked
        compare liked flown
    """,
    "optimise": """
        design optimise --generations 1 --seed 11 --updrafts 9.5 10 --write best.toml
    """,
    "design": """
        design
        design --json
        design --length 2 --mass 8 --write big.toml
        drag-model
    """,
}
HASHED = (".py", ".c", ".h", ".md", ".css", ".js", ".ld", ".in", ".tlog", ".perfetto-trace")
DATA = (
    ".mcap",
    ".parquet",
    ".rrd",
    ".csv",
    ".jsonl",
    "result.json",
    "campaign.json",
    "report.html",
)  # simulated: exact
FLOWN = (
    "events.jsonl",
    "flight.csv",
    "flight.mcap",
    "flight.rrd",
    "log.parquet",
    "schedule.parquet",
    "telemetry.csv",
)  # whole in "flights"
STEERING = ("CI", "BUILD_NUMBER", "PYTEST_ADDOPTS")  # how much pytest prints
COMPILING = ("floaty: compiling ", options.COMPILING)  # only where it was not yet
VOLATILE = (
    (re.compile(r"^Usage: .*?floaty"), "Usage: floaty"),
    (re.compile(r"\b\d+(\.\d+)? times real time(; \d+(\.\d+)? s from start to end)?"), "N times real time"),
    (re.compile(r"^\d\d-\d\d \d\d:\d\d"), "MM-DD hh:mm"),
    (re.compile(r"\d+\.\d+s$"), "S s"),
    (re.compile(r"\b0x[0-9a-f]{10,}"), "0x…"),
    (re.compile(r'("commit": ")[^"]*'), r"\1C"),
    (re.compile(r"\bcommit( \| | )(?:none|unknown|[0-9a-f]{7,}\+?|(?=,|$))"), r"commit\1C"),
    (re.compile(r"\"versions\": \{.*?\}"), "versions V"),
    (re.compile(r"RecordingInfo:start_time: (1 )?\S+"), "RecordingInfo:start_time: T"),
    (re.compile(r"(versions:|versions \|) .*"), "versions V"),
    (re.compile(r"python \d\S*, floaty-hil .*"), "versions V"),
    (re.compile(r"(real_time_factor|speed) [\d.e+-]+"), "speed S"),
)


def helps(group: click.Group = app, *before: str) -> Iterator[str]:
    """Yield the call of every command's help."""
    yield " ".join((*before, "--help"))
    context = click.Context(group)
    group._help_option = None  # a test that walks the commands makes click keep one without -h
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        command._help_option = None
        if isinstance(command, click.Group):
            yield from helps(command, *before, name)
        else:
            yield " ".join((*before, name, "--help"))


def reference() -> Iterator[str]:
    """Yield the generated pages about the profile's keys, variables, columns and faults."""
    for name, text in runpy.run_path(str(ROOT / "tools" / "reference_pages.py"), run_name="pages")[
        "pages"
    ]().items():
        yield f"--- {name}"
        yield from text.splitlines()


def learned() -> Iterator[str]:
    """Yield what each environment of `hil.research.learn` answers to the same random actions."""
    for task in TASKS:
        for fidelity in ("fast", "firmware"):
            rng = np.random.default_rng(3)
            env = make_env(task, fidelity, duration_s=0.6)
            seen, info = env.reset(seed=5)
            for _ in range(2):
                rows, ended = [seen], False
                while not ended:
                    seen, reward, lost, over, info = env.step(rng.uniform(-0.3, 0.3, 4).astype(np.float32))
                    rows, ended = [*rows, np.append(seen, reward)], lost or over
                yield f"{task} {fidelity}: {lost} {over} {described.numbers(np.concatenate(rows))}; {info}"
                seen, info = env.reset()


def disturb(_: str, run: str, seed: str) -> int:
    """Put random values into a log, and write its recording anew."""
    from hil.pictures.viewer.recording import write_run_rrd

    disturbed.disturb(Path(run), int(seed))
    write_run_rrd(Path(run))
    return 0


def plot(_: str, run: str) -> int:
    """Draw columns, and errors and actuators, of a run in all units."""
    from hil.pictures.drawing import UNITS, plotted

    log = load_log(Path(run))
    for units in UNITS:
        for columns in (
            (),
            ("truth.x", "control.u1", "estimate.x", "estimator.pose_age_us", "battery.charge"),
        ):
            plotted(log, columns, units).savefig(io.BytesIO())
    return 0


def run_pytest(_: str, *words: str) -> int:
    """Run pytest with the plugin."""
    sys.modules.pop("flown", None)
    without = (f"no:{name}" for name in ("cacheprovider", "faulthandler", "warnings", "xdist"))
    options = (
        *(f"-p{name}" for name in without),
        "--import-mode=importlib",
        "--no-header",
        "-q",
        "--tb=short",
    )
    return int(pytest.main([*options, *words]))


OTHERWISE = {"DISTURB": disturb, "PLOT": plot, "PYTEST": run_pytest}  # in place of a command


def live() -> Iterator[str]:
    """Yield what live pictures show."""
    from support.watched_flight import watched

    with tempfile.TemporaryDirectory() as folder:
        yield from (plain(line, folder) for line in watched(Path(folder)))


def programs() -> Iterator[str]:
    """Yield what the Python board answers to each program of requests, without the tolerances of other boards."""
    from hil.board.board_firmware import PythonBoard
    from hil.deploy.service_programs import PROGRAMS
    from hil.deploy.services import ServiceBench, play_in_copies

    played = play_in_copies(ServiceBench(PythonBoard()), PROGRAMS.values())
    for name, answers in zip(PROGRAMS, played, strict=True):
        path = described.numbers(np.ravel(answers.path))
        yield f"{name}: {'; '.join(line.partition(': ')[2] for line in answers.lines)}; path {path}"


PYTHON = {
    "reference": reference,
    "learned": learned,
    "live": live,
    "programs": programs,
}


def plain(text: str, place: str) -> str:
    """Return a line without what is another one's on another machine, day or commit."""
    text = text.replace(place, "PLACE").replace(str(ROOT), "ROOT")
    for pattern, shown in VOLATILE:
        text = pattern.sub(shown, text)
    return text.rstrip()


def outputs(name: str) -> Iterator[str]:
    """Yield what a script prints, draws and writes."""
    yield from PYTHON[name]() if name in PYTHON else printed(name)


def printed(name: str) -> Iterator[str]:
    """Yield what a script's commands print, draw and write."""
    figures: list[str] = []
    save, seen = Figure.savefig, set[str]() if name == "flights" else set(FLOWN)

    def show(figure: Figure, file: io.BytesIO, **_: Any) -> None:
        figures.extend(described.figure(figure))
        if name == "campaigns":  # whose report has links at places in its picture
            save(figure, io.BytesIO(), dpi=DPI)
        file.write(b"a picture")  # to draw takes a third of the time

    with tempfile.TemporaryDirectory() as folder, chdir(folder), pytest.MonkeyPatch.context() as patch:
        place = str(Path(folder).resolve())
        for source in ("small.toml", "gallery.py", "flown.py"):
            shutil.copy(APPROVED / source, folder)
        if name == "imports":
            foreign_logs.write_all(Path())
        patch.setattr(Figure, "savefig", show)
        patch.setenv("COLUMNS", "140")
        for variable in STEERING:
            patch.delenv(variable, raising=False)
        for console in (options.console, options.notices):
            patch.setattr(console, "width", 140)
        script = SCRIPTS[name].replace("HELP", "\n".join(helps()))
        for command in filter(None, map(str.strip, script.splitlines())):
            before = {path: path.stat().st_mtime_ns for path in Path().rglob("*")}
            said = io.StringIO()
            with redirect_stdout(said), redirect_stderr(said):
                code = OTHERWISE.get(command.split()[0], floaty)(*shlex.split(command))
            yield f"$ floaty {command}"
            lines = [line for line in said.getvalue().splitlines() if not line.startswith(COMPILING)]
            yield from (plain(line, place) for line in (*lines, f"exit code {code}", *figures))
            figures.clear()
            for path in sorted(Path().rglob("*")):
                if path.suffix != ".pyc" and path.is_file() and before.get(path) != path.stat().st_mtime_ns:
                    yield from written(path, place, seen)


def written(path: Path, place: str, seen: set[str]) -> Iterator[str]:
    """Yield a file's name and lines; of a kind that was seen their hash."""
    if path.suffix in HASHED:
        yield f"--- {path} {hashlib.sha256(path.read_bytes()).hexdigest()[:16]}"
        return
    lines = [plain(line, place) for line in described.lines_of(path)]
    digest = hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]
    if path.name in seen and (path.suffix in DATA or path.name in DATA):
        yield f"--- {path} {digest}"
    else:
        seen.add(path.name)
        yield f"--- {path}"
        yield from lines


NUMBER = re.compile(r"(?<![\w.])-?\d+\.?\d*(?:e[-+]?\d+)?(?![\w])")


def close(line: str, known: str, share: float) -> bool:
    """Whether two lines differ at most in digits that another processor's linear algebra changes, a share of a number."""
    if NUMBER.sub("#", line) != NUMBER.sub("#", known):
        return False
    pairs = zip(NUMBER.findall(line), NUMBER.findall(known), strict=True)
    return all(
        a == b or ("." in a + b and math.isclose(float(a), float(b), rel_tol=share, abs_tol=1e-9))
        for a, b in pairs
    )


LONG = (
    "campaigns",
    "design",
    "identification",
    "optimise",
    "paper",
    "programs",
    "projects",
    "study",
    "tested",
    "tuning",
)
# Their gains have four digits, the last of which a processor may choose.
SEARCHED = ("design", "optimise", "tuning")
PACKAGES = (
    "click",
    "foxglove-sdk",
    "matplotlib",
    "pytest",
    "rerun-sdk",
    "rich",
    "scipy",
)  # shape the outputs


@pytest.mark.parametrize("name", tiers((*SCRIPTS, *PYTHON), LONG))
def test_users_get_what_they_got(name: str) -> None:
    (made_with, *known), found = (APPROVED / f"{name}.txt").read_text().splitlines(), [*outputs(name)]
    if len(found) == len(known):
        share = 1.1e-3 if name in SEARCHED else 1e-4
        found = [old if close(line, old, share) else line for line, old in zip(found, known, strict=True)]
    difference = list(difflib.unified_diff(known, found, "approved", "now", lineterm="", n=1))
    if difference:
        skip_unless(made_with, versions(*PACKAGES))
    assert not difference, "\n".join(difference[:60])


if __name__ == "__main__":
    for one in sys.argv[1:] or (*SCRIPTS, *PYTHON):
        sys.stdout.write(f"{one}\n")
        (APPROVED / f"{one}.txt").write_text("\n".join([versions(*PACKAGES), *outputs(one)]) + "\n")
