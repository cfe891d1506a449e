"""The process of a live picture, with a screen of the test's own: rows, texts and values in their order, and counts."""

import io
import json
import os
import signal
import sys
from collections.abc import Iterable, Mapping
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pytest

from hil.errors import LabError
from hil.live import picture
from hil.live.feed import EVENTS, PARAMETERS, READY, TAKEN, TYPED


class Screen:
    address = "here"

    def __init__(self) -> None:
        self.shown: list[Any] = []

    def show_rows(self, rows: pa.Table, events: Iterable[Mapping[str, Any]]) -> None:
        self.shown.append(("rows", rows["x"].to_pylist(), [event["text"] for event in events]))

    def know(self, values: Mapping[str, float]) -> None:
        self.shown.append(("values", dict(values)))

    def close(self) -> None:
        self.shown.append("closed")


def test_a_picture_shows_what_comes_and_counts_all_that_it_took(monkeypatch: pytest.MonkeyPatch) -> None:
    screen, said = Screen(), []
    monkeypatch.setattr(picture, "open_screen", lambda target, program, typed: screen)
    schema = pa.schema([("x", pa.int64())])
    stream = io.BytesIO()
    with pa.ipc.new_stream(stream, schema) as writer:
        for rows, texts, values in (([1, 2, 3], ["a"], {}), ([4, 5], [], {"b": 2.0}), ([], ["c"], {})):
            metadata = {
                EVENTS: json.dumps([{"t_us": 0, "source": "lab", "text": text} for text in texts]).encode(),
                PARAMETERS: json.dumps(values).encode(),
            }
            writer.write_batch(
                pa.RecordBatch.from_arrays([pa.array(rows, pa.int64())], schema=schema), metadata
            )
    stream.seek(0)
    picture.run("window", "fly", stream, lambda word, text: said.append((word, text)))
    assert said == [(READY, "here"), (TAKEN, "3"), (TAKEN, "5"), (TAKEN, "5")]
    assert screen.shown == [
        ("rows", [1, 2, 3], ["a"]), ("values", {"b": 2.0}), ("rows", [4, 5], []), ("rows", [], ["c"]), "closed",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("error", "told", "code"),
    [
        (None, "taken 7", 0),
        (LabError("--view x: expected nothing"), "failed --view x: expected nothing", 1),
        (ModuleNotFoundError("no rerun", name="rerun.sdk"), "failed --view window: rerun is missing: ", 1),
        (ImportError("cannot import x", name="x"), "failed ImportError: cannot import x", 1),
        (ZeroDivisionError("odd"), "failed ZeroDivisionError: odd", 1),
    ],
)
def test_the_process_answers_in_lines_and_what_libraries_print_is_not_among_them(
    error: Exception | None,
    told: str,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    asked: list[Any] = []

    def run(target: str, program: str, rows: Any, say: picture.Say) -> None:
        asked.append((target, program, rows))
        os.write(1, b"a library's words\n")
        if error is not None:
            raise error
        say(TAKEN, "7")
        assert capfd.readouterr() == ("taken 7\n", "a library's words\n"), "at once"
        say(TAKEN, "7")
        os.write(1, b"a library's words\n")

    monkeypatch.setattr(picture, "run", run)
    monkeypatch.setattr(picture.os, "nice", asked.append)
    monkeypatch.setattr(picture.signal, "signal", lambda *what: asked.append(what))
    monkeypatch.setattr(sys, "argv", ["picture", "window", "fly"])
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer="rows"))
    places = {"stdout": 1, "stderr": 2}
    for name, number in places.items():
        monkeypatch.setattr(
            sys, name, SimpleNamespace(fileno=lambda number=number: number, write=len, flush=list)
        )
    kept = os.dup(1)
    try:
        assert picture.main() == code
    finally:
        os.dup2(kept, 1)
        os.close(kept)
    out, err = capfd.readouterr()
    assert out.startswith(told)
    assert out.count("\n") == 1
    assert err == "a library's words\n"
    assert asked == [(signal.SIGINT, signal.SIG_IGN), picture.NICE, ("window", "fly", "rows")]


def test_a_stream_that_breaks_off_closes_the_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Screen()
    monkeypatch.setattr(picture, "open_screen", lambda target, program, typed: typed("goal 1 2 3") or screen)
    said: list[Any] = []
    picture.run("web", "fly", io.BytesIO(b"\xff\xff\xff\xff\x10"), lambda *what: said.append(what))
    assert (said, screen.shown) == ([(TYPED, "goal 1 2 3"), (READY, "here")], ["closed"])
