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
CAUGHT = "{ old = 'left, steps = abs(n), 0', new = 'left, steps = abs(n), 1' }"
SURVIVES = "{ old = 'abs(n)', new = 'n' }"
HANGS = "{ old = 'left - 1', new = 'left', hangs = true }"
TOO_SLOW = "{ old = 'left - 1', new = 'left' }"


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "steps.py").write_text(SOURCE)
    (tmp_path / "test_steps.py").write_text(TESTS)
    subprocess.run(["git", "init", "--quiet"], cwd=tmp_path, check=True)
    return tmp_path


def plant(project: Path, *rows: str, options: tuple[str, ...] = ()) -> int:
    table = project / "table.toml"
    mistakes = ", ".join(rows)
    table.write_text(f'[[file]]\npath = "steps.py"\ntests = "test_steps.py"\nmistakes = [{mistakes}]\n')
    return planted_mistakes.main(options, project, table)


@pytest.mark.long
def test_what_the_tests_see_is_caught_and_what_they_do_not_see_survives(project, capsys) -> None:
    assert plant(project, CAUGHT, SURVIVES, options=("--jobs", "2")) == 1
    said = capsys.readouterr().out
    assert "1 of 2 caught, 50.0 %; survived:\n  steps.py: abs(n) -> n\n" in said
    assert (project / "steps.py").read_text() == SOURCE


@pytest.mark.long
def test_with_95_percent_of_the_chosen_rows_caught_all_is_well(project, capsys) -> None:
    assert plant(project, CAUGHT, SURVIVES, options=("--only", "abs.n., 1")) == 0
    assert "1 of 1 caught, 100.0 %\n" in capsys.readouterr().out


@pytest.mark.long
def test_an_endless_loop_is_caught_where_the_row_says_so(project, capsys, monkeypatch) -> None:
    monkeypatch.setattr(planted_mistakes, "LIMIT_S", 1)
    assert plant(project, HANGS, TOO_SLOW) == 1
    said = capsys.readouterr().out
    assert "no end in 1 s" in said
    assert "1 of 2 caught" in said


@pytest.mark.parametrize(
    ("row", "complaint"),
    [
        ("{ old = 'right', new = 'left' }", "steps.py: 'right' occurs 0 times, not once"),
        ("{ old = 'left', new = 'right' }", "steps.py: 'left' occurs 4 times, not once"),
        ("{ old = 'steps + 1', new = 'steps +' }", "steps.py: 'steps +' is no Python: invalid syntax"),
        ("{ old = 'abs(n)', new = 'n', tests = 'test_x.py' }", "steps.py: no such tests: test_x.py"),
    ],
)
def test_a_bad_row_is_one_line_and_exit_code_two_before_anything_is_planted(
    project, capsys, row: str, complaint: str
) -> None:
    assert plant(project, CAUGHT, row) == 2
    said = capsys.readouterr()
    assert said.err.startswith(complaint)
    assert said.err.count("\n") == 1
    assert "caught" not in said.out


def test_a_pattern_that_no_row_matches_is_exit_code_two(project, capsys) -> None:
    assert plant(project, CAUGHT, options=("--only", "right")) == 2
    assert capsys.readouterr().err == "--only right: none of 1 rows\n"


@pytest.mark.long
def test_tests_that_fail_or_are_not_there_without_a_mistake_catch_nothing(project, capsys) -> None:
    assert plant(project, CAUGHT.replace("}", ", tests = 'test_steps.py::test_x' }")) == 2
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
