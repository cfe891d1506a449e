"""ruff and mypy are part of the tests; the files for people who join name what exists."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
from configparser import ConfigParser
from pathlib import Path
from typing import Any

import pytest
import yaml
from check_jsonschema import main as check_jsonschema
from click.testing import CliRunner

from support.examples import blocks
from support.paths import ROOT


@pytest.mark.parametrize(
    "command", ["ruff check", "ruff format --check", pytest.param("mypy", marks=pytest.mark.long)]
)
def test_the_sources_are_clean(command: str) -> None:
    ran = subprocess.run(
        [sys.executable, "-m", *command.split()], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert ran.returncode == 0, ran.stdout[-4000:] + ran.stderr[-1000:]


def parsed(path: str | Path) -> dict[str, Any]:
    content: dict[str, Any] = yaml.safe_load((ROOT / path).read_text("utf-8"))
    return content


def test_workflows_run_targets_of_make_and_programs_of_the_project_on_admitted_pythons() -> None:
    [phony] = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    jobs = parsed(".github/workflows/tests.yml")["jobs"]
    commands = [step["run"].split() for job in jobs.values() for step in job["steps"] if "run" in step]
    assert [command[:2] for command in commands] == [["make", "test"], ["sudo", ".ci/run"]]
    assert commands[0][1] in phony.split()
    assert os.access(ROOT / commands[1][1], os.X_OK)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["requires-python"] == f">={jobs['test']['strategy']['matrix']['python'][0]}"


CI_PAGE = ROOT / "docs" / "tutorials" / "hil-test-in-ci.md"
OURS = ROOT / ".github" / "workflows" / "tests.yml"


@pytest.mark.parametrize(
    ("place", "schema"),
    [("tests.yml", "github-workflows"), ("fly.yml", "github-workflows"), (".gitlab-ci.yml", "gitlab-ci")],
)
def test_files_for_ci_agree_with_their_published_schema(place: str, schema: str, tmp_path: Path) -> None:
    shown = [text for language, text in blocks(CI_PAGE) if language == "yaml"]
    named = {text.partition("\n")[0].rpartition("/")[2].removeprefix("# "): text for text in shown}
    text = {"tests.yml": OURS.read_text("utf-8"), **named}[place]
    (tmp_path / place).write_text(text, encoding="utf-8")
    options = ["--builtin-schema", f"vendor.{schema}", str(tmp_path / place)]
    options += ["--data-transform", "gitlab-ci"] if schema == "gitlab-ci" else []
    ran = CliRunner().invoke(check_jsonschema, options)
    assert ran.exit_code == 0, ran.output
    wrong = text.replace("timeout", "tiemout").replace("runs-on:", "run-on:")
    (tmp_path / place).write_text(wrong, encoding="utf-8")
    assert CliRunner().invoke(check_jsonschema, options).exit_code == 1


def test_the_files_for_ci_on_the_page_fly_alike_with_options_of_pytest() -> None:
    lines = [
        re.sub(r"\$\{\{ matrix.board \}\}|\$BOARD", "BOARD", line)
        for language, text in blocks(CI_PAGE)
        if language == "yaml"
        for line in re.findall(r"- (?:run: )?((?:pytest|pip) .*)", text)
    ]
    assert lines[:2] == lines[2:]
    known = subprocess.run(
        [sys.executable, "-m", "pytest", "--help"], capture_output=True, text=True, check=True
    ).stdout
    assert {"-n", "--floaty-board", "--floaty-seeds", "--junitxml"} == set(
        re.findall(r" (-[\w-]+)", lines[1])
    )
    assert all(
        option in known for option in re.findall(r" (--[\w-]+)", lines[1].replace("junitxml", "junit-xml"))
    )


def test_hooks_before_a_commit_are_tools_of_the_environment_without_settings() -> None:
    [repo] = parsed(".pre-commit-config.yaml")["repos"]
    assert repo["repo"] == "local"
    for hook in repo["hooks"]:
        folder, tool = os.path.split(hook["entry"].split()[0])
        assert (folder, hook["language"]) == (".venv/bin", "system")
        assert shutil.which(tool, path=os.path.dirname(sys.executable)), tool
        assert "--" not in hook["entry"]


def test_form_citation_and_editor_settings_are_read_and_agree_with_the_project() -> None:
    asked = {item["id"]: item["attributes"] for item in parsed(".github/ISSUE_TEMPLATE/bug.yml")["body"]}
    assert set(asked) == {"version", "command", "expected", "run"}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = parsed("CITATION.cff")
    assert (str(citation["version"]), citation["license"]) == (project["version"], project["license"])
    assert f"({citation['preferred-citation']['url']})" in (ROOT / "README.md").read_text("utf-8")
    editor = ConfigParser()
    editor.read_string("[top]\n" + (ROOT / ".editorconfig").read_text("utf-8"))
    assert editor["Makefile"]["indent_style"] == "tab"
