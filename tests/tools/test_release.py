"""What `make dist` makes: an sdist of everything that is tracked, and a wheel built from it that installs and flies."""

import re
import shutil
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

from hil.laboratory.files.installation import commit
from hil.laboratory.files.result import read_result
from support.installed_wheel import install, run
from support.paths import ROOT

VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["version"]
PACKAGES = ("firmware_py", "ground_station", "hil")
COMMIT = "hil/commit.txt"


def test_the_version_is_the_first_one_in_the_list_of_changes() -> None:
    changes = (ROOT / "CHANGELOG.md").read_text("utf-8")
    releases = re.findall(r"^## (.+) \((\d{4}-\d\d-\d\d|Unreleased)\)$", changes, re.MULTILINE)
    assert len(releases) == len(re.findall(r"^## ", changes, re.MULTILINE))
    assert releases[0][0] == VERSION
    dates = [day for _, day in releases]
    assert dates == sorted(dates, reverse=True), "newest first; a letter sorts after all digits"
    assert "Unreleased" not in dates[1:]


def tracked(*folders: str) -> set[str]:
    return set(
        run(ROOT, "git", "ls-files", "--cached", "--others", "--exclude-standard", *folders).stdout.split()
    )


@pytest.mark.long
def test_sdist_and_wheel_are_complete_and_the_wheel_flies_from_an_empty_folder(tmp_path: Path) -> None:
    run(ROOT, sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path)
    name = f"floaty_hil-{VERSION}"
    with tarfile.open(tmp_path / f"{name}.tar.gz") as sdist:
        packed = {member.removeprefix(f"{name}/") for member in sdist.getnames()}
    assert packed == tracked() | {"PKG-INFO", COMMIT}

    wheel = tmp_path / f"{name}-py3-none-any.whl"
    with zipfile.ZipFile(wheel) as archive:
        packed = {member for member in archive.namelist() if ".dist-info/" not in member}
        assert archive.read(COMMIT).decode().strip() == commit()
        [licence] = [member for member in archive.namelist() if member.endswith("/LICENSE")]
        assert archive.read(licence) == (ROOT / "LICENSE").read_bytes()
    beside = tracked("profiles", "docs/tutorials", "docs/howto", "docs/explanation", "docs/reference")
    assert packed == tracked(*PACKAGES) | {f"hil/{path}" for path in beside} | {COMMIT}

    programs, packages = install(wheel, tmp_path)
    (packages / "rerun.py").write_text("raise ImportError('no rerun')")

    floaty, empty = programs / "floaty", tmp_path / "empty"
    empty.mkdir()
    first, *others = run(empty, floaty, "--version").stdout.splitlines()
    flies = "C" if any(map(shutil.which, ("gcc", "clang", "cc"))) else "plain Python"
    assert first == f"floaty, version {VERSION}, {flies}"
    assert ["commit", commit()] in [line.split() for line in others]
    assert run(empty, floaty, "docs", "tests").stdout == (ROOT / "docs/howto/tests.md").read_text("utf-8")
    run(empty, floaty, "fly", "hover", "--duration", "2")
    flown = read_result(empty / "runs" / "hover-1")
    assert (flown.passed, flown.program.commit) == (True, commit())
    found = run(empty, floaty, "campaign", "table", "--shrink", "1000", code=2).stderr
    assert "the campaign has flights 0..999" in found
    refused = run(empty, floaty, "view", "runs/hover-1", code=2).stderr
    assert refused.count("\n") == 1
    assert f"{programs / 'python'} -m pip install " in refused
    assert "'rerun-sdk<" in refused
