"""Laws of the tool that plants mistakes, on a project of two lines."""

import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import ROOT

PYTHON = "def count(n):\n    return abs(n) + 1\n"
C = "int steps(int n) { return n <= 0 ? 0 : n + 1; }\n"
C_TEST = """import ctypes, subprocess

def test_three_steps_are_four(tmp_path):
    subprocess.run(["cc", "-shared", "-fPIC", "-o", tmp_path / "steps.so", "room/steps.c"], check=True)
    assert ctypes.CDLL(str(tmp_path / "steps.so")).steps(3) == 4
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    for name in ("mutants.py", "mutants.rules"):
        (tmp_path / "tools").mkdir(exist_ok=True)
        (tmp_path / "tools" / name).write_bytes((ROOT / "tools" / name).read_bytes())
    (tmp_path / "room").mkdir()
    (tmp_path / "tests" / "room").mkdir(parents=True)
    (tmp_path / "tests" / "room" / "test_count.py").write_text(
        "from room.count import count\n\ndef test_it():\n    assert count(3) == 4\n"
    )
    (tmp_path / "room" / "count.py").write_text(PYTHON)
    (tmp_path / ".gitignore").write_text("runs/\n__pycache__/\n")
    subprocess.run(["git", "init", "--quiet"], cwd=tmp_path, check=True)
    return tmp_path


def mutants(project: Path, code: int) -> str:
    command = [sys.executable, "tools/mutants.py", "room", "--jobs", "1"]
    ran = subprocess.run(command, cwd=project, capture_output=True, text=True, check=False)
    assert ran.returncode == code, ran.stdout + ran.stderr
    return ran.stdout + ran.stderr


@pytest.mark.long
def test_mistakes_are_caught_or_shown_and_only_survivors_are_planted_again(project: Path) -> None:
    assert "room: 3 of 3 caught" in mutants(project, 0)
    assert "caught, " not in mutants(project, 0).replace("3 of 3 caught", "")  # nothing was run again
    weak = project / "tests" / "room" / "test_count.py"
    (project / "room" / "count.py").write_text(PYTHON.replace("+", "-"))  # its mistakes are new ones
    weak.write_text("from room.count import count\n\ndef test_it():\n    assert count(3) is not None\n")
    shown = mutants(project, 1)
    assert "room/count.py survived\n@@ -2 +2 @@\n-    return abs(n) - 1\n+    return abs(n) + 1" in shown
    assert "1 of 3 caught" in shown
    weak.write_text("from room.count import count\n\ndef test_it():\n    assert count(3) == 2\n")
    assert "room: 3 of 3 caught" in mutants(project, 0)


@pytest.mark.long
def test_a_test_that_fails_without_a_mistake_is_an_error(project: Path) -> None:
    (project / "room" / "count.py").write_text("def count(n):\n    return 5 * n\n")
    assert "tests/room/test_count.py: a test fails without a mistake" in mutants(project, 2)


@pytest.mark.long
def test_mistakes_in_c_are_caught_or_shown(project: Path) -> None:
    (project / "room" / "steps.c").write_text(C)
    (project / "room" / "count.py").unlink()
    (project / "tests" / "room" / "test_count.py").write_text(C_TEST)
    shown = mutants(project, 1)
    assert "+int steps(int n) { return n < 0 ? 0 : n + 1; }" in shown
    assert "+int steps(int n) { return n <= 0 ? 0 : n - 1; }" not in shown
