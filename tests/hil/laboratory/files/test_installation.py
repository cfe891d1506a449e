"""`floaty --version`: version, commit, packages and programs, whatever is missing."""

import os
import re
import subprocess
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import pytest

from firmware_py.compiling import flies_as
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.files import installation
from hil.laboratory.files.installation import commit, describe
from hil.laboratory.files.result import Program
from hil.research.campaigns.dataset import about
from hil.research.campaigns.jobs import Job, Plan
from support.full_disk import small_files

Write = Callable[[str, str], None]


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Write:
    """Writes a shell script of a name; no other program is found."""
    monkeypatch.setenv("PATH", str(tmp_path))

    def write(name: str, script: str) -> None:
        (tmp_path / name).write_text(f"#!/bin/sh\n{script}\n")
        (tmp_path / name).chmod(0o755)

    return write


def rows() -> dict[str, str]:
    _, *lines = describe().splitlines()
    return dict(re.split(" {2,}", line, maxsplit=1) for line in lines)


def test_the_first_line_is_for_programs_and_the_others_are_aligned(program: Write) -> None:
    first, *others = describe().splitlines()
    assert first == f"floaty, version {version('floaty-hil')}, {flies_as()}"
    assert len({len(row[0]) for line in others if (row := re.match(r"\w+( [\w-]+)? {2,}", line))}) == 1


def test_what_flies_is_c_where_a_compiler_is(program: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)  # no ziglang
    assert flies_as() == "plain Python"
    program("clang", "true")
    assert flies_as() == "C"
    monkeypatch.setattr("firmware_py.compiling.PLAIN", True)
    assert flies_as() == "plain Python"


def test_missing_git_and_tools_are_reported(program: Write) -> None:
    found = rows()
    assert found["commit"] == "unknown"
    assert {name: text for name, text in found.items() if name.startswith("program")} == {
        f"program {name}": "not found"
        for name in ("git", "gcc", "clang", "arm-none-eabi-gcc", "gdb-multiarch")
    }


def test_a_program_reports_its_own_version_and_not_its_packagers(program: Write) -> None:
    program("gcc", "echo 'gcc (Debian 12.2.0-14+deb12u1) 12.3.1'; echo 'Copyright (C) 2022.1'")
    program("clang", "echo 'Apple clang version 15.0.4 (clang-1500.3.9.4)'")
    program("git", "echo no number")
    program("gdb-multiarch", "exit 3")
    found = rows()
    assert (found["program gcc"], found["program clang"]) == ("12.3.1", "15.0.4")
    assert found["program git"] == found["program gdb-multiarch"] == "found, of unknown version"


def test_a_program_that_does_not_answer_is_left(program: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "PROGRAM_TIMEOUT_S", 0.05)
    program("gcc", "while :; do :; done")
    assert rows()["program gcc"] == "found, of unknown version"


def test_a_missing_package_of_an_extra_is_named(program: Write, monkeypatch: pytest.MonkeyPatch) -> None:
    requirements = [
        "numpy>=2.0",
        "no-such-radio[usb]>=0.1; extra == 'radio'",
        "numpy>=2; extra == 'radio'",
        "ruff; extra == 'test'",
    ]
    monkeypatch.setattr("importlib.metadata.requires", lambda project: requirements)
    found = rows()
    assert found["extra radio"] == f"no-such-radio not installed, numpy {version('numpy')}"
    assert "extra test" not in found


def test_a_package_reports_the_commit_that_it_was_built_from(
    program: Write, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "commit.txt").write_text("0123456789ab\n")
    monkeypatch.setattr(installation, "COMMIT", tmp_path / "commit.txt")
    assert commit() == "0123456789ab"


def test_git_locks_nothing_in_the_repository(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would refresh its index, whose lock stays where the disk is full."""
    who = ("-c", "user.name=x", "-c", "user.email=x")
    (tmp_path / "file").write_text("x")
    for command in (["init", "-q"], ["add", "file"], [*who, "commit", "-q", "-m", "x"]):
        subprocess.run(["git", "-C", tmp_path, *command], check=True)
    os.utime(tmp_path / "file", (1, 1))
    monkeypatch.setattr(installation, "ROOT", tmp_path)
    index = (tmp_path / ".git/index").read_bytes()
    with small_files(10):
        assert re.fullmatch(r"[0-9a-f]{12}", commit())
    assert (tmp_path / ".git/index").read_bytes() == index
    assert not (tmp_path / ".git/index.lock").exists()
    (tmp_path / "file").write_text("y")
    assert re.fullmatch(r"[0-9a-f]{12}\+", commit())


def test_all_flights_of_a_process_are_of_the_commit_that_it_has_loaded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first = Program.of(load_config())
    monkeypatch.setattr(installation, "ROOT", installation.ROOT / "hil")
    assert Program.of(load_config()) == first != replace(first, commit=commit())


def test_a_campaign_is_not_stored_without_its_commit(
    program: Write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = Plan.of([Job(0, "hover", {}, {})])
    assert about(plan)["commit"] == "unknown", "no git"
    program("git", "exit 1")
    with pytest.raises(LabError, match="git does not name the commit"):
        about(plan)
    monkeypatch.setattr(installation, "ROOT", tmp_path)
    assert about(plan)["commit"] == "unknown", "no repository"


def test_a_surrounding_repository_s_commit_is_not_the_package_s(monkeypatch: pytest.MonkeyPatch) -> None:
    assert re.fullmatch(r"[0-9a-f]{12}\+?", commit())
    monkeypatch.setattr(installation, "ROOT", installation.ROOT / "hil")
    assert commit() == ""
