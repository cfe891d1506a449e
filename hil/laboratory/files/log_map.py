"""Which column of a file gives which of the log: a map, and the one that names, units and sizes suggest."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hil.config import DEFAULT_PROFILE
from hil.errors import LabError, hint
from hil.laboratory.files.joined import Joined, Source, scale_of, unit_in, words_of
from hil.laboratory.files.tables import Values

MANY = 16  # columns that a log of ours has not
OWN = {"flight.free", "goal.x", "supervisor.state"}  # columns of this laboratory's own logs

LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLE = {"rad": 1.0, "deg": np.pi / 180.0, "°": np.pi / 180.0}
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

# Messages of ROS and Foxglove behind a topic: PoseStamped, PoseWithCovariance, Odometry, TransformStamped, PoseInFrame.
_ROS_PLACE, _ROS_TURN = (
    r"(?:pose|transform)\.(?:position|translation)",
    r"(?:pose|transform)\.(?:orientation|rotation)",
)
_OF_SEEN, _OF_ANY = rf"(?:.*\.)?{_SEEN}(?:\..*)?\.", rf"(?!.*{_WANTED}\.)(?:.*\.)?"
_ASKED = r"set\.position\.target\.local\.ned"
_BATTERY = (r"pm\.vbat", r"(?:battery\.)?(?:vbat|voltage)", r"battery", r"sys\.status\.voltage\.battery")


def _of_axis(axis: str) -> tuple[str, ...]:
    return (
        rf"{_SEEN}\.(?:{_PLACE}\.)?{axis}", rf"(?:{_PLACE}\.?)?{axis}", rf"stateestimate\.{axis}", rf"kalman\.state{axis}",
        rf"local\.position\.ned\.{axis}", rf"{_OF_SEEN}{_ROS_PLACE}\.{axis}", rf"{_OF_ANY}{_ROS_PLACE}\.{axis}",
    )  # fmt: skip


def _of_part(part: str) -> tuple[str, ...]:
    return (
        rf"{_SEEN}\.(?:{_TURN}\.?q?|q){part}", rf"{_TURN}\.?{part}", rf"stateestimate\.q{part}",
        rf"{_OF_SEEN}{_ROS_TURN}\.{part}", rf"{_OF_ANY}{_ROS_TURN}\.{part}",
    )  # fmt: skip


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
            LENGTH,
            (
                rf"{_WANTED}\.?(?:{_PLACE}\.)?{axis}",
                rf"{_ASKED}\.{axis}",
                rf"(?:.*\.)?{_WANTED}(?:\..*)?\.{_ROS_PLACE}\.{axis}",
            ),
            unit="m",
        )
        for axis in "xyz"
    },
    "goal.yaw": Target(ANGLE, (rf"{_WANTED}\.?yaw", rf"{_ASKED}\.yaw"), unit="rad"),
    "battery.voltage": Target(VOLTS, _BATTERY, "", "V"),
}
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
            return Map.model_validate(tomllib.loads(path.read_text(encoding="utf-8-sig")))
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


def guess(joined: Joined) -> Map:
    """Return the map that names, units and sizes suggest."""
    sources: dict[str, str | float] = {"t": joined.clock}
    names = list(joined.columns)
    if set(names) >= OWN:  # a table of our own export
        own = {name: f"{name} [{joined.units[name]}]" for name in names}
        return Map(columns=sources | own)
    words = {name: words_of(name) for name in names}
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
        unit, column = joined.units[name] or unit_in(name), f"robot.{re.sub(r'[^0-9A-Za-z_.]+', '_', name)}"
        while column in sources:  # names that differ in what a column's name has not
            column += "_"
        sources[column] = f"{name} [{unit}]" if unit else name
    stock = any(STOCK.match(word) for word in words.values())
    return Map(profile="crazyflie" if stock else DEFAULT_PROFILE, columns=sources)


def _source(column: str, target: Target, name: str, joined: Joined) -> str:
    """Return the source of a column, with a unit if it has one: stated, or by the size of its values."""
    unit, words, values = joined.units[name] or unit_in(name), words_of(name), np.abs(joined.columns[name])
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


def with_goal(what: str, joined: Joined, chosen: Map) -> Map:
    """Return a map that gives the goal: where nothing in the file does, the mean of the flight."""
    if "truth.x" in chosen.columns:
        return chosen
    goal: dict[str, str | float] = {}
    for axis in "xyz":
        if f"goal.{axis}" not in chosen.columns and f"cameras.{axis}" in chosen.columns:
            values, _ = read_column(what, joined, f"cameras.{axis}", chosen.columns[f"cameras.{axis}"])
            goal[f"goal.{axis}"] = round(float(np.nanmean(values)), 3) if np.isfinite(values).any() else 0.0
    if goal:
        said = ", ".join(f"{name} = {value:g}" for name, value in goal.items())
        joined.notes.append(f"nothing gives the goal, so it is the mean of the flight: {said} m")
    if "goal.yaw" not in chosen.columns:
        goal["goal.yaw"] = 0.0
    return chosen.model_copy(update={"columns": {**chosen.columns, **goal}})


def read_column(what: str, joined: Joined, column: str, source: str | float) -> tuple[Values, str]:
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
    return values * scale_of(what, column, one, target.units), target.unit
