"""A flight replaces no flight of another request, and shares its folder with no other flight."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import FrameType

import pytest

from hil import LabError, fly, load_run
from hil.api import request_of
from hil.laboratory.files.folder import OLDER, folder_of, other_in, reserved
from hil.laboratory.files.recorder import PARQUET
from hil.laboratory.files.whole_files import write_whole
from support.command import Cli

pytestmark = pytest.mark.usefixtures("empty_folder")

SHORT = 0.05  # [s]
SOON = {"flight.release_us": 50_000}
HOLDER = """
import sys
from pathlib import Path
from hil.api import request_of
from hil.laboratory.files.folder import reserved
with reserved(request_of("hover", duration_s=0.05), Path(sys.argv[1])):
    print("reserved", flush=True)
    sys.stdin.read()
"""


def stored(folder: str) -> list[tuple[str, bytes]]:
    return [(path.name, path.read_bytes()) for path in sorted(Path(folder).iterdir())]


@pytest.mark.long
def test_a_flight_replaces_the_same_request_alone() -> None:
    first = fly("hover", duration_s=SHORT)
    (first.folder / "note.txt").write_text("mine")
    again = fly("hover", duration_s=SHORT)
    assert (again.folder, again.hash) == (first.folder, first.hash)
    assert not (again.folder / "note.txt").exists()
    kept = stored("runs/hover-1")
    longer = fly("hover", duration_s=0.1)
    assert longer.folder == Path("runs/hover-1-2")
    assert stored("runs/hover-1") == kept
    assert fly("hover", duration_s=0.1).folder == longer.folder


@pytest.mark.long
def test_a_flight_that_was_just_made_way_for_counts_and_an_empty_place_for_it_does_not() -> None:
    folder = fly("hover", duration_s=SHORT).folder
    (folder / OLDER).mkdir()
    same, longer = (request_of("hover", duration_s=duration_s) for duration_s in (SHORT, 0.1))
    for kept in (folder, folder / OLDER):
        for path in [] if kept == folder else [*folder.glob("*.*")]:
            path.rename(kept / path.name)
        assert other_in(folder, same) == ""
        assert other_in(folder, longer) == "another flight (duration 0.05 s)"


@pytest.mark.long
def test_every_part_of_the_request_counts() -> None:
    fly("hover", duration_s=SHORT)
    for options in (
        {"profile": "lqr"}, {"duration_s": 0.1}, {"overrides": {"controller.gain_z": 3.1}}, {"faults": ["push.y@0=1"]},
        {"link": "mavlink"}, {"board": "python"},
    ):  # fmt: skip
        request = request_of("hover", **{"duration_s": SHORT, **options})  # type: ignore[arg-type]
        assert folder_of(request) == Path("runs/hover-1-2"), options
    assert folder_of(request_of("hover", duration_s=SHORT)) == Path("runs/hover-1")
    assert folder_of(request_of("hover", seed=2, duration_s=SHORT)) == Path("runs/hover-2")


@pytest.mark.long
def test_a_folder_that_was_asked_for_keeps_another_flight_unless_it_may_be_replaced() -> None:
    fly("hover", "mine", duration_s=SHORT)
    kept = stored("mine")
    with pytest.raises(LabError) as error:
        fly("hover", "mine", duration_s=0.1, profile="lqr")
    assert str(error.value) == (
        "--out mine: holds another flight (duration 0.05 s; profile floaty): choose another folder, or delete this one"
    )
    assert stored("mine") == kept
    assert fly("hover", "mine", replace=True, duration_s=0.1, profile="lqr").request.profile == "lqr"


@pytest.mark.long
def test_an_unreadable_folder_is_not_replaced() -> None:
    run = fly("hover", duration_s=SHORT)
    result = json.loads((run.folder / "result.json").read_text())
    (run.folder / "result.json").write_text(json.dumps({**result, "seed": "one"}))
    assert folder_of(request_of("hover", duration_s=SHORT)) == Path("runs/hover-1-2")
    Path("runs/hover-2").write_text("a file")
    assert folder_of(request_of("hover", seed=2)) == Path("runs/hover-2-2")


@pytest.mark.long
def test_a_flight_whose_process_was_killed_is_known_by_its_log() -> None:
    run = fly("hover", duration_s=SHORT)
    (run.folder / "result.json").unlink()
    assert (run.folder / PARQUET).exists()
    assert folder_of(request_of("hover", duration_s=SHORT)) == Path("runs/hover-1")
    assert folder_of(request_of("hover", duration_s=0.1)) == Path("runs/hover-1-2")


def fly_until_killed(function: str, file: str, call: int) -> int:
    """Fly in another process, which is killed at a call of a function, and return the signal."""
    child = os.fork()
    if child == 0:
        calls = []

        def kill(frame: FrameType, event: str, _: object) -> None:
            if event == "call" and frame.f_code.co_name == function and file in frame.f_code.co_filename:
                calls.append(event)
                if len(calls) == call:
                    os.kill(os.getpid(), signal.SIGKILL)

        try:
            sys.setprofile(kill)
            fly("hover", duration_s=SHORT, overrides=SOON)
        finally:
            os._exit(1)
    return -os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.parametrize(
    ("older", "function", "file", "call"),
    [
        (False, "__init__", "telemetry_log.py", 1),  # into an empty folder
        (False, "__init__", "ground_station/station.py", 1),  # the telemetry log is empty
        (False, "__init__", "recorder.py", 1),
        (False, "row", "recorder.py", 5),  # before the first second is on disk
        (False, "replacing", "whole_files.py", 1),  # before the log is converted
        (False, "replacing", "whole_files.py", 3),  # before the result is written
        (True, "rename", "pathlib", 3),  # the older run is half set aside
        (True, "__init__", "ground_station/station.py", 1),
        (True, "rmtree", "shutil.py", 2),  # the older run is to be deleted
        (True, "_rmtree_safe_fd", "shutil.py", 1),
    ],
)
def test_a_killed_flight_is_repeated_in_its_folder(older: bool, function: str, file: str, call: int) -> None:
    if older:
        fly("hover", duration_s=SHORT, overrides=SOON)
    assert fly_until_killed(function, file, call) == signal.SIGKILL
    again = fly("hover", duration_s=SHORT, overrides=SOON)
    assert (again.folder, again.outcome) == (Path("runs/hover-1"), "completed")
    assert {path.name for path in again.folder.iterdir()} == {
        "log.parquet", "events.jsonl", "telemetry.csv", "schedule.parquet", "result.json"
    }  # fmt: skip


def test_a_file_of_somebody_else_beside_an_unfinished_flight_is_kept() -> None:
    fly_until_killed("__init__", "ground_station/station.py", 1)
    assert os.listdir("runs/hover-1") == ["telemetry.csv"]
    assert folder_of(request_of("hover", duration_s=0.1)) == Path("runs/hover-1")
    for name, content in (("telemetry.csv", "of a station"), ("notes.txt", "")):
        Path("runs/hover-1/telemetry.csv").write_text("")
        Path("runs/hover-1", name).write_text(content)
        assert folder_of(request_of("hover", duration_s=SHORT)) == Path("runs/hover-1-2")


def test_a_refused_flight_leaves_no_folder() -> None:
    with pytest.raises(LabError), reserved(request_of("hover"), Path("new")):
        raise LabError("no board")
    assert not Path("new").exists()


def test_the_command_names_the_folder_that_stays(cli: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    fly("hover", duration_s=SHORT)
    kept = stored("runs/hover-1")
    monkeypatch.setattr("hil.commands.options.write_pictures", lambda folder, experiment: None)
    cli("fly", "hover", "--duration", "0.1")
    assert cli.err.splitlines() == [
        "runs/hover-1 holds another flight (duration 0.05 s); this flight is in runs/hover-1-2"
    ]
    assert "runs/hover-1-2/log.parquet" in cli.out
    assert stored("runs/hover-1") == kept
    assert load_run("runs/hover-1-2").request.duration_s == 0.1
    assert cli("fly", "hover", "--duration", "0.1", "--out", "runs/hover-1") == 2
    assert cli.err == (
        "floaty: --out runs/hover-1: holds another flight (duration 0.05 s): choose another folder, or delete this one\n"
    )


def test_a_second_flight_into_a_folder_is_refused_until_the_first_ends_or_is_killed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, "shared"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "reserved\n"
        with pytest.raises(LabError, match="--out shared: another flight is writing there: wait for its end"):
            fly("hover", "shared", duration_s=SHORT)
        assert os.listdir("shared") == []
        other.kill()
    assert fly("hover", "shared", duration_s=SHORT).folder == Path("shared")


def test_a_link_to_a_file_stays_a_link_when_the_file_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "elsewhere" / "file")
    for text in ("first", "second"):
        write_whole(link, text)
        assert (link.is_symlink(), (tmp_path / "elsewhere" / "file").read_text()) == (True, text)
