"""The tiers of the tests: one without an end is named, and the rest goes on; one that fails on a machine that stands still
is repeated."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import ROOT

CONFTEST = f"""
import importlib.util, types
spec = importlib.util.spec_from_file_location("tiers", {str(ROOT / "tests" / "conftest.py")!r})
tiers = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tiers)
tiers.LIMITS_S, tiers.GRACE_S = {{"realtime": 60.0, "long": 2.0, "fast": 0.5}}, 0.5
tiers.STEADY_S = 0.0
tiers.METER = types.SimpleNamespace(is_alive=lambda: True, longest_ms=0.0)  # no clock decides
globals().update({{name: value for name, value in vars(tiers).items() if name.startswith("pytest_")}})
"""
TESTS = """
import collections, itertools, time
import pytest

def test_endless_in_python():
    while True:
        pass

def test_after_it():
    pass

@pytest.mark.long
def test_longer_than_fast():
    time.sleep(1.2)

def test_endless_in_c():  # which looks for no signal
    collections.deque(itertools.repeat(0), maxlen=0)

def test_last():
    pass
"""


MACHINES = """
import sys
import pytest

pytestmark = pytest.mark.realtime
conftest = sys.modules["conftest"].tiers

def stand_still():
    conftest.METER.longest_ms = 101.0

def test_on_a_machine_that_stands_still():
    stand_still()
    assert False

def test_on_one_that_stood_still_once(request):
    if request.node.execution_count == 1:
        stand_still()
        assert False

def test_on_one_that_stood_still_before(request):
    if request.node.execution_count == 1:
        stand_still()
    assert False

def test_that_is_wrong():
    assert False
"""


def failing(folder: Path, tests: str, *options: str) -> str:
    """Return what pytest shows of tests of which some fail, with this project's tiers."""
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_tiers.py").write_text(tests)
    (folder / "pytest.ini").write_text(
        "[pytest]\nmarkers =\n  long: takes long\n  realtime: needs the clock\n  alone: not with others\n"
    )
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-v", *options, "-p", "no:cacheprovider", folder],
        cwd=folder,
        env={"PYTHONPATH": str(ROOT / "tests")},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ran.returncode == 1, ran.stdout + ran.stderr
    return ran.stdout + ran.stderr


@pytest.mark.long
def test_a_failure_on_a_machine_that_stands_still_says_nothing_and_any_other_counts(tmp_path: Path) -> None:
    shown = failing(tmp_path, MACHINES, "--reruns", "2", "-rsf")
    assert "2 failed, 1 passed, 1 skipped, 7 rerun" in shown, shown
    assert "inconclusive at last: the machine stood still for 101 ms" in shown, shown
    for name in ("stood_still_before", "is_wrong"):
        assert re.search(rf"FAILED test_tiers.py::test_\w*{name} - assert False", shown), shown
    shown = failing(tmp_path, MACHINES)
    assert shown.count("InconclusiveError: the machine stood still for 101 ms"), shown


@pytest.mark.long
@pytest.mark.parametrize("workers", [0, 1])
def test_a_test_without_an_end_is_named_and_the_rest_goes_on(tmp_path: Path, workers: int) -> None:
    shown = failing(tmp_path, TESTS, "-n", str(workers))
    assert " in test_endless_in_c\n" in shown, shown
    if not workers:
        assert re.search(r"::test_endless_in_python .*?FAILED", shown, re.DOTALL), shown
        assert "::test_longer_than_fast PASSED" in shown, shown
    else:  # another worker takes over
        assert "Failed: Timeout (>0.5s) from pytest-timeout." in shown, shown
        assert "crashed while running 'test_tiers.py::test_endless_in_c'" in shown, shown
        assert "2 failed, 3 passed" in shown, shown
