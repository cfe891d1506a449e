"""The edges of a record for identification, and the arithmetic of its spectra, flow and verdicts."""

import re
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.stats import t as student

from ground_station.telemetry_log import POSE_COLUMNS, TIME_COLUMN
from hil.config import LabConfig, load_config
from hil.errors import LabError
from hil.research.design.axes import (
    AXES,
    DELAY,
    HEIGHT,
    NUISANCES,
    PITCH,
    RATE,
    ROLL,
    VELOCITY,
    YAW,
    Axis,
    dynamics,
    robot_of,
)
from hil.research.design.loop import FREQUENCIES
from hil.research.identify import plates, spectra
from hil.research.identify.flow import flow_of
from hil.research.identify.identify import (
    IDENTIFIED,
    UNKNOWN,
    WEAK,
    Evidence,
    Identification,
    IdentifiedConstant,
    _truths,
    _verdict,
    identify,
    interval_text,
    operating_point,
    rows_of,
    truth_of,
)
from hil.research.identify.joint import (
    DELAY_S,
    DELAY_SPREAD_S,
    LAG_SPREAD,
    LATE_S,
    LATE_SPREAD_S,
    Estimate,
    Excited,
    JointFit,
    _equations,
    _regress,
    identities,
    instrumental,
    joint,
    pose_lateness,
    whitened,
)
from hil.research.identify.pages import _identity, _one_step, _period, _responses, write_pages
from hil.research.identify.plates import plant_of, straightened, turns_of
from hil.research.identify.record import (
    BOARD_COLUMN,
    EXCITATIONS,
    INPUTS,
    RATES,
    SHARES,
    WRAP_MS,
    Record,
    _in_order,
    _limited,
    _ticks,
    load_record,
)
from hil.research.identify.response import LAG, TICK_DELAYS_S, flap_response, one_step, outputs, response
from hil.research.identify.two_controllers import closed_loop
from hil.world.floaty.correction import OperatingPoint

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


def loaded(folder: Path, table: Mapping[str, Array], change: Callable[[str], str] = str) -> Record:
    """The record of a table, whose text is changed before it is read."""
    path, text = folder / "telemetry.csv", StringIO()
    header, values = ",".join(table), np.stack(list(table.values()), axis=1)
    np.savetxt(text, values, "%.9g", ",", header=header, comments="")
    path.write_text(change(text.getvalue()), encoding="utf-8")
    return load_record(path, "floaty")


def test_a_hundred_rows_of_flight_are_enough_and_one_less_is_not(tmp_path: Path) -> None:
    record = loaded(tmp_path, columns(100))
    assert len(record.t) == 100
    assert record.lost_rows == pytest.approx(0.0, abs=1e-12)
    assert record.period_s == pytest.approx(0.02)
    assert record.u_t - record.mean_t == pytest.approx(np.full(100, 0.005))
    with pytest.raises(LabError, match="99 rows of flight under control; identification needs 100"):
        loaded(tmp_path, columns(99))


def test_the_share_of_lost_rows_is_that_of_the_rows_that_are_missing(tmp_path: Path) -> None:
    kept = np.arange(200) % 4 != 1
    record = loaded(tmp_path, {name: values[kept] for name, values in columns(200).items()})
    assert record.lost_rows == pytest.approx(0.25, abs=0.005)


@pytest.mark.parametrize(
    ("share", "reason"),
    [(0.3, "no excitation"), (0.3001, "30% of the telemetry's rows are missing; at most 30%")],
)
def test_a_flight_may_lack_three_tenths_of_its_rows(share: float, reason: str) -> None:
    with pytest.raises(LabError, match=reason):
        identify([replace(swinging(robot_of(CONFIG), seconds=10.0), lost_rows=share)])


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
def test_a_robot_that_looks_elsewhere_is_refused(tmp_path: Path, facing: float) -> None:
    yaw = np.angle(np.exp(1j * (facing + 0.1 * np.sin(np.arange(150.0)))))
    with pytest.raises(LabError, match=r"it looks along -?\d+ deg; expected within 30 deg of 0"):
        loaded(tmp_path, columns(150, **{POSE_COLUMNS[6]: yaw}))
    for turned, refused in ((29.0, False), (31.0, True)):
        with pytest.raises(LabError, match=f"it looks along {turned:.0f} deg") if refused else nullcontext():
            loaded(tmp_path, columns(150, **{POSE_COLUMNS[6]: np.full(150, np.radians(turned))}))


def test_inputs_within_the_flaps_limits_are_what_was_commanded(tmp_path: Path) -> None:
    u = 0.02 * np.sin(np.arange(150.0))
    record = loaded(tmp_path, columns(150, **dict.fromkeys(INPUTS, u)))
    assert record.u == pytest.approx(np.stack([u] * 4, axis=1), abs=1e-6)
    assert record.saturated == 0.0


def folder_profile(folder: Path, text: str) -> str:
    """A profile of Floaty with a section changed."""
    (folder / "profile.toml").write_text(f'base = "floaty"\n{text}')
    return str(folder / "profile.toml")


@pytest.mark.parametrize("limit", ["opening_min", "opening_max"])
@pytest.mark.parametrize("beyond", [0.0, 0.05])
def test_flaps_at_their_limit_count_like_those_that_would_exceed_it(
    tmp_path: Path, limit: str, beyond: float
) -> None:
    profile = folder_profile(tmp_path, "[allocation]\nopening_min = 0.1\n")
    allocation = load_config(profile).allocation
    room = allocation.hover_angle - getattr(allocation, limit)
    u4 = np.where(
        np.arange(150) % 3 == 0, room + np.copysign(beyond, room), 0.0
    )  # on board u4 gives way at a limit
    loaded(tmp_path, columns(150, **{INPUTS[3]: np.float16(u4).astype(float)}))
    record = load_record(tmp_path / "telemetry.csv", profile)
    assert record.saturated == pytest.approx(1 / 3)
    assert np.abs(record.u[::3, 3]) == pytest.approx(abs(room), abs=1e-3)


@pytest.mark.parametrize("flap", range(4))
@pytest.mark.parametrize("beyond", [0.0, 0.05])
def test_one_flap_at_its_limit_limits_what_the_inputs_do(flap: int, beyond: float) -> None:
    allocation = CONFIG.allocation
    moved = np.zeros((4, 4))
    moved[1, flap] = allocation.opening_max - allocation.hover_angle
    moved[2, flap] = allocation.opening_min - allocation.hover_angle
    wanted = moved + beyond * np.sign(moved)
    inputs, share = _limited(wanted @ SHARES.T / 4.0, CONFIG)
    assert share == 0.5
    assert inputs == pytest.approx(moved @ SHARES.T / 4.0, abs=1e-12)


def rows_changed(change: Callable[[list[str]], list[str]]) -> Callable[[str], str]:
    def changed(text: str) -> str:
        header, *rows = text.splitlines()
        return "\n".join([header, *change(rows)]) + "\n"

    return changed


def cell(title: str, value: str) -> Callable[[str], str]:
    """A change of one cell in row 40."""
    place = list(columns()).index(title)

    def change(rows: list[str]) -> list[str]:
        cells = rows[40].split(",")
        cells[place] = value
        return [*rows[:40], ",".join(cells), *rows[41:]]

    return rows_changed(change)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: "\ufeff" + text,
        rows_changed(lambda rows: [*rows[:40], rows[40], *rows[40:]]),
        rows_changed(lambda rows: [*rows[:40], "", *rows[40:]]),
        rows_changed(lambda rows: [*rows[:40], rows[41], rows[40], *rows[42:]]),
        *(cell(title, value) for title in (POSE_COLUMNS[0], POSE_COLUMNS[3]) for value in ("nan", "", "inf")),
    ],
    ids=["bom", "twice", "blank", "exchanged", *(f"{part}-{value}" for part in ("t", "z") for value in ("nan", "", "inf"))],
)  # fmt: skip
def test_rows_count_once_and_in_their_order_whatever_wrote_the_file(
    tmp_path: Path, change: Callable[[str], str]
) -> None:
    record = loaded(tmp_path, columns(150), change)
    assert record.t == pytest.approx(1.0 + 0.02 * np.arange(150))
    assert np.diff(record.pose_t) == pytest.approx(0.02, abs=0.021)
    assert len(record.pose_t) >= 149
    assert np.isfinite(record.pose).all()


@pytest.mark.parametrize("title", [BOARD_COLUMN, TIME_COLUMN, INPUTS[1], EXCITATIONS[1], RATES[1]])
@pytest.mark.parametrize("value", ["nan", "", "-inf"])
def test_rows_with_an_unknown_value_are_left_out(tmp_path: Path, title: str, value: str) -> None:
    record = loaded(tmp_path, columns(150), cell(title, value))
    assert record.t == pytest.approx(np.delete(1.0 + 0.02 * np.arange(150), 40))
    assert np.isfinite(np.column_stack([record.u, record.excitation, record.rates])).all()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda text: text.replace(",", ";"), r"separated by ';'; ',' is expected"),
        (rows_changed(lambda rows: [*rows[60:], *rows[:60]]), "runs backwards"),
        (rows_changed(lambda rows: [row.replace(",", "000,", 1) for row in rows]),
         r"advances by 20000 and 'ground.t \[s\]' by 0.02: is one of them in another unit, such as microseconds"),
        (cell(INPUTS[0], "soon"), "could not convert string to float: 'soon'"),
    ],
    ids=["semicolons", "parts exchanged", "microseconds", "word"],
)  # fmt: skip
def test_the_real_reason_is_given_for_an_unreadable_file(
    tmp_path: Path, change: Callable[[str], str], reason: str
) -> None:
    with pytest.raises(LabError, match=reason):
        loaded(tmp_path, columns(150), change)


def test_a_file_without_what_is_needed_is_refused_by_the_name_of_that(tmp_path: Path) -> None:
    with pytest.raises(
        LabError, match=r"^x\.csv: no telemetry\.csv there; identify takes run folders and telemetry\.csv$"
    ):
        load_record(Path("x.csv"), "floaty")
    table = columns(150)
    for title in (BOARD_COLUMN, TIME_COLUMN, *POSE_COLUMNS, *INPUTS, *RATES, "supervisor.state []"):
        with pytest.raises(LabError) as refused:
            loaded(tmp_path, {name: values for name, values in table.items() if name != title})
        assert str(refused.value) == f"{tmp_path / 'telemetry.csv'}: no column {title!r}"
    silent = {name: np.full(150, np.nan) for name in POSE_COLUMNS}
    with pytest.raises(
        LabError, match=re.escape(f": no pose in {POSE_COLUMNS[0]!r} to {POSE_COLUMNS[-1]!r}")
    ):
        loaded(tmp_path, table | silent)
    for title in EXCITATIONS:
        del table[title]
    assert not loaded(tmp_path, table).excitation.any(), "none was reported"


def test_spectra_are_refused_in_one_line_with_their_numbers() -> None:
    t, w = np.arange(0.0, 20.0, 0.5), 2 * np.pi * 0.05 * np.arange(1, 14)
    with pytest.raises(
        LabError, match=r"^r: 40 samples in a period of 20 s for 13 lines: at least 42 are needed$"
    ):
        spectra._fit(t, np.zeros((40, 1)), w, "r")
    assert spectra._fit(t, np.cos(w[2] * t)[:, None], w[:12], "r")[2, 0] == pytest.approx(1.0)
    fast = excited(100.0)
    fast.excitation[:, 0] = np.cos(2 * np.pi * 20.05 * fast.t + 0.3)
    with pytest.raises(LabError, match=r"^r: rows of 20 ms are too far apart for the excitation's lines$"):
        spectra.period_spectra(fast)
    with pytest.raises(
        LabError,
        match=r": 107\.2 s of settled excitation: 0 realisations of 22 s, 5 more with holes of over 0\.3 s; at",
    ):
        spectra.windows(excited(110.0, 1.0))
    own = [np.array([5]), *[np.empty(0, int)] * 3]
    with pytest.raises(LabError, match=r"^r: u3 is not excited in it$"):
        spectra.spectra_of(excited(90.0), (own, w, np.ones((4, 13, 17), complex)), 2, (8,))
    first, second = (replace(excited(90.0), name=name) for name in ("a", "b"))
    with pytest.raises(LabError, match=r"^b: the same flight as a: each flight counts once$"):
        identify([first, second])


def holed(begin: float, end: float, afresh: float | None) -> Record:
    """A record without rows from `begin` to `end`; the excitation may begin again, at `afresh`."""
    rng, t = np.random.default_rng(4), 0.02 * np.arange(6751)
    phases, lines = 2 * np.pi * rng.random((16, 20)), 0.4 * np.arange(1, 21)
    since = t if afresh is None else np.where(t < begin, t, t - afresh)
    turns = 2 * np.pi * np.outer(since, lines) + phases[(since // spectra.REALISATION_S).astype(int)]
    r = np.zeros((len(t), 4))
    r[:, 2] = np.cos(turns).sum(axis=1)
    kept = (t < begin) | (t >= end)
    t, r = t[kept], r[kept]
    return Record("r", t, t, r, r, r[:, :3], t, np.zeros((len(t), 6)), 0.0, 0.0, CONFIG, False)


@pytest.mark.parametrize(
    ("afresh", "expected"),
    [
        (None, [1.8, 45.8, 67.8, 89.8, 111.8]),
        (40.5, [1.8, 42.3, 64.3, 86.3, 108.3]),
        (40.3, [1.8, 42.1, 64.1, 86.1, 108.1]),
    ],
)
def test_periods_with_a_hole_are_left_out_and_an_excitation_that_begins_again_is_noticed(
    afresh: float | None, expected: list[float]
) -> None:
    assert spectra.windows(holed(40.0, 40.5, afresh)) == pytest.approx(expected, abs=0.011)


def test_a_short_hole_is_no_reason_to_leave_a_period_out() -> None:
    assert spectra.windows(holed(40.0, 40.2, None)) == pytest.approx(1.8 + 22.0 * np.arange(6))


def test_holes_in_most_periods_are_the_reason_that_is_given() -> None:
    record = holed(40.0, 40.5, None)
    kept = np.min(np.abs(record.t[:, None] - [10.0, 60.0, 80.0]), axis=1) > 0.25
    poor = replace(record, pose_t=record.pose_t[kept], pose=record.pose[kept])
    with pytest.raises(
        LabError, match=r"2 realisations of 22 s, 4 more with holes of over 0\.3 s; at least 4 are"
    ):
        spectra.windows(poor)


def excited(seconds: float, period_s: float = 0.02, begin_s: float = 3.0) -> Record:
    """A record whose excitation lasts for so long."""
    t = np.round(begin_s + period_s * np.arange(round(seconds / period_s)), 3)
    r = np.zeros((len(t), 4))
    r[:, 0] = np.cos(2 * np.pi * 0.25 * t)
    zero = np.zeros((len(t), 3))
    return Record("r", t, t, r, r, zero, t, np.zeros((len(t), 6)), 0.0, 0.0, CONFIG, False)


@pytest.mark.long
@pytest.mark.parametrize("period_s", [0.01, 0.02, 0.04, 0.05])
@pytest.mark.parametrize("begin_s", [0.0, 3.0, 0.1, 17.77])
def test_a_record_of_exactly_as_many_realisations_as_needed_is_used(period_s: float, begin_s: float) -> None:
    enough = spectra.SETTLING_S + 3 * spectra.REALISATION_S + spectra.PERIOD_S
    starts = spectra.windows(excited(enough, period_s, begin_s))
    assert starts == pytest.approx([begin_s + 1.8 + 22.0 * n for n in range(4)])
    with pytest.raises(LabError, match="3 realisations of 22 s; at least 4"):
        spectra.windows(excited(enough - period_s, period_s, begin_s))


def test_the_slopes_of_the_joint_fit_are_those_of_its_errors() -> None:
    """Of roll in two records and of yaw in the second; every parameter counts, also in what is known."""
    rng, w = np.random.default_rng(3), 2 * np.pi * np.array([0.5, 2.0])
    excited_axes = []
    for axis, record in ((ROLL, 1), (YAW, 4), (ROLL, 4)):
        count = 1 + len(outputs(axis))
        Z = rng.normal(size=(2, count)) + 1j * rng.normal(size=(2, count))
        C = np.tile(np.eye(count, dtype=complex), (2, 1, 1))
        excited_axes.append(
            Excited(axis, record, spectra.Spectra(w, Z, C, Z[None], Z[:, 0], np.ones((2, count))))
        )
    names = [*ROLL.constants, *YAW.constants, LAG, DELAY]
    values = CONFIG.model.model_dump()
    x = 1.0 + 0.1 * rng.random(len(names) + 2)
    scale = np.array([*(values.get(name, 1.0) for name in names[:-2]), 0.05, 0.013, 0.003, 0.003])
    fit = JointFit(excited_axes, names, [1, 4], scale, 0.05, lambda values: [values[names[0]] * values[LAG]])
    steps = 1e-5 * np.eye(len(x))
    expected = np.stack([(fit.errors(x + step) - fit.errors(x - step)) / 2e-5 for step in steps], axis=1)
    assert np.abs(expected).max(axis=0).min() > 0.001
    assert fit.slopes(x) == pytest.approx(expected, rel=1e-3, abs=1e-3)
    assert [len(one) for one in (fit.errors(x), fit.prior(x))] == [expected.shape[0], 2 + 2 + 1]
    at, late = fit.parted(x)
    usual = [(at[LAG] / 0.05 - 1) / LAG_SPREAD, (at[DELAY] - DELAY_S) / DELAY_SPREAD_S]
    usual += [(late[record] - LATE_S) / LATE_SPREAD_S for record in (1, 4)]
    assert fit.prior(x) == pytest.approx([*usual, at[names[0]] * at[LAG]])


def test_the_covariance_of_the_mean_is_that_of_numpy_over_the_lines_around() -> None:
    rng, count, lines = np.random.default_rng(1), 5, 12
    P = rng.normal(size=(count, lines, 17)) + 1j * rng.normal(size=(count, lines, 17))
    w = 2 * np.pi * spectra.SPACING_HZ * np.arange(1, lines + 1)
    own = [np.array([1, 6, 12]), np.array([4]), *[np.empty(0, int)] * 2]
    found = spectra.spectra_of(excited(90.0), (own, w, P), 0, (4 + 3,))  # signals without a power of w
    r = P[:, :, 0]
    each = [np.einsum("ps,pt->st", P[:, n, [4, 7]], P[:, n, [4, 7]].conj()) / count for n in range(lines)]
    for row, line in enumerate((0, 5, 11)):
        responses = P[:, line, [4, 7]] / r[:, line, None]
        assert found.Z[row] == pytest.approx(responses.mean(axis=0))
        astray = P[:, line, [4, 7]] - found.Z[row] * r[:, line, None]
        each[line] = np.einsum("ps,pt->st", astray, astray.conj()) / (count - 1)
    for row, line in enumerate((0, 5, 11)):
        near = [n for n in range(max(0, line - 4), min(lines, line + 5)) if n != 3]  # line 4 is that of u2
        size = np.abs(r[:, line]).mean()
        expected = np.mean([each[n] for n in near], axis=0) / count / size**2
        assert found.C[row] == pytest.approx(expected), line


@pytest.mark.parametrize(("off", "refused"), [(0.05003, False), (0.0501, True)])
def test_an_excitation_of_which_a_twentieth_is_off_its_lines_is_refused(off: float, refused: bool) -> None:
    sizes = np.zeros((4, 2, 4))
    sizes[:, :, 0] = 1.0, off
    with pytest.raises(LabError, match="not the same sum of lines") if refused else nullcontext():
        spectra._refuse_impure("r", np.array([1, 2]), [np.array([1]), *[np.empty(0, int)] * 3], sizes)


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
    return Record("r", t, t, inputs, 0 * inputs, rates, t, pose, 0.0, 0.0, CONFIG, False)


def test_a_robot_that_follows_its_model_has_no_disturbance() -> None:
    robot = robot_of(CONFIG)
    record = swinging(robot)
    at = int(np.argmin(np.abs(FREQUENCIES - 2.0)))

    def power(believed: Mapping[str, float]) -> Array:
        return np.diag(flow_of(record, ROLL, believed).spectrum[at]).real

    own = power(robot)
    for name in ("roll_u1", "roll_roll", "roll_rate"):
        assert own[1] < 0.1 * power(robot | {name: 1.5 * robot[name]})[1], name


@pytest.mark.long
@pytest.mark.parametrize("axis", AXES, ids=[axis.name for axis in AXES])
def test_a_flow_of_known_density_is_found_on_every_axis(axis: Axis) -> None:
    robot, count, step = robot_of(CONFIG), 60_000, 0.02
    hertz, rng = np.fft.rfftfreq(count, step), np.random.default_rng(3)
    pushed = [row for row, state in enumerate(axis.states) if state in (VELOCITY, RATE)]
    densities = np.array([0.3, 0.8][: len(pushed)])  # of each acceleration, from 0.3 to 22 Hz
    lines = np.flatnonzero((hertz > 0.3) & (hertz < 22.0))
    n, s = len(axis.states), 2j * np.pi * hertz[lines]
    A, flow = dynamics(axis, robot)[0][:n, :n], np.zeros((len(lines), n), complex)
    turns = np.exp(2j * np.pi * rng.random((len(lines), len(pushed))))
    flow[:, pushed] = turns * np.sqrt(densities * count / step / 2.0)
    states = np.zeros((len(hertz), n), complex)
    states[lines] = np.linalg.solve(s[:, None, None] * np.eye(n) - A, flow[:, :, None])[:, :, 0]
    seen = np.fft.irfft(states * np.exp(2j * np.pi * hertz * LATE_S)[:, None], count, axis=0)
    t, pose, rates = step * np.arange(count), np.zeros((count, 6)), np.zeros((count, 3))
    for state, column in axis.pose.items():
        pose[:, column] = seen[:, axis.states.index(state)]
    if RATE in axis.states:
        rates[:, axis.input] = np.fft.irfft(states[:, axis.states.index(RATE)], count)
    still = np.zeros((count, 4))
    record = Record("r", t, t, still, still, rates, t, pose, 0.0, 0.0, CONFIG, False)
    among = (FREQUENCIES > 2.0) & (FREQUENCIES < 8.0)
    found = flow_of(record, axis, robot).spectrum[among].mean(axis=0)
    assert (np.abs(found - np.diag(densities)) < 0.1 * np.sqrt(np.outer(densities, densities))).all()


@pytest.mark.parametrize("part", [("t", "rates"), ("pose_t", "pose")])
def test_the_flow_is_that_of_the_time_for_which_there_are_both_rates_and_poses(part: tuple[str, str]) -> None:
    record, kept = swinging(robot_of(CONFIG), seconds=30.0), slice(200, -150)
    record.pose[:] += np.random.default_rng(3).normal(size=record.pose.shape)

    def cut(*names: str) -> Record:
        return replace(record, **{name: getattr(record, name)[kept] for name in names})

    both = cut("t", "u_t", "u", "rates", "pose_t", "pose")
    found, expected = (flow_of(one, ROLL, robot_of(CONFIG)).spectrum for one in (cut(*part), both))
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()


@pytest.mark.parametrize("hertz", [1.0, 4.0])
def test_a_robot_that_follows_its_model_is_predicted_one_step_ahead(hertz: float) -> None:
    robot = robot_of(CONFIG)
    values = {**CONFIG.model.model_dump(), LAG: 1 / robot["flap_rate"], "delay": robot[DELAY] + TICK_DELAYS_S}
    t, measured, predicted = one_step(swinging(robot, hertz), 0, values, LATE_S)
    settled = slice(len(t) // 10, None)
    assert np.std((measured - predicted)[settled]) < 0.01 * np.std(measured[settled])


def test_fifteen_seconds_of_flight_after_the_first_two_show_the_flow_and_less_do_not() -> None:
    robot = robot_of(CONFIG)
    record = swinging(robot, seconds=2.0)

    def seconds(duration: float) -> Record:
        """Rows every quarter of a second, whose times are exact."""
        t = np.arange(0.0, duration + 0.1, 0.25)
        rows = {name: getattr(record, name)[: len(t)] for name in ("u", "excitation", "rates", "pose")}
        return replace(record, t=t, u_t=t, pose_t=t, **rows)

    assert np.isfinite(flow_of(seconds(17.0), ROLL, robot).spectrum).all()
    with pytest.raises(LabError, match="15 s after the first 2 s are needed"):
        flow_of(seconds(16.75), ROLL, robot)


def test_a_constant_s_truth_is_that_of_the_first_flight_that_excited_its_axis_and_of_the_first_for_others() -> (
    None
):
    plain = replace(swinging(robot_of(CONFIG), seconds=2.0), simulated=True)
    flights = [replace(plain, u=plain.u + 0.02 * n) for n in range(4)]
    excited_axes: list[Any] = [
        SimpleNamespace(axis=axis, record=n) for axis, n in ((YAW, 0), (ROLL, 1), (ROLL, 2))
    ]
    found, own = _truths(flights[0], flights[1:], excited_axes), [truth_of(one) for one in flights]
    for axis, flown in ((YAW, 1), (ROLL, 2), (PITCH, 0), (HEIGHT, 0)):
        for name in {*axis.constants} - {"y_rate", "x_rate"}:
            assert found[name] == own[flown][name], name
    assert own[0]["yaw_u3"] != own[1]["yaw_u3"]
    assert (found[LAG], np.isnan(found["delay"]), np.isnan(found["y_rate"])) == (
        CONFIG.actuators.tau,
        True,
        True,
    )
    assert truth_of(replace(plain, simulated=False)) == {}


def test_the_operating_point_is_the_mean_of_the_flight_in_the_tunnel_s_flow() -> None:
    record = swinging(robot_of(CONFIG))
    record.pose[:, 3:] += (0.1, 0.2, 0.3)
    record.u[:] = (0.01, 0.02, 0.03, 0.04)
    air = CONFIG.tunnel.model_copy(update={"fan_factor": 0.9, "side_wind": (0.5, 1.0, 0.0)})
    point = operating_point(replace(record, config=CONFIG.model_copy(update={"tunnel": air})))
    assert point.inputs == pytest.approx((0.01, 0.02, 0.03, 0.04))
    assert point.attitude == pytest.approx((0.1, 0.2, 0.3), abs=1e-3)
    assert (point.side_wind, point.speed) == ((0.5, 1.0, 0.0), 0.9 * CONFIG.tunnel.speed)


@pytest.mark.parametrize(("axis", "column"), [(ROLL, 3), (PITCH, 4)])
def test_a_robot_that_leans_has_its_mean_angle(axis: Axis, column: int) -> None:
    record = swinging(robot_of(CONFIG))
    record.pose[:, column] += 0.2
    assert flow_of(record, axis, robot_of(CONFIG)).angle == pytest.approx(0.2, abs=0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("share", "verdict"), [(0.25, IDENTIFIED), (0.26, WEAK), (0.7, WEAK), (0.71, UNKNOWN), (np.inf, UNKNOWN)]
)
def test_a_constant_is_as_certain_as_its_interval_is_narrow(sign: float, share: float, verdict: str) -> None:
    value = 0.0 if share == np.inf else 64.0 * sign
    found = constant((value, 64.0 * min(share, 1.0)))
    assert _verdict(found, Evidence(1.0, 0.0, 1.0), 64.0)[0] == verdict


@pytest.mark.parametrize(
    ("share", "usual", "verdict"),
    [
        (0.1, -6.3, WEAK),
        (0.5, 6.3, WEAK),
        (0.8, 6.3, UNKNOWN),
        (0.1, 6.4, IDENTIFIED),
        (0.1, np.nan, IDENTIFIED),
    ],
)
def test_a_value_far_from_the_profile_s_is_not_believed_however_narrow(
    share: float, usual: float, verdict: str
) -> None:
    assert _verdict(constant((64.0, 64.0 * share)), Evidence(1.0, 0.0, 1.0), usual)[0] == verdict
    why = _verdict(constant((64.0, 64.0 * share)), Evidence(1.0, 0.0, 1.0), usual)[1]
    assert ("more than 10 times the profile's" in why) == (verdict == WEAK)


def constant(
    joint: tuple[float, float], instrumental: tuple[float, float] = (0.0, 100.0)
) -> IdentifiedConstant:
    """A constant by both fits, without its verdict."""
    nothing = (np.nan, np.nan)
    return IdentifiedConstant("roll_u1", "1/s²", nothing, np.nan, nothing, instrumental, joint, "", "")


@pytest.mark.parametrize(
    ("found", "evidence", "reason"),
    [
        (constant((64.0, 1.0)), Evidence(10.1, 0.0, 1.0), "misses the log by 3.2 times"),
        (constant((64.0, 1.0)), Evidence(1.0, 0.16, 1.0), "at their limits in 16%"),
        (constant((64.0, 1.0)), Evidence(1.0, 0.0, 0.34), "coherence 0.34"),
        (constant((64.0, 1.0), (51.5, 12.0)), Evidence(1.0, 0.0, 1.0), "exclude each other"),
    ],
    ids=["misfit", "saturated", "incoherent", "contradicted"],
)  # fmt: skip
def test_a_narrow_interval_is_not_enough(found: IdentifiedConstant, evidence: Evidence, reason: str) -> None:
    assert _verdict(found, Evidence(10.0, 0.15, 0.35), 64.0)[0] == IDENTIFIED or found.differs
    verdict, why = _verdict(found, evidence, 64.0)
    assert verdict == UNKNOWN
    assert reason in why


def test_a_value_far_from_the_profile_s_is_weak_however_narrow_its_interval() -> None:
    verdict, why = _verdict(constant((64.0, 1.0)), Evidence(1.0, 0.0, 1.0), -6.3)
    assert (verdict, why) == (WEAK, "± 2%, but more than 10 times the profile's -6.3")
    assert _verdict(constant((64.0, 46.0)), Evidence(1.0, 0.0, 1.0), -6.3)[0] == UNKNOWN


def test_the_worst_record_counts_and_of_several_the_clearest_response() -> None:
    calm, limited = excited(1.0), excited(1.0)
    object.__setattr__(limited, "saturated", 0.06)
    assert Evidence.of(Estimate({}, {}, 1.0), [calm, limited], []).saturated == 0.06
    assert Evidence.of(Estimate({}, {}, 1.0), [calm], []).coherence == 1.0
    # lines by input and outputs: of each axis the best output counts, of both the better one
    own = [
        SimpleNamespace(spectra=SimpleNamespace(coherence=np.array([[1.0, 0.2, high], [1.0, high, 0.2]])))
        for high in (0.6, 0.4)
    ]
    assert Evidence.of(Estimate({}, {}, 1.0), [calm], own).coherence == pytest.approx(0.6)


def test_rates_sampled_before_the_inputs_belong_to_the_next_tick(tmp_path: Path) -> None:
    early = loaded(tmp_path, columns(120, begin_ms=1009))
    late = loaded(tmp_path, columns(120, begin_ms=1008))
    assert early.u_t[0] == late.u_t[0] == pytest.approx(1.0)
    assert (early.t[0], late.t[0]) == (pytest.approx(1.01), pytest.approx(1.0))
    ms = np.arange(20_000)
    inputs, rates = _ticks(1e-3 * ms)
    assert np.array_equal(np.round(1e3 * inputs), ms // 10 * 10)
    assert np.array_equal(np.round(1e3 * rates), (ms + 1) // 10 * 10)


@pytest.mark.parametrize(("factor", "refused"), [(0.009, True), (0.011, False), (99.0, False), (101.0, True)])
def test_clocks_of_which_one_counts_a_hundredth_of_the_other_are_refused(
    tmp_path: Path, factor: float, refused: bool
) -> None:
    table = columns(150)
    table[TIME_COLUMN] = AHEAD_S + (table[TIME_COLUMN] - AHEAD_S) / factor
    expected = r"in another unit, such as microseconds\?$"
    with pytest.raises(LabError, match=expected) if refused else nullcontext():
        _in_order(table, tmp_path)


def test_a_file_that_is_not_csv_is_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    path.write_bytes(b"PAR1\x15\x04\xff\xfe\x00")
    with pytest.raises(LabError, match=r"log\.parquet: not a CSV file; identify takes run folders"):
        load_record(path, "floaty")


def test_u3_is_straightened_by_the_law_of_flat_plates_sin_phi_cos_phi_squared() -> None:
    t, hover = 0.02 * np.arange(3000), CONFIG.allocation.hover_angle
    u = np.zeros((len(t), 4))
    u[:, 2] = 0.2 * np.sin(2 * np.pi * 0.2 * t)
    zero = np.zeros((len(t), 3))
    record = Record("r", t, t, u, 0 * u, zero, t, np.zeros((len(t), 6)), 0.0, 0.0, CONFIG, False)
    straight = straightened(record)
    high, low = (np.sin(hover + aside) * np.cos(hover + aside) ** 2 for aside in (0.2, -0.2))
    expected = 0.5 * (high - low) / (np.cos(hover) * (1 - 3 * np.sin(hover) ** 2))
    assert straight.u[1000:, 2].max() == pytest.approx(expected, rel=0.01)
    assert expected < 0.97 * 0.2
    assert straight.u[:, [1, 3]] == pytest.approx(u[:, [1, 3]])
    assert straight.bent == pytest.approx(0.0, abs=1e-9)


@pytest.mark.long
def test_the_bent_accelerations_are_those_of_a_robot_whose_weight_the_plates_carry(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng, t, pose = np.random.default_rng(4), 0.02 * np.arange(500), np.zeros((500, 6))
    pose[:, 3], pose[:, 1] = 0.1 * np.sin(3.0 * t), 0.2 * np.cos(2.0 * t)
    u = lfilter([0.1], [1.0, -0.9], rng.normal(size=(len(t), 4)), axis=0) * 0.2
    record = Record("r", t, t, u, 0 * u, u[:, :3], t, pose, 0.0, 0.0, CONFIG, False)
    once = straightened(record)
    light = plates._plates
    monkeypatch.setattr(plates, "_plates", lambda config: lambda *at, **of: 3.0 * light(config)(*at, **of))
    again = straightened(record)
    assert (again.bent, again.u) == (pytest.approx(once.bent), pytest.approx(once.u))
    assert np.abs(once.bent).max(axis=0).min() > 0.01


def test_turning_alone_pushes_a_robot_of_plates() -> None:
    t, zero = 0.02 * np.arange(100), np.zeros((100, 6))
    record = Record("r", t, t, zero[:, :4], zero[:, :4], zero[:, :3], t, zero, 0.0, 0.0, CONFIG, False)
    bare = CONFIG.plant.model_copy(update={"variant": "plate"})
    plates, pushes = plant_of(CONFIG.model_copy(update={"plant": bare})), {}
    for name, about, along in (("y_rate", 0, 1), ("x_rate", 1, 0)):
        ends = []
        for turn in (0.02, -0.02):
            omega = np.where(np.arange(3) == about, turn, 0.0)
            plates.place((0.0, 0.0, CONFIG.tunnel.hover_height), (1.0, 0.0, 0.0, 0.0), omega_B=omega.tolist())
            ends.append(plates.acceleration_W[along])
        pushes[name] = (ends[0] - ends[1]) / 0.04
    assert turns_of(record) == pytest.approx(pushes, rel=1e-6)
    heavy = CONFIG.plant.model_copy(update={"mass_factor": 1.3, "constant_factors": {"roll_roll": 1.2}})
    other = replace(record, config=CONFIG.model_copy(update={"plant": heavy}))
    assert turns_of(other) == turns_of(record), "the profile's plates alone"
    assert min(map(abs, pushes.values())) > 0.005


def test_flat_plates_fulfil_the_identities_of_the_fit() -> None:
    settings = ("plant.variant=plate", "tunnel.height_slope=0", "tunnel.profile_radius=5")
    config = load_config("floaty", settings)
    plates = asdict(plant_of(config).linearise(OperatingPoint(speed=config.plant.airspeed)))
    turns = {"x_rate": 0.01, "y_rate": -0.02}
    left = identities(plates | turns, config.plant.airspeed, turns)
    assert left == pytest.approx([0.0] * 6, abs=1e-6)
    for name in ("roll_vy", "y_vy", "pitch_vx", "x_vx", *turns):
        changed = identities(
            plates | turns | {name: (plates | turns)[name] + 0.03}, config.plant.airspeed, turns
        )
        assert sum(abs(one) > 0.01 for one in changed) == 1, name


@pytest.mark.parametrize("best", [0, 1, 2, 3])
def test_the_best_of_all_starts_is_the_fit(monkeypatch: pytest.MonkeyPatch, best: int) -> None:
    starts: list[Array] = []

    def solved(fit: JointFit, x: Array) -> Any:
        starts.append(x * fit.scale)
        cost = 1.0 if len(starts) == 1 + best else 2.0
        return SimpleNamespace(x=x, cost=cost, fun=np.ones(12), jac=np.eye(len(x)))

    monkeypatch.setattr(JointFit, "solved", solved)
    w = 2 * np.pi * np.array([0.5, 1.0, 3.0])
    one = spectra.Spectra(w, np.ones((3, 3), complex), np.tile(np.eye(3, dtype=complex), (3, 1, 1)), np.ones((1, 3, 3)),
        np.ones(3), np.ones((3, 3)))  # fmt: skip
    values = {**CONFIG.model.model_dump(), "yaw_rate": 0.0}  # a constant that is zero has a scale, too
    found = joint([Excited(YAW, 2, one)], 0.05, [values, values | {"yaw_u3": 7.0}], lambda values: [])
    assert [start[2] for start in starts] == pytest.approx([0.05, 0.05, 0.06, 0.04]), "two lags more"
    assert [*found.values.values(), *found.late] == pytest.approx([*starts[best]])
    assert found.values["yaw_u3"] == pytest.approx(7.0 if best == 1 else values["yaw_u3"])


@pytest.mark.parametrize("late_s", [0.02, -0.008])
def test_poses_are_late_by_the_cameras_angle_behind_the_gyro_s(late_s: float) -> None:
    w = 2 * np.pi * np.array([0.5, 1.0, 3.0])
    Z = np.stack([1.0 + 0j * w, 1j * w, np.exp(-1j * w * late_s), 0j * w], axis=1)
    C = np.tile(1e-4 * np.eye(4, dtype=complex), (3, 1, 1))
    shown = spectra.Spectra(w, Z, C, Z[None], Z[:, 0], np.ones((3, 4)))
    assert pose_lateness([Excited(ROLL, 2, shown)], 2) == pytest.approx(late_s)
    assert pose_lateness([Excited(ROLL, 2, shown)], 1) == LATE_S, "another record"


@pytest.mark.parametrize("axis", AXES, ids=lambda axis: axis.name)
def test_the_instruments_find_every_constant_of_a_robot_that_follows_its_model(axis: Axis) -> None:
    """Also one that turning alone pushes, by poses that are late."""
    w, late = 2 * np.pi * np.array([0.3, 0.7, 1.1, 1.7, 2.3, 3.1]), 0.021 if RATE in axis.states else LATE_S
    values = {**dict.fromkeys(axis.constants, 0.3), **CONFIG.model.model_dump(), LAG: 0.05, "delay": DELAY_S}
    Z = np.concatenate([np.ones((len(w), 1)), response(axis, values, w, late)], axis=1)
    C = np.tile(np.eye(Z.shape[1], dtype=complex), (len(w), 1, 1)) * 1e-12
    one = Excited(axis, 0, spectra.Spectra(w, Z, C, Z[None], Z[:, 0], np.ones(Z.shape)))
    found = instrumental([one], 0.05).values
    assert found == pytest.approx({name: values[name] for name in axis.constants}, rel=0.02, abs=0.02)


@pytest.mark.parametrize("worst", [ROLL, YAW], ids=["roll", "yaw"])
def test_the_instruments_intervals_are_student_s_with_two_numbers_for_each_line(
    monkeypatch: pytest.MonkeyPatch, worst: Axis
) -> None:
    """The misfit is that of the equation that fits worst."""
    monkeypatch.setattr("hil.research.identify.joint.LAG_SPREAD", 0.0)
    monkeypatch.setattr("hil.research.identify.joint.DELAY_SPREAD_S", 0.0)
    rng, w = np.random.default_rng(2), 2 * np.pi * np.array([0.5, 1.0, 3.0, 4.0])
    values = {**CONFIG.model.model_dump(), **dict.fromkeys(NUISANCES, 0.01), LAG: 0.05, "delay": DELAY_S}
    excited, misfits = [], []
    for axis in (ROLL, YAW):
        Z = np.concatenate([np.ones((4, 1)), response(axis, values, w)], axis=1)
        Z *= 1 + (0.09 if axis is worst else 0.01) * rng.normal(size=Z.shape)
        C = np.tile(1e-4 * np.eye(Z.shape[1], dtype=complex), (4, 1, 1))
        excited.append(Excited(axis, 0, spectra.Spectra(w, Z, C, Z[None], Z[:, 0], np.ones(Z.shape))))
    found, late = instrumental(excited, 0.05), pose_lateness(excited, 0)
    for one in excited:
        for names, rows in _equations(one.axis):
            theta, covariance, misfit = _regress([(one.spectra, late)], rows, 0.05, DELAY_S)
            half = student.ppf(0.975, 2 * 4 - len(theta)) * np.sqrt(np.diag(covariance))
            assert [found.values[name] for name in names] == pytest.approx(theta)
            assert [found.errors[name] for name in names] == pytest.approx(half)
            misfits.append(misfit)
    assert found.misfit == max(misfits)


@pytest.mark.long
def test_the_misfit_of_the_instruments_is_one_where_the_scatter_is_as_stated() -> None:
    """On average of many draws: of three lines and two constants four numbers are free."""
    rng, w, model = np.random.default_rng(2), 2 * np.pi * np.array([0.5, 1.0, 3.0]), CONFIG.model
    rate = model.yaw_u3 * flap_response(w, 0.05, DELAY_S) / (1j * w - model.yaw_rate)
    true = np.stack([1.0 + 0j * w, rate, rate / (1j * w)], axis=1)
    size = 1e-4 * np.abs(true).mean(axis=0)
    C = np.tile(np.diag(size.astype(complex) ** 2), (3, 1, 1))
    ((_, rows),) = _equations(YAW)
    misfits = []
    for _ in range(400):
        noise = (rng.normal(size=true.shape) + 1j * rng.normal(size=true.shape)) * size / np.sqrt(2)
        one = spectra.Spectra(w, true + noise, C, true[None], true[:, 0], np.ones(true.shape))
        misfits.append(_regress([(one, LATE_S)], rows, 0.05, DELAY_S)[2])
    assert np.mean(misfits) == pytest.approx(1.0, abs=0.12)


def test_a_flap_follows_the_held_input_of_which_the_mean_of_two_ticks_is_reported() -> None:
    w, lag, delay, tick_s = 2 * np.pi * np.array([0.5, 4.0, 12.0]), 0.05, 0.013, 0.01
    reported = (1 + np.exp(-1j * w * tick_s)) / 2  # per commanded input
    held = 2 * np.sin(w * tick_s / 2) / (w * tick_s) * np.exp(-1j * w * delay)
    assert flap_response(w, lag, delay) * reported == pytest.approx(held / (1 + 1j * w * lag))


@pytest.mark.long
def test_roll_lifts_a_robot_that_leans_and_no_other() -> None:
    t, zero = 0.02 * np.arange(3000), np.zeros((3000, 3))
    swing, still = 0.02 * np.sin(2 * np.pi * 0.5 * t), np.zeros((3000, 4))

    def lifted(lean: float, config: LabConfig = CONFIG) -> float:
        pose = np.zeros((len(t), 6))
        pose[:, 3] = lean + swing
        record = Record("r", t, t, still, still, zero, t, pose, 0.0, 0.0, config, False)
        bent = straightened(record).bent
        assert bent.mean(axis=0) == pytest.approx(0.0, abs=1e-5)
        return float(swing @ bent[:, 1] / (swing @ swing))

    assert lifted(0.0) == pytest.approx(0.0, abs=1e-3)
    assert lifted(0.1) == pytest.approx(-lifted(-0.1), rel=1e-3)
    windy = CONFIG.tunnel.model_copy(update={"side_wind": (0.5, 1.0, 0.0)})
    assert lifted(0.1, CONFIG.model_copy(update={"tunnel": windy})) == lifted(0.1), "the lean shows the wind"
    assert lifted(0.1) < -9.81 * np.sin(0.1), (
        "the vertical share of its force, and less of the flow from below"
    )


@pytest.mark.parametrize(
    ("value", "half", "text"),
    [
        (1100.4, 172.0, "1100 ± 170"),
        (-27.46, 3.43, "-27.5 ± 3.4"),
        (0.04984, 0.0067, "0.0498 ± 0.0067"),
        (-99_950.0, 12_300.0, "-100000 ± 12000"),
        (123_456.0, np.nan, "123500"),
        (0.05, np.nan, "0.05"),
        (0.00001234, np.nan, "0.00001234"),
        (np.nan, np.nan, ""),
    ],
)
def test_a_value_ends_at_the_second_digit_of_its_interval(value: float, half: float, text: str) -> None:
    assert interval_text(value, half) == text


def test_a_column_is_shown_that_is_filled_in_any_row() -> None:
    one, other = constant((64.0, 1.0)), replace(constant((64.0, 1.0)), truth=60.0)
    rows = rows_of([one, other])
    assert list(rows[0]) == ["constant", "truth", "instruments", "joint fit", "unit", "verdict"]
    assert [row["truth"] for row in rows] == ["", "60"]
    assert rows_of([]) == []


def test_the_page_shows_identified_constants_first_and_no_empty_column(tmp_path: Path) -> None:
    weak = replace(constant((64.0, 30.0)), name="weak_one", verdict=WEAK)
    known = replace(constant((64.0, 1.0)), name="known_one", verdict=IDENTIFIED)
    page = write_pages(tmp_path, Identification((weak, known), (), Estimate({}, {}, 1.0), (), ()), None)
    before, folded = page.read_text(encoding="utf-8").split("<details>")
    assert ("known_one" in before, "weak_one" in before) == (True, False)
    assert ("known_one" in folded, "weak_one" in folded) == (False, True)
    for part in (before, folded):
        rows = [re.findall("<td>(.*?)</td>", row) for row in re.findall("<tr>(.*?)</tr>", part, re.DOTALL)]
        assert all(any(cells) for cells in zip(*filter(None, rows), strict=True))


def test_the_pictures_of_an_axis_show_measured_and_fitted_response_over_frequency_and_time() -> None:
    """Lines of 0.5, 1 and 2 Hz: twice the model, a quarter of a turn later; the excitation of 3 is real."""
    values = {**CONFIG.model.model_dump(), "lag": 0.05, "delay": 0.0145, "x_rate": 0.0, "y_rate": 0.0}
    hertz = np.array([0.5, 1.0, 2.0])
    w = 2 * np.pi * hertz
    model = response(ROLL, values, w)
    Z = np.concatenate([np.ones((3, 1)), 2.0 * np.exp(-0.5j * np.pi) * model], axis=1)
    count = Z.shape[1]
    C = np.tile(1e-4 * np.eye(count, dtype=complex), (3, 1, 1))
    coherence = np.outer([0.7, 0.8, 0.9], np.ones(count))
    seen = Excited(ROLL, 0, spectra.Spectra(w, Z, C, Z[None], np.full(3, 3.0 + 0j), coherence))
    gain, phase, errors, answer = Figure().subplots(1, 4)
    _responses(gain, phase, errors, [seen], Estimate(values, {}, 1.0, (0.0,)))
    fit, measured = gain.lines
    assert (fit.get_label(), measured.get_label()) == ("joint fit", "measured")
    assert measured.get_xydata() == pytest.approx(np.c_[hertz, 2 * np.abs(model[:, 0])])
    assert fit.get_xydata()[[0, -1]] == pytest.approx(np.c_[hertz, np.abs(model[:, 0])][[0, -1]])
    fit, measured = phase.lines
    assert measured.get_ydata()[[0, -1]] == pytest.approx(fit.get_ydata()[[0, -1]] - 90.0)
    assert (gain.get_ylabel(), phase.get_ylabel(), phase.get_xlabel()) == ("roll rate per u1 [rad/s/rad]",
        "phase [deg]", "frequency [Hz]")  # fmt: skip
    together = next(one for one in gain.figure.axes if one.get_ylabel().startswith("coherence"))
    assert together.lines[0].get_xydata() == pytest.approx(np.c_[hertz, [0.7, 0.8, 0.9]])
    left = whitened(seen, values, 0.0).reshape(2, 3, -1)[:, :, 0]
    assert [line.get_xydata() for line in errors.lines] == [pytest.approx(np.c_[hertz,
        part]) for part in left]  # fmt: skip
    _period(answer, seen, values)
    t = answer.lines[0].get_xdata()
    assert (t[0], t[-1], len(t)) == (0.0, spectra.PERIOD_S, 1001)
    sums = [(3.0 * amplitude * np.exp(1j * np.outer(t, w))).sum(axis=1).real for amplitude in (Z[:, 1],
        model[:, 0])]  # fmt: skip
    assert [line.get_ydata() for line in answer.lines] == [pytest.approx(one) for one in sums]
    assert [line.get_label() for line in answer.lines] == ["measured", "simulated from the input"]
    assert (answer.get_ylabel(), answer.get_xlim()) == ("roll rate [rad/s]", (0.0, 5.0))


def test_the_picture_of_the_paper_s_equations_has_each_flight_s_bins_and_estimate() -> None:
    records = [replace(swinging(robot_of(CONFIG), hertz, 30.0), name=name) for hertz,
        name in ((1.0, "a"), (2.0, "b"))]  # fmt: skip
    for axes, record in zip(_identity(tuple(records)).axes, records, strict=True):
        loop = closed_loop(record, ROLL)
        assert loop.w[:19] == pytest.approx(2 * np.pi * 0.25 * np.arange(1, 20)), "windows of 4 s"
        bins, line, estimate = axes.lines
        assert bins.get_xydata() == pytest.approx(np.c_[loop.w**2, (loop.acceleration / loop.angle).real])
        assert line.get_ydata() == pytest.approx(-line.get_xdata())
        assert estimate.get_ydata()[0] == loop.starred[1]
        assert estimate.get_label() == f"c* = {loop.starred[1]:.1f} ± {1.96 * loop.errors[1]:.1f}"
        assert axes.get_title() == f"{record.name}: b* = {loop.starred[0]:.2f}"


def test_the_picture_of_one_step_has_its_error_after_the_filter_settled_and_a_window_in_the_middle() -> None:
    record, values = (swinging(robot_of(CONFIG), 0.8), {**CONFIG.model.model_dump(), "lag": 0.05,
        "delay": 0.0145})  # fmt: skip
    axes, seen = Figure().subplots(), Excited(ROLL, 0, SimpleNamespace())  # type: ignore[arg-type]
    _one_step(axes, record, seen, values, 0.01)
    t, measured, predicted = one_step(record, 0, values, 0.01)
    assert axes.lines[0].get_xydata() == pytest.approx(np.c_[t - t[0], measured])
    assert axes.lines[1].get_xydata() == pytest.approx(np.c_[t - t[0], predicted])
    left = np.std((measured - predicted)[len(t) // 10 :])
    assert axes.get_title() == f"one step ahead: error {left:.2g} of {np.std(measured):.2g} rad/s rms"
    middle = (t[-1] - t[0]) / 2
    assert axes.get_xlim() == pytest.approx((middle, middle + 1.5))
    inside = measured[(t - t[0] > middle) & (t - t[0] < middle + 1.5)]
    assert np.mean(axes.get_ylim()) == pytest.approx(inside.mean())
    assert np.ptp(axes.get_ylim()) == pytest.approx(1.3 * np.ptp(inside))
    assert axes.lines[1].get_label() == "predicted 20 ms before"


@pytest.mark.parametrize(("hertz", "found"), [(0.05, [1]), (20.0, [400]), (20.05, [])])
def test_lines_are_looked_for_up_to_four_fifths_of_half_the_rows_rate(hertz: float, found: list[int]) -> None:
    record = excited(100.0)
    record.excitation[:, 0] = np.cos(2 * np.pi * hertz * record.t + 0.3)
    lines = spectra.excited_lines(record, [4.0])
    assert [one.tolist() for one in lines] == [found, [], [], []]


def test_constants_that_explain_all_are_no_better_known_than_the_scatter_of_the_spectra_allows() -> None:
    """The first output is twice the second one, exactly; both scatter by one."""
    lines = 20
    seen = np.exp(1j * np.arange(lines))
    spectra = SimpleNamespace(
        w=np.ones(lines), Z=np.stack([2 * seen, seen], axis=1), C=np.stack([np.eye(2, dtype=complex)] * lines)
    )

    def rows(w: Any, response: Any, late: float) -> Any:
        return np.tile([1.0, 0.0], (lines, 1)), np.tile([0.0, 1.0], (lines, 1, 1))

    theta, covariance, misfit = _regress([(spectra, 0.0)], rows, 0.05, 0.01)  # type: ignore[list-item]
    assert (theta, misfit) == (pytest.approx([2.0]), pytest.approx(0.0))
    assert covariance == pytest.approx(np.array([[5.0 / (2.0 * lines)]]))
