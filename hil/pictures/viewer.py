"""The flight in the rerun viewer: as the file `flight.rrd`, or while it happens; one scene for simulated and real flights.

`Stage` turns rows of the flight log into entities below `/world` (3-D; metres, W), `/plot` (`curves` and `monitor`),
`/state` and `/text`, on one timeline: `from_release`, or `from_start` while the release is not known. The only
file that knows rerun, which comes with the extra `view`: without it, importing this file raises `LabError`.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import chain, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from firmware_py.extras import install_command
from firmware_py.geometry import from_euler_zyx, yaw_quaternion
from ground_station.latency import STAGES
from hil.devices.markers import DIAMETER, marker_places
from hil.errors import LabError
from hil.laboratory.ages import ages_in_time_of
from hil.laboratory.faults import parse
from hil.laboratory.metrics import BOX, body, column, is_real
from hil.laboratory.recorder import OPERATOR, RELEASE_US, load_events, log_pieces, release_of
from hil.laboratory.schedule import load_schedule, runs
from hil.pictures import curves, monitor, scene
from hil.pictures.curves import Curves
from hil.pictures.links import HOST
from hil.pictures.monitor import MARK_COLOURS, RATES, REFUSALS, Rates
from hil.world.config import GeometryConfig, PlantConfig, TunnelConfig
from hil.world.geometry import weigh

try:
    import rerun as rr
    import rerun.blueprint as rrb
    from rerun_bindings import CatalogClientInternal
except ImportError as error:
    raise LabError(f"the viewer needs rerun: {install_command('view')}") from error

RECORDING = "flight.rrd"
APPLICATION = "floaty"
FROM_RELEASE, FROM_START = "from_release", "from_start"  # timelines
FOLLOWED_S = 20.0  # shown by the curves of a live flight
CATCH_UP_S = 5.0  # granted to the viewer at the end of a live flight

METRES_PER_NEWTON = 0.15  # length of the drag arrows, and of pushes
SECONDS_OF_FLOW = 0.02  # length of the flow's arrow: the distance that the air moves in that time
SECONDS_OF_WIND = 0.1  # likewise of its sideways part, which is small
PUSH_SHOWN_US = 500_000  # at least, because a push is too short to be seen
TRAIL_S = 4.0
NOZZLE_RADIUS = 0.6  # [m] paper, Experimental platform: 1.2 m wide
NOZZLE_TOP = 1.8  # [m] where the drawing of the tunnel ends
FLOW_RADIUS = 0.2  # [m] docs/explanation/plant.md, Tunnel
AXIS = 0.08  # [m] length of drawn axes
MARKERS_SEEN = "markers.visible"
SEEN, HIDDEN = 0xFFFFFFFF, 0xFF3030FF  # colours of markers
ROWS_AT_ONCE = 10_000  # of a long flight
SLOW = 10  # rows between samples of slow quantities: 10 Hz

PLOTS: Mapping[str, Curves] = {
    "position/error": curves.POSITION,
    "attitude/error": curves.ATTITUDE,
    "flaps/angle": curves.FLAPS,
    "flaps/command": curves.FLAPS_COMMAND,
    "inputs": curves.INPUTS,
    "miss/position": curves.POSITION_MISS,
    "miss/attitude": curves.ATTITUDE_MISS,
    "age/pose": curves.AGE,
    "age/horizon": curves.HORIZON,
    "age/without": curves.SINCE_FUSION,
    "age/stages": monitor.AGE_STAGES,
    "link/loss/radio": curves.PACKETS,
    "link/loss/serial": curves.SERIAL_FAULTS,
    "link/loss/station": curves.STATION,
    "link/air": monitor.AIR,
    "battery": monitor.BATTERY,
    "queue": curves.QUEUE,
    "processor/all": monitor.LOAD,  # of a real board; a simulated one's is by task
}
PALE = "flaps/command"
LIMITS = {  # they also keep the axes' scales fixed
    "position/limit": curves.NEAR_CM, "position/box": 100 * BOX, "attitude/limit": curves.ATTITUDE_DEG,
}  # fmt: skip
# Title and origin of each plot; the first two have their own place, the rest are tabs.
VIEWS = (
    ("Position error [cm]", "position"),
    ("Attitude error [deg]", "attitude"),
    ("Flap angles, commands pale; colours of the scene [deg]", "flaps"),
    ("Inputs [deg]", "inputs"),
    ("Estimate - truth [cm, deg]", "miss"),
    ("Age of the pose, by stage [ms]", "age"),
    ("Link: rates [1/s]", "link/rate"),
    ("Link: losses", "link/loss"),
    ("Link: air", "link/air"),
    ("Battery [V]", "battery"),
    ("Queue", "queue"),
    ("Processor [%]", "processor"),
)
STRETCHES_SHOWN = 2000  # of the schedule; the whole of it is for Perfetto
FAULT = re.compile(r"fault (\S+) (begins|ends)")  # texts of the laboratory
LEGEND = """
| drawn | what |
|---|---|
| plates, flaps 1 to 4 | the true robot, of a real flight by the cameras; flaps in the colours of their curves |
| white outline | the board's estimate |
| red box and cross | 20 cm around the goal |
| white line | the path of the last 4 s |
| yellow arrows | drag of the plates, 15 cm per newton |
| blue arrow | the air's movement in 0.02 s; pale: its sideways part in 0.1 s |
| pink arrow | a push, 15 cm per newton, shown for half a second at least |
| grey line, grid | tether, net |
| red, green, blue axes | x, y, z of W at the exit, and of the body |
| points on the zero line | poses refused, faults, an operator's actions |
"""


def timeline_of(metadata: Mapping[bytes, bytes] | None) -> tuple[str, int]:
    """Return the timeline of a log and its zero in the log's time [us]."""
    known = metadata or {}
    if RELEASE_US in known or ":" not in known.get(b"link", b"").decode():  # in lockstep it is planned
        return FROM_RELEASE, release_of(known)
    return FROM_START, 0


class Stage:
    """Writes the rows of one flight, in the order of time, to a rerun recording."""

    def __init__(self, recording: rr.RecordingStream, schema: pa.Schema) -> None:
        """Log everything static; `schema` is the log's, its metadata holds the configuration."""
        metadata = {key.decode(): value.decode() for key, value in (schema.metadata or {}).items()}
        config = json.loads(metadata.get("config", "{}"))
        self._recording = recording
        self._geometry = GeometryConfig.model_validate(config.get("geometry", {}))
        plant = {
            key: value for key, value in config.get("plant", {}).items() if key in PlantConfig.model_fields
        }
        self._plant = PlantConfig.model_validate(plant)  # older logs have the shape in [plant]
        self._tunnel = TunnelConfig.model_validate(config.get("tunnel", {}))
        self._flap_axes = scene.flap_axes(self._geometry)
        self._plots = {path: plot for path, plot in PLOTS.items() if plot.needs in schema.names}
        self._rates = {path: rate for path, rate in RATES.items() if set(rate.columns) <= set(schema.names)}
        self._states = curves.lanes_of(schema.names)
        self._processor = curves.processor(schema.names)
        self._refusals = {
            name: columns for name, columns in REFUSALS.items() if set(columns) & set(schema.names)
        }
        self._faults: list[str] = []  # kinds of the faults in force
        self._past = schema.empty_table()  # the rows of the last second
        self._slow = schema.empty_table()  # the last row that was a sample of slow quantities
        self._count = 0  # rows so far
        self._fusion = schema.empty_table()  # the row of the last fused pose
        self._timeline, self._zero_us = timeline_of(schema.metadata)
        recording.set_log_time_enabled(False)
        name = "real flight" if "cameras.x" in schema.names else f"seed {metadata.get('seed', '?')}"
        recording.send_recording_name(f"{metadata.get('experiment', 'flight')}, {name}")
        self._build_tunnel()
        self._build_robot()
        if MARKERS_SEEN in schema.names:
            self._recording.log(
                "world/robot/markers",
                rr.Points3D(marker_places(self._geometry, self._plant.ground), radii=DIAMETER / 2),
                static=True,
            )
        self._name_curves()
        self._recording.log("legend", rr.TextDocument(LEGEND, media_type=rr.MediaType.MARKDOWN), static=True)

    def add_rows(self, rows: pa.Table) -> None:
        """Log the next rows in time."""
        if rows.num_rows == 0:
            return
        past = pa.concat_tables([self._past, rows])
        before = self._past.num_rows
        joined = past.slice(max(0, before - 1))
        fresh = joined.num_rows - rows.num_rows  # the first row of `joined` that is new
        self._move(rows)
        if MARKERS_SEEN in rows.column_names:
            self._colour_markers(joined, fresh)
        since_fusion = pa.concat_tables([self._fusion, rows])
        self._fusion = curves.row_of_last_fusion(since_fusion)
        for path, plot in self._plots.items():
            values = plot.read(since_fusion)[-rows.num_rows :]
            self._send(f"plot/{path}", column(rows, "t"), rr.Scalars.columns(scalars=values))
        self._add_slow(past, np.arange(before + -self._count % SLOW, past.num_rows, SLOW))
        for path, states in self._states.items():
            begins, names = curves.changes(joined, states)
            self._send(f"state/{path}", begins[fresh:], rr.StateChange.columns(state=names[fresh:]))
        for name, columns in self._refusals.items():
            self._mark(name, column(joined, "t")[monitor.refused(joined, columns)])
        self._add_trail(joined)
        self._count += rows.num_rows
        self._past = past.slice(max(0, past.num_rows - monitor.ROWS_OF_A_SECOND))

    def _add_slow(self, past: pa.Table, at: NDArray[np.int64]) -> None:
        """Log slow quantities of rows `at`, with those of a second before them."""
        if len(at) == 0:
            return
        chosen = past.take(at)
        times = column(chosen, "t")
        for path, limit in LIMITS.items():
            lines = np.full((len(times), 2), (limit, -limit))
            self._send(f"plot/{path}", times, rr.Scalars.columns(scalars=lines))
        for path, rate in self._rates.items():
            self._send(
                f"plot/{path}", times, rr.Scalars.columns(scalars=monitor.rates(past, rate.columns, at))
            )
        if self._processor.names:
            slow = pa.concat_tables([self._slow, chosen])
            self._send(
                "plot/processor",
                column(slow, "t")[1:],
                rr.Scalars.columns(scalars=self._processor.read(slow)),
            )
        self._slow = chosen.slice(chosen.num_rows - 1)
        if "truth.x" not in past.column_names:
            return
        top = scene.tops(self._geometry, body(chosen, "x", "y", "z"), body(chosen, "qw", "qx", "qy", "qz"))
        anchor = (0.0, 0.0, self._tunnel.hover_height + self._plant.tether.anchor_height)
        lines = np.stack((np.broadcast_to(anchor, top.shape), top), axis=1).astype(np.float32)
        self._send("world/tether", times, rr.LineStrips3D.columns(strips=lines))

    def _add_trail(self, joined: pa.Table) -> None:
        """Draw the path from each row to the next where the robot was seen in both."""
        track = body(joined, "x", "y", "z")
        steps = np.stack((track[:-1], track[1:]), axis=1).astype(np.float32)
        seen = np.isfinite(steps).all(axis=(1, 2))
        self._send("world/trail", column(joined, "t")[1:][seen], rr.LineStrips3D.columns(strips=steps[seen]))

    def add_schedule(self, schedule: pa.Table) -> None:
        """Log which task had the processor, a lane per task."""
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

    def add_ages(self, ages: pa.Table) -> None:
        """Log the stages of the poses' age, from the station's own record: `t` [us] and each of `STAGES` [us]."""
        table = ages.rename_columns(["t", *(f"age.{stage}" for stage in STAGES)])
        path = "age/stages"
        if path in self._plots or table.num_rows == 0:  # they are in the log
            return
        self._name_curve(path, monitor.AGE_STAGES)
        values = monitor.AGE_STAGES.read(table)
        self._send(f"plot/{path}", column(table, "t"), rr.Scalars.columns(scalars=values))

    def add_events(self, events: Iterable[Mapping[str, Any]]) -> None:
        """Log texts: `t_us`, `source`, `text`, and the faults and actions of an operator in them."""
        for event in events:
            t_us, source, text = event["t_us"], event["source"], event["text"]
            self._at(t_us)
            self._recording.log(f"text/{source}", rr.TextLog(f"{source}: {text}"))
            if source == OPERATOR:
                self._mark(OPERATOR, np.array([t_us], np.float64))
            elif found := FAULT.fullmatch(text):
                self._add_fault(t_us, found[1], begins=found[2] == "begins")

    def _add_fault(self, t_us: int, fault: str, begins: bool) -> None:
        """Log the begin or end of a fault: in the lane of faults, as a mark, a push as an arrow."""
        kind = fault.partition("@")[0]
        if begins:
            self._faults.append(kind)
            self._mark("fault", np.array([t_us], np.float64))
            with suppress(LabError):  # a kind of the user's own
                self._push(t_us, fault)
        elif kind in self._faults:
            self._faults.remove(kind)
        lane = " + ".join(self._faults) or "-"
        self._at(t_us)
        self._recording.log("state/faults", rr.StateChange(state=lane))

    def _push(self, t_us: int, text: str) -> None:
        fault = parse(text)
        group, _, axis = fault.kind.partition(".")
        if group != "push" or axis not in "xyz":
            return
        force = METRES_PER_NEWTON * fault.size * np.eye(3)["xyz".index(axis)]
        path = f"world/held/push_{axis}"
        self._recording.log(
            path, rr.Arrows3D(vectors=[force], origins=[-force], colors=0xCC79A7FF, radii=0.006)
        )
        self._at(t_us + max(PUSH_SHOWN_US, int(1e6 * min(fault.duration_s, 1e6))))
        self._recording.log(path, rr.Clear(recursive=False))

    def _at(self, t_us: int) -> None:
        self._recording.set_time(self._timeline, duration=np.timedelta64(t_us - self._zero_us, "us"))

    def _mark(self, name: str, times_us: NDArray[np.float64]) -> None:
        self._send(
            f"plot/position/marks/{name.replace(' ', '_')}",
            times_us,
            rr.Scalars.columns(scalars=np.zeros(len(times_us))),
        )

    def _send(self, path: str, times_us: NDArray[np.float64], columns: Iterable[Any]) -> None:
        if len(times_us) == 0:
            return
        since = (times_us - self._zero_us).astype("timedelta64[us]")
        index = rr.TimeColumn(self._timeline, duration=since)
        self._recording.send_columns(path, [index], columns)

    def _move(self, rows: pa.Table) -> None:
        """Place everything that has a pose, and the arrows."""
        times = column(rows, "t")
        p_WB = body(rows, "x", "y", "z")
        q_WB = body(rows, "qw", "qx", "qy", "qz")
        flaps = np.radians(curves.FLAPS.read(rows))
        self._place("world/robot", times, p_WB, q_WB)
        upright = np.broadcast_to((1.0, 0.0, 0.0, 0.0), q_WB.shape)
        self._place("world/held", times, p_WB, upright)
        for flap in range(4):
            turn = scene.turn_quaternion(self._flap_axes[flap], flaps[:, flap])
            self._place(f"world/robot/plates/flap_{flap + 1}", times, np.zeros_like(p_WB), turn)
        goal = column(rows, "goal.x", "goal.y", "goal.z")
        self._place(
            "world/goal", times, goal, np.array([yaw_quaternion(yaw) for yaw in column(rows, "goal.yaw")])
        )
        pose = column(rows, *(f"estimate.{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw")))
        known = np.isfinite(pose).all(axis=1)  # a real board may not have reported it yet
        q_GE = [from_euler_zyx(*angles) for angles in pose[known, 3:].tolist()]
        self._place("world/goal/estimate", times[known], pose[known, :3], np.array(q_GE).reshape(-1, 4))
        if is_real(rows):  # no forces are known
            return

        parts = ("base", "flap1", "flap2", "flap3", "flap4")
        forces = column(rows, *(f"force.{part}_{axis}" for part in parts for axis in "xyz"))
        drag = METRES_PER_NEWTON * forces.reshape(-1, 3)
        origins = scene.drag_origins(self._geometry, p_WB, q_WB, flaps).reshape(-1, 3)
        arrows = rr.Arrows3D.columns(vectors=drag, origins=origins)
        self._send("world/drag", times, arrows.partition(np.full(len(times), len(parts))))
        flow = column(rows, "flow.x", "flow.y", "flow.z")
        shift = SECONDS_OF_FLOW * flow
        self._send(
            "world/flow", times, rr.Arrows3D.columns(vectors=shift, origins=p_WB - shift - (0, 0, 0.1))
        )
        wind = SECONDS_OF_WIND * flow * (1.0, 1.0, 0.0)
        self._send("world/wind", times, rr.Arrows3D.columns(vectors=wind, origins=p_WB - wind))

    def _colour_markers(self, rows: pa.Table, fresh: int) -> None:
        """Colour the markers where they appear or vanish, from row `fresh` on."""
        bits = column(rows, MARKERS_SEEN).astype(np.int64)
        changed = np.flatnonzero(np.diff(bits, prepend=-1))
        changed = changed[changed >= fresh]
        places = marker_places(self._geometry, self._plant.ground)
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
        """Send poses, q as w x y z; where they are unknown, the last one stays."""
        known = np.isfinite(p).all(axis=1) & np.isfinite(q).all(axis=1)
        xyzw = np.roll(q[known], -1, axis=1)
        self._send(path, times[known], rr.Transform3D.columns(translation=p[known], quaternion=xyzw))

    def _build_tunnel(self) -> None:
        log = self._recording.log
        log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log("world/tunnel/axes", rr.TransformAxes3D(2 * AXIS), static=True)
        net = scene.net_lines(NOZZLE_RADIUS, self._plant.ground.height)
        log("world/tunnel/net", rr.LineStrips3D(net, colors=0x8899AA50, radii=0.001), static=True)
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
        log, geometry = self._recording.log, self._geometry
        height = weigh(geometry).axis_height
        body = rr.Boxes3D(half_sizes=[(0.022, 0.016, 0.012)], colors=0x404850FF, fill_mode="solid")
        log("world/robot/body", body, static=True)
        rod = [[(0, 0, 0), (0, 0, height)]]
        log("world/robot/rod", rr.LineStrips3D(rod, colors=0x707880FF, radii=0.003), static=True)
        stand = rr.LineStrips3D(
            scene.stand_lines(geometry, self._plant.ground), colors=0x707880FF, radii=0.0015
        )
        log("world/robot/stand", stand, static=True)
        log("world/robot/axes", rr.TransformAxes3D(AXIS), static=True)
        log("world/robot/plates", rr.Transform3D(translation=(0, 0, height)), static=True)
        meshes = [("base", scene.base_mesh(geometry), "#c8ccd0")]
        for flap, colour in enumerate(curves.FLAP_COLOURS):
            meshes.append((f"flap_{flap + 1}", scene.flap_mesh(geometry, flap), colour))
        for name, mesh, colour in meshes:
            surface = rr.Mesh3D(
                vertex_positions=mesh.vertices, triangle_indices=mesh.triangles, vertex_normals=mesh.normals(),
                albedo_factor=_rgba(colour),
            )  # fmt: skip
            log(f"world/robot/plates/{name}", surface, static=True)
            if name != "base":
                number = rr.Points3D(
                    [scene.mesh_centre(mesh)], radii=0.002, colors=_rgba(colour), labels=name[-1]
                )
                log(f"world/robot/plates/{name}/number", number, static=True)
        ghost = rr.LineStrips3D(scene.outline(geometry), colors=0xFFFFFF90, radii=0.0012)
        log("world/goal/estimate/ghost", ghost, static=True)
        log("world/drag", rr.Arrows3D.from_fields(colors=[0xF0E442FF], radii=[0.0035]), static=True)
        log("world/flow", rr.Arrows3D.from_fields(colors=[0x56B4E9FF], radii=[0.005]), static=True)
        log("world/wind", rr.Arrows3D.from_fields(colors=[0xA6DDF5FF], radii=[0.005]), static=True)
        log("world/tether", rr.LineStrips3D.from_fields(colors=[0x99A3ADFF], radii=[0.0015]), static=True)
        log("world/trail", rr.LineStrips3D.from_fields(colors=[0xFFFFFFC0], radii=[0.0018]), static=True)

    def _name_curves(self) -> None:
        named: dict[str, Curves | Rates] = {**self._plots, **self._rates}
        for path, plot in named.items():
            self._name_curve(path, plot)
        if self._processor.names:
            self._name_curve("processor", self._processor)
        for path in LIMITS:
            name = path.rpartition("/")[2]
            limit = rr.SeriesLines(
                names=[name, name], colors=_rgba_array([curves.GREY] * 2), widths=[1.0] * 2
            )
            self._recording.log(f"plot/{path}", limit, static=True)
        for name, colour in MARK_COLOURS.items():
            points = rr.SeriesPoints(names=name, colors=_rgba(colour), markers="diamond", marker_sizes=5.0)
            self._recording.log(f"plot/position/marks/{name.replace(' ', '_')}", points, static=True)
        for path, states in self._states.items():
            lanes = rr.StateConfiguration(values=states.names, colors=_rgba_array(states.colours))
            self._recording.log(f"state/{path}", lanes, static=True)
        none = rr.StateConfiguration(values=["-"], colors=_rgba_array([curves.GREY]))
        self._recording.log("state/faults", none, static=True)

    def _name_curve(self, path: str, plot: Curves | Rates) -> None:
        width, opacity = (1.0, 120) if path == PALE else (1.6, 255)
        lines = rr.SeriesLines(
            names=plot.names, colors=_rgba_array(plot.colours, opacity), widths=[width] * len(plot.names)
        )
        self._recording.log(f"plot/{path}", lines, static=True)


def _rgba(colour: str, opacity: int = 255) -> int:
    """Return `#rrggbb` as rerun packs it."""
    return int(colour[1:], 16) << 8 | opacity


def _rgba_array(colours: Iterable[str], opacity: int = 255) -> NDArray[np.uint32]:
    return np.array([_rgba(colour, opacity) for colour in colours], np.uint32)


def blueprint(schema: pa.Schema, live: bool = False) -> rrb.Blueprint:
    """Return the layout of the window: the scene and the states on the left, the curves on the right.

    A live flight is followed, with the curves of its last seconds, until the user pauses or zooms.
    """
    timeline, _ = timeline_of(schema.metadata)
    now = rrb.TimeRangeBoundary.cursor_relative()
    before = rrb.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S)
    tunnel = rrb.Spatial3DView(
        name="Wind tunnel",
        origin="world",
        eye_controls=rrb.EyeControls3D(
            position=(0.62, -0.48, 1.45), look_target=(0.0, 0.0, 1.12), tracking_entity="world/robot"
        ),
        background=(14, 18, 22),  # pale lines stay visible in a light theme, too
        line_grid=False,
        overrides={
            "world/trail": [rrb.VisibleTimeRanges(rrb.VisibleTimeRange(timeline, start=before, end=now))]
        },
    )
    begin = rrb.TimeRangeBoundary.cursor_relative(seconds=-FOLLOWED_S)
    shown = [rrb.VisibleTimeRange(timeline, start=begin, end=now)] if live else None
    names = (*PLOTS, *RATES, *LIMITS, "processor")
    known = {path for path in names if _is_known(path, schema)}
    plots = [
        rrb.TimeSeriesView(
            name=name, origin=f"plot/{path}", plot_legend=rrb.PlotLegend(visible=path != "flaps"), time_ranges=shown
        )
        for name, path in VIEWS
        if any(one == path or one.startswith(f"{path}/") for one in known)
    ]  # fmt: skip
    columns = rrb.TextLogColumns(timeline_columns=[timeline], text_log_columns=["Body"])
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                tunnel,
                rrb.Horizontal(
                    rrb.StateTimelineView(name="States", origin="state", time_ranges=shown),
                    rrb.Tabs(
                        rrb.TextLogView(name="Text", origin="text", columns=columns),
                        rrb.TextDocumentView(name="Legend", origin="legend"),
                    ),
                ),
                row_shares=[3, 1],
            ),
            rrb.Vertical(*plots[:2], rrb.Tabs(*plots[2:])),
            column_shares=[5, 4],
        ),
        rrb.TimePanel(timeline=timeline, play_state="following" if live else "playing", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def _is_known(path: str, schema: pa.Schema) -> bool:
    """Whether a flight with such a log has a curve."""
    names = set(schema.names)
    if path in RATES:
        return set(RATES[path].columns) <= names
    if path == "processor":
        return bool(curves.processor(schema.names).names)
    return path in LIMITS or PLOTS[path].needs in names


def write_rrd(
    pieces: Iterator[pa.Table],
    events: Iterable[Mapping[str, Any]],
    schedule: pa.Table,
    path: Path,
    ages: pa.Table | None = None,
) -> None:
    """Write a flight log (in pieces, metadata in their schema), its texts, schedule and ages of poses as a rerun file."""
    partial = path.with_name(path.name + ".partial")
    recording = rr.RecordingStream(APPLICATION)
    begin = next(pieces)
    recording.save(partial, default_blueprint=blueprint(begin.schema))
    stage = Stage(recording, begin.schema)
    for piece in chain([begin], pieces):
        for first in range(0, piece.num_rows, ROWS_AT_ONCE):
            stage.add_rows(piece.slice(first, ROWS_AT_ONCE))
            recording.flush()
    stage.add_events(events)
    stage.add_schedule(schedule)
    if ages is not None:
        stage.add_ages(ages)
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


class Recording:
    """The recording of a run folder, which viewers fetch from here, piece by piece, while this object lives."""

    def __init__(self, folder: Path) -> None:
        """Raises `LabError` when there is no log."""
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


class LivePicture:
    """A flight in a viewer that takes it at `address`, while it happens."""

    def __init__(self, address: str) -> None:
        self._recording = rr.RecordingStream(APPLICATION)
        self._recording.connect_grpc(address)
        self._stage: Stage | None = None

    def show(self, rows: pa.Table, events: Iterable[Mapping[str, Any]]) -> None:
        """Show the next rows, and texts up to them."""
        if self._stage is None:
            self._recording.send_blueprint(blueprint(rows.schema, live=True))
            self._stage = Stage(self._recording, rows.schema)
        self._stage.add_rows(rows)
        self._stage.add_events(events)

    def close(self) -> None:
        """Flush the data that are still queued for the viewer."""
        with suppress(RuntimeError):  # a viewer that was closed, or is stuck
            self._recording.flush(timeout_sec=CATCH_UP_S)
