"""Reads tables of other programs: CSV, Parquet, MCAP, MAVLink telemetry logs, and the micro-SD logs of a Crazyflie."""

import json
import math
import re
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

from hil.errors import LabError, refusing, require

USD_MAGIC, PARQUET_MAGIC, MCAP_MAGIC = b"\xbc", b"PAR1", b"\x89MCAP0\r\n"
USD_UNITS = {1: "ms", 2: "us"}  # of the time stamps, by the version of the format
FORMATS = "CSV, Parquet, MCAP, a tlog, or a Crazyflie's micro-SD log"
MAVLINK_HEADS = {0xFD: 12, 0xFE: 8}  # bytes of a frame without its payload, by its first one, version 2 or 1
SIGNATURE = 13  # bytes behind a signed frame
MAVLINK_POSES = (
    "LOCAL_POSITION_NED",
    "ODOMETRY",
    "VISION_POSITION_ESTIMATE",
)  # the best first: its rows are the log's
TIME = "timestamp"
STAMP = 8  # bytes of a tlog's time stamps
ARROW = (pa.ArrowException, OSError, ValueError)

STAMPS = (".stamp", ".timestamp")  # inside messages of MCAP: the file has the time of each
LONGEST = 16  # of a list whose numbers become columns: not of images and point clouds

NUMBER = re.compile(r"\s*\"?[-+.\d]")  # how a row of numbers begins
NO_VALUE = ["", "nan", "NaN", "None", "null", "NULL"]
TORN = 0.01  # share of the rows, or cells, that may be unreadable
SHOWN = 3  # of those, in lines of their own

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of equal length (N,) by their names as in the file, which may end in a unit: "x [mm]"."""

    columns: Mapping[str, Values]
    left_out: tuple[str, ...] = ()  # columns without numbers
    notes: tuple[str, ...] = ()  # what else was left out, each a line


def read_tables(path: Path) -> list[Table]:
    """Return the tables of a file, one for each clock in it. Raises `LabError` for a file that is none of `FORMATS`."""
    with refusing(f"{path}: ", OSError):
        content = path.read_bytes()
    if content.startswith(USD_MAGIC):
        return _micro_sd(path, content)
    if content[8:9] in (b"\xfd", b"\xfe") and (tables := _tlog(path, content)):
        return tables
    if content.startswith(PARQUET_MAGIC):
        with refusing(f"{path}: damaged Parquet: ", *ARROW):
            return [_numbers(path, pa.parquet.read_table(pa.BufferReader(content)))]
    if content.startswith(MCAP_MAGIC):
        return _mcap(path, content)
    return [_csv(path, content)]


def _csv(path: Path, content: bytes) -> Table:
    """Return the table of lines with the names in the first one that is no remark (#), or behind the # of the last remark.

    A few lines that are cut off or torn are left out. Names may end with the units in brackets.
    """
    text, remark = _decoded(content).lstrip().replace("\r\n", "\n").replace("\r", "\n"), ""
    while text.startswith("#"):
        remark, _, text = text.partition("\n")
    if remark and NUMBER.match(text):
        text = f"{remark}\n{text}".lstrip("# \t")
    names, _, rows = text.partition("\n")
    if "\0" in text or not rows:
        raise LabError(f"{path}: expected {FORMATS}")
    first = rows.partition("\n")[0]
    delimiter = max((",", ";", "\t"), key=names.count)
    comma = delimiter != "," and "," in first and "." not in first  # of German and French numbers
    torn: list[str] = []

    def leave_out(row: pa.csv.InvalidRow) -> str:
        torn.append(f"a row, expected {row.expected_columns} columns, got {row.actual_columns}: {row.text}")
        return "skip"

    with refusing(f"{path}: expected {FORMATS}: ", *ARROW):
        table = pa.csv.read_csv(
            pa.BufferReader(text.encode()),
            read_options=pa.csv.ReadOptions(use_threads=False),  # `leave_out` counts
            parse_options=pa.csv.ParseOptions(delimiter=delimiter, invalid_row_handler=leave_out),
            convert_options=pa.csv.ConvertOptions(decimal_point="," if comma else ".", null_values=NO_VALUE),
        )
    if len(torn) > 1 + TORN * table.num_rows:
        raise LabError(
            f"{path}: {len(torn)} of {len(torn) + table.num_rows} rows are torn: {torn[0].removeprefix('a row, ')}"
        )
    for index, name in enumerate(table.column_names):
        if pa.types.is_string(table.column(index).type):
            numbers = _mostly_numbers(table.column(index).to_pylist(), comma)
            if numbers is not None:
                values, wrong = numbers
                torn += [f"{name.strip()}: no number: {one!r}" for one in wrong]
                table = table.set_column(index, name, pa.array(values))
    found = _numbers(path, table)
    notes = [f"left out: {one}" for one in torn[:SHOWN]]
    notes += [f"left out: {len(torn) - SHOWN} more"] if len(torn) > SHOWN else []
    return replace(found, notes=tuple(notes))


def _decoded(content: bytes) -> str:
    """Return the text of UTF-8, of UTF-16 with its mark, or else of Windows."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16", "replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace")


def _mostly_numbers(cells: list[str | None], comma: bool) -> tuple[list[float], list[str]] | None:
    """Return the numbers of a column, NaN elsewhere, and the texts between them; None for a column of texts."""
    values, wrong, count = [math.nan] * len(cells), list[str](), 0
    for row, cell in enumerate(cells):
        if cell is None:
            continue
        try:
            values[row] = float(cell.replace(",", ".") if comma else cell)
            count += 1
        except ValueError:
            wrong.append(cell)
    return (values, wrong) if len(wrong) < min(count, 2 + TORN * count) else None


def _numbers(path: Path, table: pa.Table) -> Table:
    columns, left_out = dict[str, Values](), []
    for name, values in zip(table.column_names, table.columns, strict=True):
        kind = values.type
        if pa.types.is_timestamp(kind):
            values, name = values.cast(pa.timestamp("ns")).cast(pa.int64()), f"{name} [ns]"
        if not (
            pa.types.is_floating(kind)
            or pa.types.is_integer(kind)
            or pa.types.is_boolean(kind)
            or pa.types.is_timestamp(kind)
        ):
            left_out.append(name)
            continue
        columns[name.strip()] = values.cast(pa.float64(), safe=False).to_numpy()
    if not columns or not table.num_rows:
        raise LabError(f"{path}: no rows with numbers; expected {FORMATS}, with the names in the first line")
    return Table(columns, tuple(left_out))


def _tlog(path: Path, content: bytes) -> list[Table]:
    """Return a table for each kind of message in a MAVLink telemetry log; frames that cannot be read are left out."""
    require(str(path), "mavlink", "pymavlink")
    from firmware_py.wire.mavlink_frames import FrameReceiver

    rows, place = dict[str, list[dict[str, float]]](), 0
    while place + STAMP < len(content):
        head = MAVLINK_HEADS.get(content[place + STAMP])
        if head is None or place + STAMP + 3 > len(content):
            place += 1
            continue
        size = head + content[place + STAMP + 1] + SIGNATURE * (head == 12 and content[place + STAMP + 2] & 1)
        frame = content[place + STAMP : place + STAMP + size]
        stamp = int.from_bytes(content[place : place + STAMP], "big")
        messages = FrameReceiver().feed(0, frame)
        for message in messages:
            fields = message.to_dict()
            kind = fields.pop("mavpackettype")
            numbers = {f"{kind}.{name}": one for name, one in fields.items() if isinstance(one, int | float)}
            rows.setdefault(kind, []).append({f"{TIME} [us]": stamp, **numbers})
        place += (
            STAMP + size if messages or content[place + 2 * STAMP + size :][:1] in (b"\xfd", b"\xfe") else 1
        )
    first = {kind: -order for order, kind in enumerate(MAVLINK_POSES[::-1], 1)}
    return [
        Table({name: np.array([row[name] for row in rows[kind]], np.float64) for name in rows[kind][0]})
        for kind in sorted(rows, key=lambda kind: first.get(kind, 0))
    ]


def _micro_sd(path: Path, content: bytes) -> list[Table]:
    """Return a table for each kind of events in a log of Bitcraze's micro-SD deck, versions 1 and 2."""
    damaged = f"{path}: a damaged micro-SD log"
    if zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], "little"):
        raise LabError(f"{damaged}: its checksum is wrong")
    place = 1

    def take(form: str) -> tuple[Any, ...]:
        nonlocal place
        values = struct.unpack_from(f"<{form}", content, place)
        place += struct.calcsize(f"<{form}")
        return values

    def name() -> str:
        nonlocal place
        end = content.index(0, place)
        begin, place = place, end + 1
        return content[begin:end].decode()

    kinds, rows = dict[int, tuple[list[str], str]](), dict[int, list[tuple[Any, ...]]]()
    try:
        version, count = take("HH")
        if version not in USD_UNITS:
            raise LabError(f"{path}: version {version} of the micro-SD log; expected 1 or 2")
        for _ in range(count):
            (kind,) = take("H")
            name()  # of the event
            variables = [name().rpartition("(") for _ in range(*take("H"))]
            kinds[kind] = [one[0] for one in variables], "".join(one[2].rstrip(")") for one in variables)
            rows[kind] = []
        while place < len(content) - 4:
            kind, stamp = take("HI" if version == 1 else "HQ")
            rows[kind].append((stamp, *take(kinds[kind][1])))
    except (struct.error, ValueError, KeyError) as error:
        raise LabError(f"{damaged}: {error}") from None
    return [
        Table(dict(zip([f"{TIME} [{USD_UNITS[version]}]", *names], np.array(rows[kind], np.float64).T, strict=True)))
        for kind, (names, _) in kinds.items()
        if rows[kind]
    ]  # fmt: skip


def _mcap(path: Path, content: bytes) -> list[Table]:
    """Return the tables of a file, that with the most positions first; messages in other encodings are left out.

    Raises `LabError` for a file that is damaged or has no numbers.
    """
    require(str(path), "mcap", "mcap", "mcap_protobuf", "mcap_ros2")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory as Protobuf
    from mcap_ros2.decoder import DecoderFactory as Ros2

    factories = [Protobuf(), Ros2()]
    decoders: dict[int, Any] = {}
    rows: dict[str, list[dict[str, float]]] = {}
    left_out: set[str] = set()
    try:
        for schema, channel, message in make_reader(BytesIO(content), validate_crcs=True).iter_messages():
            if channel.id not in decoders:
                made = (one.decoder_for(channel.message_encoding, schema) for one in factories)
                is_json = channel.message_encoding == "json"
                decoders[channel.id] = json.loads if is_json else next(filter(None, made), None)
            decode = decoders[channel.id]
            numbers = {} if decode is None else dict(_fields(channel.topic.strip("/"), decode(message.data)))
            if numbers:
                stamped = {f"{TIME} [ns]": float(message.log_time), **numbers}
                rows.setdefault(channel.topic, []).append(stamped)
            else:
                left_out.add(channel.topic)
    except Exception as error:  # three libraries read somebody else's bytes
        raise LabError(
            f"{path}: damaged MCAP: {' '.join(str(error).split()) or type(error).__name__}"
        ) from None
    if not rows:
        raise LabError(f"{path}: no message with numbers in JSON, Protobuf or ROS 2's encoding")
    ordered = sorted(rows, key=lambda topic: (-_is_place(rows[topic][0]) * len(rows[topic]), topic))
    without = tuple(sorted(left_out - rows.keys()))
    return [_of_rows(rows[topic], without if number == 0 else ()) for number, topic in enumerate(ordered)]


def _of_rows(rows: list[dict[str, float]], left_out: tuple[str, ...]) -> Table:
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: np.array([row.get(name, np.nan) for row in rows], np.float64) for name in names}
    return Table(columns, left_out)


def _is_place(row: dict[str, float]) -> bool:
    return any(name.endswith(("position.x", "translation.x")) for name in row)


def _fields(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message by their paths in it."""
    if name.endswith(STAMPS):
        return
    if isinstance(value, bool | int | float):
        yield name, float(value)
    elif isinstance(value, dict):
        for key, one in value.items():
            yield from _fields(f"{name}.{key}", one)
    elif isinstance(value, list | tuple):
        for number, one in enumerate(value if len(value) <= LONGEST else ()):
            yield from _fields(f"{name}.{number}", one)
    elif (described := getattr(value, "DESCRIPTOR", None)) is not None:  # of Protobuf
        for field in described.fields:
            yield from _fields(f"{name}.{field.name}", getattr(value, field.name))
    elif not isinstance(value, str | bytes):  # of ROS 2
        for slot in getattr(value, "__slots__", ()):
            yield from _fields(f"{name}.{slot.lstrip('_')}", getattr(value, slot))
