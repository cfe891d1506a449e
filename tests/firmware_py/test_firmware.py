"""The firmware as a whole against a board of plain numbers: timing, hand-over, queues, failsafe."""

from itertools import pairwise

import pytest

from firmware_py.drivers.imu import SAMPLES, GyroZero
from firmware_py.errors import FirmwareError
from firmware_py.firmware import MEASUREMENT_QUEUE
from firmware_py.wire import crtp, telemetry
from firmware_py.wire.supervisor import State
from hil.config import load_config
from support.firmware_bench import HOVER_COUNTS, FirmwareBench


@pytest.fixture
def bench() -> FirmwareBench:
    return FirmwareBench()


def test_flaps_are_at_hover_before_the_first_tick(bench: FirmwareBench) -> None:
    assert bench.writes[0][1] == HOVER_COUNTS


def test_controller_writes_counts_every_ten_milliseconds(bench: FirmwareBench) -> None:
    bench.run(200_000)
    late_us = [t - 10_000 * k for k, (t, _) in enumerate(bench.writes[1:], 1)]
    cost = load_config().cpu
    assert len(late_us) == 19
    assert set(late_us) == {cost.stabilizer_us + cost.controller_us}


def test_loop_closes_after_gyro_zero_and_first_pose(bench: FirmwareBench) -> None:
    bench.run(400_000)
    assert bench.firmware.signals.supervisor.state is State.CALIBRATING
    bench.run(600_000)
    assert bench.firmware.signals.supervisor.state is State.WAITING
    bench.poses(605_000, 700_000)
    bench.run(700_000)
    assert bench.firmware.signals.supervisor.state is State.FLYING
    assert [text for text in bench.console if text.startswith("supervisor")] == [
        "supervisor: waiting",
        "supervisor: flying",
    ]


def test_a_pose_reaches_the_flaps_within_eleven_milliseconds(bench: FirmwareBench) -> None:
    bench.poses(605_000, 800_000)
    bench.run(800_000)
    before = bench.writes[-1][1]
    bench.pose(805_000, (0.0, 0.05, 0.0))
    bench.run(830_000)
    changed = next(t for t, counts in bench.writes if t > 805_000 and counts != before)
    assert 805_000 < changed <= 816_000


def test_silence_of_half_a_second_is_a_failsafe_and_a_pose_ends_it(bench: FirmwareBench) -> None:
    bench.poses(605_000, 1_000_000, (0.0, 0.04, 0.02))
    bench.run(1_000_000)
    assert bench.writes[-1][1] != HOVER_COUNTS
    last_pose_us = 985_000
    bench.run(last_pose_us + 490_000)
    assert bench.firmware.signals.supervisor.state is State.FLYING
    bench.run(last_pose_us + 530_000)
    assert bench.firmware.signals.supervisor.state is State.FAILSAFE
    assert bench.writes[-1][1] == HOVER_COUNTS
    bench.poses(1_600_000, 1_700_000)
    bench.run(1_700_000)
    assert bench.firmware.signals.supervisor.state is State.FLYING


def test_controller_goes_on_when_the_imu_falls_silent(bench: FirmwareBench) -> None:
    bench.poses(605_000, 2_000_000)
    bench.run(1_000_000)
    bench.imu_alive = False
    bench.run(1_500_000)
    times = [t for t, _ in bench.writes if t > 1_010_000]
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert times[-1] > 1_480_000
    assert max(gaps) <= 20_000


def test_garbage_on_the_radio_is_counted_and_flies_on(bench: FirmwareBench) -> None:
    bench.poses(605_000, 800_000)
    for at_us, data in (
        (650_100, b""),
        (650_200, b"\x6d\x08\x00"),
        (650_300, bytes(31)),
        (650_400, bytes(40)),
    ):
        bench.events.at(at_us, lambda now_us, data=data: bench.firmware.radio_received(data))
    bench.run(800_000)
    assert bench.firmware.link.malformed == 3  # 31 zero bytes are a well-formed packet of another port
    assert bench.firmware.signals.supervisor.state is State.FLYING


def test_a_radio_that_takes_nothing_fills_the_queue_and_counts(bench: FirmwareBench) -> None:
    bench.radio_open = False
    bench.stream(0)
    bench.run(3_000_000)
    queue = next(queue for queue in bench.firmware.kernel.queues if queue.name == "crtpTx")
    assert len(queue) == queue.high_water == 120
    assert queue.dropped > 0
    bench.radio_open = True
    bench.run(3_100_000)
    assert len(queue) == 0


def test_telemetry_leaves_at_fifty_hertz_with_the_running_values(bench: FirmwareBench) -> None:
    bench.poses(605_000, 1_000_000, (0.01, 0.02, -0.03))
    bench.run(500_000)
    assert [data for _, data in bench.sent if data[0] >> 4 == crtp.PORT_LOG] == []  # nothing comes unasked
    bench.stream(507_000)
    bench.run(1_000_000)
    samples = [
        telemetry.decode_sample(packet.data)
        for packet in (crtp.decode(data) for _, data in bench.sent)
        if packet.port == crtp.PORT_LOG
    ]
    assert len(samples) == 24 * len(telemetry.BLOCKS)  # those of the last tick are still being packed
    assert [sample.timestamp_ms for sample in samples[::4]] == list(range(520, 1000, 20))
    motion = [sample for sample in samples if sample.block is telemetry.BLOCKS[0]][-1]
    assert motion.values[:3] == pytest.approx((0.01, 0.02, -0.03), abs=2e-3)
    flaps = [sample for sample in samples if sample.block is telemetry.BLOCKS[2]][-1]
    assert list(flaps.values[4:]) == pytest.approx(bench.writes[-2][1], abs=600)
    turned = [sample for sample in samples if sample.block is telemetry.BLOCKS[1]][-1]
    assert turned.values == pytest.approx(bench.firmware.signals.estimate[6:12].tolist(), abs=2e-3)
    health = [sample for sample in samples if sample.block is telemetry.BLOCKS[3]][-1]
    assert health.values[4] == State.FLYING


def test_measurement_queue_has_the_originals_length(bench: FirmwareBench) -> None:
    bench.run(1_000_000)
    assert bench.firmware.measurements.length == MEASUREMENT_QUEUE == 20
    assert bench.firmware.measurements.dropped == 0


def test_gyro_zero_is_the_mean_of_a_still_window() -> None:
    zero = GyroZero()
    found = [zero.add((5 if k % 2 else 7, -3, 100, 0, 0, 0)) for k in range(SAMPLES)]
    assert found == [False] * (SAMPLES - 1) + [True]
    assert zero.bias == (6.0, -3.0, 100.0)


def test_gyro_zero_waits_until_the_robot_is_still() -> None:
    zero = GyroZero()
    for k in range(SAMPLES):
        assert not zero.add((500 if k < 256 else -500, 0, 0, 0, 0, 0))
    assert zero.bias is None
    assert zero.windows_refused == 1
    assert [zero.add((1, 2, 3, 0, 0, 0)) for _ in range(SAMPLES)][-1]
    assert zero.bias == (1.0, 2.0, 3.0)


def test_an_error_in_a_task_names_task_and_time(bench: FirmwareBench) -> None:
    bench.run(50_000)
    bench.imu = None  # type: ignore[assignment]  # a driver that returns nonsense
    with pytest.raises(FirmwareError, match=r"task KALMAN at 5[01]\.\d+ ms: TypeError"):
        bench.run(60_000)
