"""The 3-D scene below `/world`, in metres and W: tunnel, robot, goal, estimate, drag, flow, tether, markers and pushes."""

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from firmware_py.geometry import from_euler_zyx, yaw_quaternion
from hil.board.markers import DIAMETER
from hil.laboratory.faults import parse
from hil.laboratory.files.recorder import stored_in
from hil.laboratory.metrics import BOX, body, column
from hil.pictures import scene
from hil.pictures.viewer.track import RecordingTrack, Times, rgba
from hil.world.config import PlantConfig, TunnelConfig
from hil.world.scene import Part, VisualModel

METRES_PER_NEWTON = 0.15  # length of the drag arrows, and of pushes
SECONDS_OF_FLOW = 0.02  # length of the flow's arrow: the distance that the air moves in that time
SECONDS_OF_WIND = 0.1  # likewise of its sideways part, which is small
PUSH_SHOWN_US = 500_000  # at least, because a push is too short to be seen
NOZZLE_RADIUS = 0.6  # [m] paper, Experimental platform: 1.2 m wide
NOZZLE_TOP = 1.8  # [m] where the drawing of the tunnel ends
FLOW_RADIUS = 0.2  # [m] docs/explanation/plant.md, Tunnel
AXIS = 0.08  # [m] length of drawn axes
MARKERS_SEEN = "markers.visible"
SEEN, HIDDEN = 0xFFFFFFFF, 0xFF3030FF  # colours of markers
STEEL = 0x707880FF
# Colour and radius [m].
ARROWS = {"drag": (0xF0E442FF, 0.0035), "flow": (0x56B4E9FF, 0.005), "wind": (0xA6DDF5FF, 0.005)}
LINES = {"tether": (0x99A3ADFF, 0.0015), "trail": (0xFFFFFFC0, 0.0018), "wanted": (0xD55E00C0, 0.0018)}


class Scene:
    """Draws what has a place, from the rows of a log whose schema holds configuration and look."""

    def __init__(self, track: RecordingTrack, schema: pa.Schema) -> None:
        config = stored_in(schema.metadata, "config")
        plant = {
            key: value for key, value in config.get("plant", {}).items() if key in PlantConfig.model_fields
        }
        self._track = track
        self._robot = VisualModel.read(stored_in(schema.metadata, "look"))
        self._forced = [part for part in self._robot.parts if f"{part.force}_x" in schema.names]
        self._plant = PlantConfig.model_validate(plant)  # older logs have the shape in [plant]
        self._tunnel = TunnelConfig.model_validate(config.get("tunnel", {}))
        self._markers = self._robot.markers if MARKERS_SEEN in schema.names else ()
        self._build_tunnel()
        self._build_goal()
        self._build_robot()
        self._build_arrows()

    def add_rows(self, joined: pa.Table, fresh: int) -> None:
        """Draw the rows from `fresh` on; those before are known already."""
        rows = joined.slice(fresh)
        times, p_WB, q_WB = column(rows, "t"), body(rows, "x", "y", "z"), body(rows, "qw", "qx", "qy", "qz")
        self._place("robot", times, p_WB, q_WB)
        self._place("held", times, p_WB, np.broadcast_to((1.0, 0.0, 0.0, 0.0), q_WB.shape))
        for part in self._robot.parts:
            if part.angle:
                place = np.broadcast_to(part.place, p_WB.shape)
                self._place(f"robot/parts/{part.name}", times, place, scene.turn_of(part, rows))
        self._place(
            "goal", times, goal_of(rows), np.array([yaw_quaternion(yaw) for yaw in column(rows, "goal.yaw")])
        )
        if "estimate.x" in rows.column_names:
            pose = column(rows, *(f"estimate.{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw")))
            known = np.isfinite(pose).all(axis=1)  # a real board may not have reported it yet
            q_GE = [from_euler_zyx(*angles) for angles in pose[known, 3:].tolist()]
            self._place("goal/estimate", times[known], pose[known, :3], np.array(q_GE).reshape(-1, 4))
        if "flow.x" in rows.column_names:  # of a real flight neither flow nor forces are known
            self._add_flow(rows, p_WB)
        if self._forced:
            self._add_forces(rows, p_WB, q_WB)
        if len(self._markers):
            self._colour_markers(joined, fresh)
        self._add_trail("trail", joined, body(joined, "x", "y", "z"))
        moved = np.r_[False, (np.diff(goal_of(joined), axis=0) != 0.0).any(axis=1)]
        self._add_trail("wanted", joined, np.where(moved[:, None], goal_of(joined), np.nan))

    def add_tether(self, rows: pa.Table) -> None:
        """Draw the tether of a simulated robot."""
        if "truth.x" not in rows.column_names:
            return
        q_WB = body(rows, "qw", "qx", "qy", "qz")
        top = body(rows, "x", "y", "z") + scene.rotated(q_WB, np.array(self._robot.knot))
        anchor = (0.0, 0.0, self._tunnel.hover_height + self._plant.tether.anchor_height)
        lines = np.stack((np.broadcast_to(anchor, top.shape), top), axis=1).astype(np.float32)
        self._track.send("world/tether", column(rows, "t"), rr.LineStrips3D.columns(strips=lines))

    def add_push(self, t_us: int, text: str) -> None:
        """Draw a fault that is a push. Raises `LabError` for a kind of the user's own."""
        fault = parse(text)
        group, _, axis = fault.kind.partition(".")
        if group != "push" or axis not in "xyz":
            return
        force = METRES_PER_NEWTON * fault.size * np.eye(3)["xyz".index(axis)]
        path = f"world/held/push_{axis}"
        arrow = rr.Arrows3D(vectors=[force], origins=[-force], colors=0xCC79A7FF, radii=0.006)
        self._track.at(t_us, path, arrow)
        shown_us = max(PUSH_SHOWN_US, int(1e6 * min(fault.duration_s, 1e6)))
        self._track.at(t_us + shown_us, path, rr.Clear(recursive=False))

    def _add_forces(self, rows: pa.Table, p_WB: NDArray[np.float64], q_WB: NDArray[np.float64]) -> None:
        times, parts = column(rows, "t"), self._forced
        forces = column(rows, *(f"{part.force}_{axis}" for part in parts for axis in "xyz"))
        origins = [
            p_WB + scene.rotated(q_WB, scene.force_origin(part, scene.turn_of(part, rows))) for part in parts
        ]
        arrows = rr.Arrows3D.columns(
            vectors=METRES_PER_NEWTON * forces.reshape(-1, 3),
            origins=np.stack(origins, axis=1).reshape(-1, 3),
        )
        self._track.send("world/drag", times, arrows.partition(np.full(len(times), len(parts))))

    def _add_flow(self, rows: pa.Table, p_WB: NDArray[np.float64]) -> None:
        times, flow = column(rows, "t"), column(rows, "flow.x", "flow.y", "flow.z")
        shift, wind = SECONDS_OF_FLOW * flow, SECONDS_OF_WIND * flow * (1.0, 1.0, 0.0)
        for name, vectors, below in (("flow", shift, 0.1), ("wind", wind, 0.0)):
            arrows = rr.Arrows3D.columns(vectors=vectors, origins=p_WB - vectors - (0, 0, below))
            self._track.send(f"world/{name}", times, arrows)

    def _add_trail(self, name: str, joined: pa.Table, path: NDArray[np.float64]) -> None:
        """Draw a path from each row to the next where it is known in both."""
        steps = np.stack((path[:-1], path[1:]), axis=1).astype(np.float32)
        known = np.isfinite(steps).all(axis=(1, 2))
        strips = rr.LineStrips3D.columns(strips=steps[known])
        self._track.send(f"world/{name}", column(joined, "t")[1:][known], strips)

    def _colour_markers(self, rows: pa.Table, fresh: int) -> None:
        """Colour the markers where they appear or vanish, from row `fresh` on."""
        bits = column(rows, MARKERS_SEEN).astype(np.int64)
        changed = np.flatnonzero(np.diff(bits, prepend=-1))
        changed = changed[changed >= fresh]
        count = len(self._markers)
        seen = bits[changed, None] >> np.arange(count) & 1
        colours = rr.Points3D.columns(colors=np.where(seen, SEEN, HIDDEN).astype(np.uint32).ravel())
        self._track.send(
            "world/robot/markers", column(rows, "t")[changed], colours.partition(np.full(len(seen), count))
        )

    def _place(self, name: str, times: Times, p: NDArray[np.float64], q: NDArray[np.float64]) -> None:
        """Send poses, q as w x y z; where they are unknown, the last one stays."""
        known = np.isfinite(p).all(axis=1) & np.isfinite(q).all(axis=1)
        poses = rr.Transform3D.columns(translation=p[known], quaternion=np.roll(q[known], -1, axis=1))
        self._track.send(f"world/{name}", times[known], poses)

    def _build_tunnel(self) -> None:
        static = self._track.static
        static("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
        static("world/tunnel/axes", rr.TransformAxes3D(2 * AXIS))
        net = scene.net_lines(NOZZLE_RADIUS, self._plant.ground.height)
        static("world/tunnel/net", rr.LineStrips3D(net, colors=0x8899AA50, radii=0.001))
        if self._tunnel.fan_factor == 0.0:  # a room
            return
        angle = np.linspace(0, 2 * np.pi, 73)
        ring = np.column_stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)))
        rings = [NOZZLE_RADIUS * ring, NOZZLE_RADIUS * ring + (0, 0, NOZZLE_TOP)]
        posts = [np.array([rings[0][index], rings[1][index]]) for index in range(0, 72, 18)]
        static("world/tunnel/nozzle", rr.LineStrips3D([*rings, *posts], colors=0x8899AA90, radii=0.004))
        flow = rr.Cylinders3D(
            lengths=[NOZZLE_TOP], radii=[FLOW_RADIUS], centers=[(0, 0, NOZZLE_TOP / 2)], colors=0x56B4E918,
            fill_mode="solid",
        )  # fmt: skip
        static("world/tunnel/flow", flow)

    def _build_goal(self) -> None:
        cross = [np.array([-line, line]) for line in BOX / 5 * np.eye(3)]
        static = self._track.static
        static("world/goal/cross", rr.LineStrips3D(cross, colors=0xD55E00FF, radii=0.0025))
        static("world/goal/box", rr.LineStrips3D(scene.box_lines(BOX), colors=0xD55E00A0, radii=0.0012))
        wanted = [*self._robot.outline, np.array([(0.0, 0.0, 0.0), (2 * AXIS, 0.0, 0.0)])]
        static("world/goal/ghost", rr.LineStrips3D(wanted, colors=0xD55E00FF, radii=0.0012))
        ghost = rr.LineStrips3D(list(self._robot.outline), colors=0xFFFFFF90, radii=0.0012)
        static("world/goal/estimate/ghost", ghost)

    def _build_robot(self) -> None:
        static = self._track.static
        case = rr.Boxes3D(half_sizes=[(0.022, 0.016, 0.012)], colors=0x404850FF, fill_mode="solid")
        static("world/robot/body", case)
        static("world/robot/frame", rr.LineStrips3D(list(self._robot.frame), colors=STEEL, radii=0.0015))
        static("world/robot/axes", rr.TransformAxes3D(AXIS))
        for part in self._robot.parts:
            self._build_part(part)
        if len(self._markers):
            static("world/robot/markers", rr.Points3D(self._markers, radii=DIAMETER / 2))

    def _build_part(self, part: Part) -> None:
        static, path = self._track.static, f"world/robot/parts/{part.name}"
        if not part.angle:
            static(path, rr.Transform3D(translation=part.place))
        surface = rr.Mesh3D(
            vertex_positions=part.triangles.reshape(-1, 3), vertex_normals=scene.normals_of(part).reshape(-1, 3),
            triangle_indices=np.arange(3 * len(part.triangles)).reshape(-1, 3), albedo_factor=rgba(part.colour),
        )  # fmt: skip
        static(path, surface)
        if part.label:
            centre = [scene.centre_of(part.triangles)]
            number = rr.Points3D(centre, radii=0.002, colors=rgba(part.colour), labels=part.label)
            static(f"{path}/number", number)

    def _build_arrows(self) -> None:
        for name, (colour, radius) in ARROWS.items():
            self._track.static(f"world/{name}", rr.Arrows3D.from_fields(colors=[colour], radii=[radius]))
        for name, (colour, radius) in LINES.items():
            line = rr.LineStrips3D.from_fields(colors=[colour], radii=[radius])
            self._track.static(f"world/{name}", line)


def goal_of(rows: pa.Table) -> NDArray[np.float64]:
    return column(rows, "goal.x", "goal.y", "goal.z")
