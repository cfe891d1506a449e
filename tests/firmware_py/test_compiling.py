"""Compiled code is never older than its sources, wherever it is kept, and is kept as long as they stand."""

import ast
import os
import subprocess
import sys
import weakref
from pathlib import Path

import numpy as np
import pytest

from firmware_py.compiling import bound, compiler
from firmware_py.core.subset import I32s, i32
from support.paths import ROOT

kernel = compiler()

OUTER = """
from pathlib import Path

import numpy as np

from firmware_py.compiling import bound, compiler, must_compile
from firmware_py.core.subset import F64s
from inner import FACTOR, half

@compiler(Path(__file__).parent)
def outer(x: F64s) -> None:
    '''Do.'''
    x[0] = FACTOR * half(x[0])

if __name__ == "__main__":
    x, before = np.array([8.0]), must_compile(outer)
    call = bound(outer, x)
    call()
    print(before, x[0], must_compile(outer), type(call).__name__)
"""
INNER = """
from pathlib import Path

from firmware_py.compiling import compiler

FACTOR = {factor}

@compiler(Path(__file__).parent)
def half(x: float) -> float:
    '''Return a share.'''
    return x * {half}
"""


@pytest.mark.long
def test_compiled_code_is_kept_until_a_source_changes(tmp_path: Path) -> None:
    environment = os.environ | {"PYTHONPATH": str(ROOT), "FLOATY_CACHE_DIR": str(tmp_path / "cache")}
    package = tmp_path / "package"
    package.mkdir()

    def run(factor: float, half: float) -> str:
        (package / "outer.py").write_text(OUTER)
        (package / "inner.py").write_text(INNER.format(factor=factor, half=half))
        command = [sys.executable, "-B", str(package / "outer.py")]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert run(factor=3.0, half=0.5) == "True 12.0 False builtin_function_or_method"
    assert run(factor=3.0, half=0.5) == "False 12.0 False builtin_function_or_method"
    assert run(factor=5.0, half=0.5) == "True 20.0 False builtin_function_or_method", (
        "a constant of another file"
    )
    assert run(factor=5.0, half=0.6) == "True 24.0 False builtin_function_or_method", (
        "a function of another file"
    )
    assert {path.name for path in package.iterdir()} == {"outer.py", "inner.py"}


@kernel
def count_down(left: I32s, by: I32s) -> bool:
    """Count; return whether something is left."""
    left[0] = i32(left[0] - by[0])
    return left[0] > 0


def numbers(*values: int) -> I32s:
    return np.array(values, np.int32)


def test_a_bound_call_is_that_of_python_on_the_memory_as_it_is() -> None:
    left, by = numbers(3), numbers(1)
    call = bound(count_down, left, by)
    assert [bool(call()) for _ in range(3)] == [True, True, False]
    by[0] = -5
    assert (bool(call()), left[0]) == (True, 5)
    assert (count_down(left, by), left[0]) == (True, 10)


@kernel
def clear_second(row: I32s) -> None:
    """Clear the second number."""
    row[1] = i32(0)


def test_an_array_with_gaps_is_changed_in_its_own_places() -> None:
    memory = np.ones((2, 3), np.int32)
    bound(clear_second, memory[:, 1])()
    assert memory.tolist() == [[1, 1, 1], [1, 0, 1]]


def test_the_memory_of_a_bound_call_lives_as_long_as_the_call() -> None:
    left = numbers(2)
    alive = weakref.ref(left)
    call = bound(count_down, left, numbers(1))
    del left
    assert (alive() is not None, bool(call()), bool(call())) == (True, True, False)
    del call
    assert alive() is None


@pytest.mark.long
def test_compiled_functions_depend_on_no_file_that_their_cache_does_not_look_at() -> None:
    looked_at = (
        "hil.world.",
        "firmware_py.elementary",
        "firmware_py.core.",
        "hil.research.learn.",
        "math",
        "numpy",
    )
    checked = 0
    for path in sorted((ROOT / "hil").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "@compiled" not in text:
            continue
        tree = ast.parse(text)
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
