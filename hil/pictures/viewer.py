"""The flight in the rerun viewer: as the file `flight.rrd`, or in a window while it happens.

`Stage` turns rows of the flight log into entities below `/world` (3-D; metres, W), `/plot` (`hil.pictures.curves`),
`/state` and `/text`, on the timeline `from_release`. The only file that knows rerun, which comes with the extra `view`:
without it, importing this file raises `LabError`.
"""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.extras import install_command
from firmware_py.geometry import from_euler_zyx, yaw_quaternion
from hil.devices.markers import DIAMETER, marker_places
from hil.errors import LabError
from hil.laboratory.faults import Span, spans_of
from hil.laboratory.metrics import BOX, body, column, is_real, known
from hil.laboratory.recorder import load_events, load_log, release_of
from hil.laboratory.schedule import load_schedule, runs
from hil.pictures import curves, scene
from hil.pictures.curves import Curves, States
from hil.pictures.window import LiveFeed, open_window, show_file
from hil.world.config import PlantConfig

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ImportError as error:
    raise LabError(f"the viewer needs rerun: {install_command('view')}") from error

RECORDING = "flight.rrd"
APPLICATION, TIMELINE = "floaty", "from_release"
CATCH_UP_S = 5.0  # for the window, at the end of a live flight

METRES_PER_NEWTON = 0.15  # length of the drag arrows
SECONDS_OF_FLOW = 0.02  # length of the flow's arrow: the way of the air in that time
TRAIL_S = 4.0
NOZZLE_RADIUS = 0.6  # [m] paper, Experimental platform: 1.2 m wide
NOZZLE_TOP = 1.8  # [m] where the picture of the tunnel ends
FLOW_RADIUS = 0.2  # [m] physics.md section 6: effective cylinder
MARKERS_SEEN = "markers.visible"
SEEN, HIDDEN = 0xFFFFFFFF, 0xFF3030FF  # colours of markers
SLOW = 10  # rows between samples of what changes slowly: 10 Hz

PLOTS: Mapping[str, Curves] = {
    "position/error": curves.POSITION,
    "attitude/error": curves.ATTITUDE,
    "flaps/truth": curves.FLAPS,
    "flaps/command": curves.FLAPS_COMMAND,
    "inputs": curves.INPUTS,
    "miss/position": curves.POSITION_MISS,
    "miss/attitude": curves.ATTITUDE_MISS,
    "age/pose": curves.AGE,
    "age/horizon": curves.HORIZON,
    "age/without": curves.SINCE_FUSION,
    "link/radio": curves.PACKETS,
    "link/serial": curves.SERIAL_FAULTS,
    "link/station": curves.STATION,
    "queue": curves.QUEUE,
}
PALE = "flaps/command"
LIMITS = {"position/limit": curves.NEAR_CM, "attitude/limit": curves.ATTITUDE_DEG}
STRETCHES_SHOWN = 2000  # of the schedule; the whole of it is for Perfetto
STATES: Mapping[str, States] = {"supervisor": curves.SUPERVISOR, "robot": curves.RELEASE}


class Stage:
    """Puts the rows of one flight, in the order of time, onto a rerun recording."""

    def __init__(self, recording: rr.RecordingStream, schema: pa.Schema) -> None:
        """Put up what does not move; `schema` is the log's, its metadata holds the configuration."""
        metadata = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items()}
        self._recording = recording
        self._plant = PlantConfig.model_validate(json.loads(metadata.get("config", "{}")).get("plant", {}))
        self._plots = {path: plot for path, plot in PLOTS.items() if plot.needs in schema.names}
        self._processor = curves.processor(schema.names)
        self._faults: dict[str, list[Span]] = {}  # by kind
        for span in spans_of(schema.metadata):
            self._faults.setdefault(span.fault.kind, []).append(span)
        self._last: pa.Table | None = None  # the last row so far
        self._fusion = schema.empty_table()  # the row of the last fused pose
        self._release_us = release_of(schema.metadata)
        recording.set_log_time_enabled(False)
        name = "real flight" if "cameras.x" in schema.names else f"seed {metadata.get('seed', '?')}"
        recording.send_recording_name(f"{metadata.get('experiment', 'flight')}, {name}")
        self._build_tunnel()
        self._build_robot()
        if MARKERS_SEEN in schema.names:
            self._recording.log(
                "world/robot/markers",
                rr.Points3D(marker_places(self._plant), radii=DIAMETER / 2),
                static=True,
            )
        self._name_curves()

    def add_rows(self, rows: pa.Table) -> None:
        """Put up some rows of the log, the next in time."""
        if rows.num_rows == 0:
            return
        joined = rows if self._last is None else pa.concat_tables([self._last, rows])
        fresh = joined.num_rows - rows.num_rows  # the first row of `joined` that is new
        self._last = rows.slice(rows.num_rows - 1)
        self._move(rows)
        if MARKERS_SEEN in rows.column_names:
            self._colour_markers(joined, fresh)
        since_fusion = pa.concat_tables([self._fusion, rows])
        self._fusion = curves.row_of_last_fusion(since_fusion)
        for path, plot in self._plots.items():
            values = plot.read(since_fusion)[-rows.num_rows :]
            self._send(f"plot/{path}", column(rows, "t"), rr.Scalars.columns(scalars=values))
        slow = joined.take(np.arange(0, joined.num_rows, SLOW))
        times = column(slow, "t")
        for path, limit in LIMITS.items():
            lines = np.full((len(times) - fresh, 2), (limit, -limit))
            self._send(f"plot/{path}", times[fresh:], rr.Scalars.columns(scalars=lines))
        if self._processor.names:
            self._send("plot/processor", times[1:], rr.Scalars.columns(scalars=self._processor.read(slow)))
        for path, states in STATES.items():
            begins, names = curves.changes(joined, states)
            self._send(f"state/{path}", begins[fresh:], rr.StateChange.columns(state=names[fresh:]))
        for kind, spans in self._faults.items():
            begins, names = curves.fault_changes(joined, spans)
            self._send(f"state/fault/{kind}", begins[fresh:], rr.StateChange.columns(state=names[fresh:]))
        track = body(joined, "x", "y", "z")
        steps = np.stack((track[:-1], track[1:]), axis=1).astype(np.float32)
        self._send("world/trail", column(joined, "t")[1:], rr.LineStrips3D.columns(strips=steps))

    def add_schedule(self, schedule: pa.Table) -> None:
        """Put up which task had the processor, a lane per task."""
        stretches = list(islice(runs(schedule), STRETCHES_SHOWN))
        for name in sorted({run.task for run in stretches} - {"IDLE"}):
            mine = [run for run in stretches if run.task == name]
            times = np.array([us for run in mine for us in (run.start_us, run.end_us)], np.float64)
            states = [state for _ in mine for state in ("runs", "-")]
            lane = rr.StateConfiguration(
                values=("runs", "-"), colors=_rgba_array((curves.GREEN, curves.GREY))
            )
            self._recording.log(f"state/task/{name}", lane, static=True)
            self._send(f"state/task/{name}", times, rr.StateChange.columns(state=states))

    def add_events(self, events: Iterable[Mapping[str, Any]]) -> None:
        """Put up texts: `t_us`, `source`, `text`."""
        for event in events:
            self._recording.set_time(
                TIMELINE, duration=np.timedelta64(event["t_us"] - self._release_us, "us")
            )
            self._recording.log(f"text/{event['source']}", rr.TextLog(f"{event['source']}: {event['text']}"))

    def _send(self, path: str, times_us: NDArray[np.float64], columns: Iterable[Any]) -> None:
        if len(times_us) == 0:
            return
        since = (times_us - self._release_us).astype("timedelta64[us]")
        index = rr.TimeColumn(TIMELINE, duration=since)
        self._recording.send_columns(path, [index], columns)

    def _move(self, rows: pa.Table) -> None:
        """Place everything that has a pose, and the arrows."""
        rows = known(rows)
        times = column(rows, "t")
        p_WB = body(rows, "x", "y", "z")
        q_WB = body(rows, "qw", "qx", "qy", "qz")
        flaps = np.radians(curves.FLAPS.read(rows))
        self._place("world/robot", times, p_WB, q_WB)
        for flap in range(4):
            turn = scene.turn_quaternion(scene.FLAP_AXES[flap], flaps[:, flap])
            self._place(f"world/robot/plates/flap_{flap + 1}", times, np.zeros_like(p_WB), turn)
        goal = column(rows, "goal.x", "goal.y", "goal.z")
        self._place(
            "world/goal", times, goal, np.array([yaw_quaternion(yaw) for yaw in column(rows, "goal.yaw")])
        )
        p_GE = column(rows, "estimate.x", "estimate.y", "estimate.z")
        angles = column(rows, "estimate.roll", "estimate.pitch", "estimate.yaw")
        self._place(
            "world/goal/estimate", times, p_GE, np.array([from_euler_zyx(*row) for row in angles.tolist()])
        )
        if is_real(rows):  # there are no arrows
            return

        parts = ("base", "flap1", "flap2", "flap3", "flap4")
        forces = column(rows, *(f"force.{part}_{axis}" for part in parts for axis in "xyz"))
        drag = METRES_PER_NEWTON * forces.reshape(-1, 3)
        origins = scene.drag_origins(self._plant, p_WB, q_WB, flaps).reshape(-1, 3)
        arrows = rr.Arrows3D.columns(vectors=drag, origins=origins)
        self._send("world/drag", times, arrows.partition(np.full(len(times), len(parts))))
        flow = SECONDS_OF_FLOW * column(rows, "flow.x", "flow.y", "flow.z")
        self._send("world/flow", times, rr.Arrows3D.columns(vectors=flow, origins=p_WB - flow - (0, 0, 0.1)))

    def _colour_markers(self, rows: pa.Table, fresh: int) -> None:
        """Colour the markers where they come into sight or go, from row `fresh` on."""
        bits = column(rows, MARKERS_SEEN).astype(np.int64)
        changed = np.flatnonzero(np.diff(bits, prepend=-1))
        changed = changed[changed >= fresh]
        places = marker_places(self._plant)
        seen = bits[changed, None] >> np.arange(len(places)) & 1
        colours = np.where(seen, SEEN, HIDDEN).astype(np.uint32)
        points = rr.Points3D.columns(colors=colours.ravel())
        self._send(
            "world/robot/markers",
            column(rows, "t")[changed],
            points.partition(np.full(len(seen), len(places))),
        )

    def _place(
        self, path: str, times: NDArray[np.float64], p: NDArray[np.float64], q: NDArray[np.float64]
    ) -> None:
        """Send poses, q as w x y z."""
        xyzw = np.roll(q, -1, axis=1)
        self._send(path, times, rr.Transform3D.columns(translation=p, quaternion=xyzw))

    def _build_tunnel(self) -> None:
        log = self._recording.log
        log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        angle = np.linspace(0, 2 * np.pi, 73)
        ring = np.column_stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)))
        rings = [NOZZLE_RADIUS * ring, NOZZLE_RADIUS * ring + (0, 0, NOZZLE_TOP)]
        posts = [np.array([rings[0][index], rings[1][index]]) for index in range(0, 72, 18)]
        log(
            "world/tunnel/nozzle",
            rr.LineStrips3D([*rings, *posts], colors=0x8899AA90, radii=0.004),
            static=True,
        )
        flow = rr.Cylinders3D(
            lengths=[NOZZLE_TOP],
            radii=[FLOW_RADIUS],
            centers=[(0, 0, NOZZLE_TOP / 2)],
            colors=0x56B4E918,
            fill_mode="solid",
        )
        log("world/tunnel/flow", flow, static=True)
        cross = (
            BOX / 5 * np.array([[(-1, 0, 0), (1, 0, 0)], [(0, -1, 0), (0, 1, 0)], [(0, 0, -1), (0, 0, 1)]])
        )
        log("world/goal/cross", rr.LineStrips3D(list(cross), colors=0xD55E00FF, radii=0.0025), static=True)
        log(
            "world/goal/box",
            rr.LineStrips3D(scene.box_lines(BOX), colors=0xD55E00A0, radii=0.0012),
            static=True,
        )

    def _build_robot(self) -> None:
        log, plant = self._recording.log, self._plant
        body = rr.Boxes3D(half_sizes=[(0.022, 0.016, 0.012)], colors=0x404850FF, fill_mode="solid")
        log("world/robot/body", body, static=True)
        rod = [[(0, 0, 0), (0, 0, plant.axis_height)]]
        log("world/robot/rod", rr.LineStrips3D(rod, colors=0x707880FF, radii=0.003), static=True)
        stand = rr.LineStrips3D(scene.stand_lines(plant), colors=0x707880FF, radii=0.0015)
        log("world/robot/stand", stand, static=True)
        log("world/robot/plates", rr.Transform3D(translation=(0, 0, plant.axis_height)), static=True)
        meshes = [("base", scene.base_mesh(plant), "#c8ccd0")]
        for flap, colour in enumerate(curves.FLAP_COLOURS):
            meshes.append((f"flap_{flap + 1}", scene.flap_mesh(plant, flap), colour))
        for name, mesh, colour in meshes:
            surface = rr.Mesh3D(
                vertex_positions=mesh.vertices, triangle_indices=mesh.triangles, vertex_normals=mesh.normals(),
                albedo_factor=_rgba(colour),
            )  # fmt: skip
            log(f"world/robot/plates/{name}", surface, static=True)
        ghost = rr.LineStrips3D(scene.outline(plant), colors=0xFFFFFF90, radii=0.0012)
        log("world/goal/estimate/ghost", ghost, static=True)
        log("world/drag", rr.Arrows3D.from_fields(colors=[0xF0E442FF], radii=[0.0035]), static=True)
        log("world/flow", rr.Arrows3D.from_fields(colors=[0x56B4E9FF], radii=[0.005]), static=True)
        log("world/trail", rr.LineStrips3D.from_fields(colors=[0xFFFFFFC0], radii=[0.0018]), static=True)

    def _name_curves(self) -> None:
        processor = {"processor": self._processor} if self._processor.names else {}
        for path, plot in {**self._plots, **processor}.items():
            width, opacity = (1.0, 120) if path == PALE else (1.6, 255)
            lines = rr.SeriesLines(
                names=plot.names,
                colors=_rgba_array(plot.colours, opacity),
                widths=[width] * len(plot.names),
            )
            self._recording.log(f"plot/{path}", lines, static=True)
        for path in LIMITS:
            limit = rr.SeriesLines(
                names=["limit", "limit"], colors=_rgba_array([curves.GREY] * 2), widths=[1.0] * 2
            )
            self._recording.log(f"plot/{path}", limit, static=True)
        for path, states in STATES.items():
            lanes = rr.StateConfiguration(values=states.names, colors=_rgba_array(states.colours))
            self._recording.log(f"state/{path}", lanes, static=True)
        for kind in self._faults:
            lanes = rr.StateConfiguration(
                values=curves.FAULT_STATES, colors=_rgba_array(curves.FAULT_COLOURS)
            )
            self._recording.log(f"state/fault/{kind}", lanes, static=True)


def _rgba(colour: str, opacity: int = 255) -> int:
    """Return `#rrggbb` as rerun packs it."""
    return int(colour[1:], 16) << 8 | opacity


def _rgba_array(colours: Iterable[str], opacity: int = 255) -> NDArray[np.uint32]:
    return np.array([_rgba(colour, opacity) for colour in colours], np.uint32)


def blueprint() -> rrb.Blueprint:
    """Return how the window is divided: the scene and the states on the left, the curves on the right."""
    now = rrb.TimeRangeBoundary.cursor_relative()
    before = rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S)
    tunnel = rrb.Spatial3DView(
        name="Wind tunnel",
        origin="world",
        eye_controls=rrb.EyeControls3D(position=(0.62, -0.48, 1.45), look_target=(0.0, 0.0, 1.12)),
        background=(14, 18, 22),  # pale lines stay visible in a light theme, too
        line_grid=False,
        overrides={
            "world/trail": [rrb.VisibleTimeRanges(rrb.VisibleTimeRange(TIMELINE, start=before, end=now))]
        },
    )
    plots = [
        rrb.TimeSeriesView(
            name=name, origin=f"plot/{path}", plot_legend=rrb.PlotLegend(visible=path != "flaps")
        )
        for name, path in (
            ("Position error [cm]", "position"),
            ("Attitude error [deg]", "attitude"),
            ("Flap angles, commands pale; colours of the scene [deg]", "flaps"),
            ("Inputs [deg]", "inputs"),
            ("Estimate - truth [cm, deg]", "miss"),
            ("Age of the pose [ms]", "age"),
            ("Link", "link"),
            ("Queue", "queue"),
            ("Processor [%]", "processor"),
        )
    ]
    columns = rrb.TextLogColumns(timeline_columns=[TIMELINE], text_log_columns=["Body"])
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                tunnel,
                rrb.Horizontal(
                    rrb.StateTimelineView(name="States", origin="state"),
                    rrb.TextLogView(name="Text", origin="text", columns=columns),
                ),
                row_shares=[4, 1],
            ),
            rrb.Vertical(*plots[:3], rrb.Tabs(*plots[3:])),
            column_shares=[5, 4],
        ),
        rrb.TimePanel(timeline=TIMELINE, play_state="playing", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def write_rrd(table: pa.Table, events: Iterable[Mapping[str, Any]], schedule: pa.Table, path: Path) -> None:
    """Write a flight log (metadata in its schema), its texts and its schedule as a rerun file."""
    partial = path.with_name(path.name + ".partial")
    recording = rr.RecordingStream(APPLICATION)
    recording.save(partial, default_blueprint=blueprint())
    stage = Stage(recording, table.schema)
    stage.add_rows(table)
    stage.add_events(events)
    stage.add_schedule(schedule)
    recording.disconnect()
    partial.replace(path)


def write_run_rrd(folder: Path) -> Path:
    """Write `flight.rrd` of a run folder from its log. Raises `LabError` when there is none."""
    path = folder / RECORDING
    write_rrd(load_log(folder), load_events(folder), load_schedule(folder), path)
    return path


def view_run(folder: Path) -> None:
    """Show a run folder in the viewer until its window is closed; the recording is made when missing. Raises `LabError`."""
    path = folder / RECORDING
    if not path.is_file():
        write_run_rrd(folder)
    show_file(path)


class LiveViewer:
    """A rerun window that follows a flight: `send` is the recorder's `on_batch` and never waits for the window."""

    def __init__(self, folder: Path) -> None:
        """Open the window, or join the one that is open; `folder` is where the texts of the flight appear.

        Raises `LabError` when no window opens.
        """
        self._folder = folder
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.connect_grpc(open_window(), default_blueprint=blueprint())
        self._stage: Stage | None = None
        self._texts = 0
        self._feed = LiveFeed(self._show)
        self.send = self._feed.offer

    def close(self) -> int:
        """Let the window catch up for a few seconds; returns how many batches it has missed."""
        self._feed.close(CATCH_UP_S)
        with suppress(RuntimeError):  # a window that was closed, or is stuck
            self._recording.flush(timeout_sec=CATCH_UP_S)
        return self._feed.dropped

    def _show(self, batch: pa.RecordBatch) -> None:
        if self._stage is None:
            self._stage = Stage(self._recording, batch.schema)
        self._stage.add_rows(pa.Table.from_batches([batch]))
        events = load_events(self._folder)
        self._stage.add_events(events[self._texts :])
        self._texts = len(events)
