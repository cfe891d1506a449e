"""The experiments' measures besides the errors of every flight: steps, sines, recoveries; truth against goal.

Every function takes the rows after the release of a flight that may have ended early; undetermined values are NaN, which
no limit accepts. The results have the names of `hil.laboratory.metrics.METRICS`.
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.geometry import euler_zyx_of
from hil.laboratory.faults import Fault
from hil.laboratory.metrics import BOX, body, column, position_error

BAND = 0.05  # of a step: settled; a choice, the paper names no band
RISEN = 0.90  # of a step
JUDGED_S = 0.5  # after a step: over a real link the goal's clock runs ahead, so another step may begin before the end
HOLD_S = 3.0  # before the next step: the robot is at rest by then
CALM_S = 0.5  # before the next disturbance: the robot has recovered by then
BLOWN_S = 5.0  # before the wind ends: the robot leans steadily by then
ROW_S = 0.01
Signal = NDArray[np.float64]  # (N,), one value per row


def seconds(flight: pa.Table) -> Signal:
    """Return the time since the release [s]."""
    times = column(flight, "t")
    since: Signal = 1e-6 * (times - times[:1])
    return since


def yaw_and_goal(flight: pa.Table) -> tuple[Signal, Signal]:
    """Return the true yaw without jumps at half turns, counted like the goal, and the goal [rad]."""
    q_WB, goal = body(flight, "qw", "qx", "qy", "qz"), column(flight, "goal.yaw")
    yaw = np.unwrap(euler_zyx_of(q_WB)[:, 2])
    return yaw + 2 * np.pi * np.round((goal[:1] - yaw[:1]) / (2 * np.pi)), goal


def axis_and_goal(axis: str, flight: pa.Table) -> tuple[Signal, Signal]:
    """Return the true coordinate x, y or z and the goal, W [m]."""
    return body(flight, axis), column(flight, f"goal.{axis}")


def steps(times: Signal, value: Signal, goal: Signal) -> list[tuple[float, float, float]]:
    """Return rise [s], settling [s] and overshoot [share of the step] of every jump of the goal."""
    starts = (np.flatnonzero(np.diff(goal)) + 1).tolist()
    found = []
    for start, end in pairwise((*starts, len(goal))):
        done = (value[start:end] - goal[start - 1]) / (goal[start] - goal[start - 1])  # 0 before, 1 after
        risen = np.flatnonzero(done >= RISEN)
        outside = np.flatnonzero(np.abs(done - 1.0) > BAND)
        settled = outside[-1] + 1 if len(outside) else 0
        after = times[start:end] - times[start]
        rise = float(after[risen[0]]) if len(risen) else np.nan
        settle = float(after[settled]) if settled < len(after) else np.nan
        found.append((rise, settle, max(float(done.max()) - 1.0, 0.0)))
    return found


def yaw_step(flight: pa.Table) -> Mapping[str, float]:
    """Return settling time, overshoot and largest rate of a flight with one step in yaw."""
    found = steps(seconds(flight), *yaw_and_goal(flight))
    _, settle, overshoot = found[0] if found else (np.nan, np.nan, np.nan)
    return {"settle": settle, "overshoot": overshoot, "peak_rate": peak_rate(flight)}


def peak_rate(flight: pa.Table) -> float:
    """Return the largest rate about z of B [rad/s]."""
    return float(np.abs(body(flight, "r")).max())


def y_steps(flight: pa.Table) -> Mapping[str, float]:
    """Return the slowest rise, the largest overshoot and the error at rest of a flight with steps in y."""
    times, (y, goal) = seconds(flight), axis_and_goal("y", flight)
    jumps = np.flatnonzero(np.diff(goal)) + 1
    if len(jumps) and times[-1] - times[jumps[-1]] < JUDGED_S:
        times, y, goal, jumps = times[: jumps[-1]], y[: jumps[-1]], goal[: jumps[-1]], jumps[:-1]
    found = steps(times, y, goal)
    if not found:
        return {}
    edges = np.append(times[jumps], times[-1] + ROW_S)[1:]
    holding = np.any([(times >= edge - HOLD_S) & (times < edge) for edge in edges], axis=0)
    rise, _, overshoot = np.array(found).T
    return {
        "rise": float(rise.max()),
        "overshoot": float(overshoot.max()),
        "hold_rms": float(np.sqrt(((y - goal)[holding] ** 2).mean())),
    }


def response(times: Signal, value: Signal, goal: Signal, frequency_hz: float) -> tuple[float, float]:
    """Return gain and lag [rad, positive when late] of a sine, over its last whole periods."""
    periods = int((times[-1] - times[np.argmax(goal != goal[0])]) * frequency_hz + 0.01)
    if periods < 1 or not np.any(goal != goal[0]):
        return np.nan, np.nan
    rows = times > times[-1] - periods / frequency_hz
    turn = np.exp(-2j * np.pi * frequency_hz * times[rows])
    ratio = ((value[rows] - value[rows].mean()) @ turn) / ((goal[rows] - goal[rows].mean()) @ turn)
    return float(abs(ratio)), float(-np.angle(ratio))


def yaw_sine(frequency_hz: float, flight: pa.Table) -> Mapping[str, float]:
    yaw, goal = yaw_and_goal(flight)
    gain, lag = response(seconds(flight), yaw, goal, frequency_hz)
    rms = float(np.sqrt(((yaw - goal) ** 2).mean()))
    return {"gain": gain, "lag": lag, "rms_yaw": rms, "peak_rate": peak_rate(flight)}


def height_sine(frequency_hz: float, flight: pa.Table) -> Mapping[str, float]:
    gain, lag = response(seconds(flight), *axis_and_goal("z", flight), frequency_hz)
    return {"gain": gain, "lag": lag}


def recoveries(faults: tuple[Fault, ...], duration_s: float, flight: pa.Table) -> Mapping[str, float]:
    """Return the recovery after each disturbance, until the next one or the end of the flight."""
    times, error = seconds(flight), np.abs(position_error(flight)).max(axis=1)
    starts = [fault.start_s for fault in faults]
    recovered, slowest = 0, 0.0
    for start, end in pairwise((*starts, duration_s)):
        rows = (times >= start) & (times < end)
        if times[-1] < end - 2 * ROW_S:
            break
        outside = times[rows][error[rows] > BOX]
        back_s = float(outside[-1] + ROW_S - start) if len(outside) else 0.0
        slowest = max(slowest, back_s)
        recovered += back_s < end - start - CALM_S
    disturbed = error[times >= starts[0]]
    return {
        "recovered": float(recovered),
        "excursion": float(disturbed.max()) if len(disturbed) else np.nan,
        "back_in_box": slowest if recovered == len(faults) else np.nan,
    }


def leaning(axis: int, end_s: float, flight: pa.Table) -> Mapping[str, float]:
    """Return the robot's offset from its goal, on axis 0..2, in a wind that ends at `end_s`."""
    times = seconds(flight)
    rows = (times >= end_s - BLOWN_S) & (times < end_s)
    if times[-1] < end_s - ROW_S:
        return {}
    return {"wind_offset": float(abs(position_error(flight)[rows, axis].mean()))}
