"""What is approved is what ships: here nothing has the kinds of faults and the metrics that other tests have added."""

import pytest

from hil.laboratory.fault_kinds import KINDS
from hil.laboratory.metrics import METRICS

SHIPPED = [(KINDS, frozenset(KINDS)), (METRICS, frozenset(METRICS))]  # before any test


@pytest.fixture(autouse=True)
def as_shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide them."""
    for registered, shipped in SHIPPED:
        for own in set(registered) - shipped:
            monkeypatch.delitem(registered, own)
