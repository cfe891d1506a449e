"""The curves of a flight for viewer and report, from log rows, in customary units.

Lengths in cm, angles in degrees, times in ms. Okabe and Ito's colours are distinguishable with every kind of colour vision.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.signals import REFUSED
from ground_station.latency import STAGES
from hil.laboratory.faults import switched_on
from hil.laboratory.files.recorder import OPERATOR, release_of
from hil.laboratory.metrics import attitude_error, column, position_error, rows_at

ORANGE, SKY, GREEN, YELLOW, BLUE, RED, PINK, GREY = (
    "#e69f00", "#56b4e9", "#009e73", "#b8a900", "#0072b2", "#d55e00", "#cc79a7", "#888888",
)  # fmt: skip
AXIS_COLOURS = (RED, GREEN, BLUE)  # x, y, z; roll, pitch, yaw
FLAP_COLOURS = (BLUE, ORANGE, GREEN, PINK)
SERIES_COLOURS = (BLUE, ORANGE, GREEN, PINK, SKY, RED, YELLOW, GREY)
TASK_COLOURS = {
    "STABILIZER": BLUE, "KALMAN": ORANGE, "SENSORS": GREEN, "THIEF": PINK, "SYSLINK": "#1b04fa", "LOG": "#082427",
    "CRTP-RX": "#7f2a04", "CRTP-TX": "#8ef199", "CRTP-SRV": "#2ce5ff", "PARAM": "#c27934",
    "CONSOLE": "#97eccd", "PLATFORM-SRV": "#704369", "APP": "#000690", "MEM": "#011d57", "PWRMGNT": "#26b5ff",
    "Tmr Svc": "#51fb62",
}  # fmt: skip
IN_ITS_PLACE = {  # over MAVLink
    "MAV-RX": "CRTP-RX", "MAV-TX": "CRTP-TX", "MAV-STREAM": "LOG", "MAV-PARAM": "PARAM", "MAV-SYNC": "CRTP-SRV",
    "MAV-BOOT": "PLATFORM-SRV",
}  # fmt: skip
STAGE_COLOURS = dict(zip(STAGES, SERIES_COLOURS, strict=False))  # of a pose's age

NEAR_CM, ATTITUDE_DEG = 6.0, 20.0  # paper, Hover_figure: errors below 6 cm most of the time, below 20 degrees
MARKS = b"marks"  # key in the metadata of a log that is drawn
TICK_MS = 10.0  # of the estimator's horizon

Read = Callable[[pa.Table], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Curves:
    """Curves on one axis; `read` returns (N, number of curves) from N rows of a log."""

    names: tuple[str, ...]
    colours: tuple[str, ...]
    unit: str
    read: Read
    needs: str = "t"  # columns of which a log has one at least

    def fits(self, columns: Iterable[str]) -> bool:
        """Whether a log with these columns has what is read."""
        return not set(self.needs.split()).isdisjoint(columns)


@dataclass(frozen=True, slots=True)
class States:
    """A quantity with named values 0, 1, …"""

    column: str
    names: tuple[str, ...]
    colours: tuple[str, ...]


def actuators(log: pa.Table) -> tuple[tuple[str, Curves], ...]:
    """Return what moves the robot, with its name: flaps, rotors, or what a robot of the user's own logs."""
    moving = (("flaps", FLAPS), ("rotors", ROTORS), *(("robot", plot) for plot in own_columns(log, "robot")))
    return tuple((name, plot) for name, plot in moving if plot.fits(log.column_names))


def errors_and_actuators(log: pa.Table) -> tuple[tuple[str, Curves], ...]:
    """Return the errors of position and attitude, and what moves the robot, with their names."""
    return (("position error", POSITION), ("attitude error", ATTITUDE), *actuators(log))


def command_of(plot: Curves, log: pa.Table) -> Curves | None:
    """Return the commands of actuators in their own unit; None where the log has none."""
    command = FLAPS_COMMAND if plot is FLAPS else ROTORS_COMMAND if plot is ROTORS else None
    return command if command is not None and command.fits(log.column_names) else None


def since_release(log: pa.Table) -> NDArray[np.float64]:
    """Return the time of every row [s], zero at the release."""
    return np.asarray(1e-6 * (column(log, "t") - release_of(log.schema.metadata)))


def task_colour(name: str) -> str:
    """Return the one colour of a task in every figure; grey for one that is not the firmware's."""
    return TASK_COLOURS.get(IN_ITS_PLACE.get(name, name), GREY)


def since_fusion(rows: pa.Table) -> NDArray[np.float64]:
    """Return the time since a pose was last fused [ms], by the log's rows, (N, 1); NaN before the first."""
    times, fused = column(rows, "t"), column(rows, "estimator.fused")
    latest = np.maximum.accumulate(np.where(np.diff(fused, prepend=0.0) > 0, times, -np.inf))
    return np.asarray(np.where(np.isfinite(latest), 1e-3 * (times - latest), np.nan)[:, None])


def row_of_last_fusion(rows: pa.Table) -> pa.Table:
    """Return the row of the last fused pose; no row before the first."""
    if "estimator.fused" not in rows.column_names:  # a real board does not report it
        return rows.slice(0, 0)
    fusions = np.flatnonzero(np.diff(column(rows, "estimator.fused"), prepend=0.0) > 0)
    return rows_at(rows, fusions[-1:])


def plain(*names: str, scale: float = 1.0) -> Read:
    """Return what reads columns as they are, but for their unit."""
    return lambda rows: scale * column(rows, *names).reshape(-1, len(names))


def logged(
    names: tuple[str, ...], colours: tuple[str, ...], unit: str, *columns: str, scale: float = 1.0
) -> Curves:
    """Return the curves of columns, of which a log has all or none."""
    return Curves(names, colours, unit, plain(*columns, scale=scale), needs=columns[0])


def _degrees(*names: str) -> Read:
    return lambda rows: np.degrees(column(rows, *names))


def _four(prefix: str) -> tuple[str, ...]:
    return tuple(f"{prefix}{number}" for number in (1, 2, 3, 4))


def _flaps(rows: pa.Table) -> NDArray[np.float64]:
    """Return the true angles of the flaps [deg], or a real board's estimates."""
    known = "truth.flap_" if "truth.flap_1" in rows.column_names else "telemetry.flap_"
    return np.degrees(column(rows, *_four(known)))


def _stages(rows: pa.Table) -> NDArray[np.float64]:
    """Return the ages of the newest pose behind each stage [ms], (N, 5); NaN where that is not reported."""
    camera, processing, mocap, station, link = column(
        rows, "age.camera", "age.processing", "age.mocap", "age.station", "age.link"
    ).T
    behind = (camera, camera + processing, mocap, mocap + station, mocap + station + link)
    return np.asarray(1e-3 * np.stack(behind, axis=1))


_XYZ, _RPY = ("x", "y", "z"), ("roll", "pitch", "yaw")
POSITION = Curves(_XYZ, AXIS_COLOURS, "cm", lambda rows: 100 * position_error(rows))
ATTITUDE = Curves(_RPY, AXIS_COLOURS, "deg", lambda rows: np.degrees(attitude_error(rows)))
POSITION_ESTIMATE = Curves(
    _XYZ,
    AXIS_COLOURS,
    "cm",
    lambda rows: 100 * column(rows, "estimate.x", "estimate.y", "estimate.z"),
    needs="estimate.x",
)
ATTITUDE_ESTIMATE = Curves(
    _RPY, AXIS_COLOURS, "deg", _degrees(*(f"estimate.{name}" for name in _RPY)), needs="estimate.roll"
)


def _misses(group: str) -> tuple[Curves, Curves]:
    """Return an estimate less the truth, position and attitude, by the group of its columns, in G."""

    def position(rows: pa.Table) -> NDArray[np.float64]:
        return np.asarray(100 * column(rows, f"{group}.x", f"{group}.y", f"{group}.z") - POSITION.read(rows))

    def attitude(rows: pa.Table) -> NDArray[np.float64]:
        angles = _degrees(*(f"{group}.{name}" for name in _RPY))(rows)
        return np.asarray((angles - ATTITUDE.read(rows) + 180) % 360 - 180)

    return (
        Curves(_XYZ, AXIS_COLOURS, "cm", position, needs=f"{group}.x"),
        Curves(_RPY, AXIS_COLOURS, "deg", attitude, needs=f"{group}.roll"),
    )


POSITION_MISS, ATTITUDE_MISS = _misses("estimate")
REPLAYED_POSITION_MISS, REPLAYED_ATTITUDE_MISS = _misses("replay")
REPLAYED_REFUSALS = Curves(
    tuple(f"{name}, {how}" for name in REFUSED for how in ("replayed", "flown")), SERIES_COLOURS[:6], "so far",
    plain(*(f"{group}.{name}" for name in REFUSED for group in ("replay", "estimator"))), needs="replay.refused",
)  # fmt: skip
FLAPS = Curves(_four("flap "), FLAP_COLOURS, "deg", _flaps, needs="truth.flap_1 telemetry.flap_1")
ROTORS = logged(_four("M"), FLAP_COLOURS, "mN", *_four("rotor.thrust_"), scale=1e3)
MOTORS = Curves(
    _four("M"), FLAP_COLOURS, "%", plain(*_four("motor.m"), scale=100 / 65535), needs="rotor.thrust_1"
)
FLAPS_COMMAND = Curves(
    _four("command "), FLAP_COLOURS, "deg", _degrees(*_four("control.flap_")), needs="control.flap_1"
)
ROTORS_COMMAND = logged(_four("command "), FLAP_COLOURS, "mN", *_four("rotor.command_"), scale=1e3)
INPUTS = Curves(
    ("u1 roll", "u2 pitch", "u3 yaw", "u4 height"), FLAP_COLOURS, "deg", _degrees(*_four("control.u")), needs="control.u1"
)  # fmt: skip
AGE = logged(("age of the pose",), (BLUE,), "ms", "estimator.pose_age_us", scale=1e-3)
HORIZON = logged(("horizon",), (ORANGE,), "ms", "estimator.horizon", scale=TICK_MS)
SINCE_FUSION = Curves(("since the last fused pose",), (RED,), "ms", since_fusion, needs="estimator.fused")
PACKETS = logged(
    ("lost up", "lost down", "sent again"), (RED, ORANGE, BLUE), "packets",
    "link.up_dropped", "link.down_dropped", "link.retried",
)  # fmt: skip
SERIAL_FAULTS = logged(
    ("overrun", "no room", "bad up", "bad down"), (RED, ORANGE, BLUE, SKY), "so far",
    "serial.overrun", "serial.no_room", "serial.up_bad", "serial.down_bad",
)  # fmt: skip
STATION = logged(
    ("poses late", "poses unusable", "telemetry malformed"), (RED, ORANGE, BLUE), "so far",
    "link.late", "station.unusable", "station.malformed",
)  # fmt: skip
QUEUE = logged(
    ("longest so far", "dropped"), (BLUE, RED), "measurements",
    "rtos.measurements_high_water", "rtos.measurements_dropped",
)  # fmt: skip
AGE_STAGES = Curves(
    ("camera", "+ processing", "+ network", "+ station", "+ link: on board"), (BLUE, SKY, GREEN, ORANGE, PINK), "ms",
    _stages, needs="age.link",
)  # fmt: skip
BATTERY = logged(("a cell",), (GREEN,), "V", "battery.voltage")
LOAD = logged(("all tasks",), (BLUE,), "%", "board.load")
AIR = logged(("link quality [%]", "RSSI [-dBm]"), (BLUE, ORANGE), "", "link.quality", "link.rssi")
# The colour of a mark, and the counters of a refusal, of which the log may lack some.
MARK_KINDS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "pose refused on board": (
        RED, (*(f"estimator.{name}" for name in REFUSED), "estimator.rejected"),
    ),
    "pose refused by the tracker": (ORANGE, ("tracker.refused",)),
    "pose too late for the link": (SKY, ("link.late",)),
    "fault": (PINK, ()),
    "operator": (BLUE, ()),
}  # fmt: skip
# The states of firmware_py.wire.supervisor.State, and one for a board that has not reported its state.
SUPERVISOR = States(
    "supervisor.state", ("calibrating", "waiting", "flying", "failsafe", "unknown"), (ORANGE, SKY, GREEN, RED, GREY)
)  # fmt: skip
RELEASE = States("flight.free", ("held", "free"), (GREY, BLUE))
JUDGED = States("flight.free", ("not judged", "judged"), (GREY, BLUE))  # for a real flight


def lanes_of(names: Iterable[str]) -> dict[str, States]:
    """Return the states to show for a flight whose log has columns of these names."""
    free = {"flight": JUDGED} if "cameras.x" in names else {"robot": RELEASE}
    return {"supervisor": SUPERVISOR, **free}


def processor(names: Iterable[str]) -> Curves:
    """Return the tasks' shares of the processor between rows: (N - 1, tasks) from N rows; the idle task is left out."""
    tasks = [name for name in names if name.startswith("cpu.") and name != "cpu.IDLE"]

    def load(rows: pa.Table) -> NDArray[np.float64]:
        spent = np.diff(column(rows, *tasks), axis=0).reshape(-1, len(tasks))
        return np.asarray(100 * spent / np.diff(column(rows, "t"))[:, None])

    shown = tuple(name.removeprefix("cpu.") for name in tasks)
    return Curves(shown, tuple(map(task_colour, shown)), "%", load)


def own_columns(rows: pa.Table, group: str) -> list[Curves]:
    """Return what the user's own `logic` or `robot` has logged, a set of curves for each unit."""
    by_unit: dict[str, list[str]] = {}
    for field in rows.schema:
        if field.name.startswith(f"{group}."):
            by_unit.setdefault((field.metadata or {}).get(b"unit", b"").decode(), []).append(field.name)
    return [
        Curves(
            tuple(name.removeprefix(f"{group}.") for name in names),
            tuple(SERIES_COLOURS[index % len(SERIES_COLOURS)] for index in range(len(names))),
            unit, plain(*names), needs=" ".join(names),
        )
        for unit, names in by_unit.items()
    ]  # fmt: skip


def latency(rows: pa.Table) -> NDArray[np.float64]:
    """Return the mean time in the air, up and down [ms], of the packets between rows: (N - 1, 2); NaN where none arrived."""
    total = np.diff(column(rows, "link.up_latency_sum", "link.down_latency_sum"), axis=0)
    arrived = np.diff(column(rows, "link.up_delivered", "link.down_delivered"), axis=0)
    return np.asarray(1e-3 * total / np.where(arrived > 0, arrived, np.nan))


def line_load(rows: pa.Table) -> NDArray[np.float64]:
    """Return the load of the serial line, up and down [%], between rows: (N - 1, 2) from N rows."""
    busy = np.diff(column(rows, "serial.up_busy", "serial.down_busy"), axis=0)
    return np.asarray(100.0 * busy / np.diff(column(rows, "t"))[:, None])


def changes(rows: pa.Table, states: States) -> tuple[NDArray[np.float64], list[str]]:
    """Return the instants [us] and names of new states; the first row begins one."""
    codes = column(rows, states.column).astype(np.int64)
    begins = np.flatnonzero(np.diff(codes, prepend=-1)) if len(codes) else np.empty(0, np.int64)
    return column(rows, "t")[begins], [states.names[code] for code in codes[begins]]


def with_marks(log: pa.Table, events: Iterable[Mapping[str, Any]]) -> pa.Table:
    """Return a log whose figures mark an operator's actions and the faults that were switched on in flight."""
    events = list(events)
    marks = [(event["t_us"], event["text"]) for event in events if event["source"] == OPERATOR]
    return log.replace_schema_metadata(
        {**(log.schema.metadata or {}), MARKS: json.dumps(marks).encode(), **switched_on(events)}
    )


def marks_of(log: pa.Table) -> list[tuple[float, str]]:
    """Return the operator's actions and their instants [us] in a log `with_marks`."""
    return [(t_us, text) for t_us, text in json.loads((log.schema.metadata or {}).get(MARKS, b"[]"))]
