"""A message about a missing package names a command that works: no index knows this project."""

import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError

import pytest
from packaging.requirements import Requirement

from firmware_py.extras import install_command, packages_of_extras
from support.paths import ROOT


@pytest.mark.parametrize("extra", ["compiler", "deploy", "mavlink", "mocap", "radio", "view"])
def test_the_command_names_what_the_extra_needs(extra: str) -> None:
    described = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
        "optional-dependencies"
    ]
    words = shlex.split(install_command(extra))
    assert words[:4] == [sys.executable, "-m", "pip", "install"]
    assert {Requirement(word) for word in words[4:]} == {Requirement(text) for text in described[extra]}


@pytest.mark.long
def test_the_command_works_in_a_shell() -> None:
    command = install_command("deploy") + " --dry-run --no-index"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    assert "satisfied: ziglang>=" in done.stdout


def test_without_an_installation_the_command_installs_the_clone(monkeypatch: pytest.MonkeyPatch) -> None:
    def requires(name: str) -> list[str]:
        raise PackageNotFoundError(name)

    monkeypatch.setattr("importlib.metadata.requires", requires)
    *_, option, place = shlex.split(install_command("view"))
    assert (option, place) == ("--editable", f"{ROOT}[view]")


def test_the_packages_of_an_extra_are_found_however_the_wheel_writes_its_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    listed = ["numpy", "a>=1; extra == 'view'", 'b; extra == "view"', 'c<3; extra == "radio"']
    monkeypatch.setattr("importlib.metadata.requires", lambda name: listed)
    assert packages_of_extras() == {"view": ["a>=1", "b"], "radio": ["c<3"]}


@pytest.mark.parametrize("package", ["firmware_py", "ground_station", "hil"])
def test_no_message_promises_the_project_on_an_index(package: str) -> None:
    texts = {path.name: path.read_text("utf-8") for path in (ROOT / package).rglob("*.py")}
    assert [name for name, text in texts.items() if "floaty-hil[" in text] == []
