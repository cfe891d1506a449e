"""Simulated time against the wall clock, on a wall clock that only moves when it is told to."""

import fcntl
import math
import os
import resource
import socket
import time
from pathlib import Path

import pytest

from hil.board import clock
from hil.board.clock import FreeRunning, Paced


class Wall:
    """Stands for the module `time`: sleeping takes exactly as long as asked."""

    def __init__(self) -> None:
        self.us = 5_000_000

    def monotonic_ns(self) -> int:
        return self.us * 1000

    def sleep(self, duration_s: float) -> None:
        self.us += round(duration_s * 1e6)


@pytest.fixture
def wall(monkeypatch: pytest.MonkeyPatch) -> Wall:
    wall = Wall()
    monkeypatch.setattr(clock, "time", wall)
    return wall


def test_a_paced_instant_happens_when_the_wall_clock_has_reached_it(wall: Wall) -> None:
    paced, begin_us = Paced(), wall.us
    for now_us in (0, 10_000, 15_000, 2_000_000):
        paced.wait_until(now_us)
        assert wall.us - begin_us == now_us
    assert paced.stood_still_us == 0
    assert paced.notices() == []


def test_a_little_lateness_is_made_up_for(wall: Wall) -> None:
    paced = Paced()
    paced.start(0)
    wall.us += 19_000
    paced.wait_until(1000)
    paced.wait_until(30_000)
    assert paced.now_us() == 30_000
    assert (paced.stood_still_us, paced.notices()) == (0, [])


def test_after_a_stall_time_continues_from_its_value(wall: Wall) -> None:
    paced = Paced()
    paced.start(0)
    wall.us += 301_000
    paced.wait_until(1000)
    assert paced.now_us() == 1000
    before_us = wall.us
    paced.wait_until(6000)
    assert wall.us - before_us == 5000  # no burst
    assert paced.stood_still_us == 300_000
    assert paced.notices() == ["this machine was too slow: time stood still for 300 ms"]
    assert paced.notices() == []


@pytest.mark.parametrize("stall_us", [0, 21_000, 77_000, 1_234_567])
def test_clocks_of_several_processes_are_in_phase_also_after_a_stall(wall: Wall, stall_us: int) -> None:
    phases = set()
    for delay_us in (0, 1_234, 19_999):  # between their starts
        wall.us += delay_us
        paced = Paced()
        paced.start(20_000)
        wall.us += stall_us
        paced.wait_until(27_000)
        phases.add((wall.us - paced.now_us()) % Paced.STALL_US)
    assert phases == {0}


def test_clocks_of_several_processes_stand_still_together(wall: Wall) -> None:
    pauses = memoryview(bytearray(3 * 8)).cast("q")
    clocks = [Paced(pauses, index) for index in range(3)]
    for paced in clocks:
        paced.start(0)
    wall.us += 111_000
    for paced, total_us in ((clocks[1], 100_000), (clocks[0], 0)):  # 101 ms late; 1 ms late after catching up
        paced.wait_until(10_000 if total_us else 110_000)
        assert paced.stood_still_us == total_us
    wall.us += 85_000
    clocks[1].wait_until(20_000)
    assert list(pauses) == [0, 160_000, 0]
    began_us = wall.us
    clocks[2].wait_until(150_000)  # 46 ms late, and 60 ms are the pause of the one that is 100 ms ahead
    assert (list(pauses), wall.us - began_us) == ([0, 160_000, 60_000], 14_000)
    wall.us += 45_000
    clocks[0].wait_until(120_000)  # 135 ms late, of which 60 are the other's and 60 its own
    assert (list(pauses), clocks[0].standstill_us(120_000)) == ([120_000, 160_000, 60_000], 120_000)


def test_input_that_comes_before_time_starts_is_not_in_the_past(wall: Wall) -> None:
    paced, (reader, writer) = Paced(), socket.socketpair()
    with reader, writer:
        heard: list[int] = []
        paced.readers[reader] = heard.append
        wall.us += 1
        paced.start(20_000)
        writer.send(b"early")
        paced.serve(paced.wait_until(30_000))
    assert heard == [20_000]


def test_all_who_have_input_are_called_at_its_instant_unless_another_one_closed_them(wall: Wall) -> None:
    paced, heard = Paced(), list[int]()
    pairs = [socket.socketpair() for _ in range(4)]
    for number, (reader, writer) in enumerate(pairs):
        paced.readers[reader] = lambda _, number=number: (
            heard.append(number),
            paced.readers.pop(pairs[3][0], None),
        )
        if number != 1:
            writer.send(b"input")
    paced.start(0)
    paced.serve(paced.wait_until(10_000))
    assert heard == [0, 2]
    paced.serve(10_000)
    paced.readers.clear()
    assert (heard, paced.wait_until(30_000)) == ([0, 2], 30_000), "input is served once"
    for pair in pairs:
        for end in pair:
            end.close()


def test_input_of_a_high_descriptor_is_read() -> None:
    """`select` refuses those above 1023."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, min(hard, 2048)), hard))
    paced, (reader, writer), heard = Paced(), socket.socketpair(), []
    high = socket.socket(fileno=fcntl.fcntl(reader, fcntl.F_DUPFD_CLOEXEC, 1200))
    with reader, writer, high:
        paced.readers[high] = heard.append
        paced.start(20_000)
        paced.serve(paced.wait_until(20_000))
        assert heard == []
        writer.send(b"input")
        paced.serve(paced.wait_until(10_000_000))
    assert len(heard) == 1
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_input_does_not_pass_an_event_that_a_task_has_planned_before_the_last_instant(wall: Wall) -> None:
    paced, (reader, writer) = Paced(), socket.socketpair()
    with reader, writer:
        paced.readers[reader] = lambda now_us: None
        paced.start(20_000)
        writer.send(b"input")
        wall.us += 30_000
        assert paced.wait_until(50_000) == 50_000
        assert paced.wait_until(40_000) == 40_000


def test_a_slow_machine_is_reported_once_per_second_and_every_stall_counts(wall: Wall) -> None:
    paced, lines = Paced(), []
    for now_us in range(0, 5_000_000, 50_000):
        paced.wait_until(now_us)
        wall.us += 75_000  # what 50 ms cost
        lines += paced.notices()
    told_ms = [int(line.split()[-2]) for line in lines]
    assert 4 <= len(lines) <= 6
    assert sum(told_ms) == pytest.approx(paced.stood_still_us / 1000, abs=600)
    assert paced.stood_still_us == pytest.approx(2_500_000, abs=60_000)


@pytest.mark.parametrize(("late_us", "stall_us"), [(-5, 0), (20_000, 0), (20_001, 20_000), (59_999, 40_000)])
def test_time_stalls_for_multiples_beyond_the_first(wall: Wall, late_us: int, stall_us: int) -> None:
    paced = Paced()
    assert paced.standstill_us(0) == 0  # before the start
    paced.start(0)
    wall.us += 1000 + late_us
    assert paced.standstill_us(1000) == late_us // 20_000 * 20_000 * (late_us > 0)
    paced.wait_until(1000)
    assert paced.stood_still_us == stall_us
    assert paced.standstill_us(1000) == stall_us + 20_000 * (late_us == 20_000)


def test_a_pause_takes_no_simulated_time(wall: Wall) -> None:
    paced = Paced()
    paced.start(0)
    wall.us += 7_000
    for _ in range(2):
        paced.pause(lambda: wall.sleep(3.0))
        assert paced.now_us() == 7_000


def test_the_pace_counts_from_the_first_look_at_its_instant(wall: Wall) -> None:
    pace = clock.Pace(1_000_000)
    wall.us += 5_000_000
    pace.start_when_due(999_999)
    assert pace.factor(1_000_000) == 0.2
    pace.start_when_due(1_000_000)
    wall.us += 1_000_000
    pace.start_when_due(2_000_000)
    wall.us += 1_000_000
    assert pace.factor(21_000_000) == 10.0


def test_free_running_time_never_waits() -> None:
    free = FreeRunning()
    free.wait_until(10**15)
    assert (free.stood_still_us, free.notices()) == (0, [])


def test_process_age_is_nan_where_unknown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    first = clock.process_age_s()
    assert 0.0 < first <= clock.process_age_s()
    (tmp_path / "stat").write_text(
        "7 (a (b) c) S " + " ".join(str(1000 * n) for n in range(4, 53))
    )  # proc(5)
    monkeypatch.setattr(clock, "PROCESS", tmp_path / "stat")
    since_boot_s = time.clock_gettime(time.CLOCK_BOOTTIME)
    assert clock.process_age_s() == pytest.approx(since_boot_s - 22_000 / os.sysconf("SC_CLK_TCK"), abs=1.0)
    monkeypatch.setattr(clock, "PROCESS", tmp_path / "none")
    assert math.isnan(clock.process_age_s())
