"""Laws of every `BoardFirmware`: the firmware in Python, an image on the emulated chip, a board in the loop on a link.

The image is the tests' own firmware, which knows no flight; the board in the loop is the exported app on this machine.
"""

import random
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from firmware_py.signals import COUNTERS
from firmware_py.wire.supervisor import Cause, State
from ground_station.links.core_client import CoreClient
from hil.board.board_firmware import BoardFirmware, Executor, PowerOn, PythonBoard
from hil.board.pins import VirtualBoard
from hil.board.real_firmware import RealBoard
from hil.config import load_config
from hil.emulator.events import EventQueue
from support.app_air import AppAir
from support.crazyflie_app import App
from support.stm32_firmware import build

CONFIG = load_config()
SAMPLE_US = 1_000
LEVEL = (0, 0, 0, 0, 0, 2731)
POSE = bytes((0x61, 8)) + np.array((0.01, 0, 0, 0, 0, 0, 1), "<f4").tobytes()
NOISE = random.Random(5)

# The signals of a board that flies the core, and of an image without it, which shows Bitcraze's own.
OF_CORE = [(16,), (len(COUNTERS),), (4,), (4,), (4,)]
OF_STOCK = [(12,), (0,), (0,), (0,), (4,)]

Make = Callable[[EventQueue], Executor]


def has_core(firmware: BoardFirmware) -> bool:
    return firmware.signals.estimate.shape == OF_CORE[0]


def image() -> Executor:
    pytest.importorskip("unicorn")
    pytest.importorskip("cffi")
    from hil.board.image_firmware import ChipImage

    return ChipImage.load(build(), None)


@pytest.fixture(params=["python", "image", "real"])
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Make]:
    if request.param == "python":
        yield lambda events: PythonBoard()
    elif request.param == "image":
        yield lambda events: image()
    else:
        app = App(request.getfixturevalue("library"), tmp_path / "copy.so")
        app.boot()
        air = AppAir(app)

        def real(events: EventQueue) -> Executor:
            air.join(events)
            return RealBoard(CoreClient(air, "app"), False, air)

        yield real


class Bench:
    """A board at rest and level, whose gyro's last bit is never still."""

    def __init__(self, make: Make) -> None:
        self.events = EventQueue()
        self.counts: list[tuple[int, ...]] = []
        self.said: list[str] = []
        self.pins = VirtualBoard(
            self._move, lambda now_us, data: True, lambda now_us, text: self.said.append(text)
        )
        self.executor = make(self.events)
        self.now_us = self.booted_us = 0
        self.boot()

    def boot(self) -> BoardFirmware:
        self.booted_us = self.now_us
        self.pins.boot(self.now_us)
        assert self.pins.now_us == self.now_us  # until the new processor has a clock
        self.firmware = self.executor.boot(PowerOn(self.pins, CONFIG, False, False, None))
        self.pins.run_on(self.firmware.kernel, self.events)
        return self.firmware

    def run(self, us: int, packets: Sequence[bytes] = ()) -> None:
        waiting = list(packets)
        for _ in range(us // SAMPLE_US):
            self.firmware.kernel.run(
                self.now_us - self.booted_us, self.now_us - self.booted_us + SAMPLE_US - 1
            )
            self.now_us += SAMPLE_US
            self.firmware.kernel.advance(self.now_us - self.booted_us)
            self.events.run(self.now_us)
            self.pins.measure((*LEVEL[:2], NOISE.choice((-1, 0, 1)), *LEVEL[3:]))
            self.firmware.imu_ready()
            if waiting:
                self.firmware.radio_received(waiting.pop(0))
            self.firmware.kernel.run(self.now_us - self.booted_us)

    def _move(self, now_us: int, counts: Sequence[int]) -> None:
        self.counts.append(tuple(counts))


@pytest.fixture
def bench(make: Make) -> Bench:
    return Bench(make)


@pytest.mark.long
def test_time_counts_from_the_boot_and_goes_where_it_is_led(bench: Bench) -> None:
    kernel = bench.firmware.kernel
    assert kernel.now_us == 0
    bench.run(20_000)
    assert kernel.now_us == 20_000
    kernel.run(20_000, 20_900)
    kernel.advance(20_950)
    assert kernel.now_us == 20_950


@pytest.mark.long
def test_views_have_the_core_s_shapes_and_follow_it(bench: Bench, request: pytest.FixtureRequest) -> None:
    assert has_core(bench.firmware) == (request.node.callspec.params["make"] != "image")
    signals = bench.firmware.signals
    views = (signals.estimate, signals.counters, signals.u, signals.flap, signals.count)
    assert [view.shape for view in views] in (OF_CORE, OF_STOCK)
    assert [str(view.dtype) for view in views] == ["float32", "int32", "float32", "float32", "int32"]
    bench.run(30_000)
    if has_core(bench.firmware):
        assert bench.firmware.signals is signals
    if bench.counts and signals.count.any():
        assert tuple(signals.count.tolist()) == bench.counts[-1]


@pytest.mark.long
def test_a_supervisor_calibrates_first_and_has_no_cause(bench: Bench) -> None:
    supervisor = bench.firmware.signals.supervisor
    first = State.CALIBRATING if has_core(bench.firmware) else State.WAITING
    assert (supervisor.state, supervisor.cause) == (first, Cause.NONE)
    bench.run(30_000)
    assert supervisor.state in State
    assert supervisor.cause in Cause


@pytest.mark.long
def test_poses_are_counted_and_the_last_one_has_its_age_in_microseconds(bench: Bench) -> None:
    if not has_core(bench.firmware):
        return
    bench.run(1_000_000)  # the gyro's zero is found
    place, ages_us = COUNTERS.index("pose_age_us"), []
    for _ in range(10):
        bench.run(
            21_000, [POSE + bytes((2 * 30,))]
        )  # 30 ms old on arrival, at every phase of the estimator's steps
        ages_us.append(bench.firmware.signals.counters[place])
    counters = dict(zip(COUNTERS, bench.firmware.signals.counters.tolist(), strict=True))
    assert (8 <= counters["fused"] <= 10, counters["refused"]) == (True, 0)
    shown = {variable.name: variable.read for variable in bench.firmware.variables}
    added_us = shown["loop.added"]() if "loop.added" in shown else 0
    assert added_us == pytest.approx(3000 * ("loop.added" in shown), abs=1000)  # the link's way
    assert min(ages_us[1:]) == pytest.approx(30_000 + added_us, abs=1200)
    assert max(ages_us[1:]) == pytest.approx(40_000 + added_us, abs=1200)


@pytest.mark.long
def test_variables_have_names_of_their_own_and_numbers_of_their_types(bench: Bench) -> None:
    bench.run(50_000)
    names = [variable.name for variable in bench.firmware.variables]
    assert len(set(names)) == len(names)
    for variable in bench.firmware.variables:
        assert all(variable.name.partition("."))
        value = variable.read()
        assert variable.scalar.is_float or value == variable.scalar.cast(value), variable.name


@pytest.mark.long
def test_scheduler_and_statistics_report_the_same_tasks(bench: Bench) -> None:
    bench.run(100_000)
    scheduler, reports = bench.firmware.scheduler, bench.firmware.reports()
    if scheduler is None:
        assert not reports
        return
    names = [task.name for task in scheduler.tasks]
    assert len(set(names)) == len(names) == len(scheduler.run_times_us())
    assert {report.name for report in reports} <= set(names)
    times = dict(zip(names, scheduler.run_times_us(), strict=True))
    assert all(times[report.name] == report.run_time_us for report in reports)
    assert 90_000 < sum(times.values()) < 101_000
    assert all(task.deadline_misses == 0 for task in scheduler.tasks)
    assert scheduler.current.name in names
    assert all(queue.dropped == 0 <= queue.high_water <= queue.length for queue in scheduler.queues)


@pytest.mark.long
def test_interrupt_load_is_counted_beside_the_tasks(bench: Bench) -> None:
    scheduler = bench.firmware.scheduler
    if scheduler is None:
        return
    bench.run(30_000)
    scheduler.occupy("LOAD", lambda: 300)
    bench.run(50_000)
    times = dict(zip((task.name for task in scheduler.tasks), scheduler.run_times_us(), strict=True))
    assert times["LOAD"] == pytest.approx(50 * 300, abs=300)
    assert 70_000 < sum(times.values()) < 81_000


@pytest.mark.long
def test_a_trace_goes_forward_and_ends(bench: Bench) -> None:
    scheduler = bench.firmware.scheduler
    if scheduler is None:
        return
    bench.run(30_000)
    rows: list[tuple[int, str, str, int, int]] = []
    scheduler.set_trace(lambda *row: rows.append(row))
    bench.run(20_000)
    scheduler.set_trace(None)
    assert scheduler.trace is None
    times = [row[0] for row in rows]
    assert times == sorted(times)
    assert 30_000 <= times[0] <= times[-1] <= 50_000
    assert {row[2] for row in rows if row[1] == "IN"} <= {task.name for task in scheduler.tasks}
    count = len(rows)
    bench.run(20_000)
    assert len(rows) == count


def test_whatever_the_radio_brings_the_board_goes_on(bench: Bench) -> None:
    packets = [bytes((0x61, *NOISE.randbytes(NOISE.randrange(31)))) for _ in range(40)]
    bench.run(60_000, [*packets, *(NOISE.randbytes(NOISE.randrange(1, 32)) for _ in range(20))])
    bench.firmware.radio_polled()
    bench.firmware.uart_ready()
    bench.firmware.radio_received(POSE, broadcast=True)
    bench.run(60_000)
    bench.firmware.check_watchdog()
    assert bench.firmware.kernel.now_us == 120_000


@pytest.mark.long
def test_servos_get_four_counts_of_a_pulse(bench: Bench) -> None:
    bench.run(100_000)
    assert all(len(counts) == 4 for counts in bench.counts)
    assert all(0 <= count <= 52_501 for counts in bench.counts for count in counts)  # 0: not set yet


@pytest.mark.long
def test_missing_reports_are_none(bench: Bench) -> None:
    firmware = bench.firmware
    assert firmware.mavlink is None
    assert firmware.overrun == ""
    assert firmware.usage is None
    before = firmware.clock_us
    bench.run(20_000)
    after = firmware.clock_us
    assert (before is None) == (after is None)
    assert before is None or after is None or after >= before
    if firmware.flashed is not None:
        assert firmware.flashed.resets == 0
        assert "\n" not in firmware.flashed.differences(CONFIG)
        report = firmware.flashed.report()
        assert len(report.sha256) == 64
        assert len(report.stack_free_bytes) >= len(firmware.scheduler.tasks) > 1
        assert (report.watchdog_resets, report.software_resets) == (0, 0)


@pytest.mark.long
def test_a_reboot_restores_the_initial_views(bench: Bench) -> None:
    bench.run(30_000)
    first = bench.firmware
    again = bench.boot()
    assert again is not first
    assert again.kernel.now_us == 0
    assert [one.name for one in again.variables] == [one.name for one in first.variables]
    assert has_core(again) == has_core(first)
    assert again.signals.supervisor.state is (State.CALIBRATING if has_core(again) else State.WAITING)
    bench.run(30_000)
    assert again.kernel.now_us == 30_000


def test_a_packet_takes_no_negative_time_to_the_processor(bench: Bench) -> None:
    times = [bench.executor.wire_us(bytes(size)) for size in range(1, 32)]
    assert times == sorted(times)
    assert times[0] >= 0
