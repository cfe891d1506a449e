"""The signals that end a flight: all in order, and a terminal that hangs up only where the user has not ruled that out."""

import signal

import pytest

from ground_station.stops import STOPS, heeded, stop_signals, stopped_like_ctrl_c

pytestmark = pytest.mark.usefixtures("own_signal_handlers")


@pytest.mark.parametrize("number", STOPS)
def test_each_signal_is_noted_and_interrupts_nothing(number: int) -> None:
    stops = stop_signals()
    signal.raise_signal(number)
    signal.raise_signal(number)
    assert stops == [number, number]


@pytest.mark.parametrize("number", STOPS[1:])
def test_a_lost_session_is_like_ctrl_c_but_only_once(number: int) -> None:
    before = [signal.getsignal(each) for each in STOPS]
    with stopped_like_ctrl_c():
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
        for each in STOPS[1:]:  # the result is being written
            signal.raise_signal(each)
        assert signal.getsignal(signal.SIGINT) == before[0]  # Ctrl-C still ends it
    assert [signal.getsignal(each) for each in STOPS] == before


def test_what_nohup_has_started_survives_its_terminal() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    assert heeded() == [signal.SIGINT, signal.SIGTERM]
    stops = stop_signals()
    with stopped_like_ctrl_c():
        signal.raise_signal(signal.SIGHUP)
    assert stops == []
