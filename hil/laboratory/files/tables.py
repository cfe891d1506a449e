"""Reads tables of other programs: CSV, Parquet, and the micro-SD logs of a Crazyflie."""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from numpy.typing import NDArray

from hil.errors import LabError, refusing

USD_MAGIC, PARQUET_MAGIC = b"\xbc", b"PAR1"
USD_UNITS = {1: "ms", 2: "us"}  # of the time stamps, by the version of the format
FORMATS = "CSV, Parquet, or a Crazyflie's micro-SD log"
TIME = "timestamp"
ARROW = (pa.ArrowException, OSError, ValueError)

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of equal length (N,) by their names as in the file, which may end in a unit: "x [mm]"."""

    columns: Mapping[str, Values]
    left_out: tuple[str, ...] = ()  # columns without numbers


def read_tables(path: Path) -> list[Table]:
    """Return the tables of a file, one for each clock in it. Raises `LabError` for a file that is none of `FORMATS`."""
    with refusing(f"{path}: ", OSError):
        content = path.read_bytes()
    if content.startswith(USD_MAGIC):
        return _micro_sd(path, content)
    if content.startswith(PARQUET_MAGIC):
        with refusing(f"{path}: damaged Parquet: ", *ARROW):
            return [_numbers(path, pa.parquet.read_table(pa.BufferReader(content)))]
    return [_numbers(path, _csv(path, content))]


def _csv(path: Path, content: bytes) -> pa.Table:
    """Return a table whose first line has the names; it may begin with #, and end with the units in brackets."""
    text = content.removeprefix(b"\xef\xbb\xbf").lstrip(b"# \t\r\n")
    lines = text.split(b"\n", 2)
    if b"\0" in text or len(lines) < 2:
        raise LabError(f"{path}: expected {FORMATS}")
    delimiter = max((b",", b";", b"\t"), key=lines[0].count)
    comma = delimiter != b"," and b"," in lines[1] and b"." not in lines[1]  # of German and French numbers
    with refusing(f"{path}: expected {FORMATS}: ", *ARROW):
        return pa.csv.read_csv(
            pa.BufferReader(text),
            parse_options=pa.csv.ParseOptions(delimiter=delimiter.decode()),
            convert_options=pa.csv.ConvertOptions(
                decimal_point="," if comma else ".", null_values=["", "nan", "NaN", "None", "null", "NULL"]
            ),
        )


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
