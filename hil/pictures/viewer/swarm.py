"""Writes robots that flew together as one rerun recording, `flight.rrd`: their scenes in one room."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb

from hil.errors import unlinked
from hil.laboratory.files.recorder import load_events, log_pieces
from hil.laboratory.swarms.result import SwarmResult
from hil.pictures.viewer.layout import tunnel_view
from hil.pictures.viewer.recording import APPLICATION, RECORDING, ROWS_AT_ONCE
from hil.pictures.viewer.scene import Scene
from hil.pictures.viewer.track import RecordingTrack, timeline_of


def write_swarm_rrd(result: SwarmResult) -> Path:
    """Write `flight.rrd` into the folder of the robots and return its path."""
    path = result.folder / RECORDING
    partial = unlinked(path.with_name(path.name + ".partial"))
    recording = rr.RecordingStream(APPLICATION)
    recording.send_recording_name(result.request.title)
    schema = next(log_pieces(result.robots[0].folder)).schema
    recording.save(partial, default_blueprint=_blueprint(schema, len(result.robots)))
    for number, (one, origin) in enumerate(zip(result.robots, result.origins, strict=True), 1):
        _add(recording, number, one.folder, origin)
        recording.flush()
    recording.disconnect()
    partial.replace(path)
    return path


def _add(
    recording: rr.RecordingStream, number: int, folder: Path, origin: tuple[float, float, float]
) -> None:
    """Draw one robot, with what belongs to it, around its place in the room."""
    pieces = log_pieces(folder)
    first = next(pieces)
    track = RecordingTrack(recording, first.schema, f"room/{number}/")
    track.static("world", rr.Transform3D(translation=origin))
    track.static("world/robot/number", rr.Points3D([(0.0, 0.0, 0.06)], radii=0.002, labels=str(number)))
    scene = Scene(track, first.schema)
    past = first.schema.empty_table()
    for piece in (first, *pieces):
        for begin in range(0, piece.num_rows, ROWS_AT_ONCE):
            rows = piece.slice(begin, ROWS_AT_ONCE)
            scene.add_rows(pa.concat_tables([past, rows]), past.num_rows)
            past = rows.slice(rows.num_rows - 1)
    for event in load_events(folder):
        text = f"{number}: {event['source']}: {event['text']}"
        track.at(event["t_us"], f"text/{event['source']}", rr.TextLog(text))


def _blueprint(schema: pa.Schema, count: int) -> rrb.Blueprint:
    timeline, _ = timeline_of(schema.metadata)
    eye = rrb.EyeControls3D(
        position=(1.8, -1.9, 2.3), look_target=(-0.5, 0.0, 0.9), eye_up=np.array((0.0, 0.0, 1.0))
    )
    worlds = [f"room/{number}/world" for number in range(1, count + 1)]
    columns = rrb.TextLogColumns(timeline_columns=[timeline], text_log_columns=["Body"])
    texts = rrb.TextLogView(name="Text", origin="room", contents="$origin/**", columns=columns)
    return rrb.Blueprint(
        rrb.Vertical(tunnel_view(timeline, "room", worlds, eye), texts, row_shares=[4, 1]),
        rrb.TimePanel(timeline=timeline, play_state="playing", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )
