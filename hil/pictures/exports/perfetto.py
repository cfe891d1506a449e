"""A run's schedule as a Perfetto trace: one track per task with its slices, opened by the Perfetto viewer.

A slice is an interval in which the task had the processor; from READY to its slice the task waits for it.
"""

from pathlib import Path

import pyarrow as pa

from firmware_py.extras import install_command
from hil.errors import LabError, unlinked
from hil.laboratory.schedule import load_schedule, runs

try:
    from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import TrackEvent
    from perfetto.trace_builder.proto_builder import StreamingTraceProtoBuilder
except ImportError as error:
    raise LabError(f"no Perfetto trace without its package ({error}): {install_command('view')}") from None

FILE = "flight.perfetto-trace"
SEQUENCE = 1
NS_PER_US = 1000


def write_perfetto(folder: Path) -> Path:
    """Write `flight.perfetto-trace` from the run's schedule and return its path."""
    path = unlinked(folder / FILE)
    with path.open("wb") as file:
        write_trace(load_schedule(folder), StreamingTraceProtoBuilder(file))
    return path


def write_trace(schedule: pa.Table, builder: StreamingTraceProtoBuilder) -> None:
    """Write tracks and slices of a schedule; the idle task gets none."""
    stretches = [run for run in runs(schedule) if run.task != "IDLE"]
    tracks = {name: number for number, name in enumerate(sorted({run.task for run in stretches}), 1)}
    for name, number in tracks.items():
        packet = builder.create_packet()
        packet.track_descriptor.uuid = number
        packet.track_descriptor.name = name
        packet.trusted_packet_sequence_id = SEQUENCE
        builder.write_packet(packet)
    for run in stretches:
        for us, kind in (
            (run.start_us, TrackEvent.TYPE_SLICE_BEGIN),
            (run.end_us, TrackEvent.TYPE_SLICE_END),
        ):
            packet = builder.create_packet()
            packet.timestamp = us * NS_PER_US
            packet.track_event.type = kind
            packet.track_event.track_uuid = tracks[run.task]
            packet.track_event.name = run.task
            packet.trusted_packet_sequence_id = SEQUENCE
            builder.write_packet(packet)
