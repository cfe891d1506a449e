"""Exports of a flight that looks along 180 degrees, with gaps: a log of a few rows whose every number is known."""

import json
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
from hil.exports.mcap import write_mcap
from hil.exports.tlog import write_tlog

ROWS, RELEASE_US = 201, 1_500_000
GOAL = (0.5, -0.25, 1.25, np.radians(179.0))
ESTIMATE = {"x": 0.03, "y": -0.02, "z": 0.01, "vx": 0.4, "vy": -0.3, "vz": 0.2, "p": 0.1, "q": 0.2, "r": 0.3}


def turning() -> NDArray[np.float64]:
    """The yaw of the estimate against the goal, through 180 degrees of the world."""
    return np.radians(np.linspace(-5.0, 5.0, ROWS))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
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
    columns |= {"supervisor.state": np.full(ROWS, 2, np.int8), "battery.voltage": zero + 3.95}
    columns["wind.gust"] = np.array([0.5, np.nan, np.inf, -np.inf, *[1.5] * (ROWS - 4)])
    table = pa.table(columns).replace_schema_metadata({b"release_us": str(RELEASE_US).encode()})
    pq.write_table(table, tmp_path / "log.parquet")
    return tmp_path


def wrapped(angle: Any) -> Any:
    return np.angle(np.exp(1j * np.asarray(angle)))


def test_a_telemetry_log_has_the_estimate_in_the_world_with_yaw_within_half_a_turn(folder: Path) -> None:
    said: dict[str, list[Any]] = {}
    with closing(mavutil.mavlink_connection(str(write_tlog(folder)))) as link:
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
    pulses = said["SERVO_OUTPUT_RAW"][0]
    assert [getattr(pulses, f"servo{servo}_raw") for servo in (1, 2, 3, 4)] == [1401, 1402, 1403, 1404]


def test_an_mcap_file_has_a_gap_where_there_is_no_number_and_angles_in_their_order(folder: Path) -> None:
    found: dict[str, list[tuple[int, Any]]] = {}
    with write_mcap(folder).open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            content = (
                json.loads(message.data)
                if channel.message_encoding == "json"
                else DecoderFactory().decoder_for("protobuf", schema)(message.data)  # type: ignore[misc]
            )
            found.setdefault(channel.topic, []).append((message.log_time, content))
    gusts = [content["wind_gust"] for _, content in found["/wind"]]
    assert gusts == [0.5, None, None, None, *[1.5] * (ROWS - 4)]
    (time_ns, first), *_ = found["/estimate/pose"]
    assert first.timestamp.ToNanoseconds() == time_ns == 1_234_567_000
    for row, (_, message) in enumerate(found["/estimate/pose"]):
        q = message.pose.orientation
        angles = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_euler("ZYX")
        assert angles == pytest.approx([turning()[row], -0.2, 0.1], abs=1e-9)
