"""The order of hardware events."""

from functools import partial

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.emulator.events import EVENTS_AT_ONE_INSTANT, EndlessInstantError, EventQueue


@pytest.mark.long
@given(st.lists(st.integers(0, 20)), st.integers(0, 25))
def test_due_events_run_in_time_order_and_first_come_first_served(times, now_us):
    events, ran = EventQueue(), []
    for number, time_us in enumerate(times):
        events.at(time_us, lambda planned_us, number=number: ran.append((planned_us, number)))
    assert events.next_us == min(times, default=None)
    events.run(now_us)
    in_order = sorted((time_us, number) for number, time_us in enumerate(times))
    assert ran == [event for event in in_order if event[0] <= now_us]
    assert events.next_us == min((time_us for time_us in times if time_us > now_us), default=None)


def test_what_a_callback_plans_runs_in_the_same_run_when_due():
    events, ran = EventQueue(), []

    def again(time_us):
        ran.append(time_us)
        events.at(time_us + 10, again)

    events.at(0, again)
    events.run(35)
    assert ran == [0, 10, 20, 30]
    assert events.next_us == 40


def test_the_past_cannot_be_planned():
    events = EventQueue()
    events.run(10)
    events.at(10, lambda time_us: None)
    with pytest.raises(ValueError, match="9 us"):
        events.at(9, lambda time_us: None)


def test_a_callback_that_raises_leaves_the_rest_planned():
    events, ran = EventQueue(), []

    def fail(time_us):
        raise RuntimeError("broken")

    events.at(1, fail)
    events.at(2, ran.append)
    with pytest.raises(RuntimeError):
        events.run(5)
    assert events.next_us == 2
    events.run(5)
    assert ran == [2]


@pytest.mark.long
@given(
    st.lists(st.tuples(st.sampled_from([4, 5, 10, 12]), st.sampled_from([0, 5, 10])), max_size=4),
    st.integers(0, 4),
    st.lists(st.integers(1, 12), min_size=1, max_size=6),
)
def test_the_beat_happens_in_turn_like_what_is_planned_for_every_period(others, place, passed_us):
    """What repeats is planned among the others; runs go on in any portions, and may leave the beat if it is the last."""

    def ran(how, leave=False):
        events, log, now_us = EventQueue(), [], 0
        for number in range(len(others) + 1):
            if number == min(place, len(others)):
                getattr(events, how)(5, 5, lambda us: log.append((us, "beat")))
            if number < len(others):
                start_us, period_us = others[number]
                note = partial(lambda number, us: log.append((us, number)), number)
                events.every(period_us, start_us, note) if period_us else events.at(start_us, note)
        for portion_us in passed_us:
            now_us += portion_us
            if leave:
                events.run(now_us, leave_beat=True)
                assert events.other_us is None or events.other_us > now_us
            events.run(now_us)
        return log

    assert ran("every") == ran("set_beat") == ran("set_beat", leave=True)


def test_a_beat_that_is_last_is_left_on_request():
    events, ran = EventQueue(), []
    events.set_beat(10, 10, ran.append)
    events.every(10, 10, lambda us: ran.append(-us))
    events.run(10, leave_beat=True)
    assert (ran, events.next_us) == ([10, -10], 20)  # the beat came first
    events.at(20, lambda us: ran.append(0))
    events.run(20, leave_beat=True)
    assert ran[2:] == [20, -20, 0]
    events.at(25, ran.append)
    events.run(30, leave_beat=True)
    assert (ran[5:], events.next_us) == ([25, 30, -30], 40)


def test_there_is_one_beat():
    events, ran = EventQueue(), []
    for start_us in (1, 2, 3):
        events.set_beat(10, start_us, ran.append)
    events.run(13)
    assert ran == [1, 2, 3, 11, 12, 13]


def test_a_period_counts_from_the_planned_instant():
    events, ran = EventQueue(), []
    events.every(10, 5, ran.append)
    events.at(15, lambda planned_us: ran.append(-planned_us))
    events.run(12)
    events.run(38)  # late: nothing is skipped
    assert ran == [5, -15, 15, 25, 35]
    with pytest.raises(ValueError, match="period of 0"):
        events.every(0, 50, ran.append)


@pytest.mark.parametrize("in_a_run_for_each", [False, True])
def test_a_callback_that_plans_itself_at_its_own_instant_for_ever_is_named(in_a_run_for_each):
    events, ran = EventQueue(), []

    def again(time_us):
        ran.append(time_us)
        if not in_a_run_for_each:
            events.at(time_us, again)

    def run_for_ever():
        while True:
            events.at(2_000, again)
            events.run(2_000)

    with pytest.raises(
        EndlessInstantError, match=r"again at 0\.002000 s of simulated time: more than 10000 events"
    ):
        run_for_ever()
    assert len(ran) == EVENTS_AT_ONE_INSTANT


@pytest.mark.long
def test_events_of_many_instants_are_not_counted_together():
    events, ran = EventQueue(), []
    for time_us in range(0, 3 * EVENTS_AT_ONE_INSTANT // 2):
        events.at(time_us // 2, ran.append)
    for _ in range(EVENTS_AT_ONE_INSTANT):
        events.at(EVENTS_AT_ONE_INSTANT, ran.append)
    events.run(EVENTS_AT_ONE_INSTANT)
    assert len(ran) == 5 * EVENTS_AT_ONE_INSTANT // 2
