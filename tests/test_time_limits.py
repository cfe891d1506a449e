"""The time limits of the tests: a test without an end is named, and the rest goes on."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import ROOT

CONFTEST = f"""
import importlib.util
spec = importlib.util.spec_from_file_location("tiers", {str(ROOT / "tests" / "conftest.py")!r})
tiers = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tiers)
tiers.LIMITS_S, tiers.GRACE_S = {{"long": 2.0, "fast": 0.5}}, 0.5
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


@pytest.mark.long
@pytest.mark.parametrize("workers", [0, 1])
def test_a_test_without_an_end_is_named_and_the_rest_goes_on(tmp_path: Path, workers: int) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    (tmp_path / "test_endless.py").write_text(TESTS)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = long: takes long\n")
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-v", "-n", str(workers), "-p", "no:cacheprovider", tmp_path],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT / "tests")},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    shown = ran.stdout + ran.stderr
    assert ran.returncode == 1, shown
    assert " in test_endless_in_c\n" in shown, shown
    if not workers:
        assert re.search(r"::test_endless_in_python .*?FAILED", shown, re.DOTALL), shown
        assert "::test_longer_than_fast PASSED" in shown, shown
    else:  # another worker takes over
        assert "Failed: Timeout (>0.5s) from pytest-timeout." in shown, shown
        assert "crashed while running 'test_endless.py::test_endless_in_c'" in shown, shown
        assert "2 failed, 3 passed" in shown, shown
