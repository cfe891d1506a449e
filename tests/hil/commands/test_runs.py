"""`floaty runs` lists what has been flown, whatever else is there."""

import os
import re
import shutil
from pathlib import Path

import pytest

from hil import fly
from support.command import Cli


@pytest.fixture(autouse=True)
def in_an_empty_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("hil.commands.listing.console._width", 80)


def test_runs_are_listed_with_date_request_verdict_and_hash(
    cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = fly("hover", duration_s=0.1, profile="as-flown", faults=["push.y@0=1"])
    shutil.copytree(run.folder, "runs/deep/[broken]")
    Path("runs/deep/[broken]/result.json").write_text("{}")
    Path("runs/foreign").mkdir()
    Path("runs/foreign/notes.txt").write_text("no run")
    os.utime(run.folder / "result.json", (1e9, 1e9))
    assert cli("runs") == 0
    lines = cli.out.splitlines()
    assert all(len(line) <= 80 for line in lines)
    text = re.sub(r"\s+", " ", " ".join(lines))
    assert re.match(r"date folder request verdict hash 09-0[89] \d\d:\d\d hover-1 hover, seed 1", text)
    assert run.hash[:12] in text
    assert "foreign" not in text
    assert "deep/[broken]" in text.replace(" ", "")
    assert "missing" in text
    monkeypatch.setattr("hil.commands.listing.console._width", 400)
    assert cli("runs") == 0
    heading, sound, broken = cli.out.splitlines()
    assert sound[heading.index("verdict") :].split() == ["ok", run.hash[:12]]
    assert broken[heading.index("verdict") :].startswith("experiment is missing")


@pytest.mark.parametrize("command", ["report", "view"])
def test_a_missing_run_folder_is_called_missing(cli: Cli, command: str) -> None:
    assert cli(command, "runs/hover-7") == 2
    assert "runs/hover-7: there is no such run folder" in cli.err


@pytest.mark.parametrize(
    ("command", "file"), [(("report",), "report.html"), (("export", "--csv"), "flight.csv")]
)
def test_a_file_that_cannot_be_written_is_one_line(cli: Cli, command: tuple[str, ...], file: str) -> None:
    run = fly("hover", duration_s=0.1)
    (run.folder / file).unlink(missing_ok=True)
    (run.folder / file).mkdir()
    said = cli.refusal(*command, run.folder)
    assert said.startswith(f"floaty: RUN {run.folder}: cannot be written (")
    assert "s a directory" in said


def test_pages_with_all_words_are_listed_by_their_best_line_then_by_their_lines(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pages = {
        "tutorials/often": "# Often\nred\nblue\nred\nblue\nred\n", "tutorials/half": "# Half\nred\n",
        "howto/once": "# Once\nRed-Blue\n", "reference/best": "# Best\nred\n  blue\nred blue\nred\nblue\n",
    }  # fmt: skip
    for name, text in pages.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.md").write_text(text, encoding="utf-8")
    monkeypatch.setattr("hil.commands.listing.FOLDERS", (tmp_path / "none", tmp_path))
    assert cli("docs", "red", "blue") == 0
    assert cli.out.splitlines() == [
        "best  Best", "    red", "    blue", "    red blue", "once  Once", "    Red-Blue",
        "often  Often", "    red", "    blue", "    red",
    ]  # fmt: skip
    assert cli("docs") == 0
    assert cli.out.split()[:8:2] == ["half", "often", "once", "best"]
