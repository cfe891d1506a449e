"""The tiers of the tests, and what holds in each.

A test in `tests/realtime/` or marked `realtime` needs the wall clock and a part of a core: such tests run side by side
(`make test-all`), but alone where marked `alone`, and whenever they are repeated. One that fails while this machine
stood still is inconclusive, and skipped when the last repetition is, too. All other tests pass however busy the machine
is.
A test that exceeds its tier's time limit fails (pytest-timeout); one that does not even return from C takes its process
with it, and pytest-xdist names it and goes on. Property tests try the same examples on every machine, and
look for new ones with FLOATY_FUZZ set.
"""

import faulthandler
import fcntl
import gc
import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings

pytest.register_assert_rewrite("support")  # what a helper asserts is shown, too

from support.serving import SERVED, STANDSTILL  # noqa: E402

if TYPE_CHECKING:
    from support.command import Cli

settings.register_profile("reproducible", derandomize=True, deadline=None)  # a first call compiles
if "FLOATY_FUZZ" not in os.environ:
    settings.load_profile("reproducible")

REALTIME, TOOLS = Path(__file__).parent / "realtime", Path(__file__).parent / "tools"
STANDSTILL_MS = 100  # of the test's own process, which no real-time test need survive
METER_PERIOD_S = 0.005
STEADY_MS, STEADY_S = 20, 5.0  # a machine runs steadily when a busy process misses no longer time for so long
PATIENCE_S = 120.0  # that the tests of one session wait for a steady machine, together
LIMITS_S = {
    "realtime": 600.0,
    "long": 600.0,
    "fast": 300.0,
}  # of one test with its fixtures, on a busy machine
GRACE_S = 60.0  # from a test's limit until its process ends, because C code lets no exception through


# Workers share the cores: more threads of a linear algebra would only wait for one another. Read when numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The sessions that `pytester` starts have another home, but the same compiled code.
os.environ.setdefault("XDG_CACHE_HOME", str(Path.home() / ".cache"))


@pytest.fixture(autouse=True)
def _own_search_path() -> Iterator[None]:
    """Remove what `floaty` in this process sets for the programs that it starts: those of tests import `support`."""
    yield
    os.environ.pop("PYTHONSAFEPATH", None)


class InconclusiveError(Exception):
    """A real-time test failed on a machine that stood still: it says nothing. `make test-all` repeats it twice."""


class StallMeter(threading.Thread):
    """Measures the longest time [ms] that this process did not run when it was due."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.longest_ms = 0.0

    def run(self) -> None:
        before_s = time.monotonic()
        while True:
            threading.Event().wait(METER_PERIOD_S)
            now_s = time.monotonic()
            self.longest_ms = max(self.longest_ms, 1000 * (now_s - before_s - METER_PERIOD_S))
            before_s = now_s


METER = StallMeter()


class SteadyMachine:
    """Waits, before a test that was inconclusive is repeated, until this machine runs steadily again."""

    def __init__(self) -> None:
        self.doubtful = False
        self._left_s = PATIENCE_S

    def wait(self) -> None:
        """Wait if a test was inconclusive; not longer than there is patience."""
        before_s = start_s = steady_since_s = time.monotonic()
        while self.doubtful and before_s - start_s < self._left_s:
            now_s = time.monotonic()
            if 1000 * (now_s - before_s) > STEADY_MS:
                steady_since_s = now_s
            self.doubtful = now_s - steady_since_s < STEADY_S
            before_s = now_s
        self.doubtful = False
        self._left_s -= before_s - start_s


MACHINE = SteadyMachine()


GATE, ROOM = 0, 1  # bytes of the file that are locked


class Turns:
    """Lets real-time tests of all workers run side by side, or one alone: who waits to be alone lets nobody in before."""

    def __init__(self, session: str) -> None:
        self._path = Path(tempfile.gettempdir()) / f"floaty-turns-{session}"
        self._file = os.open(self._path, os.O_CREAT | os.O_RDWR)

    def take(self, alone: bool) -> None:
        """Wait for a turn."""
        self.leave()
        fcntl.lockf(self._file, fcntl.LOCK_EX, 1, GATE)
        fcntl.lockf(self._file, fcntl.LOCK_EX if alone else fcntl.LOCK_SH, 1, ROOM)
        fcntl.lockf(self._file, fcntl.LOCK_UN, 1, GATE)

    def leave(self) -> None:
        """Let others run alone."""
        fcntl.lockf(self._file, fcntl.LOCK_UN, 1, ROOM)

    def close(self) -> None:
        """Close what the constructor opened."""
        os.close(self._file)
        self._path.unlink(missing_ok=True)  # those who have it open keep it


STDERR = pytest.StashKey[int]()  # where a test that has to be ended is reported: nothing captures it
TURNS = pytest.StashKey[Turns]()


def pytest_configure(config: pytest.Config) -> None:
    """Let Ctrl-C reach the programs under test when these tests run in the background of a shell, which ignores it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    config.stash[STDERR] = os.dup(2)
    config.stash[TURNS] = Turns(os.environ.get("PYTEST_XDIST_TESTRUNUID", str(os.getpid())))


def pytest_unconfigure(config: pytest.Config) -> None:
    """Close what `pytest_configure` opened."""
    os.close(config.stash[STDERR])
    config.stash[TURNS].close()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the tests in `tests/realtime/`, and give every test its time limit; those of the tools, minutes long, begin."""
    for item in items:
        if item.path.is_relative_to(REALTIME):
            item.add_marker("realtime")
        if config.pluginmanager.hasplugin("timeout"):  # `make` installs it
            item.add_marker(pytest.mark.timeout(limit_s(item), method="signal"))
    items.sort(key=lambda item: not item.path.is_relative_to(TOOLS))


def limit_s(item: pytest.Item) -> float:
    """Return the time limit [s] of a test's tier."""
    return next((limit for tier, limit in LIMITS_S.items() if tier in item.keywords), LIMITS_S["fast"])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[Any]:
    """End the process of a test that its time limit did not end."""
    faulthandler.dump_traceback_later(limit_s(item) + GRACE_S, exit=True, file=item.config.stash[STDERR])
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()
        item.config.stash[TURNS].leave()


def pytest_collection_finish() -> None:
    """Spare the garbage collector what stays anyway: modules and tests, a sixth of the time of `make test`."""
    gc.collect()
    gc.freeze()


def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers of `-n auto`."""
    return os.cpu_count() or 1


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[Any]:
    """Judge a fixture that fails, once it is a real-time test's turn."""
    if "realtime" in item.keywords:
        repeated = getattr(item, "execution_count", 1) > 1
        item.config.stash[TURNS].take(alone=repeated or "alone" in item.keywords)
    MACHINE.wait()
    return (yield from judged(item))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[Any]:
    """Judge a test that fails."""
    return (yield from judged(item))


def judged(item: pytest.Item) -> Iterator[Any]:
    """Call a real-time test inconclusive when it fails while this process or a server that it uses stood still."""
    if "realtime" not in item.keywords:
        return (yield)
    if not METER.is_alive():
        METER.start()
    METER.longest_ms = 0.0
    heard = {served: len(served.standstills_ms) for served in SERVED}
    try:
        return (yield)
    except Exception as error:
        for served in SERVED:
            served.listen()
        served_ms = sum(sum(served.standstills_ms[heard.get(served, 0) :]) for served in SERVED)
        served_ms += sum(int(ms) for ms in STANDSTILL.findall(str(error)))  # a program that the test shows
        if METER.longest_ms > STANDSTILL_MS or served_ms:
            text = (
                f"the machine stood still for {METER.longest_ms:.0f} ms, its servers for {served_ms:.0f} ms"
            )
            MACHINE.doubtful = True
            if METER.longest_ms > STANDSTILL_MS and is_last_repetition(item):
                pytest.skip(f"inconclusive at last: {text}: {type(error).__name__}")
            raise InconclusiveError(f"{text}: {type(error).__name__}: {error}") from error
        raise


def is_last_repetition(item: pytest.Item) -> bool:
    """Whether pytest-rerunfailures repeats tests, and this one no more."""
    repetitions = item.config.getoption("reruns", None) or 0
    return 0 < repetitions < getattr(item, "execution_count", 1)


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the exported app for this host, once for all files; an `App` runs a copy of it."""
    from support.crazyflie_app import build_app

    return build_app(tmp_path_factory.mktemp("app"))


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> "Cli":
    """The command line in this process."""
    from support.command import Cli

    return Cli(capsys)


@pytest.fixture
def empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A new folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Show why each test that was repeated had failed."""
    for report in terminalreporter.stats.get("rerun", ()):
        terminalreporter.section(f"why it was repeated: {report.nodeid}", sep="_")
        terminalreporter.write_line(report.longreprtext)
