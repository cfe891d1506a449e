"""The edges of metrics and faults: a flight at yaw 180, values of faults that leave a knob's range together."""

from math import pi, radians

import numpy as np
import pyarrow as pa
import pytest

from firmware_py.geometry import yaw_quaternion
from hil.experiments import EXPERIMENTS, measures
from hil.laboratory.fault_kinds import KINDS, MARKERS_ON
from hil.laboratory.faults import Fault, why_not
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.metrics import attitude_error, measure
from hil.laboratory.request import MAVLINK, RADIO, Request

ROWS = 400
TIMES = 10_000 * np.arange(ROWS)


def turned(yaw: np.ndarray, goal: np.ndarray) -> pa.Table:
    """Rows of a flight at home that looks along `yaw`, wanted is `goal` [rad]."""
    q = np.array([yaw_quaternion(angle) for angle in yaw.tolist()])
    zero = np.zeros(len(yaw))
    columns = {
        "t": TIMES[: len(yaw)],
        "flight.free": zero + 1,
        "goal.yaw": goal,
        "supervisor.state": zero + 2,
    }
    columns |= {f"truth.q{part}": q[:, index] for index, part in enumerate("wxyz")}
    columns |= dict.fromkeys(("truth.x", "truth.y", "truth.z", "goal.x", "goal.y", "goal.z", "truth.r"), zero)
    columns |= {f"estimate.{name}": zero for name in ("x", "y", "z", "p", "q", "r")}
    columns |= dict.fromkeys(("estimator.refused", "estimator.too_old", "estimator.invalid"), zero)
    return pa.table(columns | {"estimator.pose_age_us": zero + 40_000})


@pytest.mark.parametrize("facing", [0.0, 180.0, -180.0, 179.0, -179.0, 540.0])
@pytest.mark.parametrize("first", [0.01, -0.01])
def test_metrics_are_the_same_when_yaw_crosses_180_degrees(facing: float, first: float) -> None:
    goal = np.full(ROWS, radians(facing))
    error = first + 0.05 * np.sin(2 * pi * 0.5 * 1e-6 * TIMES)
    flight = turned(goal + error, goal)
    assert attitude_error(flight)[:, 2] == pytest.approx(error, abs=1e-9)
    assert measure(flight, lost=False)["attitude_max"] == pytest.approx(np.abs(error).max())
    yaw, wanted = measures.yaw_and_goal(flight)
    assert yaw - wanted == pytest.approx(error, abs=1e-9)
    assert measures.yaw_sine(0.5, flight)["rms_yaw"] == pytest.approx(np.sqrt((error**2).mean()))


@pytest.mark.parametrize("facing", [0.0, 100.0, 180.0, -100.0])
def test_a_step_across_180_degrees_settles_where_one_elsewhere_does(facing: float) -> None:
    seconds = 1e-6 * TIMES
    since = np.maximum(seconds - 1.0, 0.0)
    goal = radians(facing) + radians(110.0) * (seconds >= 1.0)
    yaw = radians(facing) + radians(110.0) * (1 - np.exp(-since / 0.2))
    found = measures.yaw_step(turned(yaw, goal))
    first_within = np.flatnonzero(since >= -0.2 * np.log(0.05))[0]
    assert found["settle"] == pytest.approx(seconds[first_within] - 1.0)
    assert found["overshoot"] == 0.0


def test_a_step_settles_at_the_first_row_from_which_it_stays_within_5_percent() -> None:
    times, goal = np.arange(6.0), np.array([0.0, 1, 1, 1, 1, 1])
    ((rise_s, settle_s, overshoot),) = measures.steps(times, np.array([0, 0.5, 1.2, 0.94, 0.96, 1.0]), goal)
    assert (rise_s, settle_s, overshoot) == (1.0, 3.0, pytest.approx(0.2))
    ((_, never_s, _),) = measures.steps(times, np.array([0, 0.5, 1.2, 0.94, 0.96, 0.9]), goal)
    assert np.isnan(never_s)


@pytest.mark.parametrize("link", [RADIO, MAVLINK])
def test_faults_that_together_leave_a_knobs_range_stop_at_its_end_and_give_it_back(link: str) -> None:
    """Every kind three times at once, at its largest and at its smallest: the flight goes on, and ends as it began."""
    flight = lockstep_flight(
        Request.of(EXPERIMENTS["hover"], overrides=[MARKERS_ON], duration_s=1.0, link=link)
    )
    kinds = {
        name: kind for name, kind in KINDS.items() if not why_not(kind, flight.robot.links, flight.config)
    }
    knobs = [knob for kind in kinds.values() for knob in kind.knobs]
    before = [knob.read(flight.robot) for knob in knobs]
    robot, board = flight.robot, flight.switchboard
    for name, kind in kinds.items():
        for size in {kind.low, kind.high}:
            faults = [Fault(name, number, 1.0, size) for number in range(3)]
            for fault in faults:
                board.begin(fault, flight.now_us)
            robot.look(flight.now_us)
            assert np.isfinite([knob.read(robot) for knob in kind.knobs if name != "imu.saturation"]).all()
            for fault in faults:
                board.end(fault, flight.now_us)
    assert [knob.read(robot) for knob in knobs] == before
    assert board.active == []


@pytest.mark.parametrize(
    ("kind", "size", "most"),
    [("wind.fan", 2.0, 2.0), ("wind.gusts", 5.0, 5.0), ("imu.noise", 1000.0, 1000.0), ("cpu.load", 1.0, 1.0)],
)
def test_two_faults_of_the_largest_size_are_one_of_that_size(kind: str, size: float, most: float) -> None:
    flight = lockstep_flight(Request.of(EXPERIMENTS["hover"], duration_s=1.0))
    (knob,) = KINDS[kind].knobs
    for start_s in (0.0, 1.0):
        flight.switchboard.begin(Fault(kind, start_s, 1.0, size), flight.now_us)
        assert knob.read(flight.robot) == most
