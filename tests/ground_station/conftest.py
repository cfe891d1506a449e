"""Fixtures of the ground station's tests."""

import signal
from collections.abc import Iterator

import pytest

from ground_station.stops import STOPS


@pytest.fixture
def own_signal_handlers() -> Iterator[None]:
    """Keep the test runner's own signal handlers; begin without what `nohup` has ruled out."""
    kept = {number: signal.getsignal(number) for number in STOPS}
    for number in STOPS:
        if kept[number] is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)
