"""Exports: what other programs read of a flight is what its log holds; read back with those programs' own libraries."""

import csv
import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from numpy.typing import NDArray
from pymavlink import mavutil
from scipy.spatial.transform import Rotation

from firmware_py.geometry import from_euler_zyx
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import load_events, load_log, release_of
from hil.laboratory.metrics import column
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.pictures.exports.mcap import write_mcap
from hil.pictures.exports.tlog import write_tlog
from hil.pictures.exports.wide_csv import write_csv
from support.command import Cli


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with the step in yaw, 1 s after the release, until the robot has turned."""
    folder = tmp_path_factory.mktemp("export") / "run"
    fly(Request.of(EXPERIMENTS["yaw-step"], duration_s=1.6), folder)
    return folder


@pytest.mark.long
def test_the_wide_table_has_every_column_with_its_unit_in_seconds_from_the_release(folder: Path) -> None:
    log = load_log(folder)
    with write_csv(folder).open(newline="") as file:
        header, *rows = csv.reader(file)
    assert header[0] == "time from the release [s]"
    assert {"truth.x [m]", "truth.p [rad/s]", "battery.voltage [V]", "supervisor.state []"} < set(header)
    assert len(header) == log.num_columns
    table = np.array(rows, float)
    release_us = release_of(log.schema.metadata)
    assert table[:, 0] == pytest.approx(1e-6 * (column(log, "t") - release_us), abs=1e-9)
    assert table[0, 0] < 0 < table[-1, 0]
    for title, values in zip(header[1:], table.T[1:], strict=True):
        assert values == pytest.approx(column(log, title.partition(" [")[0]), rel=1e-6), title


def messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Time [us] and content of everything in an MCAP file, by topic; every topic has a schema."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                content = json.loads(message.data)
                properties = json.loads(schema.data)["properties"]
                assert content.keys() == properties.keys(), channel.topic
            else:
                content = DecoderFactory().decoder_for("protobuf", schema)(message.data)
                assert schema.name.startswith("foxglove.")
            found.setdefault(channel.topic, []).append((message.log_time // 1000, content))
    return found


@pytest.fixture(scope="module")
def found(folder: Path) -> dict[str, list[tuple[int, Any]]]:
    """The messages of the flight's MCAP file."""
    return messages(write_mcap(folder))


def test_foxglove_reads_every_row_with_its_type_and_its_time(
    folder: Path, found: dict[str, list[tuple[int, Any]]]
) -> None:
    log = load_log(folder)
    times = log.column("t").to_pylist()
    poses = {"/truth/pose", "/goal/pose", "/estimate/pose", "/tf"}
    assert poses | {"/truth/twist", "/estimate/twist", "/flaps", "/link", "/text", "/battery"} <= found.keys()
    for topic, said in found.items():
        if topic != "/text":
            assert [us for us, _ in said] == times, topic
    truth = [one.pose for _, one in found["/truth/pose"]]
    assert [[p.position.x, p.position.y, p.position.z] for p in truth] == pytest.approx(
        column(log, "truth.x", "truth.y", "truth.z")
    )
    assert [
        [p.orientation.w, p.orientation.x, p.orientation.y, p.orientation.z] for p in truth
    ] == pytest.approx(column(log, "truth.qw", "truth.qx", "truth.qy", "truth.qz"))
    assert {one.frame_id for _, one in found["/estimate/pose"]} == {"goal"}
    assert found["/truth/pose"][-1][1].timestamp.ToMicroseconds() == times[-1]
    assert [one["truth_p"] for _, one in found["/truth/twist"]] == pytest.approx(column(log, "truth.p"))
    assert [one["control_flap_2"] for _, one in found["/flaps"]] == pytest.approx(
        column(log, "control.flap_2")
    )
    texts = [(us, one.name, one.message) for us, one in found["/text"]]
    assert texts == [(event["t_us"], event["source"], event["text"]) for event in load_events(folder)]


def test_numbers_of_an_mcap_file_cover_the_log_and_name_unit_and_frame(folder: Path) -> None:
    log, path = load_log(folder), write_mcap(folder)
    described: dict[str, str] = {}
    types: dict[str, Any] = {}
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        for schema in summary.schemas.values():
            if schema.encoding == "jsonschema":
                properties = json.loads(schema.data)["properties"]
                described |= {name: one["description"] for name, one in properties.items()}
                types |= {name: one["type"] for name, one in properties.items()}
    whole = {field.name.replace(".", "_") for field in log.schema if pa.types.is_integer(field.type)}
    assert {name for name, kind in types.items() if kind == "integer"} == whole - {"t"}
    assert described["estimate_flap_1"] == "rad, frame B, from the hover angle"
    assert described["battery_charge"] == "no unit"
    assert described["truth_vx"] == "m/s, frame W"
    assert described["battery_voltage"] == "V"
    in_poses = {name.replace(".", "_") for name in log.column_names} - described.keys()
    assert all(name == "t" or name.startswith(("truth_", "goal_", "estimate_")) for name in in_poses)
    assert len(in_poses) == 1 + 7 + 4 + 6


def test_frames_lead_from_the_world_to_the_estimate(found: dict[str, list[tuple[int, Any]]]) -> None:
    _, last = found["/tf"][-1]
    assert [(one.parent_frame_id, one.child_frame_id) for one in last.transforms] == [
        ("world", "body"), ("world", "goal"), ("goal", "estimate"),
    ]  # fmt: skip
    body, goal, estimate = last.transforms

    def turned(one: Any) -> Rotation:
        q = one.rotation
        return Rotation.from_quat([q.x, q.y, q.z, q.w])

    assert abs(turned(goal).as_euler("ZYX")[0]) > 1.0, "the goal has turned"
    miss = (turned(body).inv() * turned(goal) * turned(estimate)).magnitude()
    assert miss < np.radians(8.0), "the estimate is near the truth"


@pytest.mark.long
def test_pymavlink_reads_the_flight_in_the_world_s_frame(folder: Path) -> None:
    log = load_log(folder)
    said: dict[str, list[Any]] = {}
    with closing(mavutil.mavlink_connection(str(write_tlog(folder)))) as link:
        while (message := link.recv_match()) is not None:
            assert message.get_type() != "BAD_DATA"
            said.setdefault(message.get_type(), []).append(message)
    times = column(log, "t")[::2]
    assert [one._timestamp for one in said["ATTITUDE"]] == pytest.approx(1e-6 * times, abs=1e-6)
    yaw = Rotation.from_quat(column(log, "truth.qx", "truth.qy", "truth.qz", "truth.qw")).as_euler("ZYX")[
        ::2, 0
    ]
    assert np.ptp(yaw) > 1.0
    flown = np.array([-one.yaw for one in said["ATTITUDE"]])
    jump_us = column(log, "t")[np.argmax(np.diff(column(log, "goal.yaw"), prepend=0.0))]
    told = (times < jump_us) | (times >= jump_us + 50_000)  # until then the board has not heard of the goal
    assert np.abs(np.angle(np.exp(1j * (flown - yaw))))[told].max() < np.radians(8.0)
    assert np.array([[one.x, -one.y, -one.z] for one in said["LOCAL_POSITION_NED"]]) == pytest.approx(
        column(log, "truth.x", "truth.y", "truth.z")[::2], abs=0.03
    )
    mocap = said["ATT_POS_MOCAP"]
    assert np.array([[one.x, -one.y, -one.z] for one in mocap]) == pytest.approx(
        column(log, "truth.x", "truth.y", "truth.z")[::2], abs=1e-6
    )
    assert {one.get_srcSystem() for one in mocap} == {255}
    assert "released" in [one.text for one in said["STATUSTEXT"]]
    assert len(said["SET_POSITION_TARGET_LOCAL_NED"]) == 2, "before and after the step"
    assert said["SET_POSITION_TARGET_LOCAL_NED"][-1].yaw == pytest.approx(-np.radians(110.0), abs=1e-4)
    pulses = [one.servo1_raw for one in said["SERVO_OUTPUT_RAW"]]
    assert pulses == pytest.approx(column(log, "motor.m1")[::2] / 21, abs=1.0)


@pytest.mark.parametrize("write", [write_csv, write_mcap, write_tlog])
def test_a_killed_run_is_exported(folder: Path, tmp_path: Path, write: Callable[[Path], Path]) -> None:
    log = load_log(folder)
    with pa.ipc.new_stream(str(tmp_path / "log.arrows"), log.schema) as stream:
        stream.write_table(log.slice(0, 100))
    assert write(tmp_path).stat().st_size > 1000


def test_the_command_writes_what_was_asked_for_and_asks_when_nothing_was(cli: Cli, folder: Path) -> None:
    for path in folder.glob("flight.*"):
        path.unlink()
    assert cli("export", folder, "--csv", "--tlog") == 0
    assert {path.name for path in folder.glob("flight.*")} == {"flight.csv", "flight.tlog"}
    assert cli("export", folder, "--mcap") == 0
    assert (folder / "flight.mcap").is_file()
    assert "--csv, --mcap, --tlog, --video, --gif" in cli.refusal("export", folder)


# A flight that looks along 180 degrees, with gaps: a log of a few rows whose every number is known

ROWS, RELEASE_US = 201, 1_500_000
GOAL = (0.5, -0.25, 1.25, np.radians(179.0))
ESTIMATE = {"x": 0.03, "y": -0.02, "z": 0.01, "vx": 0.4, "vy": -0.3, "vz": 0.2, "p": 0.1, "q": 0.2, "r": 0.3}


def turning() -> NDArray[np.float64]:
    """The yaw of the estimate against the goal, through 180 degrees of the world."""
    return np.radians(np.linspace(-5.0, 5.0, ROWS))


@pytest.fixture
def turning_run(tmp_path: Path) -> Path:
    yaw, zero = turning(), np.zeros(ROWS)
    columns: dict[str, Any] = {"t": 1_234_567 + 10_000 * np.arange(ROWS)}
    for name, value in zip(("x", "y", "z", "yaw"), GOAL, strict=True):
        columns[f"goal.{name}"] = zero + value
    columns |= {f"estimate.{name}": zero + value for name, value in ESTIMATE.items()}
    columns |= {"estimate.roll": zero + 0.1, "estimate.pitch": zero - 0.2, "estimate.yaw": yaw}
    q = np.array([from_euler_zyx(0.1, -0.2, GOAL[3] + angle) for angle in yaw.tolist()])
    columns |= {f"truth.q{part}": q[:, index] for index, part in enumerate("wxyz")}
    columns |= {f"truth.{axis}": zero + 0.1 * number for number, axis in enumerate("xyz")}
    columns |= {f"motor.m{servo}": np.full(ROWS, 21 * (1400 + servo)) for servo in (1, 2, 3, 4)}
    state = np.repeat([1, 2, 3], (50, 100, ROWS - 150)).astype(np.int8)
    columns |= {"supervisor.state": state, "battery.voltage": zero + 3.95}
    columns["wind.gust"] = np.array([0.5, np.nan, np.inf, -np.inf, *[1.5] * (ROWS - 4)])
    table = pa.table(columns).replace_schema_metadata({b"release_us": str(RELEASE_US).encode()})
    pq.write_table(table, tmp_path / "log.parquet")
    return tmp_path


def wrapped(angle: Any) -> Any:
    return np.angle(np.exp(1j * np.asarray(angle)))


def test_a_telemetry_log_has_the_estimate_in_the_world_with_yaw_within_half_a_turn(turning_run: Path) -> None:
    said: dict[str, list[Any]] = {}
    with closing(mavutil.mavlink_connection(str(write_tlog(turning_run)))) as link:
        while (message := link.recv_match()) is not None:
            said.setdefault(message.get_type(), []).append(message)
    yaw = np.array([-one.yaw for one in said["ATTITUDE"]])  # z down
    assert np.abs(yaw).max() < np.pi + 1e-6  # float32
    assert np.ptp(np.sign(yaw)) == 2, "it crosses half a turn"
    assert wrapped(yaw - GOAL[3] - turning()[::2]) == pytest.approx(np.zeros(len(yaw)), abs=1e-5)
    turn = Rotation.from_euler("z", GOAL[3])
    place, velocity = (
        turn.apply([ESTIMATE[name] for name in names]) for names in (("x", "y", "z"), ("vx", "vy", "vz"))
    )
    one = said["LOCAL_POSITION_NED"][0]
    assert (one.x, -one.y, -one.z) == pytest.approx(tuple(np.array(GOAL[:3]) + place), abs=1e-5)
    assert (one.vx, -one.vy, -one.vz) == pytest.approx(tuple(velocity), abs=1e-5)
    assert {one.voltages[0] for one in said["BATTERY_STATUS"]} == {3950}
    first_us = round(1e6 * said["ATTITUDE"][0]._timestamp)
    assert [round(1e6 * one._timestamp) - first_us for one in said["HEARTBEAT"]] == [0, 1_000_000, 2_000_000]
    armed = [bool(one.base_mode & mavutil.mavlink.MAV_MODE_FLAG_SAFETY_ARMED) for one in said["HEARTBEAT"]]
    assert armed == [False, True, False], "while it flies"
    pulses = said["SERVO_OUTPUT_RAW"][0]
    assert [getattr(pulses, f"servo{servo}_raw") for servo in (1, 2, 3, 4)] == [1401, 1402, 1403, 1404]


def test_a_telemetry_log_has_each_goal_once_when_it_changes(turning_run: Path, tmp_path: Path) -> None:
    log = load_log(turning_run)
    moved = pa.array([0.1 * (row // 20) for row in range(ROWS)])
    index = log.column_names.index("goal.x")
    pq.write_table(log.set_column(index, log.schema.field(index), moved), tmp_path / "log.parquet")
    with closing(mavutil.mavlink_connection(str(write_tlog(tmp_path)))) as link:
        goals = [*iter(lambda: link.recv_match(type="SET_POSITION_TARGET_LOCAL_NED"), None)]
    assert [one.x for one in goals] == pytest.approx(sorted({*moved.to_pylist()}))


def test_an_mcap_file_has_a_gap_where_there_is_no_number_and_angles_in_their_order(turning_run: Path) -> None:
    found = messages(write_mcap(turning_run))
    gusts = [content["wind_gust"] for _, content in found["/wind"]]
    assert gusts == [0.5, None, None, None, *[1.5] * (ROWS - 4)]
    (time_us, first), *_ = found["/estimate/pose"]
    assert first.timestamp.ToMicroseconds() == time_us == 1_234_567
    for row, (_, message) in enumerate(found["/estimate/pose"]):
        q = message.pose.orientation
        angles = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("ZYX")
        assert angles == pytest.approx([turning()[row], -0.2, 0.1], abs=1e-9)


@pytest.mark.long
def test_an_mcap_file_has_only_the_frames_that_are_known(turning_run: Path) -> None:
    log = load_log(turning_run)
    names = [name for name in log.column_names if not name.startswith("estimate.")]
    pq.write_table(log.select(names), turning_run / "log.parquet")
    found = messages(write_mcap(turning_run))
    assert "/estimate/pose" not in found
    assert {tuple(sent.child_frame_id for sent in one.transforms) for _, one in found["/tf"]} == {
        ("body", "goal")
    }
