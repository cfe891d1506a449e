"""A board without a world: what it is fed, what it says and sends, and when."""

import math
from collections.abc import Iterator

import pytest

from firmware_py.rtos.errors import WatchdogError
from firmware_py.wire import crtp
from firmware_py.wire.crtp import Packet
from hil.config import load_config
from hil.errors import LabError
from hil.testing.board import BareBoard, UnmetExpectation

POSE = crtp.encode_ext_pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), 40_000)
ECHO = crtp.encode(Packet(15, 0, b"hello"))


@pytest.fixture
def board() -> BareBoard:
    return BareBoard(load_config())


def test_time_passes_only_when_it_is_let(board: BareBoard) -> None:
    assert board.now_us == 0
    board.run(ms=12.5)
    assert board.now_us == 12_500


def test_expect_returns_a_line_in_its_millisecond(board: BareBoard) -> None:
    assert board.expect("gyro zero", within_ms=2000) == "imu: gyro zero found, 0.0 0.0 0.0 counts"
    said_us = board.now_us
    again = BareBoard(load_config())
    again.run(ms=said_us / 1000 - 1)
    assert again.console == []
    again.run(ms=1)
    assert len(again.console) > 0


def test_a_line_counts_once_and_those_before_it_not_at_all(board: BareBoard) -> None:
    board.expect("supervisor: waiting", within_ms=1000)
    board.run(ms=0.5)
    with pytest.raises(UnmetExpectation) as error:
        board.expect("gyro zero", within_ms=20)
    begin = f"'gyro zero' not printed within 20 ms from {board.now_us / 1000 - 20:g} ms on; the board "
    assert str(error.value).startswith(begin)
    assert str(error.value).endswith("the board printed: nothing")


def test_other_lines_are_shown_on_failure(board: BareBoard) -> None:
    with pytest.raises(
        UnmetExpectation, match=r"from 0 ms on; the board printed:\n  imu: gyro zero found.*\n  super"
    ):
        board.expect("flying", within_ms=1000)
    assert board.now_us == 1_000_000


def test_poses_at_50_hz_let_it_fly_and_silence_ends_that(board: BareBoard) -> None:
    board.expect("gyro zero", within_ms=2000)
    board.receive(POSE, every_ms=20)
    board.expect("supervisor: flying", within_ms=500)
    board.run(ms=1000)
    board.stop_repeating()
    hushed_us = board.now_us
    board.expect("supervisor: failsafe", within_ms=1000)
    assert board.now_us - hushed_us == pytest.approx(load_config().supervisor.pose_timeout_us, abs=30_000)


def test_a_packet_is_answered_on_the_port_that_it_came_to(board: BareBoard) -> None:
    board.receive(ECHO)
    board.run(ms=5)
    (answer,) = [data for t_us, data in board.sent if data[0] >> 4 == 15]
    assert crtp.decode(answer).data == b"hello"


def test_rates_come_out_as_they_were_fed(board: BareBoard) -> None:
    board.expect("gyro zero", within_ms=2000)
    board.feed_imu(omega_B=(0.1, -0.2, 0.3))
    board.run(ms=20)
    rates = [board.read(f"gyro.{axis}") for axis in "xyz"]
    assert rates == pytest.approx([math.degrees(0.1), math.degrees(-0.2), math.degrees(0.3)], abs=0.2)


def test_forces_come_out_as_they_were_fed_and_counts_go_before_them(board: BareBoard) -> None:
    board.feed_imu(f_B=(1.0, -2.0, 9.0))
    board.run(ms=20)
    forces = [board.read(f"acc.{axis}") for axis in "xyz"]
    assert forces == pytest.approx([1.0 / 9.81, -2.0 / 9.81, 9.0 / 9.81], abs=0.005)
    board.feed_imu(f_B=(1.0, 1.0, 1.0), counts=(0, 0, 0, 0, 0, 1365))
    board.run(ms=20)
    assert board.read("acc.z") == pytest.approx(1365 * 24 / 32768, abs=1e-3)


def test_a_silent_imu_finds_no_zero(board: BareBoard) -> None:
    board.imu_running = False
    board.run(ms=300)
    assert board.console == []


def test_a_task_that_takes_the_processor_for_ever_ends_in_a_watchdog_reset(board: BareBoard) -> None:
    kernel = board.firmware.kernel

    def hog() -> Iterator[int]:
        yield from kernel.work(10_000_000)

    board.run(ms=100)
    kernel.create_task("HOG", 6, hog)
    with pytest.raises(WatchdogError, match="STABILIZER has not run"):
        board.run(ms=1000)


def test_tasks_battery_and_counts_are_those_of_the_firmware(board: BareBoard) -> None:
    assert len(board.counts) == 4
    board.run(ms=500)
    tasks = board.tasks
    assert tasks["SENSORS"].activations == pytest.approx(500, abs=2)
    assert tasks["STABILIZER"].deadline_misses == 0
    board.battery_mv = 3700
    assert board.battery_mv == 3700
    board.run(ms=1000)
    assert board.read("pm.vbat") == pytest.approx(3.7)


def test_a_log_variable_that_is_not_there_is_one_line(board: BareBoard) -> None:
    with pytest.raises(LabError, match=r"log variable 'a\.b': there is none"):
        board.read("a.b")


def test_with_a_serial_line_it_speaks_mavlink() -> None:
    from pymavlink.dialects.v20 import common

    board = BareBoard(load_config(), serial=True)
    board.run(ms=1500)
    parser = common.MAVLink(None)
    heard = [message for _, data in board.sent for message in parser.parse_buffer(data) or []]
    assert any(message.get_type() == "HEARTBEAT" for message in heard)
    ping = common.MAVLink(None, srcSystem=255)
    board.receive(common.MAVLink_timesync_message(0, 77).pack(ping))
    count = len(board.sent)
    board.run(ms=100)
    answers = [message for _, data in board.sent[count:] for message in parser.parse_buffer(data) or []]
    assert any(message.get_type() == "TIMESYNC" and message.ts1 == 77 for message in answers)
