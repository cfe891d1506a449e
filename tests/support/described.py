"""Describes files and figures as text: names in full, and many numbers by their count, first, last and two sums."""

import base64
import hashlib
import json
import math
import re
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from mcap.reader import make_reader
from PIL import Image
from rerun.chunk import RrdReader

from hil.pictures.viewer.track import FROM_RELEASE
from support.figures import named

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?"
RUN = re.compile(rf"(?<![\w.#])(?:{NUMBER}[\s,;MLZ\[\]]+){{8,}}{NUMBER}(?![\w.])")
ONE = re.compile(NUMBER)
UUID = re.compile(r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}")
SKIPPED = ("rerun.controls.RowId", "log_time", "log_tick")


def numbers(values: Iterable[float]) -> str:
    """Return count, first, last, sum and sum by place of numbers; of gaps only how many there are."""
    given = [0.0 if abs(value) < 1e-12 else float(value) for value in values]
    known = [value for value in given if math.isfinite(value)]
    if len(given) <= 4:
        return " ".join(f"{value:.6g}" for value in given)
    sums = math.fsum(known), math.fsum(n * value for n, value in enumerate(given) if math.isfinite(value))
    gaps = f", {len(given) - len(known)} gaps" if len(known) < len(given) else ""
    return f"{len(given)}: {given[0]:.6g} … {given[-1]:.6g}, {sums[0]:.6g}, {sums[1]:.6g}{gaps}"


def texts(values: Iterable[Any]) -> str:
    """Return texts with how often each occurs, in the order of their first."""
    found = Counter(" / ".join(str(value).splitlines()) for value in values)
    return " | ".join(f"{text} x{count}" if count > 1 else text for text, count in found.items())


def short(text: str) -> str:
    """Return a text with a summary in place of each long list of numbers."""
    return RUN.sub(lambda run: f"<{numbers(map(float, ONE.findall(run.group())))}>", text)


def array(values: pa.Array | pa.ChunkedArray) -> str:
    """Return a column's values: nested ones flat."""
    kind = values.type
    while pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind) or pa.types.is_large_list(kind):
        values = (
            values.combine_chunks().flatten() if isinstance(values, pa.ChunkedArray) else values.flatten()
        )
        kind = values.type
    if pa.types.is_temporal(kind):
        values, kind = values.cast(pa.int64()), pa.int64()
    if pa.types.is_integer(kind) or pa.types.is_floating(kind):
        return numbers(math.nan if value is None else value for value in values.to_pylist())
    if pa.types.is_struct(kind):
        return (
            "; ".join(f"{field.name} {array(pc.struct_field(values, [n]))}" for n, field in enumerate(kind))
            if len(values)
            else ""
        )
    return texts(values.to_pylist())


def parquet(path: Path) -> Iterator[str]:
    """Yield each column with type, metadata and values."""
    table = pq.read_table(path)
    for name, value in sorted((table.schema.metadata or {}).items()):
        yield f"{name.decode()} = {short(value.decode())}"
    for field in table.schema:
        told = " ".join(f"{key.decode()}={value.decode()}" for key, value in (field.metadata or {}).items())
        yield f"{field.name} {field.type} {told}: {array(table.column(field.name))}"


def recording(path: Path) -> Iterator[str]:
    """Yield each entity's components, of all its batches."""
    batches: dict[str, list[pa.RecordBatch]] = {}
    for chunk in RrdReader(path).stream():
        batches.setdefault(str(chunk.entity_path), []).append(chunk.to_record_batch())
    yield from layout(path)
    for entity, members in sorted(batches.items()):
        columns: dict[str, list[pa.Array]] = {}
        for batch in sorted(members, key=_begin):
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                columns.setdefault(name, []).append(column)
        for name, pieces in sorted(columns.items()):
            if name not in SKIPPED:
                yield f"{entity} {name}: {len(pieces)} {component(name, pa.chunked_array(pieces))}"


def component(name: str, values: pa.ChunkedArray) -> str:
    """Return a component's values; colours as rrggbbaa, the root of the layout as its name."""
    flat = values.combine_chunks().flatten() if pa.types.is_list(values.type) else values
    if "color" in name and pa.types.is_uint32(flat.type):
        return texts(f"{value:08x}" for value in flat.to_pylist())
    if name.endswith("root_container"):
        return str(uuid.UUID(bytes=bytes(flat.flatten().to_pylist())))
    return array(values)


def layout(path: Path) -> Iterator[str]:
    """Yield the components of a recording's views and containers, from the outermost to the innermost."""
    reader, lines, order = RrdReader(path), dict[str, list[str]](), list[str]()
    for entry in reader.blueprints():
        for chunk in reader.stream(store=entry):
            batch, entity = chunk.to_record_batch(), str(chunk.entity_path)
            lines.setdefault(entity, []).extend(
                f"{entity} {name}: {component(name, pa.chunked_array([column]))}"
                for name, column in zip(batch.schema.names, batch.columns, strict=True)
                if name not in (*SKIPPED, "blueprint")
            )
    waiting = [entity for entity in sorted(lines) if not UUID.search(entity)]
    while waiting:
        for line in sorted(lines.pop(waiting.pop(0))):
            order += [one for one in UUID.findall(line) if one not in order]
            for number, view in enumerate(order):
                line = line.replace(view, f"#{number}")
            yield line
        waiting += [one for view in order for one in sorted(lines) if view in one and one not in waiting]


def _begin(batch: pa.RecordBatch) -> tuple[list[str], int]:
    times = [name for name in batch.schema.names if name == FROM_RELEASE]
    return batch.schema.names, batch.column(times[0])[0].value if times else 0


def csv(path: Path) -> Iterator[str]:
    """Yield each column of a table, or its lines when they are few."""
    rows = [line.split(",") for line in path.read_text().splitlines()]
    if len(rows) < 12:
        yield from path.read_text().splitlines()
        return
    for name, *column in zip(*(row for row in rows if len(row) == len(rows[-1])), strict=True):
        try:
            yield f"{name}: {numbers(float(cell or 'nan') for cell in column)}"
        except ValueError:
            yield f"{name}: {texts(column)}"


def mcap(path: Path) -> Iterator[str]:
    """Yield each topic with its schema, and the hash of its messages' bytes and instants."""
    found: dict[str, list[bytes]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            told = f"{channel.topic} {schema.name if schema else ''} {channel.message_encoding}"
            found.setdefault(told, []).append(message.log_time.to_bytes(8, "big") + message.data)
    for told, messages in sorted(found.items()):
        yield f"{told}: {len(messages)} {hashlib.sha256(b''.join(messages)).hexdigest()[:16]}"


def gif(path: Path) -> Iterator[str]:
    """Yield the size, and of each tenth picture its time and the mean colours of the squares of a grid."""
    with Image.open(path) as pictures:
        yield f"{pictures.size} {getattr(pictures, 'n_frames', 1)} {pictures.info}"
        for number in range(0, getattr(pictures, "n_frames", 1), 10):
            pictures.seek(number)
            grid = pictures.convert("RGB").resize((8, 8), Image.Resampling.BOX)
            yield f"{number} {pictures.info['duration']}: {numbers(np.asarray(grid, float).ravel())}"


class _Html(HTMLParser):
    """The text of a page, a line for each block or row of a table; embedded pictures and curves described."""

    INLINE = ("span", "a", "b", "i", "em", "code", "td", "th", "dt", "dd", "sup", "sub", "strong")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.lines: list[str] = []
        self._line: list[str] = []
        self._tag = ""
        self.feed(text)
        self._end()

    def _end(self) -> None:
        if self._line:
            self.lines.append(" ".join(self._line))
        self._line = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self._tag = "data" if values.get("type") == "application/json" else tag
        if tag not in self.INLINE:
            self._end()
        if tag in ("td", "th") and self._line:
            self._line.append("|")
        source = values.pop("src", "")
        if source.startswith("data:image/svg+xml"):
            source = short(base64.b64decode(source.partition(",")[2]).decode())
        shown = [
            value
            for name, value in values.items()
            if name not in ("lang", "charset", "content", "target", "type")
        ]
        if source or shown:
            self._line.append(
                f"<{' '.join([*shown, 'picture' if source.startswith('data:') else source]).strip()}>"
            )

    def handle_endtag(self, tag: str) -> None:
        self._tag = ""
        if tag not in self.INLINE:
            self._end()

    def handle_data(self, data: str) -> None:
        if self._tag == "data":
            self.lines += described(_curves(json.loads(data)))
        elif self._tag not in ("script", "style") and data.strip():
            self._line.append(short(" ".join(data.split())))


def _curves(content: Any) -> Any:
    """Return embedded figures with their curves as numbers."""
    if isinstance(content, dict):
        return {
            name: [[np.frombuffer(base64.b64decode(text), "<f4").tolist() for text in table] for table in value]
            if name == "tables" else _curves(value)
            for name, value in content.items()
        }  # fmt: skip
    return [_curves(one) for one in content] if isinstance(content, list) else content


def _leaf(value: Any) -> str:
    if isinstance(value, list):
        return f"[{numbers(value)}]" if value else "[]"
    return f"{value:.6g}" if isinstance(value, float) else short(str(value))


def _is_leaf(value: Any) -> bool:
    return (
        not value
        or not isinstance(value, dict | list)
        or (isinstance(value, list) and all(type(one) in (int, float) for one in value))
    )


def described(value: Any, name: str = "") -> Iterator[str]:
    """Yield JSON values, a line for each object or list that holds no other."""
    if _is_leaf(value):
        yield f"{name} = {_leaf(value)}"
    elif isinstance(value, dict):
        if leaves := {key: one for key, one in value.items() if _is_leaf(one)}:
            yield f"{name}: " + ", ".join(f"{key} {_leaf(one)}" for key, one in leaves.items())
        for key, one in value.items():
            if key not in leaves:
                yield from described(one, f"{name}.{key}".lstrip("."))
    elif all(isinstance(one, str) for one in value):
        yield f"{name} = {texts(value)}"
    else:
        for number, one in enumerate(value):
            yield from described(one, f"{name}[{number}]")


def lines_of(path: Path) -> Iterator[str]:
    """Yield what a file holds; of one that is neither text nor a log only that it is there."""
    kind = path.suffix
    if kind == ".parquet":
        yield from parquet(path)
    elif kind == ".rrd":
        yield from recording(path)
    elif kind == ".csv":
        yield from csv(path)
    elif kind == ".html":
        yield from _Html(path.read_text(encoding="utf-8")).lines
    elif kind == ".json":
        yield from described(json.loads(path.read_text(encoding="utf-8")))
    elif kind == ".mcap":
        yield from mcap(path)
    elif kind == ".gif":
        yield from gif(path)
    elif kind not in (".png", ".tlog", ".perfetto-trace", ".elf"):
        yield from map(short, path.read_text(encoding="utf-8").splitlines())


def figure(made: Figure) -> Iterator[str]:
    """Yield what a matplotlib figure shows."""
    yield f"figure {numbers(made.get_size_inches())} {[text.get_text() for text in made.texts]}"
    for legend in made.legends:
        yield f"legend {[text.get_text() for text in legend.get_texts()]}"
    for axes in made.axes:
        yield from _axes(axes)


def _colour(value: Any) -> str:
    given = np.atleast_2d(value) if not isinstance(value, str) else [value]
    return texts(to_hex(one, keep_alpha=True) for one in given)


def _axes(axes: Axes) -> Iterator[str]:
    yield (
        f"axes {axes.get_title()!r} {axes.get_xlabel()!r} {axes.get_ylabel()!r} {axes.get_xscale()} {axes.get_yscale()} "
        f"x {numbers(axes.get_xlim())} y {numbers(axes.get_ylim())} {axes.axison}"
    )
    if names := named(axes):
        yield f"  legend {names}"
    for line in axes.lines:
        x, y = (np.asarray(one, float) for one in line.get_data(orig=False))
        yield (
            f"  line {line.get_label()} {_colour(line.get_color())} {line.get_linestyle()} {line.get_marker()} "
            f"{line.get_linewidth():g}: {numbers(x)}; {numbers(y)}"
        )
    for patch in axes.patches:
        outline = patch.get_path().transformed(patch.get_patch_transform())
        yield f"  {type(patch).__name__} {patch.get_label()} {_colour(patch.get_facecolor())}: {_corners([outline])}"
    for one in axes.collections:
        yield (
            f"  {type(one).__name__} {one.get_label()} {_colour(one.get_facecolor()) or _colour(one.get_edgecolor())}: "
            f"{numbers(np.ma.getdata(one.get_offsets()).ravel())}; {_corners(one.get_paths())}"
        )
    for text in axes.texts:
        yield f"  text {text.get_text()!r} {numbers(text.xy if hasattr(text, 'xy') else text.get_position())}"
    for axis in (axes.xaxis, axes.yaxis):
        labels = [label.get_text() for label in axis.get_ticklabels()]
        if any(re.search("[a-z]", label) for label in labels):
            yield f"  ticks {labels}"


def _corners(paths: Sequence[Any]) -> str:
    return (
        numbers(np.concatenate([np.asarray(path.vertices, float).ravel() for path in paths])) if paths else ""
    )
