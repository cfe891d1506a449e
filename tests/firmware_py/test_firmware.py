"""The firmware as a whole against a board of plain numbers: timing, hand-over, queues, failsafe."""

from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from firmware_py.config import parameters_of
from firmware_py.core import entry
from firmware_py.core.sampling import WINDOW
from firmware_py.core.structs import POSE_TOO_OLD, Input, Sampling
from firmware_py.core_runner import CoreBlocks, costs_of, default_runner
from firmware_py.errors import FirmwareError
from firmware_py.firmware import OLDEST_POSE_US, WATCHDOG_US, Firmware
from firmware_py.rtos import WatchdogError
from firmware_py.supervisor import wrapped
from firmware_py.wire.crtp import Correction
from firmware_py.wire.memories import CONFIG_SIZE, RadioSettings, decode_config, encode_config
from firmware_py.wire.parameters import ABSOLUTE
from hil.config import load_config
from support.firmware_bench import HOVER_COUNTS, LEVEL, FirmwareBench
from support.mavlink_client import MavlinkClient


@pytest.fixture
def bench() -> FirmwareBench:
    return FirmwareBench()


def test_flaps_are_at_hover_before_the_first_tick(bench: FirmwareBench) -> None:
    assert bench.writes[0][1] == HOVER_COUNTS


@pytest.mark.parametrize("absolute", [False, True])
def test_poses_are_of_the_kind_of_the_profile(bench: FirmwareBench, absolute: bool) -> None:
    firmware = Firmware(load_config("floaty", (f"predictor.absolute={absolute}".lower(),)), bench)
    (kind,) = [one.read() for one in firmware.parameters if one.name == ABSOLUTE]
    assert kind == absolute


def test_controller_writes_counts_every_ten_milliseconds(bench: FirmwareBench) -> None:
    bench.run(200_000)
    late_us = [t - 10_000 * k for k, (t, _) in enumerate(bench.writes[1:], 1)]
    cost = load_config().cpu
    assert len(late_us) == 19
    assert set(late_us) == {cost.stabilizer_us + cost.controller_us}


@pytest.mark.long
def test_each_cost_is_its_task_s_alone() -> None:
    def spent_us(*overrides: str) -> dict[str, int]:
        kernel = FirmwareBench("cpu.measured=false", *overrides)
        kernel.run(1_000_000)
        tasks = kernel.firmware.kernel.tasks
        return {task.name: kernel.firmware.kernel.run_time_us(task) for task in tasks if task.name != "IDLE"}

    cost, usual = load_config().cpu, spent_us()
    for name, task, times in (
        ("sensors", "SENSORS", 1000), ("stabilizer", "STABILIZER", 1000), ("controller", "STABILIZER", 100),
        ("kalman", "KALMAN", 1000), ("estimator", "KALMAN", 100),
    ):  # fmt: skip
        now = spent_us(f"cpu.{name}_us={getattr(cost, f'{name}_us') + 20}")
        more = {one: now[one] - usual[one] for one in now if now[one] != usual[one]}
        assert more == {task: pytest.approx(20 * times, rel=0.15)}, name


def test_a_pose_reaches_the_flaps_within_eleven_milliseconds(bench: FirmwareBench) -> None:
    bench.poses(605_000, 800_000)
    bench.run(800_000)
    before = bench.writes[-1][1]
    bench.pose(805_000, (0.0, 0.05, 0.0))
    bench.run(830_000)
    changed = next(t for t, counts in bench.writes if t > 805_000 and counts != before)
    assert 805_000 < changed <= 816_000


def test_controller_goes_on_when_the_imu_falls_silent(bench: FirmwareBench) -> None:
    bench.poses(605_000, 2_000_000)
    bench.run(1_000_000)
    bench.imu_alive = False
    bench.run(1_500_000)
    times = [t for t, _ in bench.writes if t > 1_010_000]
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert times[-1] > 1_480_000
    assert max(gaps) <= 20_000


def test_every_queue_has_its_length_and_a_board_in_peace_drops_nothing() -> None:
    """As in Crazyflie firmware, and the original's of measurements; of MAVLink and the console our own."""
    bench = MavlinkClient()
    bench.run(1_000_000)
    queues = bench.firmware.kernel.queues
    ports = {queue.name: 16 for queue in queues if queue.name.startswith("port")}
    of_link = {"syslink": 8, "crtpPacketDelivery": 5, "crtpTx": 120, "app": 10}
    own = {"mavTx": 32, "console": 40, "measurements": 20}
    assert {queue.name: queue.length for queue in queues} == ports | of_link | own
    assert {queue.dropped for queue in queues} == {0}


class Gyro:
    """A gyro whose zero the core seeks."""

    def __init__(self) -> None:
        self.data, self.sampling = Input.allocate(), Sampling.allocate()

    def add(self, *counts: int) -> bool:
        self.data.fields.gyro[:] = counts
        return bool(entry.take_sample(self.data.fields, self.sampling.fields))

    @property
    def bias(self) -> list[float]:
        bias: list[float] = self.data.fields.gyro_bias.tolist()
        return bias


def test_gyro_zero_is_the_mean_of_a_still_window() -> None:
    gyro = Gyro()
    found = [gyro.add(5 if k % 2 else 7, -3, 100) for k in range(WINDOW)]
    assert found == [False] * (WINDOW - 1) + [True]
    assert gyro.bias == [6.0, -3.0, 100.0]
    assert gyro.sampling.fields.variance.tolist() == [1.0, 0.0, 0.0]
    assert not any(gyro.add(500, 0, 0) for _ in range(WINDOW))
    assert gyro.bias == [6.0, -3.0, 100.0]


@pytest.mark.long
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize(("noise", "still"), [(100, True), (101, False), (32767, False)])
def test_gyro_zero_waits_until_the_robot_is_still(axis: int, noise: int, still: bool) -> None:
    gyro = Gyro()
    for _ in range(1 if still else 2):
        for k in range(WINDOW):
            sample = [0, 0, 0]
            sample[axis] = noise if k % 4 < 2 else -noise
            found = gyro.add(*sample)
        assert found == still
    assert gyro.sampling.fields.windows_refused == (0 if still else 2)
    assert gyro.bias == [0.0, 0.0, 0.0]
    if not still:
        assert [gyro.add(1, 2, 3) for _ in range(WINDOW)][-1]
        assert gyro.bias == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("zero", [-32768, -12345, 32767])
def test_gyro_zero_is_exact_at_the_ends_of_its_range(zero: int) -> None:
    gyro = Gyro()
    for _ in range(WINDOW):
        gyro.add(zero, zero, zero)
    assert gyro.bias == [zero] * 3


def test_samples_are_summed_from_tick_to_tick() -> None:
    core = CoreBlocks(parameters_of(load_config()), default_runner)
    core.run.call("reset")
    data = core.data.fields
    for _ in range(2):
        for k in range(10):
            data.gyro[:] = k, -k, 1
            core.run.call("take_sample")
        assert (data.gyro_sum.tolist(), data.gyro_samples) == ([45, -45, 10], 10)
        core.run.call("estimate")
        assert (data.gyro_sum.tolist(), data.gyro_samples) == ([0, 0, 0], 0)


@pytest.mark.parametrize("start", [0, 2**31 - 35])
def test_the_controller_runs_in_every_tenth_step_and_the_estimator_in_the_one_before(start: int) -> None:
    """Steps are counted over the wrap of their number; one that is missed is caught up, and does not move the next."""
    core = CoreBlocks(parameters_of(load_config()), default_runner)
    data, sampling = core.data.fields, core.sampling.fields
    sampling.tick, sampling.phase = start, 0
    controls, estimates = [], []
    for step in [*range(1, 32), 45, 46, 49, 50, 52, 60, 85, 86, 90, 88, 97, 98]:  # set back, it moves nothing
        data.tick = wrapped(start + step)
        if core.run.call("begin_step"):
            controls.append(step)
        if sampling.estimate_due:
            estimates.append(step)
            core.run.call("estimate")
    assert controls == [10, 20, 30, 45, 50, 60, 85, 90, 98]
    assert estimates == [9, 19, 29, 45, 49, 60, 85, 90, 97]


def test_an_error_in_a_task_names_task_and_time(bench: FirmwareBench) -> None:
    bench.run(50_000)
    bench.write_compare = None  # type: ignore[method-assign,assignment]  # a driver that is not there
    with pytest.raises(FirmwareError, match=r"task STABILIZER at 6?[05]\d?\.\d+ ms: TypeError"):
        bench.run(60_000)


def test_the_watchdog_bites_after_its_longest_time_and_not_before(bench: FirmwareBench) -> None:
    bench.run(20_000)
    path, now_us = bench.firmware.flight_tasks._path.fields, bench.firmware.kernel.now_us
    path.fed_us = now_us - WATCHDOG_US
    bench.firmware.check_watchdog()
    path.fed_us -= 1
    with pytest.raises(WatchdogError, match="STABILIZER has not run for 353 ms"):
        bench.firmware.check_watchdog()


def test_a_pose_is_named_as_too_old_only_beyond_the_longest_horizon(bench: FirmwareBench) -> None:
    pose, data = Correction((0.0, 0.0, 0.0), LEVEL, None), bench.firmware._core.data.fields
    said, notices = list[str](), bench.firmware._notices
    notices._write = said.append  # type: ignore[method-assign]
    for age_us in (-1, 40_000, OLDEST_POSE_US):
        data.pose_age_us = age_us
        bench.firmware._pose_refused(POSE_TOO_OLD, pose)
    assert said == []
    for name, age_us in (("120", 120_499), ("121", 120_500)):
        data.pose_age_us, notices._reported_us = age_us, {}
        bench.firmware._pose_refused(POSE_TOO_OLD, pose)
        assert said.pop() == f"poses {name} ms old: at most 120 ms"


@pytest.mark.parametrize("spoilt", [False, True])
def test_a_board_keeps_its_radio_s_settings_unless_they_are_spoilt(
    bench: FirmwareBench, spoilt: bool
) -> None:
    assert decode_config(bytes(bench.eeprom[:CONFIG_SIZE])) == RadioSettings()
    own = RadioSettings(5, 1, 0xE7E7E7E703)
    bench.eeprom[:] = b"\7" * len(bench.eeprom)
    bench.eeprom[:CONFIG_SIZE] = encode_config(own)
    bench.eeprom[CONFIG_SIZE - 1] ^= spoilt
    Firmware(load_config(), bench)
    assert decode_config(bytes(bench.eeprom[:CONFIG_SIZE])) == (RadioSettings() if spoilt else own)
    assert set(bench.eeprom[CONFIG_SIZE:]) == {7}


def test_the_profile_s_costs_count_unless_a_board_measures_its_own() -> None:
    cpu = load_config().cpu.model_copy(update={"estimator_us": 11, "controller_us": 22})
    plain: Any = SimpleNamespace(call=int)
    measuring: Any = SimpleNamespace(call=int, usage=None, estimate_us=lambda: 33, control_us=lambda: 44)
    for runner, measured, expected in (
        (plain, True, (11, 22)), (plain, False, (11, 22)), (measuring, False, (11, 22)), (measuring, True, (33, 44)),
    ):  # fmt: skip
        costs = costs_of(runner, cpu.model_copy(update={"measured": measured}))
        assert (costs.estimate_us(), costs.control_us()) == expected


def test_what_own_logic_sees_stays_as_it_was_when_the_next_samples_come() -> None:
    blocks = CoreBlocks(parameters_of(load_config()), default_runner)
    sample = np.zeros(2, np.float32)
    blocks.sense({"flow": sample})
    sample[:] = 5.0
    assert blocks.sensed["flow"].tolist() == [0.0, 0.0]


def test_an_excitation_s_amplitudes_are_those_of_the_inputs_in_their_order() -> None:
    keys = [f"excitation.u{number}={number / 100}" for number in (1, 2, 3, 4)]
    assert load_config(overrides=keys).excitation.rms == (0.01, 0.02, 0.03, 0.04)


def test_the_processor_s_load_is_read_anew_after_a_tenth_of_a_second(bench: FirmwareBench) -> None:
    (load,) = [one.read for one in bench.firmware.variables if one.name == "system.load"]
    bench.run(150_000)
    first = load()
    bench.run(240_000)
    assert load() == first > 0
    bench.run(251_000)
    assert load() != first


def test_the_smallest_and_the_largest_angle_of_the_flaps_are_logged(bench: FirmwareBench) -> None:
    bench.firmware._core.control.fields.flap[:] = (0.25, -0.5, 0.125, 0.75)
    read = {variable.name: variable.read for variable in bench.firmware.variables}
    assert [read[f"motors_ctrp.{name}_angle"]() for name in ("min", "max")] == [-0.5, 0.75]


def test_a_report_has_the_priority_of_its_task_also_while_that_waits(bench: FirmwareBench) -> None:
    """Those of Bitcraze's config.h, but for the app."""
    bench.run(50_000)
    told = {report.name: report.priority for report in bench.firmware.reports()}
    named = {
        "STABILIZER": 5,
        "SENSORS": 4,
        "SYSLINK": 3,
        "CRTP-TX": 2,
        "CRTP-RX": 2,
        "KALMAN": 2,
        "LOG": 1,
        "PARAM": 1,
        "MEM": 1,
    }
    assert told == dict.fromkeys(told, 0) | named
