"""What every set of counters keeps: it begins at zero."""

import dataclasses

import pytest

from firmware_py.export.usage import EntryLoad
from firmware_py.wire.mavlink_frames import FrameCounters
from ground_station.sources.natnet_stream import StreamCounters
from ground_station.station import StationCounters
from ground_station.tracker import TrackerCounters
from hil.board.radio import DirectionCounters
from hil.board.uart import LineCounters
from hil.emulator.crazyflie.shockburst import AirCounters

KINDS = (
    AirCounters,
    DirectionCounters,
    EntryLoad,
    FrameCounters,
    LineCounters,
    StationCounters,
    StreamCounters,
    TrackerCounters,
)


@pytest.mark.parametrize("kind", KINDS)
def test_counters_begin_at_zero(kind: type) -> None:
    fresh = kind()
    names = [one.name for one in dataclasses.fields(kind)]
    assert names
    assert {name: getattr(fresh, name) for name in names if getattr(fresh, name)} == {}
