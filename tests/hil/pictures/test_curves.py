"""The arithmetic of curves, intervals and pictures: half turns, gaps, states, ends of ranges."""

import json
import re
from collections.abc import Sequence
from math import nan

import numpy as np
import pyarrow as pa
import pytest

from firmware_py.geometry import from_euler_zyx, yaw_quaternion
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import load_log
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.pictures import compare, curves, trials
from hil.pictures.panels import TOGETHER_S, marks_of_flight, saturated
from hil.pictures.viewer.plots import RATES

RELEASE = {b"release_us": b"0"}
SENSES = np.array([1.0, -1.0, 1.0, -1.0])  # of opening flaps
MEMBERS = (("up", "down"), ("x", "y", "z"), ("roll", "pitch", "yaw"), ("1", "2", "3", "4"))


def flight(yaw: Sequence[float], period_us: int = 10_000, **columns: Sequence[float]) -> pa.Table:
    """Rows of a flight at home that looks along `yaw` [deg], wanted is 180."""
    count = len(yaw)
    zero = np.zeros(count)
    q = np.array([yaw_quaternion(np.radians(angle)) for angle in yaw])
    table = {
        "t": period_us * np.arange(count),
        "flight.free": zero + 1,
        "supervisor.state": np.full(count, 2),
    }
    table |= {f"truth.q{part}": q[:, index] for index, part in enumerate("wxyz")}
    names = [f"{where}.{axis}" for where in ("truth", "goal", "estimate") for axis in "xyz"]
    names += [
        *(f"truth.flap_{flap}" for flap in (1, 2, 3, 4)),
        "estimate.roll",
        "estimate.pitch",
        "estimate.yaw",
    ]
    table |= dict.fromkeys(names, zero) | {"goal.yaw": zero + np.pi}
    return pa.table(
        table | {name: np.asarray(values) for name, values in columns.items()}
    ).replace_schema_metadata(RELEASE)


def test_own_columns_are_those_of_the_group_by_unit() -> None:
    fields = [
        ("t", ""),
        ("robot.b", "V"),
        ("robots.x", "V"),
        ("robot.a", "m"),
        ("logic.c", "V"),
        ("robot.d", "V"),
    ]
    schema = pa.schema([pa.field(name, pa.float64(), metadata={"unit": unit}) for name, unit in fields])
    rows = pa.table([pa.array([1.0 + place]) for place in range(len(fields))], schema=schema)
    found = curves.own_columns(rows, "robot")
    assert [(one.unit, one.names, one.read(rows).tolist()) for one in found] == [
        ("V", ("b", "d"), [[2.0, 6.0]]), ("m", ("a",), [[4.0]])]  # fmt: skip
    assert len({*found[0].colours}) == 2


def test_angles_have_their_own_names() -> None:
    rows = flight(
        [180.0],
        **{f"truth.q{part}": [q] for part, q in zip("wxyz", from_euler_zyx(0.1, -0.2, 3.0), strict=True)},
    )
    shown = dict(zip(curves.ATTITUDE.names, curves.ATTITUDE.read(rows)[0].tolist(), strict=True))
    expected = {"roll": 0.1, "pitch": -0.2, "yaw": 3.0 - np.pi}
    assert shown == pytest.approx({name: np.degrees(angle) for name, angle in expected.items()})


def test_an_estimate_across_half_a_turn_misses_by_the_difference() -> None:
    rows = flight([1.0, -1.0], **{"estimate.yaw": np.radians([179.0, -178.0])})
    missed = curves.ATTITUDE_MISS.read(rows)[:, 2]
    assert missed == pytest.approx([-2.0, 3.0], abs=1e-9)


def probed(columns: set[str], grown: str = "") -> pa.Table:
    """Three rows of a log with these columns, of which one grows."""
    packets = {"link.up_delivered", "link.down_delivered"} if "link.up_latency_sum" in columns else set()
    always = {"t", grown, *packets}
    rows = {one: np.arange(3.0) if one in always else np.full(3, float(one == "truth.qw")) for one in columns}
    return pa.table(rows).replace_schema_metadata(RELEASE)


def columns_of(plot: curves.Curves) -> set[str]:
    columns: set[str] = {"t"}
    while True:
        try:
            plot.read(probed(columns))
            return columns
        except LabError as missing:
            columns.add(str(missing).split("'")[1])


def words(text: str) -> set[str]:
    return set(re.findall(r"[a-z]+|[0-9]", text.replace("rotor", "")))


PLOTTED = {name: one for name, one in vars(curves).items() if isinstance(one, curves.Curves)} | dict(RATES)
PLOTTED |= {
    one.__name__: curves.Curves(("up", "down"), ("", ""), "", one)
    for one in (curves.latency, curves.line_load)
}


@pytest.mark.long
@pytest.mark.parametrize("name", PLOTTED)
def test_a_curve_shows_the_member_of_a_group_that_its_name_says(name: str) -> None:
    plot = PLOTTED[name]
    read = columns_of(plot)
    moved: list[set[str]] = [set() for _ in plot.names]
    for grown in read - {"t"}:
        with np.errstate(all="ignore"):
            changed = (plot.read(probed(read, grown)) != plot.read(probed(read))).reshape(-1, len(moved))
        for index in np.flatnonzero(changed.any(axis=0)):
            moved[index].add(grown.partition(".")[2])
    for label, columns in zip(plot.names, moved, strict=True):
        for members in MEMBERS:
            named, shown = (
                set(members) & found for found in (words(label), set().union(*map(words, columns)))
            )
            assert not named or not shown or shown == named, (label, columns)


# Of a column's unit, the shown one, and one in the other.
SCALES = {("m", "cm"): 100.0, ("rad", "deg"): np.degrees(1.0), ("us", "ms"): 1e-3, ("N", "mN"): 1e3, ("V", "V"): 1.0,
    ("ticks", "ms"): 10.0, ("counts", "%"): 100.0 / 65535, ("%", "%"): 1.0}  # fmt: skip
OTHERWISE = {"rotor.thrust_1": "N", "rotor.command_1": "N", "estimator.horizon": "ticks", "board.load": "%"}


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The units of the columns of a log."""
    folder = tmp_path_factory.mktemp("units") / "run"
    fly(Request.of(EXPERIMENTS["hover"], duration_s=0.05), folder)
    log = load_log(folder)
    return {one.name: (one.metadata or {}).get(b"unit", b"").decode() for one in log.schema} | OTHERWISE


@pytest.mark.long
@pytest.mark.parametrize("name", PLOTTED)
def test_a_curve_is_in_the_unit_that_it_names(name: str, units: dict[str, str]) -> None:
    """Others count: events so far or per second, packets, poses, or have units of their own in their names."""
    plot = PLOTTED[name]
    assert len(plot.names) == len(set(plot.names)) == len(plot.colours)
    if plot.unit in ("so far", "1/s", "packets", "measurements", ""):
        assert name in ("AIR", "latency", "line_load") or plot.unit
        assert name != "AIR" or plot.names == ("link quality [%]", "RSSI [-dBm]")
        return
    assert len(set(plot.colours)) == len(plot.colours)
    for column in (one for one in columns_of(plot) - {"t"} if units.get(one)):
        ones, twos = (probed(columns_of(plot)).set_column(probed(columns_of(plot)).column_names.index(column), column,
            pa.array([value] * 3)) for value in (0.0, 1e-3))  # fmt: skip
        change = np.abs(plot.read(twos) - plot.read(ones)).max()
        assert change == pytest.approx(1e-3 * SCALES.get((units[column], plot.unit), 0.0), rel=1e-3), column


def test_the_time_since_the_last_fused_pose_grows_until_the_next_one() -> None:
    rows = flight([0.0] * 6, **{"estimator.fused": [0, 1, 1, 1, 2, 2]})
    assert curves.since_fusion(rows)[:, 0].tolist() == pytest.approx([nan, 0, 10, 20, 0, 10], nan_ok=True)
    assert curves.row_of_last_fusion(rows)["t"].to_pylist() == [40_000]
    assert curves.row_of_last_fusion(rows.slice(0, 1)).num_rows == 0


def test_the_first_row_begins_a_state_whatever_it_is() -> None:
    for first in (0, 2):
        rows = flight([0.0] * 3, **{"supervisor.state": [first, first, 3]})
        begins, names = curves.changes(rows, curves.SUPERVISOR)
        assert begins.tolist() == [0, 20_000]
        assert names == [curves.SUPERVISOR.names[first], "failsafe"]


LIMITS = {"opening_min": 0.0, "opening_max": 0.9}


def commanded(*angles: float) -> pa.Table:
    """One row per angle of flap 2; the others stay inside."""
    count = len(angles)
    names = {f"control.flap_{flap}": [0.4 * sign] * count for flap, sign in ((1, 1), (3, 1), (4, -1))}
    table = flight([0.0] * count, **names, **{"control.flap_2": list(angles)})
    return table.replace_schema_metadata(
        RELEASE | {b"config": json.dumps({"allocation": LIMITS, "flight": {"release_us": 0}}).encode()}
    )


@pytest.mark.parametrize(("angle", "at_limit"), [(-0.9, True), (0.0, True), (-0.4, False), (-0.8999, False)])
def test_a_flap_that_opens_the_other_way_is_at_its_limit_at_both_ends(angle: float, at_limit: bool) -> None:
    found = {flap: rows.tolist() for flap, rows in saturated(commanded(-0.4, angle))}
    assert found == ({"flap 2": [False, True]} if at_limit else {})


@pytest.mark.parametrize(("gap", "intervals"), [(9, 1), (11, 2)])
def test_a_failsafe_that_ends_for_less_than_a_tenth_of_a_second_is_one_interval(
    gap: int, intervals: int
) -> None:
    states = [2, *[3] * 30, *[2] * gap, *[3] * 30, 2]
    marks = marks_of_flight(flight([0.0] * len(states), **{"supervisor.state": states}))
    found = [(one.begin_s, one.end_s) for one in marks.intervals if one.kind == "failsafe"]
    assert len(found) == intervals, TOGETHER_S
    assert found[0][0] == pytest.approx(0.01)
    assert found[-1][1] == pytest.approx(0.01 * (len(states) - 1))
    if intervals == 2:
        assert found[0][1] == pytest.approx(0.31), "to the first row without it"


def test_an_interval_to_the_end_ends_with_the_last_row() -> None:
    marks = marks_of_flight(flight([0.0] * 3, **{"supervisor.state": [2, 3, 3]}))
    assert [(one.begin_s, one.end_s) for one in marks.intervals] == [(0.01, 0.02)]
    faults = json.dumps({"faults": ["push.y@0.01:9=1", "push.x@0.02=1", "push.z@0.03=1"]}).encode()
    log = flight([0.0] * 3).replace_schema_metadata(RELEASE | {b"request": faults})
    marked = [(one.text, one.begin_s, one.end_s) for one in marks_of_flight(log).intervals]
    assert marked == [("push.y@0.01:9=1", 0.01, 0.02)], (
        "those that begin with the end or after it have no time"
    )


def test_a_trial_shows_the_true_value_beside_its_target_and_the_mean_opening_each_flap_in_its_sense() -> None:
    kinds, numbers = ("truth", "goal", "control"), np.arange(1.0, 13.0).reshape(3, 4)
    names = [(*(f"{kind}.{name}" for name in "xyz"), f"{kind}.yaw") for kind in kinds[:2]]
    names += [tuple(f"{kind}.flap_{n}" for n in (1, 2, 3, 4)) for kind in kinds[::2]]
    values = [*numbers[:2], 0.1 * numbers[0] * SENSES, 0.2 * numbers[0] * SENSES]
    columns = dict(zip(np.ravel(names).tolist(), np.ravel(values).tolist(), strict=True))
    rows = flight([np.degrees(4.0)] * 30, **{name: [value] * 30 for name, value in columns.items()})
    turns = np.degrees((4.0 + 2 * np.pi, 8.0)), np.degrees((0.25, 0.5))
    expected = {trials.X: (100, 500), trials.Y: (200, 600), trials.Z: (300, 700), trials.YAW: turns[0]}
    for curve, shown in (expected | {trials.OPENING: turns[1]}).items():
        assert [one[7] for one in curve.read(rows)] == pytest.approx(shown)


def test_an_opening_is_the_mean_of_the_tenth_of_a_second_around_its_row() -> None:
    values = np.arange(30.0) ** 2
    smooth = trials._tenth(values)
    assert [smooth[row] for row in (5, 12, 25)] == pytest.approx(
        [values[row - 5 : row + 5].mean() for row in (5, 12, 25)]
    )
    assert (len(smooth), smooth[0]) == (30, pytest.approx(np.arange(5.0) @ np.arange(5.0) / 10))


def trial(number: int, seconds: float) -> pa.Table:
    """A flight in which everything is `number` times as large as in the first; its first 0.1 s it is held."""
    count = round(100 * seconds)
    columns = {
        f"battery.{name}": [number * value] * count for name, value in (("voltage", 3.9), ("charge", 0.2))
    }
    columns |= {name: [number * value] * count for name, value in (("truth.vz", 0.3), ("flow.z", 9.0))}
    columns |= {
        "truth.z": [0.049 + number * 0.5] * count,
        "goal.z": [1.049] * count,
        "truth.x": [0.01 * number] * count,
    }
    columns |= {"battery.power": np.repeat(np.arange(seconds + 1) * number, 100)[:count],
        "flight.free": np.arange(count) >= 10.0}  # fmt: skip
    table = flight([180.0] * count, **columns)
    return table.replace_schema_metadata(
        RELEASE | {b"config": json.dumps({"supervisor": {"low_battery_mv": 3200}}).encode()}
    )


def test_an_experiment_s_picture_has_its_flight_last_over_the_trials_and_then_the_target() -> None:
    flights = [trial(n, seconds) for n, seconds in ((1, 3.5), (2, 3.0), (3, 2.0))]
    light, dark = trials.LIGHT, trials.DARK
    own = [("", light), ("trials", light), ("flight", dark)]
    expected = {  # of each panel: label, the lines, and the values in their last rows
        "follow": {"x [cm]": ([*own, ("target", trials.WANTED)], [3, 2, 1, 0]), "z [cm]": ([*own, ("target",
        trials.WANTED)], [154.9, 104.9, 54.9, 104.9])},
        "disturbed": {f"{axis} error [cm]": ([*own[:2], ("flight", colour)], values) for axis, colour, values in (
            ("x", curves.RED, [-3, -2, -1]), ("y", curves.GREEN, [0, 0, 0]), ("z", curves.BLUE, [50, 0, -50]))},
        "take_off": {"height over the net [cm]": ([*own, ("goal", "black")], [150, 100, 50, 100]), "climb [cm/s]": (own,
        [90, 60, 30]),
                     "air, upwards [m/s]": (own, [27, 18, 9]), "stages": ([], [])},
        "discharge": {"cell [V]": (own, [11.7, 7.8, 3.9]), "power [W]": (
            [*own, ("mean 1.32 W", curves.GREY)], [0.3, 2.2, 2.1, 1.32]),
                      "charge [%]": (own, [60, 40, 20])},
    }  # fmt: skip
    plots = {"follow": trials.follow((trials.X, trials.Z), (0.5, 60.0), *flights),
        "disturbed": trials.disturbed(*flights), "take_off": trials.take_off_and_landing(*flights),
        "discharge": trials.discharge(*flights)}  # fmt: skip
    for name, plot in plots.items():
        assert [one.label for one in plot.panels] == list(expected[name])
        for panel in plot.panels:
            lines, values = expected[name][panel.label]
            assert [(line.name, line.colour) for line in panel.series] == lines, panel.label
            assert [float(line.values[-1]) for line in panel.series] == pytest.approx(values,
                abs=0.05), (panel.label)  # fmt: skip
            assert [len(line.times) for line in panel.series] == [len(line.values) for line in panel.series]
            assert [line.dashed for line in panel.series] == [line.name in ("target",
                "goal") for line in panel.series]  # fmt: skip
    assert [(one.lane, one.name, one.begin_s, one.end_s) for one in plots["take_off"].panels[3].bars] == [
        ("controller", "on", pytest.approx(2.2), pytest.approx(26.2)), ("controller", "off", pytest.approx(26.2),
        pytest.approx(26.2)),
        ("fans", "take-off 93%", 1.0, pytest.approx(8.2)), ("fans", "flight 100%", pytest.approx(8.2), pytest.approx(18.2)),
        ("fans", "landing 88%", pytest.approx(18.2), pytest.approx(26.2)), ("fans", "off", pytest.approx(26.2),
        pytest.approx(26.2)),
    ], "the menu's times"  # fmt: skip
    cell, power, _ = plots["discharge"].panels
    assert cell.limits == (3.2,)
    assert (power.series[2].times.tolist(), power.series[3].times.tolist()) == (
        [pytest.approx(0.495 + n) for n in range(3)],
        [0.0, pytest.approx(3.39)],
    )
    assert all(one.limits == (-10.0, 10.0) for one in plots["disturbed"].panels)
    windows = [trials.follow((trials.X,), asked, *flights).window_s for asked in ((0.5, 60.0), (0.5, 2.0),
        (5.0, 60.0))]  # fmt: skip
    assert windows == [(0.5, pytest.approx(3.39)), (0.5, 2.0), (5.0, 5.1)]
    assert plots["discharge"].window_s is None


def test_logs_differ_first_where_they_do_a_gap_equals_a_gap_and_a_longer_one_goes_on() -> None:
    a = flight([0.0] * 5, **{"truth.x": [0.0, nan, 1.0, 2.0, 3.0], "truth.y": [0.0, 0, 0, 0, 1]})
    b = flight([0.0] * 5, **{"truth.x": [0.0, nan, 1.0, 2.0, 4.0], "truth.y": [0.0, 0, 0, 9, 1]})
    names = a.column_names
    assert compare._first_difference(a, a, names) is None
    found = compare._first_difference(a, b, names)
    assert found is not None
    assert (found.row, found.t_s, found.column, found.values) == (
        3,
        pytest.approx(0.03),
        "truth.y",
        (0.0, 9.0),
    )
    found = compare._first_difference(
        a, a.set_column(names.index("truth.x"), "truth.x", [[0.0, 0.5, 1, 2, 3]]), names
    )
    assert found is not None
    assert (found.row, found.values[1]) == (1, 0.5), "a gap is no number"
    for first, second, values in ((a, a.slice(0, 4), (40_000, None)), (a.slice(0, 4), a, (None, 40_000))):
        found = compare._first_difference(first, second, names)
        assert found is not None
        assert (found.row, found.column, found.values) == (4, "t", values)
        assert "the log has ended" in str(found)


def test_two_flights_along_half_a_turn_are_as_far_apart_as_elsewhere() -> None:
    """The second is released 5 ms later in its rows, so that its attitude is taken between two of them."""
    turn = np.linspace(-3.0, 3.0, 61)
    first = flight((180.0 + 180.0 + turn).tolist())  # error of 180 degrees: a robot that looks the wrong way
    second = flight((180.0 + 182.0 + turn).tolist()).replace_schema_metadata({b"release_us": b"5000"})
    behind = {one.name: one for one in compare._apart(second, first)}
    assert behind["yaw"].largest == pytest.approx(2.0, abs=0.1)
    apart = {one.name: one for one in compare._apart(first, second)}
    assert apart["yaw"].largest == pytest.approx(2.0, abs=0.1)
    assert apart["roll"].largest == pytest.approx(0.0, abs=1e-6)
