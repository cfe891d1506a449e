"""Compiled code is never older than its sources, wherever it is kept, and is kept as long as they stand."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import ROOT

OUTER = """
from pathlib import Path

from firmware_py.compiling import compiler, is_kept
from inner import FACTOR, half

@compiler(Path(__file__).parent)
def outer(x):
    return FACTOR * half(x)

if __name__ == "__main__":
    print(is_kept(outer), outer(8.0), is_kept(outer))
"""
INNER = """
from pathlib import Path

from firmware_py.compiling import compiler

FACTOR = {factor}

@compiler(Path(__file__).parent)
def half(x):
    return x * {half}
"""


@pytest.mark.long
@pytest.mark.parametrize(
    "kept", [pytest.param("beside the sources", marks=pytest.mark.long), "NUMBA_CACHE_DIR"]
)
def test_what_is_compiled_is_kept_until_any_source_changes(kept: str, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.pop("NUMBA_CACHE_DIR", None)
    if kept == "NUMBA_CACHE_DIR":
        environment["NUMBA_CACHE_DIR"] = str(tmp_path / "cache")
    package = tmp_path / "package"
    package.mkdir()

    def run(factor: float, half: float) -> str:
        (package / "outer.py").write_text(OUTER)
        (package / "inner.py").write_text(INNER.format(factor=factor, half=half))
        command = [sys.executable, "-B", str(package / "outer.py")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert run(factor=3.0, half=0.5) == "False 12.0 True"
    assert run(factor=3.0, half=0.5) == "True 12.0 True"
    assert run(factor=5.0, half=0.5) == "False 20.0 True", "a constant of another file"
    assert run(factor=5.0, half=0.6) == "False 24.0 True", "a function of another file"


def test_compiled_functions_depend_on_no_file_that_their_cache_does_not_look_at() -> None:
    looked_at = ("hil.world.", "firmware_py.elementary", "math", "numpy")
    checked = 0
    for path in sorted((ROOT / "hil").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        imported = {
            alias.asname or alias.name: f"{node.module}.{alias.name}"
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and "compiled" in map(ast.unparse, node.decorator_list):
                names = {
                    name.id for part in node.body for name in ast.walk(part) if isinstance(name, ast.Name)
                }
                foreign = {imported[name] for name in names & imported.keys()}
                assert {name for name in foreign if not name.startswith(looked_at)} == set(), (
                    f"{path}: {node.name}"
                )
                checked += 1
    assert checked > 15
