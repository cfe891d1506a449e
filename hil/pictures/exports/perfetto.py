"""A run's schedule as a Perfetto trace: one track per task with its slices, opened by the Perfetto viewer.

A slice is an interval in which the task had the processor; from READY to its slice the task waits for it. After a flight
with --profile-cpu, a second track per task has its activations.
"""

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet

from firmware_py.extras import install_command
from hil.emulator.stm32f405.chip import CYCLES_PER_US
from hil.errors import LabError, unlinked
from hil.laboratory.files.cpu_profile import ACTIVATIONS
from hil.laboratory.schedule import load_schedule, runs

try:
    from perfetto.protos.perfetto.trace.perfetto_trace_pb2 import TrackEvent
    from perfetto.trace_builder.proto_builder import StreamingTraceProtoBuilder
except ImportError as error:
    raise LabError(f"no Perfetto trace without its package ({error}): {install_command('view')}") from None

FILE = "flight.perfetto-trace"
SEQUENCE = 1
NS_PER_US = 1000
ACTIVATION_TRACKS = 1 << 16  # from this number on


def write_perfetto(folder: Path) -> Path:
    """Write `flight.perfetto-trace` from the run's schedule and return its path."""
    path = unlinked(folder / FILE)
    with path.open("wb") as file:
        builder = StreamingTraceProtoBuilder(file)
        write_trace(load_schedule(folder), builder)
        if (folder / ACTIVATIONS).exists():
            write_activations(pa.parquet.read_table(folder / ACTIVATIONS), builder)
    return path


def write_trace(schedule: pa.Table, builder: StreamingTraceProtoBuilder) -> None:
    """Write tracks and slices of a schedule; the idle task gets none."""
    stretches = [run for run in runs(schedule) if run.task != "IDLE"]
    tracks = {name: number for number, name in enumerate(sorted({run.task for run in stretches}), 1)}
    for name, number in tracks.items():
        _write_track(builder, number, name)
    for run in stretches:
        _write_slice(builder, tracks[run.task], run.task, (run.start_us * NS_PER_US, run.end_us * NS_PER_US))


def write_activations(table: pa.Table, builder: StreamingTraceProtoBuilder) -> None:
    """Write a track per task with its activations since the laboratory's start, each named by its own time."""
    names = sorted(set(table.column("task").to_pylist()))
    tracks = {name: ACTIVATION_TRACKS + number for number, name in enumerate(names)}
    for name, number in tracks.items():
        _write_track(builder, number, f"{name} activations")
    for row in table.to_pylist():
        if row["begin_us"] >= 0.0:
            times = round(row["begin_us"] * NS_PER_US), round(row["end_us"] * NS_PER_US)
            own = f"{row['cycles'] / CYCLES_PER_US:.1f} us of its own"
            _write_slice(builder, tracks[row["task"]], own, times)


def _write_track(builder: StreamingTraceProtoBuilder, number: int, name: str) -> None:
    packet = builder.create_packet()
    packet.track_descriptor.uuid = number
    packet.track_descriptor.name = name
    packet.trusted_packet_sequence_id = SEQUENCE
    builder.write_packet(packet)


def _write_slice(
    builder: StreamingTraceProtoBuilder, track: int, name: str, times_ns: tuple[int, int]
) -> None:
    kinds = TrackEvent.TYPE_SLICE_BEGIN, TrackEvent.TYPE_SLICE_END
    for time_ns, kind in zip(times_ns, kinds, strict=True):
        packet = builder.create_packet()
        packet.timestamp = time_ns
        packet.track_event.type = kind
        packet.track_event.track_uuid = track
        packet.track_event.name = name
        packet.trusted_packet_sequence_id = SEQUENCE
        builder.write_packet(packet)
