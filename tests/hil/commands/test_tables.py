"""What `floaty fly` and `compare` print and return for several seeds: means, verdicts, exit codes."""

import io
import os
import sys
from contextlib import suppress
from dataclasses import replace
from math import radians
from pathlib import Path

import pytest

from hil.commands.options import exit_code
from hil.commands.tables import SEED_COLUMNS, print_result, print_seeds
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.result import Result, read_result
from hil.laboratory.metrics import METRICS, Verdict
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.research.campaigns.jobs import Job, Row
from hil.research.campaigns.run import Runner
from support.command import Cli


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Result:
    folder = tmp_path_factory.mktemp("tables") / "run"
    fly(Request.of(EXPERIMENTS["hover"], duration_s=0.1), folder)
    return read_result(folder)


def made(rms: float, holds: bool, outcome: str = "completed") -> Row:
    """The row of a flight with the same error on every axis and one limit."""
    names = [name for _, group, _, _ in SEED_COLUMNS for name in group]
    metrics = {
        **dict.fromkeys(names, 0.5),
        **{f"rms_{axis}": rms for axis in "xyz"},
        "attitude_max": radians(9.0),
    }
    metrics |= {"flown": 0.1} | {f"within_6cm_{axis}": 0.9 if holds else 0.5 for axis in "xyz"}
    job = Job(0, "hover", {"profile": "floaty"}, {})
    return Row(job, outcome, "", holds, "0" * 64, metrics, {"rms_x": holds})


def test_a_table_shows_control_characters_and_no_writer_can_send_them(
    capsys: pytest.CaptureFixture[str],
) -> None:
    print_seeds([replace(made(0.01, True, "error"), passed=False, error="a\x1b[2J\x9b\nb")])
    shown = capsys.readouterr().out
    assert r"a\x1b[2J\x9b" in shown
    assert "\x1b[2J" not in shown


def test_a_table_into_a_closed_pipe_is_an_error_that_a_flight_handles(
    flown: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rich would end the program, while it flies or before it has closed its files, and print the table again later."""
    read, write = os.pipe()
    os.close(read)
    output = os.fdopen(write, "w")
    monkeypatch.setattr(sys, "stdout", output)
    with pytest.raises(BrokenPipeError):
        print_result(flown)
    with suppress(BrokenPipeError):
        output.close()
    monkeypatch.setattr(sys, "stdout", shown := io.StringIO())
    print_result(flown)
    assert shown.getvalue().count("rms_x") == 1


@pytest.mark.long
def test_a_held_limit_is_ok_and_a_missed_one_fails(flown: Result, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("report.html", "flight.rrd"):
        (flown.folder / name).touch()
    for holds, mark in ((True, "ok"), (False, "FAILS")):
        verdict = Verdict("rms_x", 0.01, 0.02, holds, "m", "max")
        judged = replace(flown, metrics=flown.metrics | {"rms_x": 0.01}, verdicts=(verdict,))
        print_result(judged)
        assert exit_code(judged) == (0 if holds else 1)
        told = capsys.readouterr().out.splitlines()
        (line,) = [line for line in told if "rms_x" in line]
        files = [f"  {flown.folder / name}" for name in ("report.html", "flight.rrd", "log.parquet")]
        files[1] += f"   (floaty view {flown.folder})"
        assert told[-3:] == files
        assert [cell.strip() for cell in line.split("│")[-3:-1]] == ["<= 2 cm", mark]


def test_every_metric_of_the_tables_exists() -> None:
    assert {name for _, names, _, _ in SEED_COLUMNS for name in names} <= METRICS.keys()


@pytest.mark.parametrize(
    ("passed", "code"), [((True, True, True), 0), ((True, False, True), 1), ((False,) * 3, 1)]
)
def test_seeds_count_up_and_one_that_fails_is_exit_code_one(
    cli: Cli, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, passed: tuple[bool, ...], code: int
) -> None:
    monkeypatch.chdir(tmp_path)
    jobs: list[Job] = []
    names: list[str] = []

    def fly_all(runner: Runner, name: str, wanted: list[Job], out: Path) -> list[Row]:
        jobs.extend(wanted)
        names.append(name)
        return [made(0.01, holds) for holds in passed]

    monkeypatch.setattr(Runner, "fly", fly_all)
    assert cli("fly", "hover", "--seeds", "3", "--seed", "5") == code
    assert [job.options["seed"] for job in jobs] == [5, 6, 7]
    assert len({job.folder for job in jobs}) == 3
    assert names == ["hover-5-7"]
