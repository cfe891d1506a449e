"""Imports a foreign log as the run of a real flight: `t` in microseconds, the cameras' poses, the goal, and all the rest.

A `Map` says which column of the file gives which column of the log, as "NAME [UNIT]", with a minus in front to turn the
sign, or as a number. `guess` makes one from names, units and sizes; it is stored with the run, where it can be corrected.
What a file lacks stays unknown. Frames: W has z up; quaternions turn from B to W; angles are roll, pitch and yaw (z-y'-x'').
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from firmware_py.geometry import from_euler_zyx
from hil.config import DEFAULT_PROFILE, read_config
from hil.errors import LabError, hint, reading
from hil.laboratory.bodies import make_body
from hil.laboratory.channels import UNKNOWN_STATE
from hil.laboratory.experiment import unknown
from hil.laboratory.files.recorder import EVENTS, PARQUET, RELEASE_US
from hil.laboratory.files.result import Program, Result, judged, metadata_of, write_result
from hil.laboratory.files.tables import Table, Values, read_tables
from hil.laboratory.files.whole_files import replacing, write_whole
from hil.laboratory.metrics import measure
from hil.laboratory.request import REAL, Bench, Request

MAP = "map.toml"  # in the run folder
EXPERIMENT = "imported"
MANY = 16  # columns that a log of ours has not
OWN = {"flight.free", "goal.x", "supervisor.state"}  # columns of this laboratory's own logs

LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLE = {"rad": 1.0, "deg": np.pi / 180.0, "°": np.pi / 180.0}
TIME = {"s": 1e6, "ms": 1e3, "us": 1.0, "µs": 1.0, "ns": 1e-3}
VOLTS = {"V": 1.0, "mV": 1e-3}
PLAIN = {"": 1.0}


@dataclass(frozen=True, slots=True)
class Target:
    """A column of the log that a file can give, and names that it is known by, the best first."""

    units: Mapping[str, float]  # allowed units, in that of the log
    names: tuple[str, ...]  # regular expressions of lower-case names with dots between words
    frame: str = "W"
    unit: str = ""


# What measures a pose, before what estimates one.
_SEEN = r"(?:mocap|vicon|optitrack|qualisys|cameras|ground\.?truth|truth|gt|locsrv|lighthouse)"
_PLACE = r"(?:pos(?:ition)?|p|translation|pose|p\.wb)"
_TURN = r"(?:q|quat(?:ernion)?|orientation|rotation|q\.wb)"
_WANTED = r"(?:goal|target|setpoint|ctrltarget|reference|ref|desired|command(?:ed)?)"

_ASKED = r"set\.position\.target\.local\.ned"
_BATTERY = (r"pm\.vbat", r"(?:battery\.)?(?:vbat|voltage)", r"battery", r"sys\.status\.voltage\.battery")


def _of_axis(axis: str) -> tuple[str, ...]:
    return (
        rf"{_SEEN}\.(?:{_PLACE}\.)?{axis}", rf"(?:{_PLACE}\.?)?{axis}", rf"stateestimate\.{axis}", rf"kalman\.state{axis}",
        rf"local\.position\.ned\.{axis}",
    )  # fmt: skip


def _of_part(part: str) -> tuple[str, ...]:
    return rf"{_SEEN}\.(?:{_TURN}\.?)?q?{part}", rf"{_TURN}\.?{part}", rf"stateestimate\.q{part}"


def _of_angle(angle: str, letter: str) -> tuple[str, ...]:
    return (
        rf"{_SEEN}\.{angle}", rf"{angle}|{letter}", rf"stateestimate\.{angle}", rf"stabilizer\.{angle}",
        rf"attitude\.{angle}",
    )  # fmt: skip


TARGETS: Mapping[str, Target] = {
    **{f"cameras.{axis}": Target(LENGTH, _of_axis(axis), unit="m") for axis in "xyz"},
    **{f"cameras.q{part}": Target(PLAIN, _of_part(part)) for part in "wxyz"},
    **{
        f"cameras.{angle}": Target(ANGLE, _of_angle(angle, letter), unit="rad")
        for angle, letter in (("roll", "phi"), ("pitch", "theta"), ("yaw", "psi"))
    },
    **{
        f"goal.{axis}": Target(
            LENGTH, (rf"{_WANTED}\.?(?:{_PLACE}\.)?{axis}", rf"{_ASKED}\.{axis}"), unit="m"
        )
        for axis in "xyz"
    },
    "goal.yaw": Target(ANGLE, (rf"{_WANTED}\.?yaw", rf"{_ASKED}\.yaw"), unit="rad"),
    "battery.voltage": Target(VOLTS, _BATTERY, "", "V"),
}
CLOCK = r"t|time|timestamp|time\.stamp|seconds?|tick|time\.from\.the\.release|elapsed(?:\.time)?"
# Bitcraze's firmware logs angles in degrees.
STOCK = re.compile(r"(?:stateestimate|stabilizer|ctrltarget|controller|gyro)\.")
# Its state's pitch has the sign of its old frame; MAVLink's local frame is north, east, down.
TURNED = re.compile(
    rf"(?:stateestimate|stabilizer)\.pitch|(?:local\.position\.ned|{_ASKED})\.[yz]|{_ASKED}\.yaw|attitude\.(?:pitch|yaw)"
)


class Map(BaseModel):
    """Where the columns of a log come from; `release_s` counts as the file's own clock, None: its first row."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    profile: str = DEFAULT_PROFILE  # of the robot
    release_s: float | None = None
    columns: dict[str, str | float] = Field(default_factory=dict)

    @staticmethod
    def read(path: Path) -> Map:
        """Return the map of a TOML file. Raises `LabError`."""
        import tomllib

        try:
            return Map.model_validate(tomllib.loads(path.read_text(encoding="utf-8")))
        except ValidationError as error:
            detail = error.errors()[0]
            key = ".".join(map(str, detail["loc"][:2]))
            raise LabError(f"--map {path}: {key} = {detail['input']!r}: {detail['msg'].lower()}") from None
        except (OSError, ValueError) as error:
            raise LabError(f"--map {path}: {getattr(error, 'strerror', None) or error}") from None

    def text(self) -> str:
        """Return the map as TOML."""
        lines = [f"profile = {json.dumps(self.profile)}"]
        lines += [] if self.release_s is None else [f"release_s = {self.release_s!r}"]
        lines += ["", '[columns]  # of the log = "NAME [UNIT]" of the file, or a number']
        lines += [f"{json.dumps(name)} = {json.dumps(source)}" for name, source in self.columns.items()]
        return "\n".join(lines) + "\n"


@dataclass(frozen=True, slots=True)
class Source:
    """A column of a file, as a map names it."""

    name: str
    unit: str
    sign: float

    @staticmethod
    def of(text: str) -> Source:
        """Return the source of "NAME [UNIT]", the sign of a minus in front."""
        found = re.fullmatch(r"\s*(-?)\s*(.*?)\s*(?:[\[(]([^\[\]()]*)[\])])?\s*", text, re.DOTALL)
        assert found is not None
        return Source(found[2], (found[3] or "").strip(), -1.0 if found[1] else 1.0)


@dataclass(frozen=True, slots=True)
class Imported:
    """An imported run: where its columns come from, and what a user should know."""

    result: Result
    map: Map
    log: pa.Table
    notes: tuple[str, ...]


@dataclass(slots=True)
class _Joined:
    """The columns of all files on the clock of the first table."""

    t_us: Values
    columns: dict[str, Values]  # by the names of `Source`
    units: dict[str, str]  # of names with one
    clock: str
    notes: list[str] = field(default_factory=list)


def import_log(files: Sequence[Path], folder: Path, given: Map | None = None) -> Imported:
    """Write the run folder of a foreign log; several files share a clock, the first one gives the rows.

    Raises `LabError` for files or a map that do not fit, `OSError` for a folder that cannot be written.
    """
    tables = [table for file in files for table in read_tables(file)]
    what = " ".join(map(str, files))
    joined = _join(what, tables, None if given is None else given.columns.get("t"))
    chosen = _with_goal(what, joined, given or _guess(joined))
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
    body = make_body(config, np.random.Generator(np.random.PCG64(0)), config.flight.home)
    stored = {name.encode(): text.encode() for name, text in metadata_of(request, program, body.look).items()}
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


def _join(what: str, tables: Sequence[Table], clock: str | float | None) -> _Joined:
    """Return all columns on the rows of the first table: of the others the newest value, none before their first."""
    joined = _Joined(np.empty(0), {}, {}, "")
    for number, table in enumerate(tables):
        source = _clock_of(what, table, clock if isinstance(clock, str) else None, number == 0)
        times = _values(table, source.name) * TIME[source.unit]
        advances = np.isfinite(times) & (times > np.fmax.accumulate(np.concatenate(([-np.inf], times[:-1]))))
        if not advances.all():
            joined.notes.append(f"{(~advances).sum()} rows whose {source.name} does not advance are left out")
        times = times[advances]
        if not len(times):
            raise LabError(f"{what}: {source.name}: no row with a time")
        rows = np.arange(len(times))
        if number == 0:
            joined.t_us, joined.clock = times, f"{source.name} [{source.unit}]"
        else:
            rows = np.searchsorted(times, joined.t_us, "right") - 1
        for title, values in table.columns.items():
            one = Source.of(title)
            if one.name == source.name:
                continue
            key = one.name if one.name not in joined.columns else f"{one.name}.{number + 1}"
            joined.columns[key] = np.where(rows >= 0, values[advances][np.maximum(rows, 0)], np.nan)
            joined.units[key] = one.unit
        if table.left_out:
            joined.notes.append(f"columns without numbers are left out: {', '.join(table.left_out)}")
    return joined


def _values(table: Table, name: str) -> Values:
    return next(values for title, values in table.columns.items() if Source.of(title).name == name)


def _clock_of(what: str, table: Table, wanted: str | None, is_first: bool) -> Source:
    """Return the source of a table's times, with its unit; only the first table must have the wanted one.

    Without a stated unit it is the one in which a usual step is 0.5 ms to 0.5 s. Raises `LabError`.
    """
    titles = {Source.of(title).name: title for title in table.columns}
    named = wanted is not None and (is_first or Source.of(wanted).name in titles)
    found = (
        wanted if named else next((titles[one] for one in titles if re.fullmatch(CLOCK, _words(one))), None)
    )
    if found is None or Source.of(found).name not in titles:
        like, names = f" like {found!r}" if found else "", ", ".join([*titles][:12])
        raise LabError(f'{what}: no column of times{like} among {names}; name it in a map: t = "NAME [ms]"')
    source = Source.of(found)
    if source.unit:
        _scale(what, "t", source, TIME)
        return source
    steps = np.diff(_values(table, source.name))
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    unit = next((unit for unit, scale in TIME.items() if 500.0 <= step * scale <= 5e5), "s")
    return replace(source, unit=unit)


def _words(name: str) -> str:
    """Return a name in lower case with a dot between its words, without a unit at its end."""
    name = re.sub(r"_(?:m|cm|mm|rad|deg|s|ms|us|ns|v|mv)$", "", name.strip())
    return re.sub(r"[\s_/:.]+", ".", name.lower())


def _unit_in(name: str) -> str:
    """Return the unit that a name ends with, as in x_mm; empty without one."""
    found = re.search(r"_(m|cm|mm|rad|deg|mv)$", name, re.IGNORECASE)
    return found[1].lower().replace("mv", "mV") if found else ""


def _guess(joined: _Joined) -> Map:
    """Return the map that names, units and sizes suggest."""
    sources: dict[str, str | float] = {"t": joined.clock}
    names = list(joined.columns)
    if set(names) >= OWN:  # a table of our own export
        own = {name: f"{name} [{joined.units[name]}]" for name in names}
        return Map(columns=sources | own)
    words = {name: _words(name) for name in names}
    for column, target in TARGETS.items():
        known = ((pattern, name) for pattern in target.names for name in names)
        found = next((name for pattern, name in known if re.fullmatch(pattern, words[name])), None)
        if found is not None:
            sources[column] = _source(column, target, found, joined)
    taken = {Source.of(text).name for text in sources.values() if isinstance(text, str)}
    others = [name for name in names if name not in taken]
    if len(others) > MANY:
        changing = [
            name
            for name in others
            if len(np.unique(joined.columns[name][np.isfinite(joined.columns[name])])) > 1
        ]
        joined.notes.append(f"{len(others) - len(changing)} further columns that do not change are left out")
        others = changing
    for name in others:
        unit, column = joined.units[name] or _unit_in(name), f"robot.{re.sub(r'[^0-9A-Za-z_.]+', '_', name)}"
        while column in sources:  # names that differ in what a column's name has not
            column += "_"
        sources[column] = f"{name} [{unit}]" if unit else name
    stock = any(STOCK.match(word) for word in words.values())
    return Map(profile="crazyflie" if stock else DEFAULT_PROFILE, columns=sources)


def _source(column: str, target: Target, name: str, joined: _Joined) -> str:
    """Return the source of a column, with a unit if it has one: stated, or by the size of its values."""
    unit, words, values = joined.units[name] or _unit_in(name), _words(name), np.abs(joined.columns[name])
    largest = float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
    if unit not in target.units:
        stock = STOCK.match(words) is not None
        if target.units is LENGTH:
            unit = "mm" if largest > 20.0 and not stock else "m"
        elif target.units is ANGLE:
            unit = "deg" if stock or largest > 2.0 * np.pi else "rad"
        elif target.units is VOLTS:
            unit = "mV" if largest > 100.0 else "V"
        else:
            unit = ""
    sign = "-" if TURNED.fullmatch(words) else ""
    return f"{sign}{name} [{unit}]" if unit else f"{sign}{name}"


def _scale(what: str, column: str, source: Source, units: Mapping[str, float]) -> float:
    if source.unit not in units:
        allowed = ", ".join(filter(None, units)) or "none"
        raise LabError(f"{what}: {column} = {source.name!r}: unit {source.unit!r}; expected {allowed}")
    return units[source.unit]


def _columns(what: str, joined: _Joined, chosen: Map) -> tuple[dict[str, tuple[Any, str, str]], int]:
    """Return the columns of the log, each with unit and frame, and when the robot was released [us]."""
    first_us, count = float(joined.t_us[0]), len(joined.t_us)
    from_zero = _words(Source.of(joined.clock).name) == "time.from.the.release"
    released_us = 0.0 if from_zero else first_us
    if chosen.release_s is not None:
        released_us = 1e6 * chosen.release_s
    found: dict[str, tuple[Any, str, str]] = {}
    for column, source in chosen.columns.items():
        if column == "t":
            continue
        values, unit = _read(what, joined, column, source)
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


def _read(what: str, joined: _Joined, column: str, source: str | float) -> tuple[Values, str]:
    """Return what a source gives for a column of the log, and its unit. Raises `LabError`."""
    target = None if set(joined.columns) >= OWN else TARGETS.get(column)
    if not isinstance(source, str):
        return np.full(len(joined.t_us), source), "" if target is None else target.unit
    one = Source.of(source)
    if one.name not in joined.columns:
        raise LabError(f"{what}: {column} = {source!r}: no such column; {hint(one.name, joined.columns)}")
    values = one.sign * joined.columns[one.name]
    if target is None:
        return values, one.unit
    return values * _scale(what, column, one, target.units), target.unit


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
        for name in turn:
            found.pop(name, None)
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


def _with_goal(what: str, joined: _Joined, chosen: Map) -> Map:
    """Return a map that gives the goal: where nothing in the file does, the mean of the flight."""
    if "truth.x" in chosen.columns:
        return chosen
    goal: dict[str, str | float] = {}
    for axis in "xyz":
        if f"goal.{axis}" not in chosen.columns and f"cameras.{axis}" in chosen.columns:
            values, _ = _read(what, joined, f"cameras.{axis}", chosen.columns[f"cameras.{axis}"])
            goal[f"goal.{axis}"] = round(float(np.nanmean(values)), 3) if np.isfinite(values).any() else 0.0
    if goal:
        said = ", ".join(f"{name} = {value:g}" for name, value in goal.items())
        joined.notes.append(f"nothing gives the goal, so it is the mean of the flight: {said} m")
    if "goal.yaw" not in chosen.columns:
        goal["goal.yaw"] = 0.0
    return chosen.model_copy(update={"columns": {**chosen.columns, **goal}})


def _table(columns: Mapping[str, tuple[Any, str, str]], metadata: Mapping[bytes, bytes]) -> pa.Table:
    fields = [
        pa.field(name, pa.from_numpy_dtype(values.dtype), metadata={"unit": unit, "frame": frame})
        for name, (values, unit, frame) in columns.items()
    ]
    return pa.table(
        [values for values, _, _ in columns.values()], schema=pa.schema(fields, metadata=dict(metadata))
    )
