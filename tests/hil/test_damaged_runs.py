"""A run folder of somebody else is data: whatever it contains, each reader succeeds or refuses it in one line."""

import json
import math
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil import fly, load_run
from hil.errors import LabError, reading
from hil.laboratory.files.recorder import load_events
from hil.laboratory.schedule import load_schedule
from hil.pictures.viewer.recording import recording_of
from hil.research.identify.record import load_record
from support.command import Cli, floaty

Read = Callable[[Path, Path], None]  # reads the first folder; the second is not damaged
FILES = ("result.json", "log.parquet", "events.jsonl", "schedule.parquet", "telemetry.csv")
VALUES = (
    None, True, -1, 0, 1.5, 10**30, 10**400, 1e308, math.nan, math.inf, "", "x", "1", "\x1b[2J", "\ud800", "a" * 10_000, [],
    {}, [[]], [1, 2, 3], {"a": 1},
)  # fmt: skip
DEEP = 100_000  # levels


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("flown") / "run"
    assert fly("hover", folder, duration_s=0.3, faults=["push.y@0.1:0.1=1"]).outcome == "completed"
    assert {path.name for path in folder.iterdir()} == set(FILES)
    return folder


@pytest.fixture(scope="module")
def copy(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[], Path]:
    """Return the function that makes the same folder a copy of the flown one again."""
    place = tmp_path_factory.mktemp("damaged") / "run"

    def copied() -> Path:
        shutil.rmtree(place, ignore_errors=True)
        return Path(shutil.copytree(flown, place))

    return copied


# Damage


@st.composite
def other_bytes(draw: st.DrawFn, content: bytes) -> bytes:
    """Truncate, flip, remove or insert bytes."""
    at, length = draw(st.integers(0, len(content))), draw(st.integers(1, 200))
    kind = draw(st.sampled_from(("truncate", "flip", "remove", "insert")))
    if kind == "truncate":
        return content[:at]
    if kind == "flip":
        flips = draw(st.binary(min_size=1, max_size=30))
        flipped = bytes(a ^ b for a, b in zip(content[at:], flips, strict=False))
        return content[:at] + flipped + content[at + len(flipped) :]
    return content[:at] + (draw(st.binary(max_size=30)) if kind == "insert" else b"") + content[at + length :]


@st.composite
def other_json(draw: st.DrawFn, text: bytes) -> bytes:
    """Delete a key or replace a value, anywhere in the tree; or nest it too deeply."""
    tree = {"whole": json.loads(text)}
    if draw(st.integers(0, 20)) == 0:
        return b'{"a":' + b"[" * DEEP + b"]" * DEEP + b"}"
    node: Any = tree
    while True:
        key = draw(st.sampled_from(list(node) if isinstance(node, dict) else range(len(node))))
        if not (isinstance(node[key], dict | list) and node[key] and draw(st.booleans())):
            break
        node = node[key]
    if node is not tree and draw(st.integers(0, 3)) == 0:
        del node[key]
    else:
        node[key] = draw(st.sampled_from(VALUES))
    return json.dumps(tree["whole"], ensure_ascii=draw(st.booleans())).encode("utf-8", "surrogatepass")


@st.composite
def other_table(draw: st.DrawFn, table: pa.Table) -> pa.Table:
    """Change columns, rows or metadata of a table."""
    at = draw(st.integers(0, table.num_columns - 1))
    field, rows = table.schema.field(at), table.num_rows
    numbers = [math.nan, math.inf, 1e308, -1e308, 0.0, -1.0, 1e18]
    kind = draw(st.sampled_from(("drop", "text", "number", "rows", "nulls", "plain", "metadata")))
    if kind == "drop":
        names = draw(st.sets(st.sampled_from(table.column_names), max_size=40))
        return table.drop_columns(list(names)) if len(names) < table.num_columns else table
    if kind == "text":
        return table.set_column(at, pa.field(field.name, pa.string()), pa.array(["x"] * rows))
    if kind == "number":
        kept = pa.field(field.name, pa.float64(), metadata=field.metadata)
        return table.set_column(at, kept, pa.array([draw(st.sampled_from(numbers))] * rows))
    if kind == "rows":
        return table.slice(0, draw(st.integers(0, 5)))
    if kind == "nulls":
        return table.set_column(at, field, pa.nulls(rows, field.type))
    if kind == "plain" or not table.schema.metadata:
        return table.set_column(at, pa.field(field.name, field.type), table.column(at))
    metadata = dict(table.schema.metadata)
    name = draw(st.sampled_from(sorted(metadata)))
    metadata[name] = draw(st.one_of(other_json(metadata[name]), other_bytes(metadata[name])))
    return table.replace_schema_metadata(metadata)


def damage(draw: Callable[[st.SearchStrategy[Any]], Any], folder: Path) -> None:
    """Change one file of a run folder."""
    path = folder / draw(st.sampled_from(FILES))
    content = path.read_bytes()
    kind = draw(st.sampled_from(("missing", "folder", "bytes", "content", "content", "content")))
    if kind in ("missing", "folder"):
        path.unlink()
        if kind == "folder":
            path.mkdir()
    elif kind == "content" and path.suffix == ".parquet":
        pa.parquet.write_table(draw(other_table(pa.parquet.read_table(path))), path)
    elif kind == "content" and path.suffix == ".json":
        path.write_bytes(draw(other_json(content)))
    elif kind == "content" and path.suffix == ".jsonl":
        lines = content.splitlines()
        at = draw(st.integers(0, len(lines) - 1))
        lines[at] = draw(other_json(lines[at]))
        path.write_bytes(b"\n".join(lines) + b"\n")
    else:
        path.write_bytes(draw(other_bytes(content)))


# Readers


@contextmanager
def one_line() -> Iterator[None]:
    """Accept a `LabError` of one line."""
    told = ""
    try:
        yield
    except LabError as error:
        told = str(error)
    assert "\n" not in told


def load_everything(run: Path, _: Path) -> None:
    loaded = load_run(run)
    str(loaded)
    loaded._repr_html_()
    parts: list[Callable[[], object]] = [
        lambda: loaded.log, lambda: loaded.units, lambda: loaded.events, lambda: loaded.config, lambda: load_schedule(run),
        loaded.to_dataset,
    ]  # fmt: skip
    for part in parts:
        with one_line():
            part()


def record(run: Path, _: Path) -> None:
    with reading(run):
        load_record(run, "floaty")


def recording(run: Path, _: Path) -> None:
    with reading(run):
        recording_of(run)


def command(*words: str) -> Read:
    def call(run: Path, flown: Path) -> None:
        assert floaty(*({"RUN": run, "FLOWN": flown}.get(word, word) for word in words)) in (0, 1, 2)

    return call


READERS: dict[str, Read] = {
    "report": command("report", "RUN"),
    "compare": command("compare", "RUN", "FLOWN", "--out", "RUN"),
    "compare with": command("compare", "FLOWN", "RUN"),
    "view": recording,
    "export": command("export", "RUN", "--csv", "--mcap", "--tlog"),
    "identify": record,
    "runs": command("runs", "RUN"),
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("read", "examples"),
    [
        pytest.param(load_everything, 50, id="load_run"),
        # two plots by matplotlib per comparison
        *(pytest.param(read, 4 if "compare" in name else 40, id=name) for name, read in READERS.items()),
    ],
)
def test_a_damaged_run_is_read_or_refused_in_one_line(
    read: Read, examples: int, flown: Path, copy: Callable[[], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    @settings(max_examples=examples, database=None)
    @given(st.data())
    def law(data: st.DataObject) -> None:
        run = copy()
        damage(data.draw, run)
        with one_line():
            read(run, flown)
        refused = [line for line in capsys.readouterr().err.splitlines() if line.startswith("floaty: ")]
        assert len(refused) <= 1

    law()


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


def without_event(path: Path) -> None:
    first, *others = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join((first, '{"t_us": "soon"}', *others)), encoding="utf-8")


@pytest.mark.long
@pytest.mark.parametrize(
    ("file", "change", "told"),
    [
        ("schedule.parquet", cut, ": not a schedule ("),
        ("events.jsonl", without_event, ":2: not an event: expected JSON with t_us, source and text"),
        ("result.json", cut, ": invalid JSON: EOF while parsing"),
        ("log.parquet", cut, ": not a flight log ("),
        ("log.parquet", lambda path: path.write_bytes(b""), ": not a flight log ("),
    ],
    ids=["schedule", "events", "result", "log", "empty log"],
)
def test_what_is_damaged_is_named(
    file: str, change: Callable[[Path], None], told: str, copy: Callable[[], Path], cli: Cli
) -> None:
    run = copy()
    change(run / file)
    assert cli.refusal("report", run).startswith(f"floaty: {run / file}{told}")


def test_the_line_that_was_being_written_is_no_damage(copy: Callable[[], Path]) -> None:
    run = copy()
    whole = load_events(run)
    cut(run / "events.jsonl")
    assert load_events(run) == whole[:-1]


@pytest.mark.long
@pytest.mark.parametrize(
    ("files", "words"),
    [
        (("report.html",), ("report", "RUN")),
        (("compare.html", "compare.png"), ("compare", "FLOWN", "RUN")),
        (("flight.csv", "flight.mcap", "flight.tlog"), ("export", "RUN", "--csv", "--mcap", "--tlog")),
    ],
)
def test_a_link_in_a_run_folder_is_replaced_not_followed(
    files: tuple[str, ...], words: tuple[str, ...], flown: Path, copy: Callable[[], Path], tmp_path: Path
) -> None:
    mine = tmp_path / "mine"
    mine.write_text("mine")
    run = copy()
    for file in files:
        (run / file).symlink_to(mine)
    command(*words)(run, flown)
    assert mine.read_text() == "mine"
    assert [((run / file).is_file(), (run / file).is_symlink()) for file in files] == [(True, False)] * len(
        files
    )
