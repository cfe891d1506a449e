"""The process of a live picture, with a screen of the test's own: rows, texts and values in their order, and counts."""

import io
import json
from collections.abc import Iterable, Mapping
from typing import Any

import pyarrow as pa
import pytest

from hil.live import picture
from hil.live.feed import EVENTS, PARAMETERS, READY, TAKEN


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
