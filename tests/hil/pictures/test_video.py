"""The animation of a flight: 30 frames per second, the robot where it was, the curves up to each instant."""

from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from hil.config import load_config
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.files.recorder import load_log
from hil.laboratory.metrics import body, column, free_flight, known
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.pictures import curves, video
from hil.pictures.curves import since_release
from hil.world.floaty.drawing import look_of
from hil.world.scene import Part, VisualModel
from support.command import Cli

av = pytest.importorskip("av")
COLOURS = [(0, 255, 0), (0, 0, 255), video.PATH, video.GOAL, video.SKY]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("video") / "run"
    fly(Request.of(EXPERIMENTS["yaw-step"], duration_s=1.0), folder)
    return folder


def test_video_and_gif_last_as_long_as_the_flight_at_30_frames_per_second(
    folder: Path, cli: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = load_log(folder)
    monkeypatch.setattr(video, "load_log", lambda run: log.slice(0, log.num_rows - 80))
    assert cli("export", folder, "--video", "--gif") == 0
    with av.open(str(folder / "flight.mp4")) as file:
        (stream,) = file.streams.video
        assert (stream.average_rate, stream.codec.name) == (30, "h264")
        pictures = [frame.to_image() for frame in file.decode(stream)]
    assert len(pictures) == 6
    expected = [*video.frames(video.load_log(folder))]
    for picture, frame in zip(pictures, expected, strict=True):
        assert picture.size == (880, 440)
        assert np.abs(np.asarray(picture).astype(int) - np.asarray(frame)).mean() < 6.0
    with Image.open(folder / "flight.gif") as picture:
        assert (picture.n_frames, picture.info["loop"]) == (6, 0)
        lengths = []
        for frame in range(6):
            picture.seek(frame)
            lengths.append(picture.info["duration"])
        shown = np.asarray(picture.convert("RGB")).reshape(-1, 3).astype(int)
    assert lengths == [30, 30, 40, 30, 30, 40]
    for colour in curves.FLAP_COLOURS:
        wanted = [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
        assert np.abs(shown - wanted).max(axis=1).min() < 12, colour


@pytest.mark.long
def test_each_frame_shows_the_robot_of_its_instant_and_the_curves_up_to_it(folder: Path) -> None:
    log = load_log(folder)
    pictures = [np.asarray(picture).astype(int) for picture in video.frames(log.slice(0, log.num_rows - 67))]
    assert len(pictures) == 10
    scenes = [picture[:, : video.SIDE] for picture in pictures]
    assert all((np.abs(a - b).max(axis=2) > 40).any() for a, b in pairwise(scenes))
    ink = [(picture[:, video.SIDE :].min(axis=2) < 100).sum() for picture in pictures]
    assert ink[0] < ink[5] < ink[-1]
    flight = free_flight(log)
    graph = video._Graph(log, flight)
    assert graph._axes[-1].get_xlim() == pytest.approx(tuple(since_release(flight)[[0, -1]]))
    whole, pale = (np.asarray(one).astype(float) for one in (graph._whole, graph._pale))
    assert pale == pytest.approx(whole + 0.8 * (255.0 - whole), abs=1.0)


def test_the_scene_shows_every_goal_and_every_place_of_the_robot() -> None:
    still = np.zeros((1, 3))
    for far in (0.0, 0.5, 3.0):
        goals = np.array([(0.0, 0.0, 0.0), (far, -far, 2 * far), (-far, far, 0.0)])
        for places in (still, goals + np.array([0.3, 0.0, -0.3])):
            view = video.VideoScene(VisualModel(), goals, places)
            seen, distances = view._seen(np.concatenate([goals, places]))
            assert (distances > 0.3).all()
            assert seen.min() > 0
            assert seen.max() < video.SHARPER * video.SIDE


def test_the_robot_has_its_plates_where_the_geometry_has_them() -> None:
    geometry, still = load_config().geometry, np.array([1.0, 0.0, 0.0, 0.0])
    parts = look_of(geometry, load_config().plant.ground).parts
    shown = video.faces(parts, [still] * len(parts), np.array([1.0, 2.0, 3.0]), still)
    corners = np.concatenate([corners for corners, _ in shown])
    assert np.ptp(corners[:, :2], axis=0) == pytest.approx([geometry.footprint] * 2, rel=0.06)
    assert corners[:, :2].mean(axis=0) == pytest.approx([1.0, 2.0], abs=1e-6)
    assert len({colour for _, colour in shown}) == 5


def test_what_is_nearer_hides_what_is_behind_and_paths_have_the_colours_of_goal_and_robot() -> None:
    triangle = 0.1 * np.array([[(0.0, 1.0, -1.0), (0.0, -1.0, -1.0), (0.0, 0.0, 1.0)]])
    eye, ground = 0.1 * video.EYE, pa.table(
        {f"{group}.{name}": [0.0] for group in ("truth", "goal") for name in ("x", "y", "z")}
        | {"truth.qw": [1.0], "truth.qx": [0.0], "truth.qy": [0.0], "truth.qz": [0.0], "goal.yaw": [0.0]}
    )  # fmt: skip
    parts = [Part("near", triangle, "#00ff00", tuple(eye)), Part("far", triangle, "#0000ff", tuple(-eye))]
    places = np.zeros((1, 3))
    trail, course = (np.array([(-0.2, 0.0, z), (0.2, 0.0, z)]) for z in (0.2, -0.2))
    for order in (parts, parts[::-1]):
        view = video.VideoScene(VisualModel(tuple(order)), places, places)
        picture = view.at(ground, trail, course)
        middles = view._seen(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 0.2), (0.0, 0.0, -0.2)]))[0]
        shown = [picture.getpixel(tuple((place // video.SHARPER).astype(int))) for place in middles]
        for colour, wanted in zip(shown, ((0, 255, 0), video.PATH, video.GOAL), strict=True):
            assert np.argmin([np.abs(np.subtract(colour, one)).sum() for one in COLOURS]) == COLOURS.index(
                wanted
            )


def test_a_flight_that_never_began_or_is_too_long_for_a_gif_is_one_line(
    folder: Path, cli: Cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = load_log(folder)
    rows = log.num_rows - free_flight(log).num_rows
    (tmp_path / "held").mkdir()
    pq.write_table(log.slice(0, rows), tmp_path / "held" / "log.parquet")
    assert "never began" in cli.refusal("export", tmp_path / "held", "--video")
    monkeypatch.setattr(video, "GIF_MOST", 20)
    assert "1 s: a GIF holds at most 0 s; use --video" in cli.refusal("export", folder, "--gif")


def test_a_frame_has_the_path_of_the_last_seconds_and_the_goal_s_whole_course(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def at(scene: video.VideoScene, row: pa.Table, trail: np.ndarray, course: np.ndarray) -> Image.Image:
        shown.append((row["t"].to_numpy(), trail, course))
        return Image.new("RGB", (1, 1))

    monkeypatch.setattr(video, "TRAIL_S", 0.1)
    monkeypatch.setattr(video.VideoScene, "at", at)
    monkeypatch.setattr(video, "_Graph", lambda *_: SimpleNamespace(at=lambda at_s: Image.new("RGB", (1, 1))))
    log = load_log(folder)
    flight = known(free_flight(log))
    places, goals = body(flight, "x", "y", "z"), column(flight, *video.GOAL_COLUMNS)
    assert len(list(video.frames(log, np.array([0.02, 0.5])))) == 2
    for (t, trail, course), row in zip(shown, (2, 50), strict=True):
        assert t.tolist() == [flight["t"][row].as_py()]
        assert trail.tolist() == places[max(0, row - 10) : row + 1 : 3].tolist()
        assert course.tolist() == goals[::5].tolist()


def test_a_scene_draws_the_goal_turned_and_the_robot_s_nearest_parts_last(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The robot is drawn at its place and attitude, over its path; the goal with an arrow along its yaw."""
    drawn: list[tuple[str, object]] = []
    pen = SimpleNamespace(polygon=lambda points, fill: drawn.append(("polygon", fill)))
    monkeypatch.setattr(video.ImageDraw, "Draw", lambda picture: pen)
    monkeypatch.setattr(
        video.VideoScene, "_line",
        lambda scene, draw, points, colour, width: drawn.append((("path", "goal")[colour == video.GOAL], points)),
    )  # fmt: skip
    asked: list[list[float]] = []

    def faces(
        parts: object, turns: object, p_WB: np.ndarray, q_WB: np.ndarray
    ) -> list[tuple[np.ndarray, str]]:
        asked.extend([p_WB.tolist(), q_WB.tolist()])
        return [
            (p_WB + away * video.EYE + np.zeros((3, 3)), f"#{n}")
            for n, away in ((1, -0.1), (2, 0.2), (3, 0.1))
        ]

    monkeypatch.setattr(video, "faces", faces)
    names = [
        "goal.x",
        "goal.y",
        "goal.z",
        "goal.yaw",
        *(f"truth.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz")),
    ]
    values = [0.1, 0.2, 0.3, 0.5, 0.4, 0.5, 0.6, 0.5, 0.5, -0.5, 0.5]
    row = pa.table({name: [value] for name, value in zip(names, values, strict=True)})
    goals = np.array([(0.1, 0.2, 0.3), (0.0, 0.0, 0.0)])
    trail = np.array([(0.4, 0.5, 0.5), (0.4, 0.5, 0.6)])
    picture = video.VideoScene(VisualModel(outline=(np.ones((2, 3)),)), goals, trail).at(row, trail, goals)
    assert picture.size == (video.SIDE, video.HEIGHT)
    assert [what for what, _ in drawn] == ["goal"] * 9 + ["path"] + ["polygon"] * 3
    course, *_, outline, arrow = (points for what, points in drawn if what == "goal")
    c, s = np.cos(0.5), np.sin(0.5)
    assert np.array_equal(course, goals)
    assert arrow[1] - arrow[0] == pytest.approx([0.16 * c, 0.16 * s, 0.0])
    assert (arrow[0], outline[0]) == (
        pytest.approx(values[:3]),
        pytest.approx([0.1 + c - s, 0.2 + s + c, 1.3]),
    )
    assert np.array_equal(drawn[9][1], trail)
    assert asked == [values[4:7], values[7:]]
    assert [colour for what, colour in drawn if what == "polygon"] == ["#1", "#3", "#2"], "the nearest last"
