"""Compiled modules are used while they fit their sources, and fly the same bits; `make fast`."""

import ast
import json
import os
import shutil
import subprocess
import sys
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest

from firmware_py.fast import RECORD, SWITCH, CompiledModules, digest, usable

ROOT = Path(__file__).parent.parent.parent
FLY = """
import sys
from pathlib import Path
from hil.experiments import find_experiment
from hil.laboratory.result import read_result
from hil.laboratory.request import Request
from hil.laboratory.run import fly
for number, link in enumerate(("radio", "mavlink")):
    request = Request.of(
        find_experiment("hover"), overrides=["markers.enabled=true"], seed=4, duration_s=3.0, link=link,
        faults=["push.y@1=1", "mocap.dropout@1.5:0.3"],
    )
    folder = Path(sys.argv[1]) / str(number)
    print(fly(request, folder).hash == read_result(folder).hash, read_result(folder).hash)
"""


@pytest.fixture
def tree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A source, and a compiled module that was made of it."""
    monkeypatch.delenv(SWITCH, raising=False)
    source, file = tmp_path / "flow.py", f"flow{EXTENSION_SUFFIXES[0]}"
    source.write_text("SPEED = 9.5\n")
    (tmp_path / "compiled").mkdir()
    (tmp_path / "compiled" / file).write_bytes(b"")
    record = {"sources": {"flow.py": digest(source)}, "modules": {"flow": file}}
    (tmp_path / "compiled" / RECORD).write_text(json.dumps(record))
    return tmp_path


def test_a_compiled_module_is_found_while_its_sources_are_what_it_was_made_of(tree: Path) -> None:
    files, why = usable(tree / "compiled", tree)
    assert (list(files), why) == (["flow"], "")
    spec = CompiledModules(files).find_spec("flow", None)
    assert spec is not None
    assert spec.origin == str(tree / "compiled" / f"flow{EXTENSION_SUFFIXES[0]}")
    assert CompiledModules(files).find_spec("other", None) is None


def test_a_changed_source_makes_all_modules_pure_and_is_named(tree: Path) -> None:
    (tree / "flow.py").write_text("SPEED = 9.6\n")
    assert usable(tree / "compiled", tree) == ({}, "flow.py has changed since")


def test_a_missing_source_makes_all_modules_pure(tree: Path) -> None:
    (tree / "flow.py").unlink()
    assert usable(tree / "compiled", tree) == ({}, "flow.py has changed since")


def test_modules_of_another_python_are_not_used(tree: Path) -> None:
    record = json.loads((tree / "compiled" / RECORD).read_text())
    record["modules"]["flow"] = "flow.cpython-39-other.so"
    (tree / "compiled" / "flow.cpython-39-other.so").write_bytes(b"")
    (tree / "compiled" / RECORD).write_text(json.dumps(record))
    files, why = usable(tree / "compiled", tree)
    assert not files
    assert "none of this Python's modules" in why


def test_pure_python_can_be_demanded(tree: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(SWITCH, "1")
    assert usable(tree / "compiled", tree) == ({}, "")


def test_no_class_inherits_from_a_compiled_one() -> None:
    """Such a class raises TypeError when the first object of it is made."""
    text = (ROOT / "tools/fast.py").read_text(encoding="utf-8").partition("\nMODULES = ")[2].partition("}")[0]
    folders = ast.literal_eval(text + "}")
    compiled = {
        f"{folder.replace('/', '.')}.{name}" for folder in folders for name in folders[folder].split()
    }
    found = []
    for path in sorted(ROOT.glob("[fgh]*/**/*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        names = {
            alias.asname or alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module in compiled
            for alias in node.names
        }
        bases = {
            base.id: node.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ClassDef) and module not in compiled
            for base in node.bases
            if isinstance(base, ast.Name)
        }
        found += [f"{module}.{bases[name]}({name})" for name in sorted(names & bases.keys())]
    assert found == []


@pytest.mark.long
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler: nothing can be compiled here")
def test_compiled_flights_have_the_same_hashes_until_a_source_changes(tmp_path: Path) -> None:
    for name in ("firmware_py", "ground_station", "hil", "profiles", "tools"):
        shutil.copytree(
            ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("compiled", "__pycache__")
        )
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    tool = tmp_path / "tools" / "fast.py"
    tool.write_text(
        tool.read_text().replace('opt_level="2"', 'opt_level="0"')
    )  # three times as fast to compile

    def run(*arguments: str, **environment: str) -> tuple[str, str]:
        variables = {name: value for name, value in os.environ.items() if name != SWITCH}
        variables |= {"PYTHONPATH": str(tmp_path), **environment}
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=tmp_path,
            env=variables,
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout, done.stderr

    run("tools/fast.py")
    assert "compiled by mypyc" in run("-c", "from hil.commands.app import main; main()", "--version")[0]
    pure = run("-c", FLY, str(tmp_path / "pure"), FLOATY_PURE="1")
    assert run("-c", FLY, str(tmp_path / "compiled")) == pure
    with (tmp_path / "firmware_py" / "tasks.py").open("a") as source:
        source.write("# one more line\n")
    told, noticed = run("-c", "from hil.commands.app import main; main()", "--version")
    assert "pure Python" in told
    assert noticed.splitlines() == [
        "floaty: pure Python, not what `make fast` has compiled: firmware_py/tasks.py has changed since"
    ]
