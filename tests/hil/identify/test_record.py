"""The edges of a record for identification, and the arithmetic of its spectra, flow and verdicts."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from ground_station.telemetry_log import POSE_COLUMNS, TIME_COLUMN
from hil.config import load_config
from hil.design.axes import DELAY, ROLL, dynamics, robot_of
from hil.design.loop import FREQUENCIES
from hil.errors import LabError
from hil.identify import spectra
from hil.identify.flow import flow_of
from hil.identify.identify import IDENTIFIED, UNKNOWN, WEAK, _verdict
from hil.identify.joint import LATE_S, Estimate
from hil.identify.record import BOARD_COLUMN, EXCITATIONS, INPUTS, RATES, WRAP_MS, Record, load_record
from hil.identify.response import TICK_DELAYS_S, flap_response

Array = NDArray[np.float64]
CONFIG = load_config()
AHEAD_S = 7.25  # the ground's clock


def columns(rows: int = 100, begin_ms: int = 1000, **changes: Array) -> dict[str, Array]:
    """The telemetry of a hover: 50 rows per second, every pose 40 ms old."""
    ms = begin_ms + 20.0 * np.arange(rows)
    zero = np.zeros(rows)
    found = {BOARD_COLUMN: ms % WRAP_MS, TIME_COLUMN: 1e-3 * ms + AHEAD_S, "supervisor.state []": zero + 2}
    found |= dict.fromkeys((*INPUTS, *EXCITATIONS, *RATES, *POSE_COLUMNS), zero)
    return found | {POSE_COLUMNS[0]: 1e-3 * ms + AHEAD_S - 0.04} | changes


def loaded(folder: Path, table: Mapping[str, Array]) -> Record:
    path = folder / "telemetry.csv"
    header, values = ",".join(table), np.stack(list(table.values()), axis=1)
    np.savetxt(path, values, "%.9g", ",", header=header, comments="", encoding="utf-8")
    return load_record(path, "floaty")


def test_a_hundred_rows_of_flight_are_enough_and_one_less_is_not(tmp_path: Path) -> None:
    record = loaded(tmp_path, columns(100))
    assert len(record.t) == 100
    assert record.lost_rows == pytest.approx(0.0, abs=1e-12)
    assert record.period_s == pytest.approx(0.02)
    with pytest.raises(LabError, match="99 rows of flight under control; identification needs 100"):
        loaded(tmp_path, columns(99))


def test_the_share_of_lost_rows_is_that_of_the_rows_that_are_missing(tmp_path: Path) -> None:
    kept = np.arange(200) % 4 != 1
    record = loaded(tmp_path, {name: values[kept] for name, values in columns(200).items()})
    assert record.lost_rows == pytest.approx(0.25, abs=0.005)


def test_a_board_whose_time_stamps_wrap_flies_on(tmp_path: Path) -> None:
    record = loaded(tmp_path, columns(120, begin_ms=WRAP_MS - 1000))
    assert np.diff(record.t) == pytest.approx(np.full(119, 0.02))


def test_poses_have_the_board_s_clock_and_a_yaw_without_jumps(tmp_path: Path) -> None:
    record = loaded(tmp_path, columns(150))
    assert record.t[0] - record.pose_t[0] == pytest.approx(0.04, abs=1e-6)
    wide = np.linspace(-np.pi, np.pi, 150) * 1.5
    record = loaded(tmp_path, columns(150, **{POSE_COLUMNS[6]: np.angle(np.exp(1j * wide))}))
    assert np.ptp(record.pose[:, 5]) == pytest.approx(3 * np.pi)


@pytest.mark.parametrize("facing", [np.pi, -np.pi, 2.0])
def test_a_robot_that_looks_elsewhere_is_refused_because_its_poses_are_in_the_world(
    tmp_path: Path, facing: float
) -> None:
    yaw = np.angle(np.exp(1j * (facing + 0.1 * np.sin(np.arange(150.0)))))
    with pytest.raises(LabError, match=r"it looks along -?\d+ deg; expected within 30 deg of 0"):
        loaded(tmp_path, columns(150, **{POSE_COLUMNS[6]: yaw}))


def test_inputs_within_the_flaps_limits_are_what_was_commanded(tmp_path: Path) -> None:
    u = 0.02 * np.sin(np.arange(150.0))
    record = loaded(tmp_path, columns(150, **dict.fromkeys(INPUTS, u)))
    assert record.u == pytest.approx(np.stack([u] * 4, axis=1), abs=1e-6)
    assert record.saturated == 0.0


def excited(seconds: float, period_s: float = 0.02, begin_s: float = 3.0) -> Record:
    """A record whose excitation lasts for so long."""
    t = np.round(begin_s + period_s * np.arange(round(seconds / period_s)), 3)
    r = np.zeros((len(t), 4))
    r[:, 0] = np.cos(2 * np.pi * 0.25 * t)
    zero = np.zeros((len(t), 3))
    return Record("r", t, r, r, zero, t, np.zeros((len(t), 6)), 0.0, 0.0, CONFIG, False)


@pytest.mark.parametrize("period_s", [0.01, 0.02, 0.04, 0.05])
@pytest.mark.parametrize("begin_s", [0.0, 3.0, 0.1, 17.77])
def test_a_record_of_exactly_as_many_periods_as_needed_is_used(period_s: float, begin_s: float) -> None:
    enough = spectra.SETTLING_S + spectra.LEAST_PERIODS * spectra.PERIOD_S
    starts = spectra.windows(excited(enough, period_s, begin_s))
    assert starts == pytest.approx([begin_s + 2.0 + 20.0 * n for n in range(4)])
    with pytest.raises(LabError, match="3 periods of 20 s after it settled; at least 4"):
        spectra.windows(excited(enough - period_s, period_s, begin_s))


def test_the_covariance_of_the_mean_is_that_of_numpy_over_the_lines_around() -> None:
    rng, count, lines = np.random.default_rng(1), 5, 12
    P = rng.normal(size=(count, lines, 17)) + 1j * rng.normal(size=(count, lines, 17))
    w = 2 * np.pi * spectra.SPACING_HZ * np.arange(1, lines + 1)
    own = [np.array([1, 6, 12]), *[np.empty(0, int)] * 3]
    found = spectra.spectra_of(excited(90.0), (own, w, P), 0, (4 + 3,))  # signals without a power of w
    for row, line in enumerate((0, 5, 11)):
        near = range(max(0, line - 4), min(lines, line + 5))
        each = [np.cov(P[:, n, [4, 7]].T) for n in near]
        excitation = P[:, line, 0].mean()
        expected = np.mean(each, axis=0) / count / abs(excitation) ** 2
        assert found.Z[row] == pytest.approx(P[:, line, [4, 7]].mean(axis=0) / excitation)
        expected[1, 1] += spectra.NOT_LINEAR**2 * abs(found.Z[row, 1]) ** 2
        assert found.C[row] == pytest.approx(expected), line


def swinging(robot: Mapping[str, float], hertz: float = 2.0, seconds: float = 60.0) -> Record:
    """A robot in still air that swings as its model says, with poses that are late as those of a flight."""
    axis, s = ROLL, 2j * np.pi * hertz
    flow, _ = dynamics(axis, robot)
    u = 0.1
    flap = flap_response(np.array([abs(s)]), 1 / robot["flap_rate"], robot[DELAY] + TICK_DELAYS_S)[0]
    n = len(axis.states)
    y, _, roll, rate = np.linalg.solve(s * np.eye(n) - flow[:n, :n], flow[:n, n] * flap * u)
    t = 0.02 * np.arange(round(seconds / 0.02))
    wave = np.exp(s * t)
    zero = np.zeros(len(t))
    pose = np.stack([zero] * 6, axis=1)
    pose[:, 1], pose[:, 3] = (wave * y * np.exp(s * LATE_S)).real, (wave * roll * np.exp(s * LATE_S)).real
    inputs, rates = np.stack([(wave * u).real, zero, zero, zero], axis=1), np.zeros((len(t), 3))
    rates[:, 0] = (wave * rate).real
    return Record("r", t, inputs, 0 * inputs, rates, t, pose, 0.0, 0.0, CONFIG, False)


def test_a_robot_that_moves_as_its_model_says_is_disturbed_by_nothing() -> None:
    robot = robot_of(CONFIG)
    record = swinging(robot)
    at = int(np.argmin(np.abs(FREQUENCIES - 2.0)))

    def power(believed: Mapping[str, float]) -> Array:
        return np.diag(flow_of(record, ROLL, believed).spectrum[at]).real

    own = power(robot)
    for name in ("roll_u1", "roll_roll", "roll_rate"):
        assert own[1] < 0.1 * power(robot | {name: 1.5 * robot[name]})[1], name


def test_fifteen_seconds_of_flight_after_the_first_two_show_the_flow_and_less_do_not() -> None:
    robot = robot_of(CONFIG)
    assert flow_of(swinging(robot, seconds=17.04), ROLL, robot).input == pytest.approx(0.0, abs=0.01)
    with pytest.raises(LabError, match="15 s after the first 2 s are needed"):
        flow_of(swinging(robot, seconds=16.9), ROLL, robot)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("share", "verdict"), [(0.25, IDENTIFIED), (0.26, WEAK), (0.7, WEAK), (0.71, UNKNOWN), (np.inf, UNKNOWN)]
)
def test_a_constant_is_as_well_known_as_its_interval_is_narrow_whatever_its_sign(
    sign: float, share: float, verdict: str
) -> None:
    fit = Estimate({}, {}, 1.0)
    value = 0.0 if share == np.inf else 64.0 * sign
    assert _verdict("roll_u1", (value, 64.0 * min(share, 1.0)), fit, [excited(1.0)])[0] == verdict


def test_one_record_at_the_flaps_limits_spoils_all() -> None:
    calm, limited = excited(1.0), excited(1.0)
    object.__setattr__(limited, "saturated", 0.06)
    fit = Estimate({}, {}, 1.0)
    assert _verdict("roll_u1", (64.0, 1.0), fit, [calm])[0] == IDENTIFIED
    assert _verdict("roll_u1", (64.0, 1.0), fit, [calm, limited])[0] == UNKNOWN
    assert _verdict("roll_u1", (64.0, 1.0), Estimate({}, {}, 10.1), [calm])[0] == UNKNOWN
