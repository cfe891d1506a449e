"""Writes a flight as a rerun recording: row by row, as the file `flight.rrd`, and on a server for viewers."""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import rerun as rr
from rerun_bindings import CatalogClientInternal

from hil.errors import LabError, unlinked
from hil.laboratory.files.ages import ages_in_time_of
from hil.laboratory.files.recorder import OPERATOR, load_events, log_pieces, stored_in
from hil.laboratory.metrics import rows_at
from hil.laboratory.schedule import load_schedule
from hil.pictures.links import HOST
from hil.pictures.viewer.layout import LEGEND, blueprint
from hil.pictures.viewer.plots import ROWS_OF_A_SECOND, SLOW, Plots
from hil.pictures.viewer.scene import Scene
from hil.pictures.viewer.track import RecordingTrack, timeline_of

RECORDING = "flight.rrd"
APPLICATION = "floaty"
ROWS_AT_ONCE = 10_000  # of a long flight
FAULT = re.compile(r"fault (\S+) (begins|ends)")  # texts of the laboratory


class RerunFlight:
    """Writes the rows of one flight, in the order of time, to a rerun recording."""

    def __init__(self, recording: rr.RecordingStream, schema: pa.Schema) -> None:
        """Log everything static; `schema` is the log's, its metadata holds the configuration."""
        request = stored_in(schema.metadata, "request")
        self._track = RecordingTrack(recording, schema)
        name = "real flight" if "cameras.x" in schema.names else f"seed {request.get('seed', '?')}"
        recording.send_recording_name(f"{request.get('experiment', 'flight')}, {name}")
        self._scene = Scene(self._track, schema)
        self.plots = Plots(self._track, schema)
        self._track.static("legend", rr.TextDocument(LEGEND, media_type=rr.MediaType.MARKDOWN))
        self._faults: list[str] = []  # kinds of the faults in force
        self._past = schema.empty_table()  # the rows of the last second
        self._count = 0  # rows so far

    def add_rows(self, rows: pa.Table) -> None:
        if rows.num_rows == 0:
            return
        past = pa.concat_tables([self._past, rows])
        before = self._past.num_rows
        joined = past.slice(max(0, before - 1))
        fresh = joined.num_rows - rows.num_rows  # the first row of `joined` that is new
        self._scene.add_rows(joined, fresh)
        self.plots.add_rows(joined, fresh)
        at = np.arange(before + -self._count % SLOW, past.num_rows, SLOW)
        if len(at):
            self.plots.add_slow(past, at)
            self._scene.add_tether(rows_at(past, at))
        self._count += rows.num_rows
        self._past = past.slice(max(0, past.num_rows - ROWS_OF_A_SECOND))

    def add_events(self, events: Iterable[Mapping[str, Any]]) -> None:
        """Log texts: `t_us`, `source`, `text`, and the faults and actions of an operator in them."""
        for event in events:
            t_us, source, text = event["t_us"], event["source"], event["text"]
            self._track.at(t_us, f"text/{source}", rr.TextLog(f"{source}: {text}"))
            if source == OPERATOR:
                self._track.mark(OPERATOR, np.array([t_us], np.float64))
            elif found := FAULT.fullmatch(text):
                self._add_fault(t_us, found[1], begins=found[2] == "begins")

    def _add_fault(self, t_us: int, fault: str, begins: bool) -> None:
        """Log the begin or end of a fault: in the lane of faults, as a mark, a push as an arrow."""
        kind = fault.partition("@")[0]
        if begins:
            self._faults.append(kind)
            self._track.mark("fault", np.array([t_us], np.float64))
            with suppress(LabError):  # a kind of the user's own
                self._scene.add_push(t_us, fault)
        elif kind in self._faults:
            self._faults.remove(kind)
        self._track.at(t_us, "state/faults", rr.StateChange(state=" + ".join(self._faults) or "-"))


def stream_to(address: str) -> rr.RecordingStream:
    """Return a recording that the viewer at an address takes while it is written."""
    recording = rr.RecordingStream(APPLICATION)
    recording.connect_grpc(address)
    return recording


def write_rrd(
    pieces: Iterator[pa.Table],
    events: Iterable[Mapping[str, Any]],
    schedule: pa.Table,
    path: Path,
    ages: pa.Table | None = None,
) -> None:
    """Write a flight log (in pieces, metadata in their schema), its texts, schedule and ages of poses as a rerun file."""
    partial = unlinked(path.with_name(path.name + ".partial"))
    recording = rr.RecordingStream(APPLICATION)
    begin = next(pieces)
    recording.save(partial, default_blueprint=blueprint(begin.schema))
    flight = RerunFlight(recording, begin.schema)
    for piece in chain([begin], pieces):
        for first in range(0, piece.num_rows, ROWS_AT_ONCE):
            flight.add_rows(piece.slice(first, ROWS_AT_ONCE))
            recording.flush()
        pa.default_memory_pool().release_unused()  # a long flight's curves would add up
    flight.add_events(events)
    flight.plots.add_schedule(schedule)
    if ages is not None:
        flight.plots.add_ages(ages)
    recording.disconnect()
    partial.replace(path)


def write_run_rrd(folder: Path) -> Path:
    """Write `flight.rrd` of a run folder from its log. Raises `LabError` when there is none."""
    path, ages = folder / RECORDING, ages_in_time_of(log_pieces(folder), folder)
    write_rrd(log_pieces(folder), load_events(folder), load_schedule(folder), path, ages)
    return path


def recording_of(folder: Path) -> Path:
    """Return the recording of a run folder, which is written if it is missing. Raises `LabError` when there is no log."""
    path = folder / RECORDING
    return path if path.is_file() else write_run_rrd(folder)


class ServedRecording:
    """Serves the recording of a run folder while this object lives."""

    def __init__(self, folder: Path) -> None:
        """Raise `LabError` when there is no log."""
        path = recording_of(folder)
        schema = next(log_pieces(folder)).schema
        self._timeline, _ = timeline_of(schema.metadata)
        self._server = rr.server.Server(host=HOST, datasets={APPLICATION: [path]})
        # rerun's own client requires a query engine that is not needed here
        (inner,) = CatalogClientInternal(self._server.url()).datasets(False)
        dataset = rr.catalog.DatasetEntry(inner)
        with TemporaryDirectory() as kept:
            layout = Path(kept) / "layout.rbl"
            blueprint(schema).save(APPLICATION, layout)
            dataset.register_blueprint(layout.as_uri())
        (segment,) = dataset.segment_ids()
        self._address = dataset.segment_url(segment)

    def at(self, at_s: float) -> str:
        """Return the address at which viewers find it, with the time at an instant, seconds from the release."""
        return f"{self._address}#when={self._timeline}@{at_s:+.3f}s"
