"""The offset between two clocks, against clocks whose offset is known."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_py.links.mavlink_poses import DRIFT_PPM, LONGEST_US, UNKNOWN_US, WINDOW, RemoteClock

AHEAD_US = 1_700_000_000_000_000  # a station with the time of day against a board that counts from boot

delays = st.integers(0, LONGEST_US // 2)


def exchange(clock: RemoteClock, sent_us: int, there_us: int, back_us: int, ahead_us: int = AHEAD_US) -> bool:
    """One request with these delays; returns whether the answer was of use."""
    clock.request(sent_us)
    return clock.answer(sent_us + there_us + back_us, sent_us, sent_us + there_us + ahead_us)


def test_the_offset_is_unknown_before_the_first_answer() -> None:
    clock = RemoteClock()
    clock.request(1000)
    assert clock.offset_us(2000) is None


@pytest.mark.long
@given(st.lists(st.tuples(delays, delays), min_size=1, max_size=2 * WINDOW))
def test_the_offset_error_is_at_most_half_the_shortest_round_trip(rounds: list[tuple[int, int]]) -> None:
    clock = RemoteClock()
    for number, (there_us, back_us) in enumerate(rounds):
        exchange(clock, number * 500_000, there_us, back_us)
    now_us = len(rounds) * 500_000
    offset_us = clock.offset_us(now_us)
    window = rounds[-WINDOW:]
    aging_us = len(window) * 500_000 * DRIFT_PPM // 1_000_000  # by which an older one must have been better
    best_us = min(there_us + back_us for there_us, back_us in window) // 2
    if best_us + aging_us <= UNKNOWN_US:
        assert offset_us is not None
    if offset_us is not None:
        assert abs(offset_us - AHEAD_US) <= best_us + aging_us + 1


@pytest.mark.long
@given(st.integers(-DRIFT_PPM, DRIFT_PPM), st.lists(st.tuples(delays, delays), min_size=40, max_size=40))
def test_drifting_clocks_never_contradict_themselves(ppm: int, rounds: list[tuple[int, int]]) -> None:
    clock = RemoteClock()
    exchange(clock, 0, 1000, 1000)
    for number, (there_us, back_us) in enumerate(rounds, 1):
        sent_us = number * 500_000
        drift_us = (sent_us + there_us) * ppm // 1_000_000
        exchange(clock, sent_us, there_us, back_us, AHEAD_US + drift_us)
        if number < WINDOW:  # the good first one is still remembered
            offset_us = clock.offset_us(sent_us + there_us + back_us)
            assert offset_us is not None
            assert abs(offset_us - AHEAD_US - drift_us) <= 1000 + 2 * number * 50 + 60


def test_a_reset_clock_is_accepted_at_once() -> None:
    clock = RemoteClock()
    for number in range(5):
        exchange(clock, number * 100_000, 1000, 1000)
    exchange(clock, 900_000, 20_000, 20_000, ahead_us=0)  # a far worse exchange than the old ones
    assert clock.offset_us(940_000) == 0


def test_an_answer_counts_once_and_only_when_it_was_asked_for() -> None:
    clock = RemoteClock()
    assert not clock.answer(5000, 1000, AHEAD_US)
    clock.request(1000)
    assert not clock.answer(5000, 1001, AHEAD_US)
    assert clock.answer(5000, 1000, AHEAD_US)
    assert not clock.answer(6000, 1000, AHEAD_US)
    assert clock.exchanges == 1


def test_of_more_requests_than_four_only_the_last_four_can_be_answered() -> None:
    for asked in range(1, 7):
        clock = RemoteClock()
        for number in range(asked):
            clock.request(1000 + number)
        answered = [clock.answer(5000, 1000 + number, AHEAD_US) for number in range(asked)]
        assert answered == [number >= asked - 4 for number in range(asked)]


def test_a_long_round_trip_is_not_believed() -> None:
    clock = RemoteClock()
    assert not exchange(clock, 0, LONGEST_US, 1)
    assert clock.offset_us(LONGEST_US + 1) is None
    assert exchange(clock, LONGEST_US + 1, LONGEST_US - 1, 1)


def test_an_old_offset_is_forgotten() -> None:
    clock = RemoteClock()
    exchange(clock, 0, 1000, 1000)
    lasts_us = (UNKNOWN_US - 1000) * 1_000_000 // DRIFT_PPM
    assert clock.offset_us(lasts_us) == AHEAD_US
    assert clock.offset_us(lasts_us + 1_000_000) is None
