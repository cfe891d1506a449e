"""Faults: what a text means, that every kind acts from its begin to its end, and what the hover makes of it."""

import json
import math
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS, Experiment
from hil.laboratory.fault_kinds import KINDS, MARKERS_ON
from hil.laboratory.faults import SWITCHED_ON, Fault, check, parse, spans_of, switched_on, why_not
from hil.laboratory.files.recorder import load_events, load_log
from hil.laboratory.files.result import Result, read_result
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.metrics import column
from hil.laboratory.request import MAVLINK, RADIO, Request
from hil.laboratory.run import fly
from hil.pictures.curves import since_release
from hil.pictures.report import write_report
from support.command import Cli
from support.flights import hover

HOVER = EXPERIMENTS["hover"]
OF_FLOATY = {name: kind for name, kind in KINDS.items() if kind.body in ("", "floaty")}
Settings = tuple[str, ...]


def settings_for(fault: str) -> Settings:
    """What a flight must be told for a fault to act in it."""
    return (MARKERS_ON,) if KINDS[parse(fault).kind].markers else ()


RELEASE_S = load_config().flight.release_us * 1e-6


def go(
    folder: Path, *faults: str, settings: Settings = (), duration_s: float = 3.0, **options: Any
) -> Result:
    return hover(folder, *settings, faults=faults, duration_s=duration_s, **options)


# What a text means


def test_a_text_gives_kind_start_duration_and_size() -> None:
    assert parse("mocap.dropout@10:0.5") == Fault("mocap.dropout", 10.0, 0.5, 1.0)
    assert parse("mocap.outlier@10:0.5=0.3") == Fault("mocap.outlier", 10.0, 0.5, 0.3)
    assert parse(" servo.stuck.2@5 ") == Fault("servo.stuck.2", 5.0, math.inf, 0.0)
    assert parse("push.y@1e1=-2") == Fault("push.y", 10.0, 0.1, -2.0)
    assert parse("push.y@1:inf") == Fault("push.y", 1.0, math.inf, 2.0)


@pytest.mark.long
@given(st.data())
def test_a_fault_reads_back_from_its_text(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(KINDS)))
    kind = KINDS[name]
    fault = Fault(
        name,
        data.draw(st.floats(0, 1e6)),
        data.draw(st.floats(1e-6, 1e6) | st.just(math.inf)),
        data.draw(st.floats(kind.low, kind.high)),
    )
    assert parse(str(fault)) == fault


def test_every_default_is_a_size_that_its_kind_allows() -> None:
    for name in KINDS:
        assert str(parse(f"{name}@1")).startswith(f"{name}@1")


@pytest.mark.parametrize("link", ["radio", "udp://127.0.0.1:19850", "radio://0/80/2M/E7E7E7E7E7", MAVLINK])
def test_faults_of_a_link_act_on_that_link_alone_and_those_of_markers_on_all(link: str) -> None:
    own, other = ("serial", "radio") if link == MAVLINK else ("radio", "serial")
    check([parse(f"{own}.cut@1")], 3.0, link, load_config())
    with pytest.raises(LabError, match=f"acts with --link {'radio' if link == MAVLINK else 'mavlink'} only"):
        check([parse(f"{other}.cut@1")], 3.0, link, load_config())
    check([parse("marker.swap@1")], 3.0, link, load_config(overrides=[MARKERS_ON]))


# Every kind acts from its begin to its end and no longer

BEGIN_S = 0.5  # after the release
GYRO_LSB = 2000 / 32768  # [deg/s], data sheet
Seen = Callable[[pa.Table, pa.Table], float]  # (rows with the fault, the same rows of a flight without)


def _grown(*names: str) -> Seen:
    return lambda rows, _: float(sum(column(rows, name)[-1] - column(rows, name)[0] for name in names))


def _mean_of(name: str, scale: float = 1.0) -> Seen:
    """The mean of a quantity less that of the flight without the fault."""
    return lambda rows, without: scale * float(np.mean(column(rows, name)) - np.mean(column(without, name)))


def _gyro(rows: pa.Table) -> NDArray[np.float64]:
    """What the gyro says less the truth, p q r [deg/s]; S lies as the author's firmware mounts it."""
    gx, gy, gz = (GYRO_LSB * column(rows, f"imu.{name}") for name in ("gx", "gy", "gz"))
    told = np.stack((0.7071 * (gx + gy), 0.7071 * (gy - gx), gz), axis=1)
    return np.asarray(told - np.degrees(column(rows, "truth.p", "truth.q", "truth.r")))


def _gyro_bias(axis: int) -> Seen:
    return lambda rows, without: float((_gyro(rows) - _gyro(without)).mean(axis=0)[axis])


def _gyro_noise(rows: pa.Table, _: pa.Table) -> float:
    return float(_gyro(rows).std())


def _gyro_reach(rows: pa.Table, _: pa.Table) -> float:
    return float(np.abs(GYRO_LSB * column(rows, "imu.gx", "imu.gy", "imu.gz")).max())


def _imu_changes(rows: pa.Table, _: pa.Table) -> float:
    names = ("gx", "gy", "gz", "ax", "ay", "az")
    return float(np.ptp(column(rows, *(f"imu.{name}" for name in names)), axis=0).min())


def _flap_moves(number: int) -> Seen:
    return lambda rows, _: math.degrees(np.ptp(column(rows, f"truth.flap_{number}")))


def _flap_off(number: int) -> Seen:
    return lambda rows, _: math.degrees(
        np.mean(column(rows, f"truth.flap_{number}") - column(rows, f"control.flap_{number}"))
    )


def _flap_speed(number: int) -> Seen:
    """Pace of a servo: flap rate over the error that it follows, relative to that without the fault."""

    def pace(rows: pa.Table) -> float:
        flap, told = column(rows, f"truth.flap_{number}"), column(rows, f"control.flap_{number}")
        error = (told - flap)[:-1]
        return float(error @ np.diff(flap) / (error @ error))

    return lambda rows, without: pace(rows) / pace(without)


def _flow_ratio(rows: pa.Table, without: pa.Table) -> float:
    return float(column(rows, "flow.z").mean() / column(without, "flow.z").mean())


def _gust_ratio(rows: pa.Table, without: pa.Table) -> float:
    fast, plain = (np.diff(column(table, "flow.x")).std() for table in (rows, without))
    return float(fast / plain)


def _impulse(name: str) -> Seen:
    """What was gained over the window, against the flight without the fault."""

    def gained(rows: pa.Table) -> float:
        return float(column(rows, name)[-1] - column(rows, name)[0])

    return lambda rows, without: gained(rows) - gained(without)


def _markers_seen(rows: pa.Table, _: pa.Table) -> float:
    bits = column(rows, "markers.visible").astype(np.int64)
    return float((bits[:, None] >> np.arange(8) & 1).sum(axis=1).mean())


def _mean(name: str, scale: float = 1.0) -> Seen:
    return lambda rows, _: float(scale * column(rows, name).mean())


def _latency(rows: pa.Table, without: pa.Table) -> float:
    """Mean time in the air upwards [ms], less that without."""

    def mean(table: pa.Table) -> float:
        return _grown("link.up_latency_sum")(table, table) / _grown("link.up_delivered")(table, table)

    return (mean(rows) - mean(without)) * 1e-3


@dataclass(frozen=True)
class Sign:
    """By what a fault is known: bounds of a figure in a window [s] after its begin, and in the same after its end."""

    fault: str
    seen: Seen
    during: tuple[float, float]
    after: tuple[float, float]
    window: tuple[float, float] = (0.15, 0.95)

    @property
    def duration_s(self) -> float:
        return round(self.window[1] + 0.05, 2)


NONE = (-0.5, 0.5)
WHITE = math.degrees(0.02) * math.sqrt(10)  # [deg/s] of one gyro sample, see [imu]
MASS, INERTIA = 0.340, (1.30e-3, 1.30e-3, 1.47e-3)  # docs/explanation/plant.md, Plates
FIRST = (-0.005, 0.015)  # the first 10 ms
SIGNS = [
    Sign("mocap.dropout", _grown("link.up_sent"), (0, 0), (38, 41)),
    Sign("mocap.outlier", _grown("tracker.refused"), (28, 28), (0, 0), (0.1, 0.25)),
    Sign("mocap.swap", _grown("tracker.refused"), (28, 28), (0, 0), (0.15, 0.3)),
    Sign("mocap.freeze", _grown("link.up_sent"), (0, 0), (38, 41)),
    Sign("mocap.latency=20", _mean_of("estimator.pose_age_us", 1e-3), (19.5, 20.5), (-1.5, 1.5)),
    Sign("marker.hidden", _markers_seen, (4, 4), (8, 8)),
    Sign("marker.swap", _mean("markers.error", 1e3), (97, 100), (1.4, 1.7), (0.1, 0.25)),
    Sign("marker.noise", _mean("markers.error", 1e3), (2.8, 3.3), (1.4, 1.7)),
    Sign("marker.ghosts", _mean("markers.unlabelled"), (5, 5), (0, 0)),
    Sign("radio.loss", _grown("link.retried"), (60, 1000), (0, 20)),
    Sign("radio.uplink_loss", _latency, (1.0, 2.5), (-0.3, 0.3)),
    Sign("radio.downlink_loss", _latency, (0.3, 0.95), (-0.3, 0.3)),
    Sign("radio.bit_errors", _grown("link.retried"), (30, 1000), (0, 20)),
    Sign("radio.jitter", _latency, (6.0, 9.0), (-0.5, 0.5)),
    Sign("radio.cut", _grown("link.up_delivered", "link.down_delivered"), (0, 0), (60, 500)),
    Sign("serial.bit_errors", _grown("serial.wrong_bits"), (3, 60), (0, 0)),
    Sign("serial.cut", _grown("serial.cut"), (2000, 1e5), (0, 0)),
    *(Sign(f"imu.bias.{name}", _gyro_bias(axis), (4.5, 5.5), NONE) for axis, name in enumerate("pqr")),
    Sign("imu.noise", _gyro_noise, (0.9 * 10 * WHITE, 1.1 * 10 * WHITE), (WHITE, 1.8 * WHITE)),
    Sign("imu.saturation=3", _gyro_reach, (2.9, 3.1), (6, 200)),
    *(Sign(f"imu.{kind}", _imu_changes, (0, 0), (10, 10_000)) for kind in ("freeze", "silent")),
    *(Sign(f"servo.stuck.{n}", _flap_moves(n), (0, 1e-9), (2, 60)) for n in (1, 2, 3, 4)),
    *(Sign(f"servo.slow.{n}=0.2", _flap_speed(n), (0.15, 0.25), (0.9, 1.1)) for n in (1, 2, 3, 4)),
    *(Sign(f"servo.trim.{n}", _flap_off(n), (3.5, 6.5), (-1.5, 1.5)) for n in (1, 2, 3, 4)),
    Sign("wind.side_x", _mean_of("flow.x"), (0.2, 0.3), (-0.1, 0.1)),
    Sign("wind.side_y", _mean_of("flow.y"), (1.9, 2.1), (-0.1, 0.1)),
    Sign("wind.fan=0.97", _flow_ratio, (0.965, 0.98), (0.99, 1.02)),
    Sign("wind.occlusion=0.05", _flow_ratio, (0.94, 0.965), (0.985, 1.03)),
    Sign("wind.gusts", _gust_ratio, (1.8, 2.2), (0.85, 1.15)),
    Sign("push.x=1", _impulse("truth.vx"), (0.009 / MASS, 0.011 / MASS), (-0.01, 0.01), FIRST),
    Sign("push.y=-1", _impulse("truth.vy"), (-0.011 / MASS, -0.009 / MASS), (-0.01, 0.01), FIRST),
    Sign("push.z=1", _impulse("truth.vz"), (0.009 / MASS, 0.011 / MASS), (-0.01, 0.01), FIRST),
    *(
        Sign(f"push.{name}=0.005", _impulse(f"truth.{rate}"), (3e-5 / inertia, 6e-5 / inertia), (-9, 9), FIRST)
        for name, rate, inertia in zip(("roll", "pitch", "yaw"), "pqr", INERTIA, strict=True)
    ),
    Sign("cpu.load", _grown("cpu.THIEF"), (236_000, 244_000), (0, 0)),
]  # fmt: skip


@cache
def without_fault(link: str, settings: Settings) -> pa.Table:
    """The log of the flight to compare with; in memory only, as are those with a fault."""
    return fly_for_log(link, settings)


def fly_for_log(link: str, settings: Settings, *faults: str) -> pa.Table:
    with tempfile.TemporaryDirectory() as folder:
        go(Path(folder) / "run", *faults, duration_s=2.6, link=link, settings=settings)
        return load_log(Path(folder) / "run").combine_chunks()


def rows_between(table: pa.Table, begin_s: float, end_s: float) -> pa.Table:
    times = column(table, "t") * 1e-6 - RELEASE_S
    return table.filter((times >= begin_s) & (times < end_s))


@pytest.mark.long
@pytest.mark.parametrize("sign", SIGNS, ids=lambda sign: sign.fault)
def test_a_fault_acts_from_its_begin_to_its_end(sign: Sign) -> None:
    name, _, size = sign.fault.partition("=")
    link = KINDS[name].link or RADIO
    fault = f"{name}@{BEGIN_S}:{sign.duration_s}" + (f"={size}" if size else "")
    settings = settings_for(fault)
    log, without = fly_for_log(link, settings, fault), without_fault(link, settings)
    truth = [name for name in without.column_names if name.startswith(("truth", "flow"))]
    before = (-RELEASE_S, BEGIN_S + 0.001)  # with the row at the begin: nothing acts backwards
    assert rows_between(log, *before).select(truth).equals(rows_between(without, *before).select(truth))
    for start_s, (low, high) in ((BEGIN_S, sign.during), (BEGIN_S + sign.duration_s, sign.after)):
        window = (start_s + sign.window[0], start_s + sign.window[1])
        figure = sign.seen(rows_between(log, *window), rows_between(without, *window))
        assert low <= figure <= high, f"{figure}, from {start_s} s on"


@pytest.mark.long
def test_the_station_names_frozen_frames(tmp_path: Path) -> None:
    go(tmp_path / "run", "mocap.freeze@0.2:0.3", duration_s=1.2)
    lines = [event["text"] for event in load_events(tmp_path / "run") if event["source"] == "station"]
    assert lines == ["motion capture: 58 poses unusable: the system repeats one pose"]  # 60 frames less two


def test_every_kind_has_a_sign() -> None:
    known = {sign.fault.partition("=")[0] for sign in SIGNS}
    assert known | {"battery.sag"} == set(
        OF_FLOATY
    )  # see below; the Crazyflie's: tests/hil/world/test_quadrotor.py


@pytest.mark.long
def test_a_sagging_battery_is_what_the_board_reads() -> None:
    flight = lockstep_flight(Request.of(HOVER, duration_s=3.0, faults=[parse("battery.sag@1:1=0.5")]))
    read: list[int] = []
    for moment_us in (1_999_000, 2_050_000, 2_999_000, 3_050_000):
        flight.events.at(moment_us, lambda _: read.append(flight.robot.board.read_battery_mv()))
    flight.run()
    before, *sagging, after = read
    assert sagging == pytest.approx([before - 500] * 2, abs=80)  # the flaps' load comes and goes
    assert after == pytest.approx(before, abs=80)


# Several faults


@pytest.mark.long
def test_faults_on_one_knob_add_up_and_leave_it_as_it_was() -> None:
    texts = [
        "wind.side_y@0.2:0.6=1",
        "wind.side_y@0.4:0.6=2",
        "servo.slow.1@0.2:0.6",
        "servo.stuck.1@0.4:0.1",
    ]
    settings = ["tunnel.side_wind=[0.1, 0.2, 0.3]", "actuators.speed=[0.8, 1, 1, 1]"]
    flight = lockstep_flight(Request.of(HOVER, overrides=settings, duration_s=2.0, faults=texts))
    wind: list[float] = []
    pace: list[float] = []

    def look(_: int) -> None:
        wind.append(flight.robot.body.tunnel.side_wind[1])
        pace.append(float(flight.robot.body.servo_speed[0]))

    for moment in (0.1, 0.3, 0.45, 0.7, 0.9, 1.1):
        flight.events.at(flight.release_us + round(moment * 1e6), look)
    flight.run()
    assert wind == pytest.approx([0.2, 1.2, 3.2, 3.2, 2.2, 0.2])
    assert pace == pytest.approx([0.8, 0.4, 0.0, 0.4, 0.8, 0.8])
    assert flight.robot.body.tunnel.side_wind == (0.1, 0.2, 0.3)


DEG5 = math.radians(5.0)
ACTS: dict[str, dict[str, object]] = {  # what each fault changes, and the value from rest
    "mocap.dropout": {"mocap.dropout": 1.0}, "mocap.outlier": {"mocap.wrong_by": 0.3},
    "mocap.swap": {"mocap.swapped_by": 0.1}, "mocap.freeze": {"mocap.frozen": 1.0},
    "mocap.latency": {"mocap.more_latency_us": 40_000.0},
    "marker.hidden": {"mocap.markers.hidden": 4.0}, "marker.swap": {"mocap.markers.swapped": 1.0},
    "marker.noise": {"mocap.markers.noise_scale": 2.0}, "marker.ghosts": {"mocap.markers.ghosts": 5.0},
    "radio.loss": {"air.uplink_loss": 0.5, "air.downlink_loss": 0.5}, "radio.uplink_loss": {"air.uplink_loss": 0.5},
    "radio.downlink_loss": {"air.downlink_loss": 0.5}, "radio.cut": {"air.uplink_loss": 1.0, "air.downlink_loss": 1.0},
    "radio.bit_errors": {"air.uplink_bit_error_rate": 1e-3, "air.downlink_bit_error_rate": 1e-3},
    "radio.jitter": {"air.uplink_jitter_us": 15_000.0}, "serial.cut": {"uart.connected": 0.0},
    "serial.bit_errors": {"uart.uplink_bit_error_rate": 1e-4, "uart.downlink_bit_error_rate": 1e-4},
    **{f"imu.bias.{name}": {"imu.rate_bias": DEG5 * np.eye(3)[axis]} for axis, name in enumerate("pqr")},
    "imu.noise": {"imu.noise_scale": 10.0}, "imu.saturation": {"imu.rate_range": 4.0 * DEG5},
    "imu.freeze": {"imu.frozen": True}, "imu.silent": {"imu.silent": True},
    **{f"servo.stuck.{n}": {f"servo.pace.{n}": 0.0} for n in (1, 2, 3, 4)},
    **{f"servo.slow.{n}": {f"servo.pace.{n}": 0.5} for n in (1, 2, 3, 4)},
    **{f"servo.trim.{n}": {f"servo.trim.{n}": DEG5} for n in (1, 2, 3, 4)},
    "wind.side_x": {"body.tunnel.side_wind": (0.25, 0.0, 0.0)}, "wind.side_y": {"body.tunnel.side_wind": (0.0, 2.0, 0.0)},
    "wind.fan": {"body.tunnel.fan_factor": 0.95}, "wind.occlusion": {"body.tunnel.shadow": 0.2},
    "wind.gusts": {"body.tunnel.gust_scale": 2.0},
    **{
        f"push.{name}": {"pushes": size * np.eye(6)[part]}
        for part, (name, size) in enumerate(
            (("x", 1.0), ("y", 2.0), ("z", 2.0), ("roll", 0.02), ("pitch", 0.02), ("yaw", 0.02))
        )
    },
    "cpu.load": {"thief.share": 0.3}, "battery.sag": {"battery.sag_V": 1.0},
}  # fmt: skip


@pytest.mark.parametrize("link", [RADIO, MAVLINK])
def test_a_fault_turns_what_it_names_and_nothing_else_and_puts_it_back(link: str) -> None:
    assert set(ACTS) == set(OF_FLOATY)
    settings = [MARKERS_ON, "radio.uplink_loss=0", "radio.downlink_loss=0"]
    flight = lockstep_flight(Request.of(HOVER, overrides=settings, duration_s=1.0, link=link))
    robot, own = flight.robot, flight.robot.body.settings
    kinds = {name: kind for name, kind in OF_FLOATY.items() if kind.link in ("", link)}
    places = {place for name in kinds for place in ACTS[name]}

    def readings() -> dict[str, object]:
        return {place: own[place].read() if place in own else attrgetter(place)(robot) for place in places}

    rest = readings()
    for name, kind in kinds.items():
        fault = Fault(name, 0.0, 1.0, kind.size)
        flight.switchboard.begin(fault, 0)
        turned = {place: value for place, value in readings().items() if value != rest[place]}
        assert turned.keys() == ACTS[name].keys(), name
        for place, value in ACTS[name].items():
            assert turned[place] == pytest.approx(value), name
        flight.switchboard.end(fault, 0)
        assert readings() == rest, name


def test_a_fault_that_would_begin_at_the_end_is_refused() -> None:
    with pytest.raises(LabError, match=r"the flight ends 1 s after the release, before it begins"):
        Request.of(HOVER, duration_s=1.0, faults=["push.y@1"])


@pytest.mark.long
def test_a_change_between_two_faults_persists_beside_a_third() -> None:
    faults = ["wind.fan@0.1:0.1=0.9", "wind.fan@0.5:0.1=0.9", "imu.noise@0=2"]
    flight = lockstep_flight(Request.of(HOVER, duration_s=1.0, faults=faults))
    flight.events.at(1_300_000, lambda _: flight.robot.body.tunnel.set_fan_factor(1.1))
    flight.run()
    assert flight.robot.body.tunnel.fan_factor == 1.1


@pytest.mark.long
def test_the_log_counts_the_faults_in_force_and_names_them(tmp_path: Path) -> None:
    result = go(tmp_path / "run", "push.x@0.5=0.1", "imu.noise@0.2:1=2", "push.x@1.5=1", duration_s=2.0)
    log = load_log(result.folder)
    assert log.schema.field("fault.active").type == pa.int8()
    expected, times = np.zeros(log.num_rows), since_release(log)
    for span in spans_of(log.schema.metadata):
        expected += (times >= span.begin_s) & (times < span.end_s)
    assert column(log, "fault.active").tolist() == expected.tolist()
    assert [str(span.fault) for span in spans_of(log.schema.metadata)] == list(
        read_result(result.folder).request.faults
    )
    texts = [event["text"] for event in load_events(result.folder) if "fault" in event["text"]]
    assert texts[:3] == [
        "fault imu.noise@0.2:1=2 begins", "fault push.x@0.5=0.1 begins", "fault push.x@0.5=0.1 ends"
    ]  # fmt: skip
    assert len(texts) == 6


@pytest.mark.long
def test_an_experiments_faults_that_do_not_concern_the_flight_are_left_out(tmp_path: Path) -> None:
    own = (*map(parse, ("push.x@0.2=0.1", "push.x@1=0.1", "serial.cut@0.1", "marker.swap@0.1")),)
    experiment = Experiment("hover", "", 10.0, {}, faults=own)
    fly(Request.of(experiment, duration_s=1.0, faults=[parse("push.y@0.5:0.5")]), tmp_path / "run")
    begun = [event["text"] for event in load_events(tmp_path / "run") if event["text"].startswith("fault")]
    assert begun == [
        "fault push.x@0.2=0.1 begins",
        "fault push.x@0.2=0.1 ends",
        "fault push.y@0.5:0.5=2 begins",
    ]


@pytest.mark.long
@pytest.mark.parametrize("link", [RADIO, MAVLINK])
def test_faults_that_together_leave_a_knobs_range_stop_at_its_end_and_give_it_back(link: str) -> None:
    """Every kind three times at once, at its largest and at its smallest: the flight goes on, and ends as it began."""
    flight = lockstep_flight(Request.of(HOVER, overrides=[MARKERS_ON], duration_s=1.0, link=link))
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
            robot.advance_truth(flight.now_us)
            assert np.isfinite([knob.read(robot) for knob in kind.knobs if name != "imu.saturation"]).all()
            for fault in faults:
                board.end(fault, flight.now_us)
    assert [knob.read(robot) for knob in knobs] == before
    assert board.active == []


@pytest.mark.long
@pytest.mark.parametrize(
    ("kind", "size", "most"),
    [("wind.fan", 2.0, 2.0), ("wind.gusts", 5.0, 5.0), ("imu.noise", 1000.0, 1000.0), ("cpu.load", 1.0, 1.0)],
)
def test_two_faults_of_the_largest_size_are_one_of_that_size(kind: str, size: float, most: float) -> None:
    flight = lockstep_flight(Request.of(HOVER, duration_s=1.0))
    (knob,) = KINDS[kind].knobs
    for start_s in (0.0, 1.0):
        flight.switchboard.begin(Fault(kind, start_s, 1.0, size), flight.now_us)
        assert knob.read(flight.robot) == most


# What becomes of the hover

LONGER = {
    "mocap.dropout@1:0.7": "failsafe",
    "mocap.outlier@1:0.3=0.5": "holds",
    "mocap.outlier@1:0.6=0.5": "failsafe",
    "mocap.dropout@1:inf=0.5": "holds",
    "mocap.swap@1:0.6": "degrades",  # after 0.4 s the tracker believes it
    "mocap.latency@1=100": "lost",  # 140 ms; the predictor's buffer ends before
    "radio.cut@1:0.7": "failsafe",
    "serial.cut@1:0.7": "failsafe",
    "imu.noise@1=100": "degrades",
    "servo.slow.1@1=0.2": "holds",
    "wind.fan@1=0.9": "lost",
    "wind.side_x@1=1": "lost",  # the x axis is the weak one
    "push.x@1=2": "lost",
    "cpu.load@1=0.6": "holds",
    "cpu.load@1=0.95": "lost",
    "cpu.load@1=1": "lost",
}  # fmt: skip
LONGEST = {
    "marker.hidden@1=5": "holds",
    "marker.hidden@1:0.7=6": "failsafe",  # two are too few
    "marker.noise@1:0.7=6": "failsafe",  # it fits too badly
}
STATED = {**{f"{name}@1": kind.outcome for name, kind in OF_FLOATY.items()}, **LONGER, **LONGEST}


# The others are in the long tier.
QUICK = ("mocap.outlier@1", "radio.cut@1:0.7", "servo.stuck.1@1", "push.y@1")
FLIGHTS = [
    pytest.param(text, 1 + place % 2, marks=() if text in QUICK else pytest.mark.long)
    for place, text in enumerate(STATED)
]


@pytest.mark.long
@pytest.mark.parametrize(("text", "seed"), FLIGHTS)
def test_the_hover_has_the_stated_outcome(tmp_path: Path, text: str, seed: int) -> None:
    link = KINDS[parse(text).kind].link or RADIO
    result = go(tmp_path / "run", text, seed=seed, duration_s=7.0, link=link, settings=settings_for(text))
    opened = (column(load_log(result.folder), "supervisor.state") == 3)[round(100 * RELEASE_S) :].any()
    flown = "failsafe" if opened else "holds" if result.passed else "degrades"
    outcome = "lost" if result.outcome == "lost" else flown
    failed = [str(verdict) for verdict in result.verdicts if not verdict.holds]
    assert outcome == STATED[text], f"{result.cause} {failed}"


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_swapped_markers_lose_the_robot_where_fit_and_tracker_accept_them(tmp_path: Path, seed: int) -> None:
    wide = (MARKERS_ON, "markers.max_error=0.2")
    assert go(tmp_path / "run", "marker.swap@1", seed=seed, duration_s=4.0, settings=wide).passed
    alone = (*wide, "tracker.enabled=false")
    assert go(tmp_path / "long", "marker.swap@1", seed=seed, duration_s=4.0, settings=alone).outcome == "lost"
    short = go(tmp_path / "short", "marker.swap@1:0.02", seed=seed, duration_s=2.0, settings=alone)
    assert short.passed  # one pose, which the gate refuses
    assert column(load_log(short.folder), "estimator.refused")[-1] == 1


def test_the_watchdog_ends_a_flight_whose_processor_is_taken(tmp_path: Path) -> None:
    result = go(tmp_path / "run", "cpu.load@0.2=1")
    assert "watchdog" in str(result.cause)


# Where they are shown


@pytest.mark.long
def test_report_and_recording_show_the_faults(tmp_path: Path) -> None:
    from rerun.chunk import RrdReader

    from hil.pictures.viewer.recording import write_run_rrd

    folder = go(tmp_path / "run", "push.x@0.3=0.5", "servo.slow.2@0.5", duration_s=1.0).folder
    page = write_report(folder).read_text(encoding="utf-8")
    table = page[page.index('<table id="faults">') :].partition("</table>")[0]
    for cell in ("push.x", "0.300", "0.400", "0.5 N", "servo.slow.2", "0.500", "with the flight"):
        assert f">{cell}<" in table, cell
    lane: list[tuple[int, str]] = []
    for chunk in RrdReader(write_run_rrd(folder)).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/state/faults" and "from_release" in batch.schema.names:
            times = [moment.value // 1000 for moment in batch.column("from_release")]
            states = [row[0] for row in batch.column("StateChange:state").to_pylist()]
            lane += zip(times, states, strict=True)
    assert lane == [(300_000, "push.x"), (400_000, "-"), (500_000, "servo.slow.2")]


@pytest.mark.long
def test_a_flight_without_faults_has_no_table_of_them(tmp_path: Path) -> None:
    folder = go(tmp_path / "run", duration_s=0.3).folder
    assert 'id="faults"' not in write_report(folder).read_text(encoding="utf-8")
    assert json.loads((folder / "result.json").read_text())["faults"] == []


@pytest.mark.long
def test_the_list_tells_every_kind(cli: Cli) -> None:
    assert cli("list", "--faults") == 0
    shown = cli.out
    first = [line.split()[0] for line in shown.splitlines() if line and not line.startswith(" ")]
    assert first == ["kind", *KINDS]


def test_a_fault_that_was_switched_on_twice_has_two_spans() -> None:
    def event(t_us: int, text: str, source: str = "lab") -> dict[str, object]:
        return {"t_us": t_us, "source": source, "text": text}

    events = [
        event(1, "fault push.y=1 begins"), event(2, "fault push.x=1 begins"), event(3, "fault push.y=1 ends"),
        event(4, "fault push.y=1 begins", "board"), event(5, "fault push.y=1 begins"), event(6, "fault push.y=1 begins"),
        event(7, "fault push.y=1 ends"), event(8, "fault push.y=1 ends"),
    ]  # fmt: skip
    assert json.loads(switched_on(events)[SWITCHED_ON]) == [
        ["push.y=1", 1, 3], ["push.x=1", 2, math.inf], ["push.y=1", 5, 7], ["push.y=1", 6, 8],
    ]  # fmt: skip
