"""Computes metrics and verdicts from a flight log after the release: from the truth, never from the estimate.

The truth of a real flight is unknown, so the cameras' poses replace it: errors and shares cover the time `flown`, in
which the robot was seen; the metric `unseen` is the rest. Errors and shares of a flight from floor to floor cover its
hold; take-off and landing have their own metrics. A lost flight fails all limits, unless its limit on `lost` admits the
loss.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import BeforeValidator, PlainSerializer

from firmware_py.geometry import euler_zyx_of
from firmware_py.signals import REFUSED
from firmware_py.wire.supervisor import State
from ground_station.links.crazyflie_link import FlightTimes
from hil.errors import LabError, hint, shown
from hil.laboratory.arguments import checked

NEAR = 0.06  # [m] "less than 6 cm over each axis"
BOX = 0.10  # [m] half of the 20 cm box
UNDER_WAY_US = 100_000  # at the end of a real flight: its last poses are in flight
STEADY = tuple(f"estimate.{name}" for name in "xyzpqr")  # a running estimator changes them in every step
PHASES = "phases"  # in the metadata of a log: the `FlightTimes` of a flight from floor to floor, as JSON
CLEAR = 0.02  # [m] above the net or the floor: in the air
TOUCHING_ROWS = 10  # 0.1 s
SHORT_S = 0.1  # a shorter missing part of the flight is not reported

# Limits of every flight; an experiment may override them.
ALWAYS: Mapping[str, float] = {
    "resets": 0.0,
    "uncontrolled": 0.2,  # [s] a silence slightly longer than the supervisor's timeout
    "unseen": 0.5,  # [s] that timeout
}


@checked
@dataclass(frozen=True, slots=True)
class Metric:
    """A figure of a flight; a limit on it is an upper or a lower bound."""

    unit: str
    bound: Literal["max", "min"]
    meaning: str
    over_time: bool = False  # a share of the time in which the robot was seen

    def show(self, value: float) -> str:
        """Return a value as text with its unit."""
        return show(value, self.unit)


SHOWN = {
    "m": (100.0, "cm"),
    "rad": (180.0 / np.pi, "deg"),
    "rad/s": (180.0 / np.pi, "deg/s"),
    "share": (100.0, "%"),
}


def show(value: float, unit: str) -> str:
    """Return a value as text: lengths in cm, angles in deg, shares in percent; infinity is never."""
    if np.isposinf(value):
        return "never"
    scale, shown = SHOWN.get(unit, (1.0, unit))
    return f"{value * scale:.4g} {shown}".strip()


METRICS: Mapping[str, Metric] = {
    "lost": Metric("", "max", "1 when the flight ended as a crash"),
    "flown": Metric("s", "min", "free flight in which the robot was seen: what errors and shares are of"),
    "held": Metric(
        "s",
        "min",
        "of a flight from floor to floor, between take-off and landing: what errors and shares are of",
    ),
    "rms_x": Metric("m", "max", "root mean square of the x error, goal frame"),
    "rms_y": Metric("m", "max", "root mean square of the y error"),
    "rms_z": Metric("m", "max", "root mean square of the z error"),
    "max_x": Metric("m", "max", "largest x error"),
    "max_y": Metric("m", "max", "largest y error"),
    "max_z": Metric("m", "max", "largest z error"),
    "within_6cm_x": Metric("share", "min", "share of the time with |x error| < 6 cm", over_time=True),
    "within_6cm_y": Metric("share", "min", "share of the time with |y error| < 6 cm", over_time=True),
    "within_6cm_z": Metric("share", "min", "share of the time with |z error| < 6 cm", over_time=True),
    "in_box": Metric(
        "share", "min", "share of the time inside the 20 cm box around the goal", over_time=True
    ),
    "attitude_max": Metric("rad", "max", "largest roll, pitch or yaw error, also in take-off and landing"),
    "y_over_x": Metric("", "min", "rms of y over rms of x"),
    "settle": Metric("s", "max", "from a step of the goal until the error stays within 5 % of it"),
    "rise": Metric("s", "max", "from a step of the goal to 90 % of it, the slowest"),
    "overshoot": Metric("share", "max", "largest excess over a step of the goal, as a share of the step"),
    "hold_rms": Metric("m", "max", "root mean square of the y error in the last 3 s before a step"),
    "peak_rate": Metric("rad/s", "min", "largest yaw rate"),
    "gain": Metric("", "min", "amplitude of the sine flown over that of the goal"),
    "lag": Metric("rad", "max", "phase by which the sine flown is behind the goal"),
    "rms_yaw": Metric("rad", "max", "root mean square of the yaw error"),
    "recovered": Metric(
        "", "min", "disturbances after which the robot was back in the 20 cm box before the next"
    ),
    "excursion": Metric("m", "max", "largest error on an axis from the first disturbance on"),
    "back_in_box": Metric(
        "s", "max", "longest time after a disturbance until the robot stays in the 20 cm box"
    ),
    "wind_offset": Metric("m", "max", "mean error along the wind in its last 5 s"),
    "height_off": Metric("m", "max", "mean error in height over the second half of the flight"),
    "as_computed": Metric("", "min", "1 when the height is held exactly if the lift of the flaps allows it"),
    "age_mean": Metric(
        "s",
        "max",
        "mean age of the pose at the estimator's tick that uses it: on arrival, and the wait for the tick",
    ),
    "poses_refused": Metric("", "max", "poses that the estimator did not fuse"),
    "frames_refused": Metric("", "max", "frames that the ground station's tracker refused"),
    "failsafe": Metric("s", "max", "time in failsafe: actuators at hover, loop open"),
    "resets": Metric("", "max", "how often the board's processor was reset"),
    "uncontrolled": Metric(
        "s", "max", "time in which no loop was closed: failsafe, or the board hangs, boots or waits"
    ),
    "unseen": Metric(
        "s", "max", "time whose true pose is unknown: of a real flight, without the cameras' poses"
    ),
    "line_up": Metric("share", "max", "mean load of the serial line to the board"),
    "line_down": Metric("share", "max", "mean load of the serial line from the board"),
    "line_overrun": Metric("bytes", "max", "lost because the board's receive buffer was full"),
    "loop_delay": Metric(
        "s", "max", "mean time from a gyro sample to the flaps that it moved, of a board in the loop"
    ),
    "loop_added": Metric(
        "s", "max", "mean age that the link to a board in the loop adds to poses, and that they report"
    ),
    "loop_stood": Metric(
        "s", "max", "how long simulated time stood still because a board in the loop was late"
    ),
    "samples_held": Metric("", "max", "milliseconds for which a board in the loop waited for a gyro sample"),
    "samples_late": Metric("", "max", "milliseconds for which it flew on without a gyro sample"),
    "samples_lost": Metric("", "max", "gyro samples that were lost on the link and sent again"),
    "samples_doubled": Metric("", "max", "gyro samples that it received twice"),
    "estimator_late_from": Metric("share", "min", "thief's load at which KALMAN first misses a deadline"),
    "controller_late_from": Metric(
        "share", "min", "thief's load at which STABILIZER first misses a deadline"
    ),
    "held_up_to": Metric(
        "share", "min", "thief's largest load, in steps, with which the robot stays inside the 20 cm box"
    ),
    "power": Metric("W", "max", "mean power from the battery"),
    "specific_power": Metric("W/kg", "max", "that power over the robot's mass"),
    "endurance": Metric("min", "min", "flight until the supervisor finds the battery empty"),
    "lift_off": Metric("s", "max", "from the controller's start until the robot is 2 cm above the net"),
    "reached_box": Metric(
        "s", "max", "from the start of the flight speed or of a take-off until the robot is in the 20 cm box"
    ),
    "hover_in_box": Metric("share", "min", "from then to the landing speed: share of the time in that box"),
    "touch_down_speed": Metric(
        "m/s", "max", "fastest descent in the last 0.1 s before the feet touch the net or the floor"
    ),
    "landed_off_axis": Metric(
        "m", "max", "distance at the end from the tunnel's axis, or from the place where it was to land"
    ),
    "off_path": Metric("m", "max", "largest sideways error in take-off and landing, on an axis"),
}


Figure = Annotated[  # in a file NaN is null, infinity "inf"
    float,
    BeforeValidator(lambda value: np.nan if value is None else value),
    PlainSerializer(lambda value: "inf" if np.isinf(value) else value, when_used="json"),
]


@dataclass(frozen=True, slots=True)
class Verdict:
    """One limit, judged."""

    metric: str
    value: Figure
    bound: float
    holds: bool
    unit: str
    sense: Literal["max", "min"]  # of the bound
    applies: bool = True  # False: the flight was lost, so its earlier values do not count

    @property
    def mark(self) -> str:
        """The verdict in one word."""
        return "ok" if self.holds else "FAILS" if self.applies else "lost"

    def __str__(self) -> str:
        relation = "<=" if self.sense == "max" else ">="
        value, bound = show(self.value, self.unit), show(self.bound, self.unit)
        until = "" if self.applies else " until the robot was lost"
        return f"{self.metric} = {value}{until} (limit {relation} {bound})"


@checked
def column(table: pa.Table, *names: str) -> NDArray[np.float64]:
    """Return columns of a log as an array (N,) or (N, len(names)). Raises `LabError` for a missing column."""
    for name in names:
        if name not in table.column_names:
            raise LabError(f"column {shown(name)}: the log has none; {hint(name, table.column_names)}")
    arrays = [table.column(name).to_numpy().astype(np.float64) for name in names]
    return arrays[0] if len(arrays) == 1 else np.stack(arrays, axis=1)


def is_real(table: pa.Table) -> bool:
    """Whether a log is of a real flight, or only its ground station's record."""
    return "cameras.x" in table.column_names


def body(table: pa.Table, *names: str) -> NDArray[np.float64]:
    """Return columns of the body's motion, like `column`: the truth, or in a real flight the cameras' poses."""
    source = "cameras" if is_real(table) else "truth"
    return column(table, *(f"{source}.{name}" for name in names))


def known(table: pa.Table) -> pa.Table:
    """Return the rows with a pose and an estimate; in a real flight the cameras or the board may not report them."""
    if not is_real(table):
        return table
    seen = _seen(table)
    if "estimate.x" in table.column_names:
        seen &= np.isfinite(column(table, "estimate.x"))
    return rows_where(table, seen)


@checked
def position_error(table: pa.Table) -> NDArray[np.float64]:
    """Return the body's position in the goal frame, (N, 3) [m]."""
    offset = body(table, "x", "y", "z") - column(table, "goal.x", "goal.y", "goal.z")
    yaw = column(table, "goal.yaw")
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack(
        (c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]), axis=1
    )


def attitude_error(table: pa.Table) -> NDArray[np.float64]:
    """Return roll, pitch and yaw relative to the goal, (N, 3) [rad], yaw in -pi..pi."""
    angles = euler_zyx_of(body(table, "qw", "qx", "qy", "qz"))
    angles[:, 2] = np.angle(np.exp(1j * (angles[:, 2] - column(table, "goal.yaw"))))
    return angles


ANGLES = ("roll", "pitch", "yaw")


def with_angles(table: pa.Table) -> pa.Table:
    """Return a log with roll, pitch and yaw [rad] of the body's quaternions, which the recorded log does not have."""
    for source in ("truth", "cameras"):
        if f"{source}.qw" not in table.column_names:
            continue
        angles = euler_zyx_of(column(table, *(f"{source}.{name}" for name in ("qw", "qx", "qy", "qz"))))
        for name, values in zip(ANGLES, angles.T, strict=True):
            described = {"unit": "rad", "frame": "W"}
            field = pa.field(f"{source}.{name}", pa.float64(), metadata=described)
            table = table.append_column(field, pa.array(np.ascontiguousarray(values)))
    return table


def free_flight(table: pa.Table) -> pa.Table:
    """Return the rows after the release; of a real flight, those in which the cameras saw the robot."""
    return rows_where(table, _free(table) & (_seen(table) if is_real(table) else True))


def rows_where(table: pa.Table, chosen: NDArray[np.bool_]) -> pa.Table:
    """Return the chosen rows; without a copy of an hour's flight when they are contiguous, the usual case."""
    numbers = np.flatnonzero(chosen)
    if len(numbers) and numbers[-1] - numbers[0] + 1 == len(numbers):
        return table.slice(int(numbers[0]), len(numbers))
    return table.filter(chosen)


def rows_at(table: pa.Table, numbers: NDArray[np.int64]) -> pa.Table:
    """Return the rows of these numbers. `Table.take` loads all of pyarrow's functions at its first call, 30 ms."""
    columns = [pa.array(one.to_numpy()[numbers]) for one in table.columns]
    return pa.table(columns, schema=table.schema)


def _free(table: pa.Table) -> NDArray[np.bool_]:
    return column(table, "flight.free") > 0.5


def _seen(table: pa.Table) -> NDArray[np.bool_]:
    return np.isfinite(column(table, "cameras.x"))


def _time_seen(table: pa.Table) -> tuple[float, float]:
    """Return how long [s] the robot was seen and not seen between the release and the end."""
    free = rows_where(table, _free(table))
    times, seen = column(free, "t"), _seen(free) if is_real(table) else np.ones(free.num_rows, np.bool_)
    if (last := times[seen][-1]) >= times[-1] - UNDER_WAY_US:
        times, seen = times[times <= last], seen[times <= last]
    steps = np.diff(times)
    flown = float(steps[seen[1:] & seen[:-1]].sum())
    return flown * 1e-6, (float(steps.sum()) - flown) * 1e-6


def _without_control(table: pa.Table) -> tuple[float, float]:
    """Return how long [s] after the release the supervisor was in failsafe, and how long no loop was closed."""
    free = rows_where(table, _free(table))
    times, state = column(free, "t"), column(free, "supervisor.state")
    open_loop = state != State.FLYING
    if not is_real(table):
        stands = (np.diff(column(free, *STEADY), axis=0) == 0.0).all(axis=1)
        open_loop[1:] |= stands  # also for a board that hangs in flight, whose state stays unchanged
    whole_s = float(times[-1] - times[0]) * 1e-6
    return float((state == State.FAILSAFE).mean()) * whole_s, float(open_loop.mean()) * whole_s


def _boots(table: pa.Table) -> int:
    """Return how often a board calibrated its gyro after the release, as it does after a reset."""
    calibrating = column(rows_where(table, _free(table)), "supervisor.state") == State.CALIBRATING
    return int((calibrating[1:] & ~calibrating[:-1]).sum())


def measure(table: pa.Table, lost: bool, resets: int | None = None) -> dict[str, float]:
    """Return every metric of METRICS; NaN where the flight was too short.

    `resets`: of the board after the release; None: count them in the log.
    """
    flight = free_flight(table)
    values = dict.fromkeys(METRICS, float("nan"))
    values["lost"] = float(lost)
    values["flown"] = 0.0
    if flight.num_rows < 2:
        return values
    times, phases = column(flight, "t"), _phases(table)
    judged = rows_where(flight, held_rows(flight))
    if phases is not None:
        values["held"] = judged.num_rows * float(np.median(np.diff(times))) * 1e-6
        values.update(_floor_to_floor(flight, phases))
    if judged.num_rows > 1:
        values.update(_errors(judged))
    values["flown"], values["unseen"] = _time_seen(table)
    values["attitude_max"] = float(np.abs(attitude_error(flight)).max())
    values["age_mean"] = _mean_age(flight)
    if (column(flight, "supervisor.state") <= max(State)).any():  # it was reported
        values["resets"] = float(_boots(table) if resets is None else resets)
        values["failsafe"], values["uncontrolled"] = _without_control(table)
    if "serial.up_busy" in table.schema.names:
        busy = column(flight, "serial.up_busy", "serial.down_busy")
        values["line_up"], values["line_down"] = (busy[-1] - busy[0]) / (times[-1] - times[0])
        values["line_overrun"] = float(column(flight, "serial.overrun")[-1])
    if "loop.delay" in table.schema.names:
        values["loop_delay"], values["loop_added"] = (
            column(flight, "loop.delay", "loop.added").mean(axis=0) * 1e-6
        )
        values["loop_stood"] = float(column(flight, "loop.stood")[-1]) * 1e-6
        for name in ("held", "late", "lost", "doubled"):
            values[f"samples_{name}"] = float(column(flight, f"loop.{name}")[-1])
    if "estimator.rejected" in table.schema.names:  # of a real flight
        values["poses_refused"] = float(column(flight, "estimator.rejected")[-1])
    elif "estimator.refused" in table.schema.names:
        refused = column(flight, *(f"estimator.{name}" for name in REFUSED)).sum(axis=1)
        values["poses_refused"] = float(refused[-1])
    if "tracker.refused" in table.schema.names:
        values["frames_refused"] = float(column(flight, "tracker.refused")[-1])
    return values


def _errors(rows: pa.Table) -> dict[str, float]:
    """Return errors and shares of these rows."""
    error = np.abs(position_error(rows))
    rms = np.sqrt((error**2).mean(axis=0))
    values = {}
    for index, axis in enumerate("xyz"):
        values[f"rms_{axis}"] = float(rms[index])
        values[f"max_{axis}"] = float(error[:, index].max())
        values[f"within_6cm_{axis}"] = float((error[:, index] < NEAR).mean())
    values["in_box"] = float((error <= BOX).all(axis=1).mean())
    values["y_over_x"] = float(rms[1] / rms[0]) if rms[0] > 0 else float("nan")
    return values


def _phases(table: pa.Table) -> FlightTimes | None:
    """Return the instants of a flight from floor to floor; None for another. Raises `LabError` for damaged ones."""
    stored = (table.schema.metadata or {}).get(PHASES.encode())
    if stored is None:
        return None
    try:
        return FlightTimes(**{name: int(us) for name, us in json.loads(stored).items()})
    except (ValueError, TypeError, AttributeError, RecursionError):
        raise LabError(f"{PHASES} in the log's schema = {stored[:80]!r}: expected instants [us]") from None


def held_rows(flight: pa.Table) -> NDArray[np.bool_]:
    """Return which rows after the release errors and shares cover, (N,): those between take-off and landing, or all."""
    times, phases = column(flight, "t"), _phases(flight)
    if phases is None:
        return np.ones(len(times), np.bool_)
    return np.asarray((times >= phases.begin_us) & (times < phases.land_us))


def _floor_to_floor(flight: pa.Table, phases: FlightTimes) -> dict[str, float]:
    """Return the metrics of take-off and landing; NaN for what did not occur."""
    names = ("reached_box", "touch_down_speed", "landed_off_axis", "off_path")
    values, times = dict.fromkeys(names, float("nan")), column(flight, "t")
    held = held_rows(flight)
    sideways = np.abs(position_error(flight)[:, :2])
    if not held.all():
        values["off_path"] = float(sideways[~held].max())
    if held.any():
        first = int(np.argmax(held))
        home = column(flight, "goal.x", "goal.y", "goal.z")[first]
        inside = (np.abs(body(flight, "x", "y", "z") - home) <= BOX).all(axis=1)
        if inside.any():
            values["reached_box"] = float(times[np.argmax(inside)] - phases.take_off_us) * 1e-6
    z, climb = body(flight, "z", "vz").T
    down = np.flatnonzero((times > phases.land_us) & (z < z[0] + CLEAR))
    if len(down):
        before = slice(max(int(down[0]) - TOUCHING_ROWS, 0), int(down[0]) + 1)
        values["touch_down_speed"] = float(-climb[before].min())
        values["landed_off_axis"] = float(np.hypot(*sideways[-1]))
    return values


def _mean_age(flight: pa.Table) -> float:
    if "estimator.pose_age_us" not in flight.schema.names:
        return np.nan
    ages = column(flight, "estimator.pose_age_us")
    ages = ages[np.isfinite(ages)]  # unknown before a real board's first telemetry
    return float(ages.mean()) * 1e-6 if len(ages) else np.nan


def limits_of(own: Mapping[str, float], profile: Mapping[str, float] | None = None) -> dict[str, float]:
    """Return the limits of a flight: those of every flight, and the experiment's own or the profile's for it."""
    always = {name: own.get(name, bound) for name, bound in ALWAYS.items()}
    return {**(own if profile is None else profile), **always, **(profile or {})}


def judge(
    values: Mapping[str, float], limits: Mapping[str, float], own: Mapping[str, Metric]
) -> list[Verdict]:
    """Return the verdict on each limit; a metric that is not a number fails. Raises `LabError` like `check_limits`.

    A lost flight fails all limits, unless the one on `lost` admits the loss.
    """
    check_limits(limits, own)
    lost = values.get("lost", 0.0) > limits.get("lost", 0.0)
    verdicts = []
    for name, bound in limits.items():
        metric, value = own.get(name) or METRICS[name], values[name]
        applies = name == "lost" or not lost
        holds = applies and bool(value <= bound if metric.bound == "max" else value >= bound)
        verdicts.append(Verdict(name, value, bound, holds, metric.unit, metric.bound, applies))
    return verdicts


def short_of(metric: Metric, value: float, values: Mapping[str, float], duration_s: float) -> str:
    """Return the text after a share of time: the time it covers, by `values`, if less than the flight's duration."""
    flown_s, held_s = (values.get(name, np.nan) for name in ("flown", "held"))
    flown_s = flown_s if np.isnan(held_s) else held_s
    short = metric.over_time and np.isfinite(value) and flown_s < duration_s - SHORT_S
    return f" of {flown_s:.4g} s" if short else ""


def check_limits(limits: Mapping[str, float], own: Mapping[str, Metric]) -> None:
    """Raise `LabError` for a limit of NaN, or on a metric that neither METRICS nor the experiment has."""
    known = [*own, *METRICS]
    for name, bound in limits.items():
        if name not in known:
            raise LabError(f"limit on {name!r}: no such metric; {hint(name, known)}")
        if np.isnan(bound):
            raise LabError(f"limit on {name!r} = {bound}: expected a number")
