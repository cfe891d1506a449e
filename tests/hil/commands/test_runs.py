"""`floaty runs` lists what has been flown, whatever else is there."""

import os
import re
import shutil
from pathlib import Path

import pytest

from hil import fly
from support.command import floaty


@pytest.fixture(autouse=True)
def in_an_empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("hil.commands.listing.console._width", 80)


def test_runs_are_listed_with_date_request_verdict_and_hash(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = fly("hover", duration_s=0.1, profile="as-flown", faults=["push.y@0=1"])
    shutil.copytree(run.folder, "runs/deep/[broken]")
    Path("runs/deep/[broken]/result.json").write_text("{}")
    Path("runs/foreign").mkdir()
    Path("runs/foreign/notes.txt").write_text("no run")
    os.utime(run.folder / "result.json", (1e9, 1e9))
    assert floaty(monkeypatch, "runs") == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(len(line) <= 80 for line in lines)
    text = re.sub(r"\s+", " ", " ".join(lines))
    assert re.match(r"date folder request verdict hash 09-0[89] \d\d:\d\d hover-1 hover, seed 1", text)
    assert run.hash[:12] in text
    assert "foreign" not in text
    assert "deep/[broken]" in text.replace(" ", "")
    assert "missing" in text


def test_no_runs_are_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for folder in ((), ("elsewhere",)):
        assert floaty(monkeypatch, "runs", *folder) == 2
    assert capsys.readouterr().err == (
        "floaty: runs runs: no run folder there; `floaty fly hover` makes one\n"
        "floaty: runs elsewhere: no run folder there; `floaty fly hover` makes one\n"
    )


@pytest.mark.parametrize("command", ["report", "view"])
def test_a_missing_run_folder_is_called_missing(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert floaty(monkeypatch, command, "runs/hover-7") == 2
    assert "runs/hover-7: there is no such run folder" in capsys.readouterr().err
