"""Foreign logs as runs: `floaty import`."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pymavlink.dialects.v20.development as dialect
import pytest
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

from hil import LabError, Run, column, fly, load_run
from hil.laboratory.files.alignment import released_like
from hil.laboratory.files.imported import import_log
from hil.laboratory.files.joined import Joined, join
from hil.laboratory.files.log_map import Map, guess
from hil.laboratory.files.recorder import load_events
from hil.laboratory.files.tables import Table, read_tables
from hil.pictures.viewer.recording import recording_of
from support.command import Cli, floaty
from support.foreign_logs import (
    FOREIGN,
    PLACE,
    QUATERNIONS,
    ROWS,
    T,
    csv,
    micro_sd,
    place,
    ros_bag,
)


@pytest.mark.parametrize("name", FOREIGN)
def test_names_units_and_sizes_give_time_place_and_attitude(name: str, tmp_path: Path) -> None:
    done = import_log([csv(tmp_path / "log.csv", FOREIGN[name])], tmp_path)
    log, factor = load_run(tmp_path).log.to_pydict(), 30.0 if name == "neither, by size" else 1.0
    assert np.array(log["t"]) == pytest.approx(1e6 * T, abs=1)
    assert np.stack([log[f"cameras.{axis}"] for axis in "xyz"], axis=1) == pytest.approx(
        factor * PLACE, abs=1e-6
    )
    turned = np.stack([log[f"cameras.q{part}"] for part in "wxyz"], axis=1)
    if name == "neither, by size":
        turned, expected = turned[:1], QUATERNIONS[:1]
    else:
        expected = QUATERNIONS
    assert turned == pytest.approx(expected, abs=1e-7)
    clocks = ("Timestamp [ms]", "time [us]", "t_ns [ns]", "elapsed time [ms]", "timestamp [us]", "time [s]")
    assert done.map.columns["t"] in clocks
    assert done.map.profile == ("crazyflie" if "stateEstimate.x" in FOREIGN[name] else "floaty")
    assert done.result.verdicts == ()


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A flight of ours, with all its exports."""
    home = {"flight.home": (0.02, 0.03, 1.15)}
    run = fly("hover", tmp_path_factory.mktemp("flown") / "run", duration_s=0.4, overrides=home)
    assert floaty("export", str(run.folder), "--csv", "--mcap", "--tlog") == 0
    return run


@pytest.mark.long
def test_a_table_of_this_laboratory_is_its_log_again(run: Run, tmp_path: Path) -> None:
    import_log([run.folder / "flight.csv"], tmp_path)
    again = load_run(tmp_path)
    assert again.log.column_names == run.log.column_names
    for name in run.log.column_names[1:]:
        assert again.log.column(name).to_numpy() == pytest.approx(
            run.log.column(name).to_numpy(), rel=1e-6
        ), name
    assert again.units == run.units
    assert again.free.num_rows == run.free.num_rows
    assert again.metrics["rms_x"] == pytest.approx(run.metrics["rms_x"])


@pytest.mark.long
def test_the_release_is_where_the_path_fits_that_of_another_flight(cli: Cli, tmp_path: Path) -> None:
    run = fly("yaw-step", tmp_path / "run", duration_s=2.0, faults=("push.x@0.5=2",))
    rows = run.log.slice(60, 200).to_pydict()  # 0.4 s before the release and 1.6 s after it
    columns = {
        "clock": 1e-6 * np.array(rows["t"]) + 7.0,
        **{a: np.array(rows[f"truth.{a}"]) + 0.5 for a in "xyz"},
    }
    path = csv(
        tmp_path / "log.csv", {"t" if name == "clock" else name: values for name, values in columns.items()}
    )
    assert cli("import", path, "--like", tmp_path / "run", "--out", tmp_path / "again") == 0
    released_s = Map.read(tmp_path / "again" / "map.toml").release_s
    assert released_s == pytest.approx(7.0 + 1e-6 * run.free.column("t")[0].as_py(), abs=0.004)
    assert "where both paths fit best" in cli.err
    assert cli("import", path, "--like", tmp_path / "none", "--out", tmp_path / "more") == 2
    assert "there is no such run folder" in cli.err


@pytest.mark.parametrize("offset_us", [0, 3_000, 7_000, 11_000, 16_000])
@pytest.mark.parametrize("later_s", [0.0, 2.4])
def test_the_best_fit_is_found_between_the_steps_of_the_search(offset_us: int, later_s: float) -> None:
    def path(t_us: np.ndarray) -> dict[str, np.ndarray]:
        t = 1e-6 * t_us
        return {"x": np.sin(2.0 * t) + 0.3 * np.sin(7.0 * t), "y": np.cos(3.0 * t), "z": 0.1 * t}

    since_us, begin_us = 10_000.0 * np.arange(600), 5_000_000 + offset_us
    flown = {"t": since_us + 1_000_000, "flight.free": np.ones(600)}
    like = pa.table(flown | {f"truth.{axis}": values for axis, values in path(since_us).items()})
    t_us = begin_us + 1e6 * later_s + 10_000.0 * np.arange(600)  # the log may begin long after the release
    joined = Joined(
        t_us, {axis: 2.0 + values for axis, values in path(t_us - begin_us).items()}, {}, "t [us]"
    )
    chosen = Map(columns={f"cameras.{axis}": f"{axis} [m]" for axis in "xyz"})
    assert released_like("log", joined, chosen, like).release_s == pytest.approx(1e-6 * begin_us, abs=0.0021)
    one_row = Joined(t_us[:1], {axis: values[:1] for axis, values in joined.columns.items()}, {}, "t [us]")
    for few, flight in ((joined, like.slice(0, 1)), (one_row, like)):
        with pytest.raises(LabError, match="both flights need some rows after the release"):
            released_like("log", few, chosen, flight)


@pytest.mark.long
def test_a_telemetry_log_of_mavlink_is_in_the_world_s_frame(run: Run, tmp_path: Path) -> None:
    tlog = tmp_path / "flight.tlog"
    whole = (run.folder / "flight.tlog").read_bytes()
    tlog.write_bytes(whole + b"\0" * 7 + b"\xfd\x05")  # cut off while it was written
    log = import_log([tlog], tmp_path / "again").log
    first_us = run.log.column("t")[0].as_py()
    sent = run.log.take(np.searchsorted(run.log.column("t"), log.column("t").to_numpy() + first_us))
    for axis, goal in {"x": 0.02, "y": 0.03, "z": 1.15}.items():
        expected = sent.column(f"estimate.{axis}").to_numpy() + goal
        assert log.column(f"cameras.{axis}").to_numpy() == pytest.approx(expected, abs=1e-6)
        assert log.column(f"goal.{axis}").to_numpy()[-1] == pytest.approx(goal)
    turned = np.stack([log.column(f"cameras.q{part}").to_numpy() for part in "wxyz"], axis=1)[-20:]
    angles = Rotation.from_quat(turned, scalar_first=True).as_euler("ZYX")[:, ::-1]
    names = [f"estimate.{name}" for name in ("roll", "pitch", "yaw")]
    assert angles == pytest.approx(
        np.stack([sent.column(name).to_numpy() for name in names], axis=1)[-20:], abs=1e-6
    )


@pytest.mark.parametrize("version", [1, 2])
def test_the_rows_of_a_tlog_are_those_of_its_best_pose_behind_bytes_that_are_no_frame(
    tmp_path: Path, version: int
) -> None:
    codec = dialect.MAVLink(None, 1, 1)
    messages = [
        dialect.MAVLink_attitude_message(0, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0),
        dialect.MAVLink_vision_position_estimate_message(0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0),
        dialect.MAVLink_local_position_ned_message(0, 4.0, 5.0, 6.0, 0.0, 0.0, 0.0),
    ]
    content = b""
    for number, message in enumerate(messages, 1):
        frame = message.pack(codec, force_mavlink1=version == 1)
        content += number.to_bytes(8, "big") + frame + b"abc" * (number == 2)
    (tmp_path / "log.tlog").write_bytes(content)
    tables = read_tables(tmp_path / "log.tlog")
    kinds = ["LOCAL_POSITION_NED", "VISION_POSITION_ESTIMATE", "ATTITUDE"]
    assert [next(name.split(".")[0] for name in table.columns if "." in name) for table in tables] == kinds
    assert [table.columns["timestamp [us]"].tolist() for table in tables] == [[3], [2], [1]]


def test_other_delimiters_decimal_commas_marks_and_words_are_read(tmp_path: Path) -> None:
    columns = {"time": T, **place("x", "y", "z"), "note": ["fine"] * ROWS}
    path = csv(tmp_path / "log.csv", columns, ";", ",")
    path.write_bytes(b"\xef\xbb\xbf# " + path.read_bytes())
    done = import_log([path], tmp_path)
    assert done.log.column("cameras.z").to_numpy() == pytest.approx(PLACE[:, 2])
    assert "columns without numbers are left out: note" in done.notes


@pytest.mark.parametrize(
    ("change", "note"),
    [
        (lambda text: text.encode("utf-16"), ""),
        (lambda text: text.replace("\n", ",1\n").replace(",1\n", ",h\u00f6he [\u00b0]\n", 1).encode("cp1252"), ""),
        (lambda text: f"# by me\n# on Monday\n{text}".encode(), ""),
        (lambda text: f"# by me\n# {text}".encode(), ""),
        (lambda text: f"{text}9.9,1.0".encode(), "left out: a row, expected 4 columns, got 2: 9.9,1.0"),
        (lambda text: f"{text}9.9,1.0,1.0,oops\n".encode(), "left out: z: no number: 'oops'"),
        (lambda text: f"{text}9.9,1.0,1.0,1e999\n".encode(), "left out: z: infinite in 1 of 41 rows"),
    ],
    ids=["UTF-16", "Windows", "remarks", "names in the last remark", "cut off", "torn cell", "infinite"],
)  # fmt: skip
def test_usual_faults_of_a_file_are_read_over_and_said(
    change: Callable[[str], bytes], note: str, tmp_path: Path
) -> None:
    path = csv(tmp_path / "log.csv", {"time": T, **place("x", "y", "z")})
    path.write_bytes(change(path.read_text()))
    done = import_log([path], tmp_path)
    assert done.log.column("cameras.z").to_numpy()[:ROWS] == pytest.approx(PLACE[:, 2])
    assert [one for one in done.notes if one.startswith("left out")] == [note] * bool(note)


@pytest.mark.parametrize(("rows", "torn", "shown"), [(200, 3, 3), (400, 5, 3), (200, 4, None)])
def test_a_hundredth_of_the_rows_may_be_torn_and_no_more(
    rows: int, torn: int, shown: int | None, tmp_path: Path
) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,x\n" + "".join(f"{t},1\n" for t in range(rows)) + "1,2,3\n" * torn)
    if shown is None:
        with pytest.raises(
            LabError, match=f"{torn} of {rows + torn} rows are torn: expected 2 columns, got 3: 1,2,3$"
        ):
            read_tables(path)
        return
    (table,) = read_tables(path)
    line, more = "left out: a row, expected 2 columns, got 3: 1,2,3", torn - shown
    assert list(table.notes) == [line] * shown + [f"left out: {more} more"] * bool(more)
    assert len(table.columns["x"]) == rows


@pytest.mark.parametrize(
    ("cells", "numbers"),
    [(["1", "2", "a"], 2), (["1", "a"], None), (["1"] * 200 + ["a"] * 3, 200), (["1"] * 200 + ["a"] * 4, None),
     (["", "", "", "a"], None)],
)  # fmt: skip
def test_a_column_of_numbers_may_have_few_texts(
    cells: list[str], numbers: int | None, tmp_path: Path
) -> None:
    path = tmp_path / "log.csv"
    path.write_text("t,x\n" + "".join(f"{t},{cell}\n" for t, cell in enumerate(cells)))
    (table,) = read_tables(path)
    assert ("x" in table.columns, table.left_out) == (numbers is not None, () if numbers else ("x",))
    assert numbers is None or np.isfinite(table.columns["x"]).sum() == numbers


@pytest.mark.parametrize(
    ("text", "x"),
    [
        ("t,x\n1,2\n2,2.5\n", [2.0, 2.5]),
        ("t;x\n1,5;2,5\n2,5;3\n", [2.5, 3.0]),
        ("t;x\n1.5;2.5\n2.5;3\n", [2.5, 3.0]),
        ("t\tx\n1,5\t2,5\n2,5\t3\n", [2.5, 3.0]),
    ],
)
def test_a_comma_between_columns_is_none_within_numbers(text: str, x: list[float], tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(text)
    (table,) = read_tables(path)
    assert (table.columns["x"].tolist(), table.notes) == (x, ())


def test_what_is_missing_is_unknown_or_said(tmp_path: Path) -> None:
    done = import_log(
        [csv(tmp_path / "log.csv", {"t": T, **place("x", "y", "z"), "fan [rpm]": 900 + T})], tmp_path
    )
    log, goal = done.log, np.round(PLACE.mean(axis=0), 3)
    assert np.isnan(log.column("cameras.qw").to_numpy()).all()
    assert [log.column(f"goal.{axis}")[0].as_py() for axis in "xyz"] == pytest.approx(goal)
    assert Map.read(tmp_path / "map.toml") == done.map
    assert [name for name in done.map.columns if name.startswith("goal")] == [
        "goal.x",
        "goal.y",
        "goal.z",
        "goal.yaw",
    ]
    assert ("mean of the flight" in " ".join(done.notes), "attitude is unknown" in " ".join(done.notes)) == (
        True,
        True,
    )
    assert log.schema.field("robot.fan").metadata[b"unit"] == b"rpm"
    run = load_run(tmp_path)
    assert all(
        np.isnan(run.metrics[name]) for name in ("failsafe", "uncontrolled", "poses_refused", "attitude_max")
    )


def test_a_flight_lasts_from_the_first_row_to_the_last_and_its_hash_is_of_its_numbers(tmp_path: Path) -> None:
    def done(name: str, x: float) -> tuple[float, str]:
        columns = {"t": T, **place("x", "y", "z")}
        columns["x"] = np.append(columns["x"][:-1], x)
        result = import_log([csv(tmp_path / f"{name}.csv", columns)], tmp_path / name).result
        return result.request.duration_s, result.hash

    first, again, other = done("first", 0.5), done("again", 0.5), done("other", 0.500001)
    assert first == again != other
    assert first[0] == T[-1]


def test_a_map_chooses_scales_turns_and_releases(tmp_path: Path) -> None:
    path = csv(
        tmp_path / "log.csv", {"clock": 10 + T, "a": PLACE[:, 0], "b": 1e3 * PLACE[:, 1], "c": -PLACE[:, 2]}
    )
    (tmp_path / "mine.toml").write_text(
        'profile = "floaty"\nrelease_s = 10.2\n[columns]\nt = "clock [s]"\n"cameras.x" = "a [m]"\n'
        '"cameras.y" = "b [mm]"\n"cameras.z" = "-c [m]"\n"goal.x" = 0.25\n',
        encoding="utf-8-sig",
    )
    log = import_log([path], tmp_path, Map.read(tmp_path / "mine.toml")).log
    assert np.stack([log.column(f"cameras.{axis}").to_numpy() for axis in "xyz"], axis=1) == pytest.approx(
        PLACE
    )
    assert log.column("goal.x")[3].as_py() == 0.25
    assert log.column("flight.free").to_numpy().tolist() == [0] * 10 + [1] * (ROWS - 10)
    assert log.schema.metadata[b"release_us"] == b"200000"


@pytest.mark.parametrize(
    ("step", "unit"),
    [
        (0.5, "s"),
        (0.0005, "s"),
        (0.6, "ms"),
        (500.0, "ms"),
        (501.0, "us"),
        (5e5, "us"),
        (1e-5, "s"),
        (1e10, "s"),
    ],
)
def test_times_without_a_unit_have_that_of_a_usual_step(step: float, unit: str) -> None:
    t = step * np.array([0, 0, 0, 0, 1, np.inf, 1, 2, np.nan, 3])  # repeated, and some that are no times
    joined = join("log", [Table({"t": t, "x": np.arange(10.0)}, ())], None)
    assert joined.clock == f"t [{unit}]"
    assert joined.columns["x"].tolist() == [0.0, 4.0, 7.0, 9.0]
    assert joined.notes == ["6 rows are left out: t does not advance there"]


def test_a_table_of_one_row_has_no_usual_step() -> None:
    joined = join("log", [Table({"t": np.array([2.0]), "x": np.array([5.0])}, ())], None)
    assert (joined.columns["x"].tolist(), joined.notes) == ([5.0], [])


def test_the_first_table_must_have_the_clock_that_a_map_names() -> None:
    named, other = (Table({name: np.arange(3.0)}, ()) for name in ("stamp", "t"))
    assert join("log", [named, other], "stamp [ms]").clock == "stamp [ms]"
    with pytest.raises(LabError, match=r"log: no column of times like 'stamp \[ms\]' among t"):
        join("log", [other, named], "stamp [ms]")


# Names of programs that write such logs, what they give, with which sign; unit of values as large as the limit, and beyond.
KNOWN = [
    *((f"{source}.{axis}", f"cameras.{axis}", "", 20.0, "m", "mm")
      for axis in "xyz" for source in ("vicon", "mocap.pos", "p")),
    *((f"stateEstimate.{axis}", f"cameras.{axis}", "", 20.0, "m", "m") for axis in "xyz"),
    ("LOCAL_POSITION_NED.x", "cameras.x", "", 20.0, "m", "mm"), ("LOCAL_POSITION_NED.y", "cameras.y", "-", 20.0, "m", "mm"),
    ("LOCAL_POSITION_NED.z", "cameras.z", "-", 20.0, "m", "mm"), ("vicon.roll", "cameras.roll", "", 2 * np.pi, "rad", "deg"),
    ("phi", "cameras.roll", "", 2 * np.pi, "rad", "deg"), ("theta", "cameras.pitch", "", 2 * np.pi, "rad", "deg"),
    ("psi", "cameras.yaw", "", 2 * np.pi, "rad", "deg"), ("stabilizer.roll", "cameras.roll", "", 0.1, "deg", "deg"),
    ("stabilizer.pitch", "cameras.pitch", "-", 0.1, "deg", "deg"),
    ("ATTITUDE.pitch", "cameras.pitch", "-", 2 * np.pi, "rad", "deg"),
    ("ATTITUDE.yaw", "cameras.yaw", "-", 2 * np.pi, "rad", "deg"),
    ("ATTITUDE.roll", "cameras.roll", "", 2 * np.pi, "rad", "deg"),
    *((f"{name}.x", "goal.x", "", 20.0, "m", "mm") for name in ("target", "setpoint", "desired", "ref", "goal")),
    ("ctrltarget.z", "goal.z", "", 90.0, "m", "m"), ("setpoint.yaw", "goal.yaw", "", 2 * np.pi, "rad", "deg"),
    ("SET_POSITION_TARGET_LOCAL_NED.yaw", "goal.yaw", "-", 2 * np.pi, "rad", "deg"),
    ("SET_POSITION_TARGET_LOCAL_NED.x", "goal.x", "", 20.0, "m", "mm"),
    ("SET_POSITION_TARGET_LOCAL_NED.z", "goal.z", "-", 20.0, "m", "mm"),
    ("pm.vbat", "battery.voltage", "", 100.0, "V", "mV"), ("battery", "battery.voltage", "", 100.0, "V", "mV"),
    ("quat.w", "cameras.qw", "", 1.0, "", ""), ("vicon.qx", "cameras.qx", "", 1.0, "", ""),
    ("q_z", "cameras.qz", "", 1.0, "", ""),
]  # fmt: skip


@pytest.mark.parametrize(("name", "column", "sign", "limit", "up_to", "beyond"), KNOWN)
def test_a_known_name_gives_its_column_in_the_unit_of_its_size(
    name: str, column: str, sign: str, limit: float, up_to: str, beyond: str
) -> None:
    for largest, unit in ((limit, up_to), (1.001 * limit, beyond)):
        joined = Joined(1e4 * np.arange(3), {name: np.array([0.0, -largest, np.nan])}, {name: ""}, "t [us]")
        assert guess(joined).columns == {
            "t": "t [us]",
            column: f"{sign}{name} [{unit}]" if unit else f"{sign}{name}",
        }
    stated = Joined(1e4 * np.arange(3), {name: np.full(3, np.nan)}, {name: ""}, "t [us]")
    assert guess(stated).columns[column] == (f"{sign}{name} [{up_to}]" if up_to else f"{sign}{name}")


@pytest.mark.parametrize(("others", "kept"), [(16, 16), (17, 1)])
def test_of_many_columns_only_those_that_change_are_kept(others: int, kept: int) -> None:
    columns = {f"a{number}": np.array([np.nan, 1.0, 1.0 + (number == 3)]) for number in range(others)}
    joined = Joined(1e4 * np.arange(3), columns, dict.fromkeys(columns, ""), "t [us]")
    assert len(guess(joined).columns) == 1 + kept
    assert joined.notes == (
        [] if kept == others else [f"{others - 1} further columns that do not change are left out"]
    )


def test_a_clock_from_the_release_releases_at_its_zero(tmp_path: Path) -> None:
    path = csv(tmp_path / "log.csv", {"time from the release [s]": T - 0.2, **place("x", "y", "z")})
    imported = import_log([path], tmp_path)
    assert imported.log.column("flight.free").to_numpy().tolist() == [0] * 10 + [1] * (ROWS - 10)
    texts = [f"imported from {path}", *imported.notes]
    assert load_events(tmp_path) == [{"t_us": 200_000, "source": "lab", "text": text} for text in texts]


@pytest.mark.parametrize("size", [0.89, 1.11])
def test_a_quaternion_is_of_unit_length_to_a_tenth(tmp_path: Path, size: float) -> None:
    def columns(scale: float) -> dict[str, Any]:
        scales = scale ** (np.arange(ROWS) > 5)  # the last rows
        return {f"q{part}": scales * QUATERNIONS[:, index] for index, part in enumerate("wxyz")}

    for scale in (0.91, 1.09):
        import_log(
            [csv(tmp_path / "log.csv", {"t": T, **place("x", "y", "z"), **columns(scale)})],
            tmp_path / f"{scale}",
        )
    with pytest.raises(LabError, match=f"a quaternion of length {size}; expected 1"):
        import_log(
            [csv(tmp_path / "log.csv", {"t": T, **place("x", "y", "z"), **columns(size)})], tmp_path / "wrong"
        )


def test_files_are_joined_on_the_rows_of_the_first(tmp_path: Path) -> None:
    first = csv(tmp_path / "a.csv", {"t": T, **place("x", "y", "z")})
    slow = {
        "x!": [2.0] * 4,
        "x?": [3.0] * 4,
        "Timestamp [ms]": [100.0, 400.0, 300.0, 500.0],
        "battery.voltage [mV]": [4000.0, 3900.0, 1.0, 3800.0],
        "x": [1.0] * 4,
    }
    done = import_log([first, csv(tmp_path / "b.csv", slow)], tmp_path)
    volts = done.log.column("battery.voltage").to_numpy()
    expected = np.select([T >= 0.5, T >= 0.4, T >= 0.1], [3.8, 3.9, 4.0], np.nan)
    assert volts == pytest.approx(expected, nan_ok=True)
    assert "1 row is left out: Timestamp does not advance there" in done.notes
    assert [done.log.column(f"robot.{name}").to_numpy()[-1] for name in ("x.2", "x_", "x__")] == [
        1.0,
        2.0,
        3.0,
    ]
    given = Map(columns={**done.map.columns, "t": "t [s]"})  # the clock of the first file
    again = import_log([first, tmp_path / "b.csv"], tmp_path / "again", given).log
    assert again.to_pydict().keys() == done.log.to_pydict().keys()


@pytest.mark.parametrize("version", [1, 2])
def test_a_micro_sd_log_is_read(version: int, tmp_path: Path) -> None:
    (tmp_path / "log00").write_bytes(micro_sd(version))
    log = import_log([tmp_path / "log00"], tmp_path).log
    assert log.column("t").to_numpy() == pytest.approx(1e6 * T, abs=1)
    assert log.column("cameras.z").to_numpy() == pytest.approx(PLACE[:, 2], abs=1e-6)
    assert log.column("robot.idA").to_numpy()[[4, 5, -1]] == pytest.approx([np.nan, 3, 3], nan_ok=True)


@pytest.mark.long
def test_an_mcap_file_of_ros_2_gives_pose_and_goal(cli: Cli, tmp_path: Path) -> None:
    assert cli("import", ros_bag(tmp_path / "bag.mcap"), "--out", tmp_path / "run") == 0
    log = load_run(tmp_path / "run").log
    assert np.allclose(np.diff(column(log, "t")), 10_000.0)
    assert np.allclose(column(log, "cameras.x"), 0.01 * np.arange(200))
    assert set(column(log, "goal.x")) == {0.5}
    assert column(log, "cameras.yaw")[0] == pytest.approx(2 * np.arcsin(0.6))
    assert "left out: /said" in cli.err
    assert not [name for name in log.column_names if "stamp" in name]


def test_the_topic_with_the_most_positions_comes_first_without_its_long_lists(tmp_path: Path) -> None:
    place = {"position": {"x": 1.0}}
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for topic, rows, message in (
            ("/said", 4, {"text": "ready"}), ("/a", 1, {"text": "ready"}), ("/a", 2, place),
            ("/b", 3, {**place, "few": [0] * 16, "many": [0] * 17}), ("/c", 9, {"gyro": 1.0}),
        ):  # fmt: skip
            channel = writer.register_channel(topic, "json", 0)
            for ns in range(rows):
                writer.add_message(channel, ns, json.dumps(message).encode(), ns)
        writer.finish()
    tables = read_tables(tmp_path / "a.mcap")
    assert [table.left_out for table in tables] == [("/said",), (), ()], "once, and none that had numbers"
    assert [len(table.columns["timestamp [ns]"]) for table in tables] == [3, 2, 9]
    assert [*tables[0].columns] == [
        "timestamp [ns]",
        "b.position.x",
        *(f"b.few.{number}" for number in range(16)),
    ]


def test_our_own_mcap_file_has_the_log_s_path_again(run: Run, tmp_path: Path) -> None:
    log = import_log([run.folder / "flight.mcap"], tmp_path).log
    for name in ("x", "y", "z", "qw", "qx", "qy", "qz"):
        assert column(log, f"cameras.{name}") == pytest.approx(column(run.log, f"truth.{name}"), abs=1e-6)


def test_every_kind_of_number_is_a_column_by_its_name_without_blanks(tmp_path: Path) -> None:
    columns = {" whole ": [1, 2], "part\t": [0.5, 1.5], "on": [True, False], "text": ["a", "b"]}
    stamps = {" when": pa.array([3, 4], pa.timestamp("us"))}
    pa.parquet.write_table(pa.table(columns | stamps), tmp_path / "log.parquet")
    (table,) = read_tables(tmp_path / "log.parquet")
    assert {name: values.tolist() for name, values in table.columns.items()} == {
        "whole": [1.0, 2.0], "part": [0.5, 1.5], "on": [1.0, 0.0], "when [ns]": [3000.0, 4000.0],
    }  # fmt: skip
    assert table.left_out == ("text",)


def test_parquet_with_time_stamps_is_read(tmp_path: Path) -> None:
    stamps = pa.array((1_700_000_000_000_000_000 + 1e9 * T).astype(np.int64), pa.timestamp("ns"))
    pa.parquet.write_table(pa.table({"time": stamps, **place("x", "y", "z")}), tmp_path / "log.parquet2")
    log = import_log([tmp_path / "log.parquet2"], tmp_path).log
    assert log.column("t").to_numpy() == pytest.approx(1e6 * T, abs=1)


GOOD = {"t": T, **place("x", "y", "z")}
FORMATS = "expected CSV, Parquet, MCAP, a tlog, or a Crazyflie's micro-SD log"


PLACES = "cameras.x, cameras.y, cameras.z"
BAD: Mapping[str, tuple[Mapping[str, Any] | bytes, str, str]] = {
    "no clock": ({name: GOOD[name] for name in "xyz"}, "", 'no column of times among x, y, z; name it in a map: t = "NAME'),
    "no place": ({"t": T, "thrust": T}, "", f'nothing gives {PLACES}; name it in a map: "cameras.x" = "NAME [m]"'),
    "no such column": (GOOD, '"cameras.x" = "xx"', "cameras.x = 'xx': no such column; did you mean x?"),
    "no unit of a clock": ({"t [min]": T, **place("x", "y", "z")}, "", "t = 't': unit 'min'; expected s, ms, us, µs, ns"),
    "no such unit": (GOOD, '"cameras.x" = "x [deg]"', "cameras.x = 'x': unit 'deg'; expected m, cm, mm"),
    "no unit": (GOOD, '"cameras.x" = "x"', "cameras.x = 'x': unit ''; expected m, cm, mm"),
    "a unit of none": (GOOD, '"cameras.qw" = "x [deg]"', "cameras.qw = 'x': unit 'deg'; expected none"),
    "no quaternion": ({**GOOD, "qw": T, "qx": T, "qy": T, "qz": T + 2}, "", "cameras.qw to qz: a quaternion of length"),
    "text": (b"t\nhello\n", "", f"no rows with numbers; {FORMATS}"),
    "binary": (b"\1\0\2", "", FORMATS),
    "empty": (b"", "", FORMATS),
    "ragged": (b"t,x,y,z\n1,2,3,4\n1,2\n1,2\n", "", "2 of 3 rows are torn: expected 4 columns, got 2: 1,2"),
    "half a Parquet": (b"PAR1abc", "", "damaged Parquet: "),
    "a changed micro-SD log": (micro_sd(2)[:-5] + b"12345", "", "a damaged micro-SD log: its checksum is wrong"),
    "half an MCAP file": (b"\x89MCAP0\r\n" + bytes(40), "", "damaged MCAP: "),
    "a newer micro-SD log": (micro_sd(3), "", "version 3 of the micro-SD log; expected 1 or 2"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_what_cannot_be_imported_is_one_line_and_leaves_nothing(name: str, cli: Cli, tmp_path: Path) -> None:
    content, mapped, reason = BAD[name]
    path, options = tmp_path / "log.csv", list[str | Path]()
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        csv(path, content)
    if mapped:
        rest = "".join(f'"cameras.{axis}" = "{axis} [m]"\n' for axis in "yz")
        (tmp_path / "map.toml").write_text(f'[columns]\nt = "t [s]"\n{rest}{mapped}\n', encoding="utf-8")
        options = ["--map", tmp_path / "map.toml"]
    assert cli("import", path, "--out", tmp_path / "run", *options) == 2
    assert f"floaty: {path}: {reason}" in cli.err
    assert cli.err.count("\n") == 1
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("colums = 1", "colums = 1: extra inputs are not permitted"),
        ('release_s = "soon"', "release_s = 'soon': input should be a valid number"),
        ("=", "invalid"),
        (None, "No such file"),
    ],
)
def test_a_wrong_map_is_refused(text: str | None, reason: str, tmp_path: Path) -> None:
    if text is not None:
        (tmp_path / "map.toml").write_text(text, encoding="utf-8")
    with pytest.raises(LabError) as told:
        Map.read(tmp_path / "map.toml")
    assert str(told.value).startswith(f"--map {tmp_path / 'map.toml'}: ")
    assert reason.lower() in str(told.value).lower()


@pytest.mark.long
def test_an_imported_run_without_attitude_is_shown_compared_and_exported(
    run: Run, cli: Cli, tmp_path: Path
) -> None:
    path, folder = csv(tmp_path / "log.csv", GOOD), tmp_path / "run"
    assert cli("import", path, "--out", folder) == 0
    assert 'class="verdict' not in (folder / "report.html").read_text(encoding="utf-8")
    assert cli("export", folder, "--csv", "--mcap") == 0
    assert recording_of(folder).is_file()
    assert cli("compare", run.folder, folder) == 1
    assert "distance" in cli.out
    assert cli("import", path, "--out", folder) == 2
    assert "exists and is not empty" in cli.err
    events = [json.loads(line) for line in (folder / "events.jsonl").read_text(encoding="utf-8").splitlines()]
    assert events[0]["text"] == f"imported from {path}"
