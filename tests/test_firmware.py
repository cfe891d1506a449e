"""The firmware as a whole against a board of plain numbers: timing, hand-over, queues, failsafe."""

from collections.abc import Sequence
from itertools import pairwise

import pytest

from firmware_py.board import DECK_MEMORY_SIZE, EEPROM_SIZE, ImuCounts
from firmware_py.drivers.imu import SAMPLES, GyroZero
from firmware_py.errors import FirmwareError
from firmware_py.firmware import MEASUREMENT_QUEUE, Firmware
from firmware_py.wire import crtp, telemetry
from firmware_py.wire.supervisor import State
from hil.config import load_config
from hil.events import EventQueue

HOVER_COUNTS = [
    21000 + int(sign * 0.436332 * 31290 + 32767 + shift) * 21000 // 65535  # the original's mapping, +-25 deg
    for sign, shift in zip((1, -1, 1, -1), (-3600, -5000, -9000, 6200), strict=True)
]
LEVEL = (1.0, 0.0, 0.0, 0.0)


class Bench:
    """A board without a world: still IMU, pins that remember, and the loop of the harness."""

    def __init__(self) -> None:
        self.events = EventQueue()
        self.imu: ImuCounts = (3, -2, 1, 0, 0, 1365)
        self.imu_alive = True
        self.radio_open = True
        self.writes: list[tuple[int, list[int]]] = []
        self.sent: list[tuple[int, bytes]] = []
        self.console: list[str] = []
        self.now_us = 0
        self.battery_mv = 3900
        self.eeprom = bytearray(b"\xff" * EEPROM_SIZE)
        self.deck_memory = bytearray(b"\xff" * DECK_MEMORY_SIZE)
        self.firmware = Firmware(load_config(), self)
        self.events.at(1000, self._sample)

    def read_imu(self) -> ImuCounts:
        return self.imu

    def read_battery_mv(self) -> int:
        return self.battery_mv

    def write_compare(self, counts: Sequence[int]) -> None:
        self.writes.append((self.now_us, list(counts)))

    def radio_send(self, data: bytes) -> bool:
        if self.radio_open:
            self.sent.append((self.now_us, data))
        return self.radio_open

    def debug_write(self, text: str) -> None:
        self.console.append(text)

    def _sample(self, now_us: int) -> None:
        if self.imu_alive:
            self.firmware.imu_ready()
        self.events.at(now_us + 1000, self._sample)

    def pose(
        self, at_us: int, p: tuple[float, float, float] = (0.0, 0.0, 0.0), age_us: int | None = 40_000
    ) -> None:
        data = crtp.encode_ext_pose(p, LEVEL, age_us)
        self.events.at(at_us, lambda now_us: self.firmware.radio_received(data))

    def poses(self, start_us: int, end_us: int, p: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        for at_us in range(start_us, end_us, 20_000):
            self.pose(at_us, p)

    def stream(self, at_us: int) -> None:
        data = telemetry.encode_stream_request(True)
        self.events.at(at_us, lambda now_us: self.firmware.radio_received(data))

    def run(self, end_us: int) -> None:
        while self.now_us < end_us:
            wakes = [end_us, self.events.next_us, self.firmware.next_wake_us]
            self.now_us = min(wake for wake in wakes if wake is not None)
            self.events.run(self.now_us)
            self.firmware.run(self.now_us)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_flaps_are_at_hover_before_the_first_tick(bench: Bench) -> None:
    assert bench.writes[0][1] == HOVER_COUNTS


def test_controller_writes_counts_every_ten_milliseconds(bench: Bench) -> None:
    bench.run(200_000)
    late_us = [t - 10_000 * k for k, (t, _) in enumerate(bench.writes[1:], 1)]
    cost = load_config().cpu
    assert len(late_us) == 19
    assert set(late_us) == {cost.stabilizer_us + cost.controller_us}


def test_loop_closes_after_gyro_zero_and_first_pose(bench: Bench) -> None:
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


def test_a_pose_reaches_the_flaps_within_eleven_milliseconds(bench: Bench) -> None:
    bench.poses(605_000, 800_000)
    bench.run(800_000)
    before = bench.writes[-1][1]
    bench.pose(805_000, (0.0, 0.05, 0.0))
    bench.run(830_000)
    changed = next(t for t, counts in bench.writes if t > 805_000 and counts != before)
    assert 805_000 < changed <= 816_000


def test_silence_of_half_a_second_is_a_failsafe_and_a_pose_ends_it(bench: Bench) -> None:
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


def test_controller_goes_on_when_the_imu_falls_silent(bench: Bench) -> None:
    bench.poses(605_000, 2_000_000)
    bench.run(1_000_000)
    bench.imu_alive = False
    bench.run(1_500_000)
    times = [t for t, _ in bench.writes if t > 1_010_000]
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert times[-1] > 1_480_000
    assert max(gaps) <= 20_000


def test_garbage_on_the_radio_is_counted_and_flies_on(bench: Bench) -> None:
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


def test_a_radio_that_takes_nothing_fills_the_queue_and_counts(bench: Bench) -> None:
    bench.radio_open = False
    bench.stream(0)
    bench.run(3_000_000)
    queue = next(queue for queue in bench.firmware.kernel.queues if queue.name == "crtpTx")
    assert len(queue) == queue.high_water == 120
    assert queue.dropped > 0
    bench.radio_open = True
    bench.run(3_100_000)
    assert len(queue) == 0


def test_telemetry_leaves_at_fifty_hertz_with_the_running_values(bench: Bench) -> None:
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


def test_measurement_queue_has_the_originals_length(bench: Bench) -> None:
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


def test_an_error_in_a_task_names_task_and_time(bench: Bench) -> None:
    bench.run(50_000)
    bench.imu = None  # type: ignore[assignment]  # a driver that returns nonsense
    with pytest.raises(FirmwareError, match=r"task KALMAN at 5[01]\.\d+ ms: TypeError"):
        bench.run(60_000)
