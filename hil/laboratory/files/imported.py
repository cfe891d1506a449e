"""Imports a foreign log as the run of a real flight: `t` in microseconds, the cameras' poses, the goal, and all the rest.

A `Map` says which column of the file gives which column of the log, as "NAME [UNIT]", with a minus in front to turn the
sign, or as a number; it is stored with the run, where it can be corrected. What a file lacks stays unknown. Frames: W has z
up; quaternions turn from B to W; angles are roll, pitch and yaw (z-y'-x'').
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from firmware_py.geometry import from_euler_zyx
from hil.config import read_config
from hil.errors import LabError, reading
from hil.laboratory.bodies import make_body
from hil.laboratory.experiment import unknown
from hil.laboratory.files.alignment import released_like
from hil.laboratory.files.joined import Joined, Source, join, words_of
from hil.laboratory.files.log_map import OWN, TARGETS, Map, guess, read_column, with_goal
from hil.laboratory.files.recorder import EVENTS, PARQUET, RELEASE_US
from hil.laboratory.files.result import Program, Result, judged, metadata_of, write_result
from hil.laboratory.files.station_channels import UNKNOWN_STATE
from hil.laboratory.files.tables import read_tables
from hil.laboratory.files.whole_files import replacing, write_whole
from hil.laboratory.metrics import measure
from hil.laboratory.request import REAL, Bench, Request

MAP = "map.toml"  # in the run folder
EXPERIMENT = "imported"


@dataclass(frozen=True, slots=True)
class Imported:
    """An imported run: where its columns come from, and what a user should know."""

    result: Result
    map: Map
    log: pa.Table
    notes: tuple[str, ...]


def import_log(
    files: Sequence[Path], folder: Path, given: Map | None = None, like: pa.Table | None = None
) -> Imported:
    """Write the run folder of a foreign log; several files share a clock, the first one gives the rows.

    `like` is the log of a flight whose path sets the release: where both paths fit best. Raises `LabError` for files or a
    map that do not fit, `OSError` for a folder that cannot be written.
    """
    tables = [table for file in files for table in read_tables(file)]
    what = " ".join(map(str, files))
    joined = join(what, tables, None if given is None else given.columns.get("t"))
    chosen = with_goal(what, joined, given or guess(joined))
    if like is not None:
        chosen = released_like(what, joined, chosen, like)
    with reading(what):
        columns, release_us = _columns(what, joined, chosen)
    config = read_config(chosen.profile)
    duration_s = max(round(1e-6 * float(joined.t_us[-1] - joined.t_us[0]), 6), 1e-3)
    request = Request(
        unknown(EXPERIMENT, None),
        chosen.profile,
        (),
        0,
        duration_s,
        (),
        Bench(link=files[0].name, board=REAL),
    )
    program = Program.of(config)
    robot = make_body(config, np.random.Generator(np.random.PCG64(0)), config.flight.home)
    stored = {
        name.encode(): text.encode() for name, text in metadata_of(request, program, robot.look).items()
    }
    log = _table(columns, {**stored, RELEASE_US: str(release_us).encode()})
    metrics = measure(log, lost=False)
    notes = [f"imported from {what}", *joined.notes]
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / PARQUET) as partial:
        pa.parquet.write_table(log, partial, compression="zstd")
    write_whole(folder / MAP, chosen.text())
    events = [{"t_us": release_us, "source": "lab", "text": note} for note in notes]
    write_whole(folder / EVENTS, "".join(json.dumps(event) + "\n" for event in events))
    digest = hashlib.sha256(" ".join(log.column_names).encode())
    for name in log.column_names:
        digest.update(log.column(name).to_numpy().tobytes())
    result = judged(request, program, ("completed", None), metrics, log, digest.hexdigest(), folder)
    result = replace(result, verdicts=())  # nobody stated limits for a foreign flight
    write_result(result)
    return Imported(result, chosen, log, tuple(joined.notes))


def _columns(what: str, joined: Joined, chosen: Map) -> tuple[dict[str, tuple[Any, str, str]], int]:
    """Return the columns of the log, each with unit and frame, and when the robot was released [us]."""
    first_us, count = float(joined.t_us[0]), len(joined.t_us)
    from_zero = words_of(Source.of(joined.clock).name) == "time.from.the.release"
    released_us = 0.0 if from_zero else first_us
    if chosen.release_s is not None:
        released_us = 1e6 * chosen.release_s
    found: dict[str, tuple[Any, str, str]] = {}
    for column, source in chosen.columns.items():
        if column == "t":
            continue
        values, unit = read_column(what, joined, column, source)
        frame = TARGETS[column].frame if column in TARGETS else ""
        found[column] = values, unit, frame
    if "truth.x" not in found:
        _complete(what, found, count, joined.notes)
    times = np.rint(joined.t_us - first_us).astype(np.int64)
    release_us = round(released_us - first_us)
    free = found.get("flight.free", (times >= release_us, "", ""))[0]
    state = found.get("supervisor.state", (np.full(count, UNKNOWN_STATE), "", ""))[0]
    head = {"t": (times, "us", ""), "flight.free": (np.asarray(free, np.int8), "", "")}
    return {**head, "supervisor.state": (np.asarray(state, np.int8), "", ""), **{
        name: value for name, value in found.items() if name not in OWN or name == "goal.x"
    }}, release_us  # fmt: skip


def _complete(what: str, found: dict[str, tuple[Any, str, str]], count: int, notes: list[str]) -> None:
    """Turn angles into an attitude, which is unknown where the file has none. Raises `LabError` without a position."""
    missing = [name for name in ("cameras.x", "cameras.y", "cameras.z") if name not in found]
    if missing:
        raise LabError(
            f'{what}: nothing gives {", ".join(missing)}; name it in a map: "{missing[0]}" = "NAME [m]"'
        )
    angles = [found.pop(f"cameras.{angle}", None) for angle in ("roll", "pitch", "yaw")]
    turn = [f"cameras.q{part}" for part in "wxyz"]
    if not set(turn) <= found.keys():
        if None in angles:
            notes.append("the attitude is unknown: nothing gives a quaternion, or roll, pitch and yaw")
            quaternions = np.full((count, 4), np.nan)
        else:
            known = np.stack([one[0] for one in angles if one is not None], axis=1)
            quaternions = np.array([from_euler_zyx(*row) for row in known.tolist()]).reshape(-1, 4)
        found |= {name: (quaternions[:, index], "", "W") for index, name in enumerate(turn)}
    quaternions = np.stack([found[name][0] for name in turn], axis=1)
    sizes = np.sqrt((quaternions**2).sum(axis=1))
    if (np.abs(sizes - 1.0) > 0.1).any():
        worst = float(sizes[np.nanargmax(np.abs(sizes - 1.0))])
        raise LabError(f"{what}: {turn[0]} to {turn[3][-2:]}: a quaternion of length {worst:.3g}; expected 1")


def _table(columns: Mapping[str, tuple[Any, str, str]], metadata: Mapping[bytes, bytes]) -> pa.Table:
    fields = [
        pa.field(name, pa.from_numpy_dtype(values.dtype), metadata={"unit": unit, "frame": frame})
        for name, (values, unit, frame) in columns.items()
    ]
    return pa.table(
        [values for values, _, _ in columns.values()], schema=pa.schema(fields, metadata=dict(metadata))
    )
