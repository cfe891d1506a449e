"""The schedule of a board: its turns from the kernel's trace, as a file and as tracks of Perfetto."""

import io
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pytest

from hil.emulator.stm32f405.chip import CYCLES_PER_US
from hil.laboratory.schedule import ScheduleTrace, Turn, load_schedule, runs

TRACED = [
    (100, "IN", "A"), (120, "TICK", "-"), (150, "IN", "A"), (200, "IN", "B"), (200, "IN", "IDLE"), (260, "IN", "A"),
    (300, "READY", "B"),
]  # fmt: skip
TURNS = [Turn("A", 100, 200), Turn("IDLE", 200, 260), Turn("A", 260, 340)]


@pytest.fixture
def schedule(tmp_path: Path) -> pa.Table:
    """A trace that begins while A runs and ends at 340 us."""
    scheduler: Any = SimpleNamespace(current=SimpleNamespace(name="A", priority=3), trace=None)
    scheduler.set_trace = lambda take: setattr(scheduler, "trace", take)
    trace = ScheduleTrace(scheduler)
    trace.end(50)  # it has not begun
    trace.begin(100)
    for us, event, who in TRACED[1:]:
        scheduler.trace(us, event, who, 1, 0)
    for end_us in (340, 400):
        trace.end(end_us)
    trace.write(tmp_path)
    return load_schedule(tmp_path)


def test_turns_last_until_another_task_runs_and_are_never_empty(schedule: pa.Table) -> None:
    assert list(runs(schedule)) == TURNS
    assert schedule.slice(0, 1).to_pylist() == [{"us": 100, "event": "IN", "who": "A", "a": 3, "b": 0}]


def slices(builder_bytes: bytes) -> dict[str, list[tuple[str, int, int]]]:
    """Name, begin and end [ns] of every slice by its track's name."""
    from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import Trace, TrackEvent

    packets = Trace.FromString(builder_bytes).packet
    names = {
        one.track_descriptor.uuid: one.track_descriptor.name
        for one in packets
        if one.HasField("track_descriptor")
    }
    assert 0 not in names  # the trace's own track
    events = [(one.track_event.track_uuid, one) for one in packets if one.HasField("track_event")]
    found: dict[str, list[tuple[str, int, int]]] = {}
    for uuid, of_track in groupby(sorted(events, key=lambda one: one[0]), key=lambda one: one[0]):
        pairs = [one for _, one in of_track]
        for begin, end in zip(pairs[::2], pairs[1::2], strict=True):
            assert (begin.track_event.type, end.track_event.type) == (
                TrackEvent.TYPE_SLICE_BEGIN,
                TrackEvent.TYPE_SLICE_END,
            )
            found.setdefault(names[uuid], []).append((begin.track_event.name, begin.timestamp, end.timestamp))
    return found


def test_every_turn_and_activation_is_a_slice_of_its_own_track(schedule: pa.Table) -> None:
    pytest.importorskip("perfetto")
    from perfetto.trace_builder.proto_builder import StreamingTraceProtoBuilder

    from hil.pictures.exports.perfetto import write_activations, write_trace

    file = io.BytesIO()
    builder = StreamingTraceProtoBuilder(file)
    write_trace(schedule, builder)
    activations = [
        ("B", -5.0, 3.0, 9),
        ("B", 0.0, 2.5, 2 * CYCLES_PER_US),
        ("A", 7.0, 9.0, CYCLES_PER_US // 2),
    ]
    columns = dict(zip(("task", "begin_us", "end_us", "cycles"), zip(*activations, strict=True), strict=True))
    write_activations(pa.table({name: list(values) for name, values in columns.items()}), builder)
    assert slices(file.getvalue()) == {
        "A": [("A", 100_000, 200_000), ("A", 260_000, 340_000)],
        "A activations": [("0.5 us of its own", 7_000, 9_000)],
        "B activations": [("2.0 us of its own", 0, 2_500)],
    }
