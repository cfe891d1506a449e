"""Reads MCAP files, as of ROS 2 and Foxglove: a table for each topic with numbers, in JSON, Protobuf or ROS 2's encoding."""

from __future__ import annotations

import json
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from hil.errors import LabError, require
from hil.laboratory.files.tables import TIME, Table

STAMPS = (".stamp", ".timestamp")  # inside messages: the file has the time of each
LONGEST = 16  # of a list whose numbers become columns: not of images and point clouds


def mcap_tables(path: Path, content: bytes) -> list[Table]:
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
            numbers = {} if decode is None else dict(_numbers(channel.topic.strip("/"), decode(message.data)))
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
    return [_table(rows[topic], without if number == 0 else ()) for number, topic in enumerate(ordered)]


def _table(rows: list[dict[str, float]], left_out: tuple[str, ...]) -> Table:
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: np.array([row.get(name, np.nan) for row in rows], np.float64) for name in names}
    return Table(columns, left_out)


def _is_place(row: dict[str, float]) -> bool:
    return any(name.endswith(("position.x", "translation.x")) for name in row)


def _numbers(name: str, value: Any) -> Iterator[tuple[str, float]]:
    """Yield the numbers of a message by their paths in it."""
    if name.endswith(STAMPS):
        return
    if isinstance(value, bool | int | float):
        yield name, float(value)
    elif isinstance(value, dict):
        for key, one in value.items():
            yield from _numbers(f"{name}.{key}", one)
    elif isinstance(value, list | tuple):
        for number, one in enumerate(value if len(value) <= LONGEST else ()):
            yield from _numbers(f"{name}.{number}", one)
    elif (described := getattr(value, "DESCRIPTOR", None)) is not None:  # of Protobuf
        for field in described.fields:
            yield from _numbers(f"{name}.{field.name}", getattr(value, field.name))
    elif not isinstance(value, str | bytes):  # of ROS 2
        for slot in getattr(value, "__slots__", ()):
            yield from _numbers(f"{name}.{slot.lstrip('_')}", getattr(value, slot))
