"""Compiled code is never older than its sources, wherever it is kept, and is kept as long as they stand."""

import ast
import os
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from firmware_py.compiling import bound, compiler
from support.paths import ROOT

kernel = compiler()

OUTER = """
import sys
from pathlib import Path

import numpy as np

from firmware_py.compiling import bound, compiler, is_kept
from inner import FACTOR, half

@compiler(Path(__file__).parent)
def outer(x) -> None:
    x[0] = FACTOR * half(x[0])

if __name__ == "__main__":
    x, before = np.array([8.0]), is_kept(outer)
    bound(outer, x)()
    print(before, x[0], is_kept(outer), "numba" in sys.modules)
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
@pytest.mark.parametrize("kept", ["XDG_CACHE_HOME", "NUMBA_CACHE_DIR"])
def test_compiled_code_is_kept_until_a_source_changes(kept: str, tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    environment.pop("NUMBA_CACHE_DIR", None)
    environment[kept] = str(tmp_path / "cache")
    package = tmp_path / "package"
    package.mkdir()

    def run(factor: float, half: float) -> str:
        (package / "outer.py").write_text(OUTER)
        (package / "inner.py").write_text(INNER.format(factor=factor, half=half))
        command = [sys.executable, "-B", str(package / "outer.py")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert run(factor=3.0, half=0.5) == "False 12.0 True True"
    assert run(factor=3.0, half=0.5) == "True 12.0 True False"
    assert run(factor=5.0, half=0.5) == "False 20.0 True True", "a constant of another file"
    assert run(factor=5.0, half=0.6) == "False 24.0 True True", "a function of another file"
    assert {path.name for path in package.iterdir()} == {"outer.py", "inner.py"}


@kernel
def count_down(left: NDArray[np.int64], by: NDArray[np.int64]) -> bool:
    left[0] -= by[0]
    return bool(left[0] > 0)


@kernel
def ratio(a: float, b: float) -> float:
    return a / b


def test_a_bound_call_is_that_of_python_on_the_memory_as_it_is() -> None:
    left, by = np.array([3]), np.array([1])
    call = bound(count_down, left, by)
    assert [bool(call()) for _ in range(3)] == [True, True, False]
    by[0] = -5
    assert (bool(call()), left[0]) == (True, 5)
    assert count_down(left, by) == count_down.__wrapped__(left, by)
    assert ratio(3.0, 4.0) == bound(ratio, 3.0, 4.0)() == 0.75


def test_the_memory_of_a_bound_call_lives_as_long_as_the_call() -> None:
    left = np.array([2])
    alive = weakref.ref(left)
    call = bound(count_down, left, np.array([1]))
    del left
    assert (alive() is not None, bool(call()), bool(call())) == (True, True, False)
    del call
    assert alive() is None


def test_code_kept_for_a_module_is_not_taken_for_one_of_another_name() -> None:
    """Kept code names its module, and that of own logic a hash of all its modules."""

    def nothing() -> None: ...

    stamps = set()
    for nothing.__module__ in ("own_logic_1.own_controller", "own_logic_2.own_controller"):
        stamps.add(compiler()(nothing).stamp)  # type: ignore[attr-defined]
    assert len(stamps) == 2


def test_compiled_functions_depend_on_no_file_that_their_cache_does_not_look_at() -> None:
    looked_at = ("hil.world.", "firmware_py.elementary", "firmware_py.core.", "hil.learn.", "math", "numpy")
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
