"""What links to real boards have in common, on a back end that sends when the test lets it."""

import re
import threading
from itertools import pairwise
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.wire.crtp import PORT_CONSOLE, Packet, encode
from ground_station.clock import clock_us
from ground_station.config import LinkSettings
from ground_station.errors import LinkError
from ground_station.latency import LinkLatency, budget_of, columns_of
from ground_station.links.core_client import runs
from ground_station.links.crazyradio import ECHO, OWN_ECHO, CrazyradioLink
from ground_station.links.live_link import MAX_AGE_US, PIECES, LiveLink
from ground_station.mocap import MocapFrame
from ground_station.trajectory import Goal

HOME = Goal((0.0, 0.0, 1.15), 0.0)
PATIENCE_S = 30.0


class Board(LiveLink):
    """Notes the numbers of the poses that it sends, each after a `gate`; connects in `steps`."""

    def __init__(self, latency_us=0, steps=1):
        super().__init__("board:1", LinkLatency("air", latency_us, measured=False))
        self.numbers, self.opened, self.steps, self.failure = [], 0, steps, ""
        self.sending, self.gate = threading.Event(), threading.Event()
        self.gate.set()

    def _open(self):
        self.opened += 1

    def _connect(self):
        self.steps -= 1
        self.received_us = clock_us()
        return self.steps == 0

    def _why_no_connection(self, now_us, within):
        return "never"

    def _send(self, now_us, frame, goal):
        self.sending.set()
        assert self.gate.wait(PATIENCE_S)
        self.numbers.append(frame.p_WB[0])

    def _failure(self):
        return self.failure

    def _close(self):
        self.opened -= 1

    def start_telemetry(self, now_us): ...

    def receive(self, now_us, data):
        return ()

    def ask(self, now_us, request): ...

    def answer(self, now_us): ...

    def summary(self):
        return ""

    def put(self, number, age_us=-3_600_000_000):
        """A pose that stays fresh for an hour, however slow this machine is."""
        now_us = clock_us()
        self.send(now_us, MocapFrame(now_us - age_us, (number, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), True), HOME)


@pytest.mark.long
@given(st.sets(st.integers(0, 300)), st.integers(1, 30))
def test_pieces_cover_the_changed_places_of_a_core_s_memory_and_each_fits_a_packet(places, longest):
    pieces = list(runs(sorted(places), longest))
    assert all(1 <= size <= longest for _, size in pieces)
    assert all(offset in places and offset + size - 1 in places for offset, size in pieces)
    covered = [place for offset, size in pieces for place in range(offset, offset + size)]
    assert covered == sorted(set(covered))
    assert places <= set(covered)
    assert all(
        later - offset >= longest for (offset, _), (later, _) in pairwise(pieces)
    )  # as few as possible


def test_a_piece_begins_at_a_changed_place_and_reaches_as_far_as_a_packet():
    assert list(runs([0, 5, 9, 10, 18, 20, 21], 10)) == [(0, 10), (10, 9), (20, 2)]
    assert list(runs([3], 1)) == [(3, 1)]
    assert list(runs([], 10)) == []


def opened(**options):
    board = Board(**options)
    board.open(lambda: False)
    return board


def test_the_newest_pose_replaces_those_that_wait_for_the_line():
    board = opened()
    board.gate.clear()
    board.put(1)
    assert board.sending.wait(PATIENCE_S)
    for number in (2, 3, 4, 5):
        board.put(number)
    board.gate.set()
    wait_for(board, 5)
    assert (board.numbers, board.sent, board.late) == ([1, 5], 2, 3)
    board.close()


def wait_for(board, count):
    """Until the sender has done what lies before it."""
    done = threading.Event()
    board._do(done.set)
    assert done.wait(PATIENCE_S)
    assert board.sent + board.late == count


@pytest.mark.parametrize(("latency_us", "age_us"), [(0, MAX_AGE_US + 1), (100_000, MAX_AGE_US - 99_999)])
def test_a_pose_that_would_be_too_old_on_board_stays_here(latency_us, age_us):
    board = opened(latency_us=latency_us)
    board.put(1, age_us)
    wait_for(board, 1)
    board.put(2)
    wait_for(board, 2)
    assert (board.numbers, board.late) == ([2], 1)
    (line,) = board.notices()
    assert re.fullmatch(r"poses (\d+) ms old on their arrival on board: at most 120 ms", line)
    board.put(3, age_us)
    wait_for(board, 3)
    assert board.notices() == []  # not again at once
    board.close()


def test_a_muted_link_sends_nothing_until_it_is_opened_again():
    board = Board(steps=1)
    board.put(1)
    board.open(lambda: False)
    board.put(2)
    wait_for(board, 1)
    board.supervisor_state = 2
    board.mute()
    assert board.supervisor_state is None
    board.put(3)
    wait_for(board, 1)
    board.close()
    board.steps = 1
    board.open(lambda: False)
    board.put(4)
    wait_for(board, 2)
    assert board.numbers == [2, 4]
    board.close()


@pytest.mark.parametrize(
    ("stops", "failure", "why"), [(True, "", "stopped while connecting"), (False, "no", "no")]
)
def test_a_failed_connection_closes_the_device(stops, failure, why):
    board = Board(steps=5)
    board.failure = failure
    with pytest.raises(LinkError, match=f"^board:1: {why}$"):
        board.open(lambda: stops)
    assert board.opened == 0


def test_a_link_that_was_never_opened_keeps_no_pose_and_can_be_closed():
    board = Board()
    board.put(1)
    board.close()
    board.opened = 0
    board.open(lambda: False)
    board.put(2)
    wait_for(board, 1)
    assert board.numbers == [2]
    board.close()


def test_a_board_that_is_silent_for_two_seconds_is_lost():
    board = opened()
    board.received_us = clock_us()
    board.check()
    board.received_us = clock_us() - 2_000_001
    with pytest.raises(LinkError, match=r"^board:1: lost: silent for 2 s$"):
        board.check()
    board.failure = "pulled out"
    with pytest.raises(LinkError, match=r"^board:1: lost: pulled out$"):
        board.check()
    board.close()


def test_unread_data_is_bounded():
    board = opened()
    for _ in range(PIECES + 10):
        board._on_bytes(b"x")
    assert len(board.received()) == PIECES
    assert board.received() == []
    board.close()


def test_console_lines_become_notices():
    link = CrazyradioLink("udp://127.0.0.1:19850", LinkSettings(50.0, 0, 0))
    for piece in (b"imu: gyro ", b"zero found\nsuper", b"visor: flying\n\n"):
        assert link.receive(0, encode(Packet(PORT_CONSOLE, 0, piece))) == ()
    assert link.notices() == ["board: imu: gyro zero found", "board: supervisor: flying"]
    assert link.notices() == []


def test_half_the_median_round_trip_of_its_own_echoes_is_the_latency(monkeypatch):
    link, now_us = CrazyradioLink("radio://0/80/2M", LinkSettings(50.0, 1300, 0)), 5_000_000
    monkeypatch.setattr("ground_station.links.crazyradio.clock_us", lambda: now_us)

    def echo(round_trip_us, kind=OWN_ECHO, channel=0, more=b""):
        data = ECHO.pack(kind, now_us - round_trip_us) + more
        link._on_echo(SimpleNamespace(channel=channel, data=data))

    assert (link.latency.us, str(link.latency)) == (1300, "radio (assumed)")
    echo(900, kind=0)  # cflib's own, and packets that are none
    echo(900, channel=1)
    echo(900, more=b"x")
    assert not link.latency.measured
    for round_trip_us in (4000, 3000, 90_000):
        echo(round_trip_us)
    assert (link.latency.us, str(link.latency)) == (2000, "radio")
    for _ in range(30):  # of which the last thirty count
        echo(2600)
    assert link.latency.us == 1300


@pytest.mark.parametrize(
    ("count", "p99_us"), [(1, 1), (99, 99), (100, 99), (101, 100), (200, 198), (201, 199)]
)
def test_99_of_100_poses_are_no_older_than_the_p99(count, p99_us):
    rows = [(float("nan"),) * 3 + (float(number), 0.0, 0.0) for number in range(count, 0, -1)]
    pose, *_ = budget_of(columns_of(rows), "radio")
    assert (pose.name, pose.p99_us) == ("pose", p99_us)
    assert (
        sum(row[3] <= pose.p99_us for row in rows) >= 0.99 * count > sum(row[3] < pose.p99_us for row in rows)
    )


def test_a_link_that_is_opened_again_has_nothing_of_the_time_before():
    board = opened()
    board.gate.clear()
    board.put(1)
    assert board.sending.wait(PATIENCE_S)
    board.put(2)  # waits in the mailbox
    board._on_bytes(b"old")
    board.mute()
    board.gate.set()
    board.close()
    board._connect, before = lambda: True, board.received_us
    board.open(lambda: False)
    assert (before > 0, board.received_us, board.received()) == (True, 0, [])
    board.put(3)
    wait_for(board, 2)
    assert board.numbers == [1, 3]
    board.close()


@pytest.mark.parametrize(
    ("after_us", "why"), [(4_000_000, ""), (4_000_001, "never"), (60_000_001, "not connected after 60 s")]
)
def test_a_board_that_does_not_connect_is_given_up_with_the_reason(monkeypatch, after_us, why):
    monkeypatch.setattr("ground_station.links.live_link.clock_us", lambda: 7 + after_us)
    assert Board()._why_hopeless(7, lambda: False) == why
