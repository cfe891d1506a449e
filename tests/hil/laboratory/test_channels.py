"""Each number of a channel stands under its own name: every source has another value."""

import math
from collections.abc import Mapping
from itertools import count
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_py.wire.supervisor import State
from firmware_py.wire.telemetry import ALL_BLOCKS, ATTITUDE, Sample
from ground_station.trajectory import Goal, Hold
from hil.laboratory.channels import (
    MEASUREMENTS,
    _scheduler_channels,
    _stock_channels,
    battery_channel,
    excitation_channel,
    fault_channel,
    marker_channel,
    radio_channel,
    serial_channel,
    tracker_channel,
)
from hil.laboratory.files.station_channels import UNKNOWN_STATE, station_channels
from hil.world.body import Channel

numbers = count(1)


def source(names: str) -> Any:
    """An object whose attributes are numbers that nothing else has."""
    return SimpleNamespace(**{name: next(numbers) for name in names.split()})


def columns(channel: Channel) -> Mapping[str, float]:
    """What a channel reads, by the names of its columns."""
    names = [name for quantity in channel.quantities for name in quantity.names]
    return dict(zip(names, channel.read(), strict=True))


def test_the_scheduler_s_counters_are_sums_over_the_queues_of_measurements() -> None:
    tasks = [
        SimpleNamespace(name=name, deadline_misses=next(numbers)) for name in ("KALMAN", "IDLE", "STABILIZER")
    ]
    queues = [SimpleNamespace(name=name, high_water=next(numbers), dropped=next(numbers))
        for name in (MEASUREMENTS, "other", MEASUREMENTS)]  # fmt: skip
    scheduler = SimpleNamespace(tasks=tasks, queues=queues, run_times_us=lambda: [70, 80, 90, 100])
    firmware: Any = SimpleNamespace(scheduler=scheduler)
    (channel,) = _scheduler_channels(firmware)
    first, _, last = queues
    assert columns(channel) == {
        "rtos.measurements_high_water": first.high_water + last.high_water,
        "rtos.measurements_dropped": first.dropped + last.dropped,
        "late.KALMAN": tasks[0].deadline_misses, "late.STABILIZER": tasks[2].deadline_misses,
        "cpu.KALMAN": 70, "cpu.IDLE": 80, "cpu.STABILIZER": 90,
    }  # fmt: skip


def test_the_radio_s_counters() -> None:
    up, down = (source("sent delivered dropped latency_sum_us") for _ in range(2))
    air = source("retried unanswered")
    found = columns(radio_channel(SimpleNamespace(up=up, down=down, air=air)))  # type: ignore[arg-type]
    ways = {
        f"link.{way}_{name}": getattr(line, name)
        for way, line in (("up", up), ("down", down))
        for name in ("sent", "delivered", "dropped")
    }
    sums = {"link.up_latency_sum": up.latency_sum_us, "link.down_latency_sum": down.latency_sum_us}
    assert found == {**ways, **sums, "link.retried": air.retried, "link.unanswered": air.unanswered}


@pytest.mark.parametrize("known", [True, False])
def test_the_serial_line_s_counters(known: bool) -> None:
    line = "deliveries latency_sum_us busy_us sent_bytes dropped_bytes cut_bytes wrong_bits overrun_bytes"
    up, down, board = source(line), source(line), source("bad lost")
    link = SimpleNamespace(counters=source("bad lost")) if known else None
    firmware = SimpleNamespace(mavlink=SimpleNamespace(counters=board))
    found = columns(serial_channel(SimpleNamespace(up=up, down=down), firmware, link))  # type: ignore[arg-type]
    assert found == {
        "link.up_delivered": up.deliveries,
        "link.down_delivered": down.deliveries,
        "link.up_latency_sum": up.latency_sum_us,
        "link.down_latency_sum": down.latency_sum_us,
        "serial.up_busy": up.busy_us,
        "serial.down_busy": down.busy_us,
        "serial.up_bytes": up.sent_bytes,
        "serial.down_bytes": down.sent_bytes,
        "serial.overrun": up.overrun_bytes,
        "serial.no_room": up.dropped_bytes + down.dropped_bytes,
        "serial.cut": up.cut_bytes + down.cut_bytes,
        "serial.wrong_bits": up.wrong_bits + down.wrong_bits,
        "serial.up_bad": board.bad,
        "serial.up_lost": board.lost,
        "serial.down_bad": link.counters.bad if link else 0,
        "serial.down_lost": link.counters.lost if link else 0,
    }


def test_the_battery_the_tracker_and_the_faults() -> None:
    battery = source("voltage power charge")
    assert columns(battery_channel(battery)) == {
        f"battery.{name}": value for name, value in vars(battery).items()
    }
    tracker = SimpleNamespace(quality=7, counters=source("refused restarts"))
    assert columns(tracker_channel(tracker)) == {  # type: ignore[arg-type]
        "tracker.quality": 7, "tracker.refused": tracker.counters.refused, "tracker.restarts": tracker.counters.restarts,
    }  # fmt: skip
    active: list[Any] = []
    channel = fault_channel(active)
    active += [None, None]
    assert np.atleast_1d(channel.read()).tolist() == [2]


def test_the_markers_of_the_last_exposure() -> None:
    mocap: Any = SimpleNamespace(sighting=None)
    channel = marker_channel(mocap)
    names = "markers.visible", "markers.unlabelled", "markers.error"
    assert columns(channel) == dict.fromkeys(names, 0.0)
    mocap.sighting = SimpleNamespace(bits=5, unlabelled=[None] * 3, error=0.25)
    assert columns(channel) == dict(zip(names, (5, 3, 0.25), strict=True))


def test_all_that_a_ground_station_knows() -> None:
    """The board's names in the order of the log's columns."""
    told = {v.name: next(numbers) for block in ALL_BLOCKS for v in block.variables}
    counters, frame, track = source("frames invalid samples malformed"), source("t_us"), SimpleNamespace()
    frame.p_WB, frame.q_WB, track.v_WB, track.w_B, ages = (
        [next(numbers) for _ in range(n)] for n in (3, 4, 3, 3, 6)
    )
    link = source("sent late quality rssi supervisor_state")
    link.latency = source("us")
    ground: Any = SimpleNamespace(counters=counters, frame=frame, track=track, tracker=None, telemetry={})
    ground.budget = SimpleNamespace(last=lambda: ages)
    session: Any = SimpleNamespace(link=link, ground=ground)
    channels = station_channels(session, lambda: True, lambda: Goal((0.1, 0.2, 0.3), 0.4), 1000)
    assert all(map(math.isnan, (channels[3].read(), *channels[5].read()))), "no block has a sample"  # type: ignore[misc]
    for state in (None, *State):
        link.supervisor_state = state
        shown = UNKNOWN_STATE if state is None else state
        assert columns(channels[0]) == {"flight.free": True, "supervisor.state": shown}
    for block in ALL_BLOCKS:
        ground.telemetry[block.id] = Sample(block, 0, tuple(told[one.name] for one in block.variables))
    found = {name: value for channel in channels for name, value in columns(channel).items()}
    axes, four = ["x", "y", "z", "vx", "vy", "vz", "roll", "pitch", "yaw"], (1, 2, 3, 4)
    names = [f"stateEstimate.{name}" for name in (*axes, *(f"{axis}_rate" for axis in axes[6:]))]
    names += [f"{group}{n}" for group in ("stateEstimate.flap_", "motor.m", "controller.u") for n in four]
    shown = [f"estimate.{name}" for name in (*axes, *"pqr")]
    shown += [f"{group}{n}" for group in ("telemetry.flap_", "motor.m", "control.u") for n in four]
    stages = ("camera", "processing", "network", "mocap", "station", "link")
    assert list(found.items()) == [
        ("flight.free", True), ("supervisor.state", link.supervisor_state), ("cameras.exposed", frame.t_us - 1000),
        *zip((f"cameras.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz", "vx", "vy", "vz", "p", "q", "r")),
             (*frame.p_WB, *frame.q_WB, *track.v_WB, *track.w_B), strict=True),
        ("goal.x", 0.1), ("goal.y", 0.2), ("goal.z", 0.3), ("goal.yaw", 0.4),
        *zip(shown, (told[name] for name in names), strict=True),
        ("estimator.pose_age_us", 100 * told["locSrv.age"]), ("estimator.poses", 0), ("estimator.rejected", 0),
        ("link.sent", link.sent), ("link.late", link.late), ("station.frames", counters.frames),
        ("station.unusable", counters.invalid), ("station.samples", counters.samples),
        ("station.malformed", counters.malformed), ("link.latency", link.latency.us),
        ("battery.voltage", told["pm.vbat"]), ("board.load", told["system.load"]),
        ("link.quality", link.quality), ("link.rssi", link.rssi),
        *zip((f"age.{stage}" for stage in stages), ages, strict=True),
    ]  # fmt: skip
    later = {"locSrv.poses": 3, "locSrv.rejected": 5}
    sample = ground.telemetry[ATTITUDE.id]
    values = tuple(told[one.name] + later.get(one.name, 0) for one in ATTITUDE.variables)
    ground.telemetry[ATTITUDE.id] = Sample(ATTITUDE, 20, values)
    assert (sample.values[4:], channels[3].read()[-2:]) == (
        (told["locSrv.poses"], told["locSrv.rejected"]),
        (3, 5),
    )
    values = tuple({"locSrv.poses": 2, "locSrv.rejected": 1}.get(one.name, 0) for one in ATTITUDE.variables)
    ground.telemetry[ATTITUDE.id] = Sample(ATTITUDE, 10, values)
    assert channels[3].read()[-2:] == (5, 6), "its clock went back: the board counts from 0 again"


def test_the_excitation_of_each_input() -> None:
    variables = [SimpleNamespace(name=f"excite.u{n}", read=lambda n=n: float(n)) for n in range(1, 5)]
    found = columns(excitation_channel(SimpleNamespace(variables=variables)))  # type: ignore[arg-type]
    assert found == {f"excite.u{n}": float(n) for n in range(1, 5)}


def test_the_estimate_of_the_crazyflie_s_firmware_is_seen_from_the_goal() -> None:
    """p_GB = R_WG^-1 (p_WB - p_WG), v_G = R_WG^-1 v_W, and the yaw relative to the goal's."""
    yaw, now = 0.7, np.array((1.0, 2.0, 3.0, 0.4, 0.5, 0.6, 0.1, 0.2, 1.5, 11.0, 12.0, 13.0))
    signals = SimpleNamespace(estimate=now, count=np.zeros(4))
    robot = SimpleNamespace(board=SimpleNamespace(now_us=0), firmware=SimpleNamespace(signals=signals))
    estimate, *_ = _stock_channels(robot, Hold(Goal((0.5, 1.0, 2.0), yaw)), None)  # type: ignore[arg-type]
    back = np.array([[np.cos(yaw), np.sin(yaw), 0.0], [-np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    expected = [*(back @ (0.5, 1.0, 1.0)), *(back @ now[3:6]), 0.1, 0.2, 1.5 - yaw, 11.0, 12.0, 13.0]
    assert list(columns(estimate).values()) == pytest.approx(expected)
