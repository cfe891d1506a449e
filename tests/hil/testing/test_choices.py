"""Edges of the pytest plugin's choices and folders, without a flight."""

import re
from contextlib import nullcontext
from dataclasses import replace
from math import nan
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from hil.board.imu import COS, SIN
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.request import Options
from hil.testing import baselines
from hil.testing.baselines import POSE, Pinned
from hil.testing.board import BareBoard
from hil.testing.choices import name_of, why_not
from hil.testing.flights import (
    NAME_MAX,
    PICTURE,
    SHOWN,
    Flights,
    Flown,
    Item,
    draw,
    folder_of,
    properties_of,
    shown_of,
    text_of,
    trim,
    without_deleted,
)
from hil.testing.strategies import _round_step
from support.choices import choice


def test_a_name_tells_only_what_differs_between_the_choices() -> None:
    two = [choice(1), choice(2)]
    assert [name_of(one, two) for one in two] == ["seed1", "seed2"]
    boards = [choice(1, "c"), choice(1, "python")]
    assert [name_of(one, boards) for one in boards] == ["c", "python"]
    three = [choice(1), choice(2), choice(1, "python")]
    assert [name_of(one, three) for one in three] == ["c-seed1", "c-seed2", "python-seed1"]
    assert name_of(choice(), [choice()]) == ""
    faulty: list[Options] = [{**choice(), "faults": ("push.y@1=1", "push.x@2=1")}, {**choice(), "faults": ()}]
    assert [name_of(one, faulty) for one in faulty] == ["push.y@1=1+push.x@2=1", "no-fault"]


@pytest.mark.parametrize("count", [1, SHOWN, SHOWN + 1])
def test_of_a_few_flights_all_are_shown_and_of_more_the_last(count: int) -> None:
    flown: Any = [SimpleNamespace(number=number) for number in range(count)]
    shown = [one.number for one in shown_of(Item("x", Path(), Path(), choice(), flown))]
    assert shown == (list(range(count)) if count <= SHOWN else [count - 1])


def test_names_that_differ_in_what_a_folder_cannot_have_get_folders_of_their_own() -> None:
    names = [
        "a[1]", "a-1", "a(1)", "a.py::test[x/y]", "a.py::test[x y]", "a" * NAME_MAX, "a" * (NAME_MAX + 1),
    ]  # fmt: skip
    names += ["x" * (NAME_MAX + 20), "x" * (NAME_MAX + 20) + "y"]
    folders = [folder_of(name) for name in names]
    assert len(set(folders)) == len(names)
    assert folders[1] == "a-1"
    assert all(re.fullmatch(r"[\w.-]{1,100}", folder) for folder in folders)


@pytest.mark.parametrize(
    ("step", "rounded"),
    [(0.1, 0.1), (0.11, 0.2), (0.2, 0.2), (0.21, 0.5), (0.5, 0.5), (0.51, 1.0), (3e-4, 5e-4)],
)
def test_a_step_is_the_next_round_number(step: float, rounded: float) -> None:
    assert _round_step(step) == pytest.approx(rounded)


def test_what_the_imu_is_fed_is_turned_by_45_degrees_and_ends_at_its_range() -> None:
    board = BareBoard(load_config())
    board.feed_imu(omega_B=(1.0, 0.0, 0.5))
    gx, gy, gz, *_ = board._board.imu
    assert gx / gz == pytest.approx(2 * COS, rel=0.01)
    assert gy / gz == pytest.approx(-2 * SIN, rel=0.01)
    board.feed_imu(omega_B=(0.0, 0.0, 1e3), f_B=(0.0, 0.0, -1e3))
    assert board._board.imu[2] == 32767
    assert board._board.imu[5] == -32768


def test_samples_differ_by_a_count_to_either_side_until_the_imu_stops(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    board, seen = BareBoard(load_config()), list[Any]()
    monkeypatch.setattr(board._board, "measure", seen.append)
    board.run(ms=3)
    board.imu_running = False
    board.run(ms=3)
    assert [np.subtract(one, board._fed)[2] for one in seen] in ([1, -1, 1], [-1, 1, -1])
    assert all(np.delete(np.subtract(one, board._fed), 2).tolist() == [0] * 5 for one in seen)
    with pytest.raises(
        LabError, match=r"^log variable 'Estimate\.z': there is none; cfclient lists them all$"
    ):
        board.read("Estimate.z")


def test_a_packet_that_is_hushed_is_not_repeated_beside_the_next_one() -> None:
    board = BareBoard(load_config())
    arrived: list[bytes] = []
    board._arrive = arrived.append  # type: ignore[method-assign]
    board.receive(b"\x30a", every_ms=10)
    board.stop_repeating()
    board.receive(b"\x30b", every_ms=10)
    board.run(ms=35)
    assert arrived == [b"\x30a", *[b"\x30b"] * 4]


def test_an_expectation_goes_no_further_than_it_may() -> None:
    board = BareBoard(load_config())
    with pytest.raises(AssertionError, match=r"not printed within 2\.5 ms"):
        board.expect("never", within_ms=2.5)
    assert board.now_us == 2_500


def flown(number: int, folder: Path, outcome: str = "completed", cause: str = "", **more: Any) -> Any:
    """Return a flight of a test, with its own folder."""
    bench = SimpleNamespace(board="c", link="radio", is_image=more.pop("is_image", False), in_lockstep=True)
    request = SimpleNamespace(experiment=SimpleNamespace(name="hover"), seed=number + 4, profile="floaty", bench=bench,
    faults=("push.y@1=2",), duration_s=2.5)  # fmt: skip
    result = SimpleNamespace(outcome=outcome, cause=cause, failed=("max_x: 9 cm",), stood_still_ms=more.pop("still",
    0.0), failures=(), own_metrics={})  # fmt: skip
    run = SimpleNamespace(folder=folder / str(number), result=result, hash=f"{number}" * 8, outcome=outcome,
        metrics={"rms_x": 0.25, "rise": nan, "flown": 2.0}, unit_of=lambda name: "m" * (name == "rms_x"))  # fmt: skip
    return Flown(number, request, run)  # type: ignore[arg-type]


def test_a_failed_test_tells_each_shown_flight_whole_relative_to_the_root(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "hil.testing.flights.command_of",
        lambda request: "" if request.seed == 5 else f"floaty fly hover --seed {request.seed}",
    )
    item = Item("test_it[a]", tmp_path, tmp_path / "runs", {})
    item.flown += [flown(1, tmp_path / "runs", still=12.4), flown(2, tmp_path / "runs", "lost", "fell",
        is_image=True), flown(3, tmp_path / "runs", is_image=True)]  # fmt: skip
    (tmp_path / "runs/2").mkdir(parents=True)
    (tmp_path / "runs/2" / PICTURE).touch()
    lines = text_of(item, True, "--floaty-seeds=2 ", tmp_path).splitlines()
    middle = ["  limit    max_x: 9 cm", "  fault    push.y@1=2"]
    texts = [
        ["hover, seed 5, board c, profile floaty, radio: completed", *middle, "  folder   runs/1",
         "  machine  was too slow: time stood still for 12 ms", "  again    pytest --floaty-seeds=2 'test_it[a]'"],
        ["hover, seed 6, board c, profile floaty, radio: lost: fell", *middle, "  folder   runs/2",
        f"  picture  runs/2/{PICTURE}",
         "  again    floaty fly hover --seed 6", "  debug    floaty debug runs/2"],
        ["hover, seed 7, board c, profile floaty, radio: completed", *middle, "  folder   runs/3",
         "  again    floaty fly hover --seed 7", "  debug    floaty debug runs/3 --at 2.5"],
    ]  # fmt: skip
    assert lines == [line for text in texts for line in text]
    dropped = text_of(item, False, "", tmp_path).splitlines()
    assert not any(line.startswith(("  folder", "  debug")) for line in dropped)
    item.flown.append(flown(4, tmp_path / "runs"))
    last = text_of(item, True, "", tmp_path).splitlines()
    assert (last[0], last[-1]) == (texts[0][0].replace("seed 5", "seed 8"),
        "(3 flights before that are not shown)")  # fmt: skip
    assert dict(properties_of(item, True, tmp_path)) == {"floaty.hash": "44444444",
        "floaty.outcome": "completed", "floaty.folder": "runs/4", "floaty.again": "floaty fly hover --seed 8",
        "floaty.rms_x [m]": "0.25", "floaty.flown": "2"}  # fmt: skip
    crashed = flown(5, tmp_path / "runs", is_image=True)
    crashed.run.result.failures = ("assert",)
    assert (
        text_of(replace(item, flown=[crashed]), True, "", tmp_path).splitlines()[-1]
        == "  debug    floaty debug runs/5"
    )
    item.flown[2:] = []
    assert [name for name, _ in properties_of(item, False, tmp_path)] == [f"floaty.{n}.{name}" for n in (1,
        2) for name in ("hash", "outcome", "again", "rms_x [m]", "flown")]  # fmt: skip
    text = f"<Run a; {tmp_path}/runs/1> <Run b; {tmp_path}/runs/2>"
    assert without_deleted(item, True, text) == text
    assert without_deleted(item, False, text) == "<Run a> <Run b>"


def test_a_baseline_reads_back_as_it_was_written_a_row_of_the_path_on_each_line(tmp_path: Path) -> None:
    path = ((0.0, 1.0, 2.0), (0.1, 3.0, 4.5))
    pinned = (Pinned("hover, seed 1", "completed", "ab", {"rms_x": 0.5}, path),
        Pinned("yaw", "lost", "cd", {}))  # fmt: skip
    file = tmp_path / "baselines" / "x.json"
    baselines.write(file, pinned)
    assert baselines.read(file) == pinned
    lines = file.read_text().splitlines()
    assert [line for line in lines if line.startswith("  [")] == ["  [0.0, 1.0, 2.0],", "  [0.1, 3.0, 4.5]"]
    assert baselines.file_of(tmp_path, "x") == file


def test_what_left_a_baseline_is_told_whole_and_the_first_row_that_differs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The metrics: max_y by a tenth, rms_x by less than what is allowed; the path differs in y of its second row."""
    row = tuple(map(float, range(8)))
    moved = (*row[:2], 7.5, *row[3:])
    kept = Pinned("hover", "completed", "a", {"max_y": 0.1, "rms_x": 0.02, "flown": 2.0}, (row, row))
    now = Pinned("hover", "completed", "b", {"max_y": 0.11, "rms_x": 0.0201, "flown": 2.0}, (row, moved))

    def told(after: Pinned, rel: float = 0.05, metrics: tuple[str, ...] = ()) -> list[str]:
        monkeypatch.setattr(Pinned, "of", lambda run: after)
        run: Any = SimpleNamespace(result=SimpleNamespace(own_metrics={}))
        return baselines.difference(kept, run, rel, metrics)

    table = ["  metric  baseline   now  difference  unit", "  rms_x          2  2.01        0.01  cm",
        "  max_y         10    11           1  cm", "1 metrics are equal."]  # fmt: skip
    assert told(now)[0] == "hover, left by more than 5 %: max_y"
    assert sorted(told(now)[1:5]) == sorted(table)
    assert told(now)[-1] == "first difference: row at 0.00 s from the release, truth.y: 2.0 | 7.5"
    assert told(now, 0.2) == told(now, 0.05, ("rms_x",)) == []
    lost = replace(now, outcome="lost", path=kept.path[:1])
    assert told(lost, 0.2)[:2] == ["hover", "outcome: completed | lost"]
    assert told(lost, 0.2)[-1] == "the rows are equal; the last is at 0.00 s | 0.00 s"
    later = replace(lost, path=(*kept.path, (3.5, *row[1:])))
    assert told(later, 0.2)[-1] == "the rows are equal; the last is at 0.00 s | 3.50 s"
    assert told(replace(lost, path=kept.path), 0.2)[-1] == "1 metrics are equal."
    kept = replace(kept, path=())
    assert told(lost, 0.2)[-1] == "1 metrics are equal.", "a baseline over a link has no path"


@pytest.mark.parametrize(("rows", "apart"), [(5, 10), (1000, 10), (1001, 20), (2500, 30)])
def test_a_pinned_path_has_at_most_a_hundred_rows_in_seconds_from_its_first(rows: int, apart: int) -> None:
    columns = {name: np.arange(rows) + n for n, name in enumerate(POSE)}
    table = pa.table({"t": 5_000_000 + 10_000 * np.arange(rows)} | columns)
    path = baselines._path_of(SimpleNamespace(free=table))  # type: ignore[arg-type]
    assert [row[1] for row in path] == list(range(0, rows, apart))
    assert [row[0] for row in path] == pytest.approx([0.01 * n for n in range(0, rows, apart)])
    assert path[0][1:] == tuple(range(7))
    assert baselines._path_of(SimpleNamespace(free=table.slice(0, 0))) == ()  # type: ignore[arg-type]
    for in_lockstep in (True, False):
        request = SimpleNamespace(title="hover", bench=SimpleNamespace(in_lockstep=in_lockstep))
        run: Any = SimpleNamespace(
            free=table, request=request, outcome="completed", hash="h", metrics={"a": nan, "b": 1}
        )
        assert Pinned.of(run) == Pinned("hover", "completed", "h", {"b": 1.0}, path if in_lockstep else ())


@pytest.mark.parametrize(("changes", "name"), [({}, []), ({"link": "mavlink"}, ["mavlink"]),
    ({"link": "udp://1:2"}, ["udp"]), ({"profile": "a/mine.toml"}, ["mine"]), ({"seed": 3}, ["seed3"]),
    ({"faults": ("push.y@1=2",), "profile": "lqr", "link": "mavlink", "seed": 2, "board": "python"},
    ["push.y-1-2", "lqr", "mavlink", "seed2"])])  # fmt: skip
def test_an_unusual_choice_has_a_baseline_of_its_own_and_a_board_has_none(
    changes: dict[str, Any], name: list[str], tmp_path: Path
) -> None:
    usual: Any = {"seed": 1, "board": "c", "profile": "floaty", "link": "radio"}
    assert Flights(tmp_path, tmp_path)._unusual(usual | changes) == name


def test_a_flight_over_mavlink_needs_its_package_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    over: Options = {**choice(), "link": "mavlink"}
    monkeypatch.setattr("importlib.util.find_spec", lambda name: name)
    assert why_not(over, ()) == why_not(choice(), ()) == ""
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert (why_not(over, ()), why_not(choice(), ())) == ("link mavlink: pymavlink is not installed", "")


@pytest.fixture
def flights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The fixture of a test on python with seed 7 and two faults; each flight's folder is made, nothing flies."""

    def request_of(experiment: str, **options: Any) -> Any:
        bench = SimpleNamespace(
            board=options["board"], link=options["link"], is_image=False, in_lockstep=True
        )
        return SimpleNamespace(experiment=experiment, options=options, bench=bench)

    def fly(request: Any, place: Path, flight_of: str) -> Any:
        assert flight_of == "maker"
        place.mkdir(parents=True)
        return SimpleNamespace(request=request, place=place)

    def fly_swarm(experiment: str, robots: int, place: Path, **options: Any) -> Any:
        request = request_of(experiment, **options)
        each = [SimpleNamespace(request=request, folder=place / f"robot-{n}") for n in range(robots)]
        return SimpleNamespace(robots=each)

    patched = {"request_of": request_of, "fly": fly, "fly_swarm": fly_swarm, "maker_of": lambda request: "maker",
        "reserved": lambda request, place: nullcontext(), "command_of": lambda request: "", "why_no_board": lambda one: "",
        "Run": lambda result: SimpleNamespace(request=result.request, folder=result.place)}  # fmt: skip
    for name, value in patched.items():
        monkeypatch.setattr(f"hil.testing.flights.{name}", value)
    made = Flights(tmp_path, tmp_path / "runs", "usual", coverage=tmp_path / "cov")
    made.begin(
        "t.py::test[a]",
        tmp_path / "t.py",
        {**choice(7, "python", "mine"), "faults": ("push.y@1=2", "push.x@2=1")},
    )
    return made


def test_flights_of_a_test_have_numbers_folders_and_options_of_the_mark_before_their_own(
    flights: Any, tmp_path: Path
) -> None:
    """Coverage only for an image; robots of a swarm have a number each, and a folder together."""
    (tmp_path / "mine.toml").touch()
    item = flights._item
    first = flights.fly("hover", faults=["push.z@3=1"], seed=8)
    flights.fly("x.py:y", board="cf2.elf", profile="mine.toml")
    flights.fly_swarm("hover", 2)
    last = flights.fly()
    assert [one.number for one in item.flown] == [1, 2, 3, 4, 5]
    place = item.folder
    assert place == tmp_path / "runs" / folder_of("t.py::test[a]")
    assert [one.run.folder for one in item.flown] == [place / "1", place / "2", place / "3" / "robot-0",
        place / "3" / "robot-1", place / "5"]  # fmt: skip
    both = ("push.y@1=2", "push.x@2=1")
    assert first.request.options == {**choice(8, "python", "mine"), "faults": (*both, "push.z@3=1")}
    image = item.flown[1].request
    assert image.experiment == "x.py:y"
    assert image.options == {
        **choice(7, "cf2.elf", f"{tmp_path}/mine.toml"),
        "faults": both,
        "coverage": tmp_path / "cov",
    }
    assert item.flown[2].request.options == {**choice(7, "python", "mine"), "faults": both}
    assert (last.request.experiment, flights.seed, flights.profile, flights.target, flights.link, flights.faults) == (
        "hover", 7, "mine", "python", "radio", both)  # fmt: skip
    trim(item, False)
    assert [path.name for path in place.iterdir()] == ["5"]
    assert item.flown == []
    flights.begin("t.py::test[a]", tmp_path / "t.py", choice())
    assert not place.exists(), "of an earlier session"
    for _ in range(SHOWN + 1):
        flights.fly()
    assert flights._item.flown[0].number == 1
    trim(flights._item, True)
    assert sorted(path.name for path in place.iterdir()) == ["1", "2", "3", "4"], "all are kept"


@pytest.mark.parametrize("coverage", [None, Path("seen")])
@pytest.mark.parametrize("board", ["a.elf", "python"])
def test_images_add_their_coverage_where_that_was_asked_for(
    flights: Any, tmp_path: Path, coverage: Path | None, board: str
) -> None:
    own = Flights(tmp_path, tmp_path, coverage=coverage)
    own._item = flights._item
    assert own._chosen({"board": board}).get("coverage") == (coverage if board == "a.elf" else None)


def test_a_baseline_is_of_as_many_flights_and_of_metrics_that_there_are(
    flights: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    unknown: list[str] = []
    kept: list[Any] = []
    monkeypatch.setattr(baselines.Pinned, "of", lambda run: run)
    monkeypatch.setattr(
        baselines, "write", lambda path, runs: kept.extend(runs) or path.parent.mkdir() or path.touch()
    )
    monkeypatch.setattr(baselines, "read", lambda path: kept)
    monkeypatch.setattr(baselines, "difference", lambda old, run, rel, metrics: ["left"] * (old is not run))
    with pytest.raises(LabError, match=r"^baseline 'a': this test has not flown yet$"):
        flights.baseline("a")
    flights.fly().unit_of = lambda name: ""
    flights.fly().unit_of = unknown.append
    again = "`pytest --floaty-update 't.py::test[a]'`"
    shown = "baselines/a-push.y-1-2-push.x-2-1-mine-seed7.json"
    with pytest.raises(LabError, match="there is none") as missing:
        flights.baseline("a", metrics=["rms_x", "max_z"])
    assert str(missing.value) == f"baseline {shown}: there is none; {again} writes it, then commit it"
    assert unknown == ["rms_x", "max_z"], "of the last flight"
    flights._update = True
    flights.baseline("a")
    assert (flights._item.written, [run.folder.name for run in kept]) == ([shown], ["1", "2"])
    flights._update = False
    flights.baseline("a")
    kept.reverse()
    with pytest.raises(
        AssertionError, match=f"^baseline {shown}:\nleft\nleft\naccept the new flights: pytest"
    ):
        flights.baseline("a")
    for change, count in ((kept.pop, 1), (lambda: kept.extend([1, 2]), 3)):
        change()
        with pytest.raises(LabError, match=rf"json: of {count} flights, now 2; `pytest .*` writes it again$"):
            flights.baseline("a")


def test_only_shown_flights_with_rows_are_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hil.pictures.drawing.png", lambda draw, log: f"{log.num_rows}".encode())
    item = Item("a", tmp_path, tmp_path, choice())
    for number, rows in ((1, 1), (2, 2), (3, 3)):
        (tmp_path / str(number)).mkdir()
        item.flown.append(flown(number, tmp_path))
        item.flown[-1].run.log = SimpleNamespace(num_rows=rows)  # type: ignore[misc]
    draw(item)
    assert {path.parent.name: path.read_text() for path in tmp_path.rglob(PICTURE)} == {"2": "2", "3": "3"}
