"""Faults as data: kind, start, duration and size; `hil.laboratory.fault_kinds.KINDS` has the kinds.

A fault's text is KIND@START[:DURATION][=SIZE], start in seconds after the release, duration in seconds (`inf`: to the
end), size in the kind's unit: `mocap.dropout@10:0.5`, `push.y@3=2`, `servo.stuck.2@5`.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from hil.config import LabConfig
from hil.errors import LabError, blame, hint
from hil.laboratory.arguments import checked
from hil.laboratory.fault_kinds import KINDS, MARKERS_ON, Kind, Knob
from hil.laboratory.files.recorder import release_of, stored_in
from hil.laboratory.robot import Robot

_LENGTH_AND_SIZE = r"(?::(?P<duration>[^@:=]+))?(?:=(?P<size>[^@:=]+))?"
SHAPE = re.compile(rf"(?P<kind>[^@:=]+)@(?P<start>[^@:=]+){_LENGTH_AND_SIZE}")
LIVE_SHAPE = re.compile(rf"(?P<kind>[^@:=]+){_LENGTH_AND_SIZE}")
SWITCHED = re.compile(r"fault (?P<fault>[^@ ]+) (?P<change>begins|ends)")  # event of a live fault
SWITCHED_ON = b"switched_on"  # key in the metadata of a log to draw


@checked
@dataclass(frozen=True, slots=True)
class Fault:
    """One fault. `size` is in the unit of its kind. Raises `LabError` for an unknown kind or an impossible number."""

    kind: str
    start_s: float  # after the release
    duration_s: float  # inf: to the end
    size: float
    live: bool = field(
        default=False, repr=False
    )  # typed into a running server: it acts at once, and its text has no start

    def __post_init__(self) -> None:
        kind = _kind(self.kind, self.kind)
        if not 0.0 <= self.start_s < math.inf:
            raise LabError(
                f"fault {self.kind}: start {self.start_s:g} s: expected 0 or more after the release"
            )
        if not self.duration_s > 0.0:
            raise LabError(f"fault {self.kind}: duration {self.duration_s:g} s: expected more than 0, or inf")
        if not kind.low <= self.size <= kind.high:
            unit = f" {kind.unit}".rstrip()
            allowed = (
                f"expected {kind.low:g}..{kind.high:g}{unit}"
                if kind.sized
                else "this kind has no size to choose"
            )
            raise LabError(f"fault {self.kind}: size {self.size:g}: {allowed}")

    @property
    def span_us(self) -> tuple[int, float]:
        """Begin and end after the release; inf when it has no end."""
        begin_us = round(self.start_s * 1e6)
        endless = math.isinf(self.duration_s)
        return begin_us, math.inf if endless else begin_us + round(self.duration_s * 1e6)

    def __str__(self) -> str:
        kind = KINDS[self.kind]
        duration = "" if self.duration_s == kind.duration_s else f":{_number(self.duration_s)}"
        size = f"={_number(self.size)}" if kind.sized else ""
        start = "" if self.live else f"@{_number(self.start_s)}"
        return f"{self.kind}{start}{duration}{size}"


@dataclass(frozen=True, slots=True)
class Span:
    """When a fault acts, from the release; `end_s` is inf when it has no end."""

    fault: Fault
    begin_s: float
    end_s: float


@checked
def parse(text: str, live: bool = False) -> Fault:
    """Parse the text of a fault; omitted parts have the kind's defaults. Raises `LabError`.

    A `live` one, for a running server, has no start.
    """
    match = (LIVE_SHAPE if live else SHAPE).fullmatch(text.strip())
    if match is None:
        start, like = ("", "mocap.dropout:0.5") if live else ("@START", "mocap.dropout@10:0.5")
        raise LabError(f"fault {text!r}: expected KIND{start}[:DURATION][=SIZE], like {like}")
    parts = match.groupdict()
    kind = _kind(parts["kind"], text)
    try:
        start_s = float(parts.get("start") or 0.0)
        duration_s = kind.duration_s if parts["duration"] is None else float(parts["duration"])
        size = kind.size if parts["size"] is None else float(parts["size"])
    except ValueError:
        numbers = "duration and size" if live else "start, duration and size"
        raise LabError(f"fault {text!r}: {numbers} are numbers") from None
    return Fault(parts["kind"], start_s, duration_s, size, live)


def check(faults: Iterable[Fault], duration_s: float, link: str, config: LabConfig) -> None:
    """Raise `LabError` when a fault begins after the flight, or affects something that the flight lacks."""
    for fault in faults:
        if fault.start_s >= duration_s:
            raise LabError(
                f"fault {fault}: the flight ends {duration_s:g} s after the release, before it begins"
            )
        if why := why_not(KINDS[fault.kind], "mavlink" if link.startswith("mavlink") else "radio", config):
            raise LabError(f"fault {fault}: {why}")


def why_not(kind: Kind, links: str, config: LabConfig) -> str:
    """Return why a kind of fault cannot act on a robot with these links, by their names; empty when it can."""
    if kind.link not in links:
        missing = {"radio": "radio", "mavlink": "serial line"}[kind.link]
        return f"acts with --link {kind.link} only; this robot has no {missing}"
    if not kind.acts_on(config.robot.body):
        return f"acts on a part of {kind.body} only; this flight is one of {Path(config.robot.body).name}"
    if kind.markers and not config.markers.enabled:
        return f"needs --set {MARKERS_ON}"
    return ""


def switched_on(events: Iterable[Mapping[str, Any]]) -> dict[bytes, bytes]:
    """Return the live faults among the events of a flight as metadata of its log, for `spans_of`."""
    found: list[list[Any]] = []  # fault, begin and end [us]
    for event in events:
        match = SWITCHED.fullmatch(event["text"]) if event["source"] == "lab" else None
        if match is not None and match["change"] == "begins":
            found.append([match["fault"], event["t_us"], math.inf])
        elif match is not None:
            for one in [one for one in found if one[0] == match["fault"] and one[2] == math.inf][:1]:
                one[2] = event["t_us"]
    return {SWITCHED_ON: json.dumps(found).encode()}


def spans_of(metadata: Mapping[bytes, bytes] | None) -> list[Span]:
    """Return when the faults of a flight act, from the metadata of its log; omit those of unknown kinds."""
    texts = stored_in(metadata, "request").get("faults", ())
    planned = [parse(text) for text in texts if text.partition("@")[0] in KINDS]
    live = json.loads((metadata or {}).get(SWITCHED_ON, b"[]"))
    known = [one for one in live if re.split("[:=]", one[0])[0] in KINDS]
    release_us = release_of(metadata)
    return [Span(fault, *(1e-6 * us for us in fault.span_us)) for fault in planned] + [
        Span(parse(text, live=True), *(1e-6 * (us - release_us) for us in times)) for text, *times in known
    ]


class Switchboard:
    """Sets the knobs of one robot as faults begin and end; nothing else may set a knob during a fault.

    `active` has the current faults, and changes with time.
    """

    def __init__(self, robot: Robot) -> None:
        self.active: list[Fault] = []
        self._robot = robot
        self._before: dict[Knob, float] = {}  # values before the faults

    def prepare(self, faults: Iterable[Fault]) -> None:
        """Create at the start whatever faults will need."""
        for fault in faults:
            kind = KINDS[fault.kind]
            if not self._why_not(kind):
                for knob in kind.knobs:
                    try:
                        knob.read(self._robot)
                    except Exception as error:  # of a user's own
                        raise LabError(f"fault {fault.kind}: {blame(error)}") from error

    def plan(self, faults: Iterable[Fault], release_us: int, end_us: int) -> None:
        """Plan begin and end of faults that begin before `end_us`; skip those that cannot act on the robot."""
        for fault in faults:
            begins_us, ends_us = (release_us + us for us in fault.span_us)
            if self._why_not(KINDS[fault.kind]) or begins_us >= end_us:
                continue
            self._robot.events.at(int(begins_us), partial(self.begin, fault))
            if ends_us < end_us:
                self._robot.events.at(int(ends_us), partial(self.end, fault))

    def act(self, fault: Fault, now_us: int) -> None:
        """Begin a fault now, ignoring its start. Raises `LabError` if it cannot act on this robot."""
        if reason := self._why_not(KINDS[fault.kind]):
            raise LabError(f"fault {fault.kind}: {reason}")
        self.begin(fault, now_us)
        if math.isfinite(fault.duration_s):
            self._robot.events.at(now_us + round(fault.duration_s * 1e6), partial(self.end, fault))

    def begin(self, fault: Fault, now_us: int) -> None:
        """Set the knobs of a fault."""
        self._robot.note("lab", f"fault {fault} begins")
        self._switch(fault, [*self.active, fault], now_us)

    def end(self, fault: Fault, now_us: int) -> None:
        """Reset the knobs, if the fault is still active."""
        if fault not in self.active:
            return
        self._robot.note("lab", f"fault {fault} ends")
        remaining = self.active.copy()
        remaining.remove(fault)
        self._switch(fault, remaining, now_us)

    def _why_not(self, kind: Kind) -> str:
        return why_not(kind, self._robot.links, self._robot.config)

    def _switch(self, fault: Fault, active: list[Fault], now_us: int) -> None:
        """Set the knobs of `fault` to the blend of the active faults."""
        robot = self._robot
        robot.body.advance(now_us)
        self.active[:] = active
        for knob in KINDS[fault.kind].knobs:
            value = self._before.setdefault(knob, knob.read(robot))
            turning = [other for other in active if knob in KINDS[other.kind].knobs]
            for other in turning:
                value = knob.blend(value, KINDS[other.kind].scale * other.size)
            knob.turn(robot, value)
            if not turning:
                del self._before[knob]


def _kind(name: str, text: str) -> Kind:
    if name not in KINDS:
        near = hint(name, KINDS, "floaty list --faults lists them all")
        raise LabError(f"fault {text!r}: unknown kind {name!r}; {near}")
    return KINDS[name]


def _number(value: float) -> str:
    """Return a number as text that reads back equal."""
    return repr(float(value)).removesuffix(".0")
