"""Laws of the tool that plants mistakes, on a project of two lines, and of its table."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from support.paths import ROOT

spec = importlib.util.spec_from_file_location("planted_mistakes", ROOT / "tools" / "planted_mistakes.py")
planted_mistakes = importlib.util.module_from_spec(spec)
sys.modules[spec.name] = planted_mistakes
spec.loader.exec_module(planted_mistakes)

SOURCE = """def count(n):
    left, steps = abs(n), 0
    while left > 0:
        left, steps = left - 1, steps + 1
    return steps
"""
TESTS = """from steps import count

def test_three_steps_are_counted():
    assert count(3) == 3
"""
C_SOURCE = "int steps(int n) { return n < 0 ? -n : n; }\n"
C_BUILD = """import subprocess
from firmware_py.export.compilers import compilers

def build(folder):
    compiler = min(compilers(), key=lambda one: one.name == "zig")
    flags = ("-shared", "-fPIC", "-o", folder / "steps.so", "native/steps.c")
    subprocess.run([*compiler.command, *flags], check=True)
    return folder / "steps.so"
"""
C_TESTS = """import ctypes
from native.building import build

def test_three_steps_are_counted(tmp_path):
    assert ctypes.CDLL(str(build(tmp_path))).steps(-3) == 3
"""
CAUGHT = "'left, steps = abs(n), 0' = 'left, steps = abs(n), 1'"
SURVIVES = "'abs(n)' = 'n'"
HANGS = "'left - 1' = { new = 'left', hangs = true }"
TOO_SLOW = "'left > 0' = 'left == left'"


def named_by(test: str) -> str:
    old, new = CAUGHT.split(" = '")
    return f"{old} = {{ new = '{new}, tests = '{test}' }}"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "steps.py").write_text(SOURCE)
    (tmp_path / "test_steps.py").write_text(TESTS)
    subprocess.run(["git", "init", "--quiet"], cwd=tmp_path, check=True)
    return tmp_path


def plant(project: Path, *rows: str, options: tuple[str, ...] = ()) -> int:
    table = project / "table.toml"
    table.write_text("\n".join(['["steps.py"."test_steps.py"]', *rows]))
    return planted_mistakes.main(options, project, table)


@pytest.mark.long
def test_detected_mistakes_are_caught_and_others_survive(project, capsys) -> None:
    assert plant(project, CAUGHT, SURVIVES, options=("--jobs", "2")) == 1
    said = capsys.readouterr().out
    assert "1 of 2 caught, 50.0 %; survived:\n  steps.py: abs(n) -> n\n" in said
    assert (project / "steps.py").read_text() == SOURCE


@pytest.mark.long
def test_with_95_percent_of_the_chosen_rows_caught_all_is_well(project, capsys) -> None:
    assert plant(project, CAUGHT, SURVIVES, options=("--only", "abs.n., 1")) == 0
    assert "1 of 1 caught, 100.0 %\n" in capsys.readouterr().out


@pytest.mark.long
def test_an_endless_loop_is_caught_where_the_row_allows_it(project, capsys, monkeypatch) -> None:
    monkeypatch.setattr(planted_mistakes, "LIMIT_S", 1)
    assert plant(project, HANGS, TOO_SLOW) == 1
    said = capsys.readouterr().out
    assert "no end in 1 s" in said
    assert "1 of 2 caught" in said


def plant_c(project: Path, *rows: str, build: str = "'native' = 'native.building:build'") -> int:
    (project / "native").mkdir(exist_ok=True)
    (project / "native" / "__init__.py").touch()
    (project / "native" / "steps.c").write_text(C_SOURCE)
    (project / "native" / "building.py").write_text(C_BUILD)
    (project / "test_c.py").write_text(C_TESTS)
    table = project / "table.toml"
    table.write_text("\n".join(["[build]", build, '["native/steps.c"."test_c.py"]', *rows]))
    return planted_mistakes.main((), project, table)


@pytest.mark.long
def test_a_mistake_in_c_is_caught_by_a_test_that_fails(project, capsys) -> None:
    assert plant_c(project, "'-n' = 'n'", "'n < 0' = 'n <= 0'") == 1
    assert "1 of 2 caught, 50.0 %; survived:\n  native/steps.c: n < 0 -> n <= 0\n" in capsys.readouterr().out
    assert (project / "native" / "steps.c").read_text() == C_SOURCE


@pytest.mark.long
def test_c_that_does_not_compile_is_a_mistake_of_the_table(project, capsys) -> None:
    assert plant_c(project, "'-n' = 'm'") == 2
    said = capsys.readouterr()
    assert said.err.startswith("native/steps.c: 'm' does not build: ")
    assert said.err.count("\n") == 1
    assert "caught" not in said.out
    assert plant_c(project, "'-n' = 'n'", build="") == 2
    assert "native/steps.c: `build` names no function for its folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        ("'right' = 'left'", "steps.py: 'right' occurs 0 times, not once"),
        ("'left' = 'right'", "steps.py: 'left' occurs 4 times, not once"),
        ("'steps + 1' = 'steps +'", "steps.py: 'steps +' is no Python: invalid syntax"),
        ("'abs(n)' = { new = 'n', tests = 'test_x.py' }", "steps.py: no such tests: test_x.py"),
    ],
)
def test_a_bad_row_is_one_line_and_nothing_is_planted(project, capsys, row: str, complaint: str) -> None:
    assert plant(project, CAUGHT, row) == 2
    said = capsys.readouterr()
    assert said.err.startswith(complaint)
    assert said.err.count("\n") == 1
    assert "caught" not in said.out


def test_every_room_has_its_own_count() -> None:
    paths = ("hil/world/plates.py", "hil/world/native/plant.c", "hil/clock.py", "hil/live/feed.py")
    rows = [planted_mistakes.Mistake(path, old, "b", ("test.py",)) for path in paths for old in "ac"]
    assert planted_mistakes.by_room(rows, [rows[0], rows[2], rows[-1]]) == [
        ("hil", 2, 2), ("hil/live", 1, 2), ("hil/world", 2, 4),
    ]  # fmt: skip


@pytest.mark.long
def test_other_rooms_do_not_compensate_for_one_with_survivors(project, capsys, monkeypatch) -> None:
    monkeypatch.setattr(planted_mistakes, "SHARE_CAUGHT", 0.5)
    (project / "room").mkdir()
    (project / "room" / "__init__.py").touch()
    (project / "room" / "quiet.py").write_text("LOUD = 1\n")
    table = project / "table.toml"
    table.write_text(
        f'["steps.py"."test_steps.py"]\n{CAUGHT}\n\'abs(n), 0\' = "abs(n), 1"\n'
        "['room/quiet.py'.'test_steps.py']\n'1' = '2'\n"
    )
    assert planted_mistakes.main(("--jobs", "2"), project, table) == 1
    said = capsys.readouterr().out
    assert ".                              2 of   2 caught" in said
    assert "room                           0 of   1 caught" in said
    assert "2 of 3 caught, 66.7 %" in said


@pytest.mark.long
def test_a_long_test_that_a_row_names_counts(project, capsys) -> None:
    (project / "pytest.ini").write_text("[pytest]\naddopts = -m 'not long'\nmarkers = long: takes long\n")
    (project / "test_steps.py").write_text(
        TESTS.replace("def test", "import pytest\n\n@pytest.mark.long\ndef test")
    )
    named = named_by("test_steps.py::test_three_steps_are_counted")
    assert plant(project, named) == 0


def test_a_pattern_that_no_row_matches_is_exit_code_two(project, capsys) -> None:
    assert plant(project, CAUGHT, options=("--only", "right")) == 2
    assert capsys.readouterr().err == "--only right: none of 1 rows\n"


@pytest.mark.long
def test_tests_that_fail_or_are_not_there_without_a_mistake_catch_nothing(project, capsys) -> None:
    assert plant(project, named_by("test_steps.py::test_x")) == 2
    assert capsys.readouterr().err == "without any mistake pytest ends with 4: test_steps.py::test_x\n"
    (project / "test_steps.py").write_text(TESTS.replace("== 3", "== 4"))
    assert plant(project, CAUGHT) == 2
    assert capsys.readouterr().err == "without any mistake pytest ends with 1: test_steps.py\n"


@pytest.mark.long  # a change of the sources need not wait for the table; the tool says the same before it plants
def test_every_row_of_the_table_can_be_planted() -> None:
    rows = planted_mistakes.read(ROOT / "tools" / "planted_mistakes.toml")
    assert len(rows) >= 100
    for row in rows:
        assert planted_mistakes.planted(row, ROOT) != (ROOT / row.path).read_text(encoding="utf-8")
