"""A flight as an animation of scene and curves, 30 frames per second, drawn without a display: `flight.mp4`, `flight.gif`.

Pillow draws the robot, its goal and both paths, from above and beside, like the viewer's first view; matplotlib draws the
curves once, and each frame shows the part up to its time.
"""

from collections.abc import Iterator, Sequence
from itertools import chain, cycle
from pathlib import Path

import numpy as np
import pyarrow as pa
from matplotlib import rc_context
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from firmware_py.extras import install_command
from firmware_py.geometry import yaw_quaternion
from hil.errors import LabError, unlinked, writing
from hil.laboratory.files.recorder import load_log, stored_in
from hil.laboratory.metrics import BOX, body, column, free_flight, known
from hil.pictures import curves, scene
from hil.pictures.curves import since_release
from hil.pictures.drawing import STYLE, figure_of
from hil.pictures.panels import Plot, marks_of_flight, panel
from hil.world.scene import Part, Points, VisualModel

VIDEO, GIF = "flight.mp4", "flight.gif"
FRAMES_HZ = 30
GIF_MS = (30, 30, 40)  # a GIF counts hundredths of a second: on average 30 frames per second
GIF_MOST = 1800  # frames, which are all in memory: a minute
SIDE, HEIGHT = 440, 440  # [px] of the scene; the curves are as high
CURVES_WIDTH = 440
SHARPER = 2  # times, for smooth edges
TRAIL_S = 4.0
EYE = np.array([0.75, -0.62, 0.42])  # [m] from the middle of the scene
FREE = 0.1  # [m] around the middle, which is in the picture from there
ZOOM = 3.3  # width of what lies as far away as the middle, as a share of that distance
SKY, INK, GOAL, PATH, TIME = (14, 18, 22), (136, 153, 170), (213, 94, 0), (255, 255, 255), (60, 60, 60)
GOAL_COLUMNS = ("goal.x", "goal.y", "goal.z")


def write_video(run: Path) -> Path:
    """Write `flight.mp4` of a run folder and return its path. Raises `LabError`, also where the encoder is missing."""
    try:
        import av
    except ImportError as error:
        raise LabError(f"no video without its package ({error}): {install_command('export')}") from None
    path, pictures = run / VIDEO, frames(load_log(run))
    with writing("--video", path), av.open(str(unlinked(path)), "w") as file:
        first = next(pictures)
        stream = file.add_stream("h264", rate=FRAMES_HZ, options={"crf": "22"})
        stream.width, stream.height, stream.pix_fmt = *first.size, "yuv420p"
        for picture in chain([first], pictures):
            file.mux(stream.encode(av.VideoFrame.from_image(picture)))
        file.mux(stream.encode())
    return path


def write_gif(run: Path) -> Path:
    """Write `flight.gif` of a run folder and return its path. Raises `LabError`, also for a flight of more than a minute."""
    log = load_log(run)
    count = len(_instants(log))
    if count > GIF_MOST:
        raise LabError(
            f"--gif {run}: {count / FRAMES_HZ:.0f} s: a GIF holds at most {GIF_MOST // FRAMES_HZ} s; use --video"
        )
    # the last frame has all colours: nothing of its curves is pale
    palette = next(frames(log, _instants(log)[-1:])).quantize(64, dither=Image.Dither.NONE)
    path = run / GIF
    first, *rest = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in frames(log))
    lengths = [length for length, _ in zip(cycle(GIF_MS), range(count), strict=False)]
    with writing("--gif", path):
        first.save(unlinked(path), save_all=True, append_images=rest, duration=lengths, loop=0, optimize=True)
    return path


def _instants(log: pa.Table) -> NDArray[np.float64]:
    """Return the times [s] of the frames: from the release to the end. Raises `LabError` for a flight that never began."""
    times = since_release(known(free_flight(log)))
    if len(times) < 2:
        raise LabError("the flight never began, and so it has no animation")
    return np.asarray(times[0] + np.arange(0.0, times[-1] - times[0], 1.0 / FRAMES_HZ))


def frames(log: pa.Table, instants: NDArray[np.float64] | None = None) -> Iterator[Image.Image]:
    """Yield a picture of the flight for each thirtieth of a second after its release, or for given instants [s]."""
    flight = known(free_flight(log))
    instants = _instants(log) if instants is None else instants
    times, path, course = since_release(flight), body(flight, "x", "y", "z"), column(flight, *GOAL_COLUMNS)
    view = VideoScene(VisualModel.read(stored_in(flight.schema.metadata, "look")), course, path)
    graph = _Graph(log, flight)
    rows = np.searchsorted(times, instants)
    for row, at_s in zip(rows.tolist(), instants.tolist(), strict=True):
        whole = Image.new("RGB", (SIDE + CURVES_WIDTH, HEIGHT), SKY)
        begin = int(np.searchsorted(times, times[row] - TRAIL_S))
        whole.paste(view.at(flight.slice(row, 1), path[begin : row + 1 : 3], course[::5]), (0, 0))
        whole.paste(graph.at(at_s), (SIDE, 0))
        yield whole


def faces(
    parts: Sequence[Part], turns: Sequence[Points], p_WB: Points, q_WB: Points
) -> list[tuple[Points, str]]:
    """Return the triangles (3, 3) in W of parts that are turned in B by quaternions (4,), with their colours, at a pose."""
    shown = []
    for part, q_BF in zip(parts, turns, strict=True):
        corners_B = np.array(part.place) + scene.rotated(q_BF[None], part.triangles.reshape(-1, 3))
        corners = p_WB + scene.rotated(q_WB[None], corners_B)
        shown += [(triangle, part.colour) for triangle in corners.reshape(-1, 3, 3)]
    return shown


class VideoScene:
    """Draws the robot at a row of a flight, its path, its goal with the box, and the goal's path."""

    def __init__(self, robot: VisualModel, goals: Points, places: Points) -> None:
        """Look at the middle of the goals, from where they and the robot's places, (N, 3) [m] each, are in the picture."""
        self._robot = robot
        middle = (goals.min(axis=0) + goals.max(axis=0)) / 2
        back = EYE / np.linalg.norm(EYE)
        right = np.cross([0.0, 0.0, 1.0], back) / np.linalg.norm(back[:2])
        self._look = np.stack((right, np.cross(back, right), back))
        across, up, near = np.abs((np.concatenate([goals, places]) - middle) @ self._look.T).max(axis=0)
        away = ZOOM * max(0.0, max(across, up) - FREE) + max(0.0, near - FREE)
        self._eye = middle + EYE + away * back

    def at(self, row: pa.Table, trail: Points, course: Points) -> Image.Image:
        """Return the picture of one row, with the last places of the robot and the goal's path, (N, 3) [m] each."""
        picture = Image.new("RGB", (SHARPER * SIDE, SHARPER * HEIGHT), SKY)
        draw = ImageDraw.Draw(picture)
        goal, q_WG = column(row, *GOAL_COLUMNS)[0], np.array([yaw_quaternion(column(row, "goal.yaw")[0])])
        self._line(draw, course, GOAL, 1)
        ahead = np.array([(0.0, 0.0, 0.0), (0.16, 0.0, 0.0)])
        for line in (*scene.box_lines(BOX), *self._robot.outline, ahead):
            self._line(draw, goal + scene.rotated(q_WG, line), GOAL, 1)
        self._line(draw, trail, PATH, 2)
        p_WB, q_WB = body(row, "x", "y", "z")[0], body(row, "qw", "qx", "qy", "qz")[0]
        turns = [scene.turn_of(part, row)[0] for part in self._robot.parts]
        placed = [
            (*self._seen(corners), colour) for corners, colour in faces(self._robot.parts, turns, p_WB, q_WB)
        ]
        for points, _, colour in sorted(placed, key=lambda one: -one[1].mean()):
            draw.polygon([*map(tuple, points.tolist())], fill=colour)
        return picture.resize((SIDE, HEIGHT), Image.Resampling.BOX)

    def _line(
        self, draw: ImageDraw.ImageDraw, points: Points, colour: tuple[int, int, int], width: int
    ) -> None:
        if len(points) > 1:
            places, _ = self._seen(points)
            draw.line([*map(tuple, places.tolist())], fill=colour, width=SHARPER * width)

    def _seen(self, points: Points) -> tuple[Points, Points]:
        """Return places in the picture [px], (N, 2), and distances from the eye [m]."""
        right, up, back = ((points - self._eye) @ self._look.T).T
        scale = ZOOM * SHARPER * SIDE / 2 / -back
        return np.stack(
            (SHARPER * SIDE / 2 + scale * right, SHARPER * HEIGHT / 2 - scale * up), axis=1
        ), -back


class _Graph:
    """The curves, drawn once; at an instant, what is to come is pale."""

    def __init__(self, log: pa.Table, flight: pa.Table) -> None:
        shown = curves.errors_and_actuators(flight)
        plot = Plot(tuple(panel(curve, flight, label) for label, curve in shown))
        with rc_context(STYLE | {"font.size": 7.0, "legend.fontsize": 6.5}):
            figure = figure_of(plot, marks_of_flight(log))
            figure.set_layout_engine("constrained", h_pad=0.1)
            figure.set_dpi(100)
            figure.set_size_inches(CURVES_WIDTH / 100, HEIGHT / 100)
            canvas = FigureCanvasAgg(figure)
            figure.axes[-1].set_xlim(*since_release(flight)[[0, -1]])
            canvas.draw()  # type: ignore[no-untyped-call]
            pixels = np.asarray(canvas.buffer_rgba())  # type: ignore[no-untyped-call]
        self._whole = Image.fromarray(pixels).convert("RGB")
        self._axes = figure.axes
        self._pale = Image.blend(self._whole, Image.new("RGB", self._whole.size, "white"), 0.8)

    def at(self, at_s: float) -> Image.Image:
        """Return the curves up to an instant [s]."""
        picture = self._whole.copy()
        draw = ImageDraw.Draw(picture)
        for axes in self._axes:
            _, bottom, right, top = axes.bbox.extents
            place = min(round(axes.transData.transform((at_s, 0.0))[0]), int(right))
            edges = (place, int(HEIGHT - top), int(right), int(HEIGHT - bottom))
            picture.paste(self._pale.crop(edges), edges[:2])
            draw.line([(place, edges[1]), (place, edges[3])], fill=TIME)
        return picture
