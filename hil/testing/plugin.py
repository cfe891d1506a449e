"""The pytest plugin: options, the mark `floaty`, the fixture `floaty`, and the report of a failed flight.

The fixture lives as long as the session, because Hypothesis calls a test many times with one fixture; before each test it
is switched to that test. Nothing of the laboratory is loaded before a test requests it.
"""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from hil.laboratory.request import Options
    from hil.testing.choices import Marked, Wanted
    from hil.testing.flights import Flights, Item

HYPOTHESIS = "hypothesispytest"  # the name of its plugin
CHOICE = "floaty_choice"  # the parameter of a test that flies on several
KEEP = ("failed", "all", "none")
FOLDER = "runs/pytest"  # in pytest's root folder
FLIGHTS = pytest.StashKey["Flights"]()
ITEM = pytest.StashKey["Item"]()
WRITTEN = "floaty.baseline"  # the property of a test that wrote one
FIRST = pytest.StashKey[dict[str, str]]()  # the first test failed by a user's error, by the error's text
ALL = pytest.StashKey[list["Item"]]()  # of this process
MARK = (
    "floaty(seeds=20, boards=[...], profiles=[...], links=[...], faults=[...], needs=...): choices of the fixture `floaty`. "
    "seeds: how many, or which; boards: of c, python, cortex-m4; links: radio, mavlink; faults: as of `fly --fault`; "
    "needs: boards, mavlink, radio or lockstep, without which the test is skipped."
)


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("floaty", "flights in the Floaty virtual laboratory")
    group.addoption(
        "--floaty-board", action="append", default=[], metavar="BOARD[,BOARD]",
        help="what executes the flight core: c, python, cortex-m4; overrides the marks",
    )  # fmt: skip
    group.addoption(
        "--floaty-profile", action="append", default=[], metavar="NAME|FILE[,…]",
        help="profiles to fly on; overrides the marks",
    )  # fmt: skip
    group.addoption(
        "--floaty-seeds", type=int, default=0, metavar="N", help="fly seeds 1 to N; overrides the marks"
    )
    group.addoption(
        "--floaty-keep", choices=KEEP, default="failed",
        help="whose run folders are kept, in runs/pytest/ [failed]",
    )  # fmt: skip
    group.addoption(
        "--floaty-link", default="", metavar="LINK",
        help="radio or mavlink: in lockstep; radio://…, udp://… or mavlink:pty: over a real link, in real time; overrides "
        "the marks [radio]",
    )  # fmt: skip
    group.addoption(
        "--floaty-update",
        action="store_true",
        help="write the baselines of `floaty.baseline` instead of comparing",
    )
    group.addoption(
        "--floaty-coverage", type=Path, metavar="OUT",
        help="add the coverage of the firmware image that flies to OUT.info (lcov) and OUT.html",
    )  # fmt: skip
    parser.addini("floaty_profile", "the default profile of tests, a name or a path", default="")


def pytest_configure(config: pytest.Config) -> None:
    """Register the mark, and refuse invalid options."""
    config.addinivalue_line("markers", MARK)
    config.stash[ALL] = []
    if config.getoption("floaty_seeds") < 0:
        raise pytest.UsageError(f"--floaty-seeds {config.getoption('floaty_seeds')}: expected 1 or more")
    if ":" in config.getoption("floaty_link") and getattr(config.option, "numprocesses", None):
        raise pytest.UsageError(
            f"--floaty-link {config.getoption('floaty_link')}: flights in real time fly one at a time; omit -n"
        )


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Repeat a test for every seed, board and profile."""
    if "floaty" not in metafunc.fixturenames:
        return
    from hil.testing.choices import choices_of, name_of

    choices = choices_of(_marked(metafunc.definition), _wanted(metafunc.config))
    if len(choices) > 1:
        metafunc.fixturenames.append(CHOICE)
        metafunc.parametrize(CHOICE, choices, ids=[name_of(choice, choices) for choice in choices])


@pytest.fixture(scope="session")
def floaty(pytestconfig: pytest.Config) -> Flights:
    """Fly experiments and boot boards: `floaty.fly("hover", faults=["push.y@3=2"])`, `floaty.board()`."""
    return _flights(pytestconfig)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Switch the fixture to the test; skip tests that cannot fly here."""
    if "floaty" not in getattr(item, "fixturenames", ()):
        return
    from hil.testing.choices import choices_of, why_not

    marked = _marked(item)
    callspec = getattr(item, "callspec", None)
    parameters = callspec.params if callspec else {}
    choice: Options = parameters.get(CHOICE) or choices_of(marked, _wanted(item.config))[0]
    if reason := why_not(choice, marked.needs):
        pytest.skip(f"floaty: {reason}")
    item.stash[ITEM] = _flights(item.config).begin(item.nodeid, item.path, choice)
    item.config.stash[ALL].append(item.stash[ITEM])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Show a failed test's flights, and record those of every test; show an impossible request in one line."""
    flown = item.stash.get(ITEM, None)
    if flown is None:
        return (yield)
    if not flown.flown:
        return _in_one_line(item, call, (yield))
    from hil.testing.flights import draw, properties_of, text_of, trim, without_deleted

    report = _in_one_line(item, call, (yield))
    keep, root = item.config.getoption("floaty_keep"), item.config.rootpath
    kept = keep == "all" or (keep == "failed" and report.failed)
    if call.when == "call":
        found = [*properties_of(flown, kept, root), *((WRITTEN, path) for path in flown.written)]
        item.user_properties.extend(found)  # those of the next report
        report.user_properties.extend(found)
    if report.failed:
        if (text := without_deleted(flown, kept, report.longreprtext)) != report.longreprtext:
            report.longrepr = text
        if keep != "none" and not flown.failed:
            draw(flown)
        flown.failed = True
        text = text_of(flown, kept, _options(item.config), root)
        if item.config.invocation_params.dir != root:
            text += f"\n(paths are relative to {root})"
        report.sections.append(("floaty flights", text))
    if call.when == "teardown":
        trim(flown, keep == "all")
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Show why a test file cannot be read in one line, where a package or the user's input is the cause."""
    report = yield
    found = report.call.excinfo if report.failed and report.call is not None else None
    if found is not None and (line := _line_of(found.value.__cause__ or found.value)):
        report.longrepr = f"{collector.path.name}: {line}"
    return report


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Remove unkept run folders; until now a longer-lived fixture may have read them."""
    # its summary would load all of Hypothesis, even if no test used it
    if "hypothesis" not in sys.modules and session.config.pluginmanager.has_plugin(HYPOTHESIS):
        session.config.pluginmanager.unregister(name=HYPOTHESIS)
    keep = session.config.getoption("floaty_keep")
    for flown in session.config.stash[ALL]:
        if not (keep == "all" or (keep == "failed" and flown.failed)):
            shutil.rmtree(flown.folder, ignore_errors=True)
    with suppress(OSError):  # a non-empty folder is kept
        (session.config.rootpath / FOLDER).rmdir()


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Report written baselines, and skipped flights also without -rs."""
    passed = terminalreporter.stats.get("passed", [])
    for path in sorted(
        {str(path) for report in passed for name, path in report.user_properties if name == WRITTEN}
    ):
        terminalreporter.write_line(f"floaty: wrote {path}")
    _write_coverage(terminalreporter)
    reasons: dict[str, int] = {}
    for report in terminalreporter.stats.get("skipped", []):
        text = str(report.longrepr[2]) if isinstance(report.longrepr, tuple) else str(report.longrepr)
        if "floaty: " in text:
            reason = text.partition("floaty: ")[2]
            reasons[reason] = reasons.get(reason, 0) + 1
    for reason, count in reasons.items():
        terminalreporter.write_line(f"floaty: {count} not flown: {reason}", yellow=True)


def _coverage(config: pytest.Config) -> Path | None:
    """Return the absolute path of --floaty-coverage."""
    out: Path | None = config.getoption("floaty_coverage")
    return out if out is None else config.invocation_params.dir / out


def _write_coverage(terminal: Any) -> None:
    out = _coverage(terminal.config)
    if out is None:
        return
    from hil.errors import LabError
    from hil.laboratory.files.coverage import COUNTS, file_of
    from hil.pictures.exports.coverage import write_coverage

    if not file_of(out, COUNTS).exists():
        terminal.write_line(f"floaty: no image flew: {out} is not written", yellow=True)
        return
    try:
        shares, info, page = write_coverage(out)
    except LabError as error:
        terminal.write_line(f"floaty: {error}", red=True)
    else:
        terminal.write_line(f"floaty: coverage: {shares}: {info}, {page}")


def _flights(config: pytest.Config) -> Flights:
    from hil.testing.flights import Flights

    if FLIGHTS not in config.stash:
        update, usual = config.getoption("floaty_update"), _wanted(config).usual_profile
        coverage = _coverage(config)
        config.stash[FLIGHTS] = Flights(config.rootpath, config.rootpath / FOLDER, usual, update, coverage)
    return config.stash[FLIGHTS]


def _in_one_line(
    item: pytest.Item, call: pytest.CallInfo[None], report: pytest.TestReport
) -> pytest.TestReport:
    """Show a user's error without a traceback, and only once when it fails many tests."""
    if call.excinfo is None or not (text := _line_of(error := call.excinfo.value)):
        return report
    first = item.config.stash.setdefault(FIRST, {}).setdefault(text, item.nodeid)
    own = [entry for entry in call.excinfo.traceback if entry.path == item.path]
    place = f"{item.path.name}:{own[-1].lineno + 1}: " if own else ""
    line = f"{place}{text}" if first == item.nodeid else f"as in {first}"
    report.longrepr = "\n".join([line, *getattr(error, "__notes__", ())])
    return report


def _line_of(error: BaseException) -> str:
    """Return the line for a user's error or a missing package of an extra; empty for others."""
    from firmware_py.extras import why_missing
    from hil.errors import LabError

    if isinstance(error, ImportError):
        return why_missing(error)
    return str(error) if isinstance(error, LabError) else ""


def _marked(item: pytest.Item) -> Marked:
    """Return the arguments of the nearest mark."""
    from hil.errors import LabError
    from hil.testing.choices import WORDS, Marked

    mark = item.get_closest_marker("floaty")
    if mark is None:
        return Marked()
    wrong = f"{mark.args}: expected {', '.join(f'{word}=' for word in WORDS)}"
    if not mark.args:
        try:
            return Marked.of(mark.kwargs)
        except LabError as error:
            wrong = f": {error}"
    pytest.fail(f"{item.name}: @pytest.mark.floaty{wrong}", pytrace=False)


def _wanted(config: pytest.Config) -> Wanted:
    """Return the options of the command line and pytest's configuration."""
    from hil.board.cores.boards import BOARDS
    from hil.config import DEFAULT_PROFILE
    from hil.testing.choices import Wanted

    boards = _split(config.getoption("floaty_board"))
    for board in boards:
        if board not in BOARDS:
            raise pytest.UsageError(f"--floaty-board {board}: expected {', '.join(BOARDS)}")
    return Wanted(
        config.getoption("floaty_seeds"), boards, _split(config.getoption("floaty_profile")),
        config.getoption("floaty_link"), config.getini("floaty_profile") or DEFAULT_PROFILE,
    )  # fmt: skip


def _split(values: list[str]) -> tuple[str, ...]:
    return tuple(part.strip() for value in values for part in value.split(",") if part.strip())


def _options(config: pytest.Config) -> str:
    """Return the given options that choose seeds, boards and profiles."""
    given = {name: config.getoption(f"floaty_{name}") for name in ("board", "profile")}
    words = [f"--floaty-{name}={value}" for name, values in given.items() for value in values]
    if seeds := config.getoption("floaty_seeds"):
        words.append(f"--floaty-seeds={seeds}")
    return "".join(f"{shlex.quote(word)} " for word in words)
