"""ruff and mypy are part of the tests."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


@pytest.mark.parametrize("command", ["ruff check", "ruff format --check", "mypy"])
def test_the_sources_are_clean(command: str, tmp_path: Path) -> None:
    tool, *arguments = command.split()
    cache = [f"--cache-dir={tmp_path}"]
    ran = subprocess.run(
        [sys.executable, "-m", tool, *arguments, *cache],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert ran.returncode == 0, ran.stdout[-4000:] + ran.stderr[-1000:]
