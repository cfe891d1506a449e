"""The viewer: what stands in a recording, the shape of the picture, and that a window never holds a flight."""

import importlib
import json
import os
import signal
import subprocess
import sys
from collections import Counter
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import rerun
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from firmware_py.wire.supervisor import State
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.fault_kinds import MARKERS_ON
from hil.laboratory.faults import parse
from hil.laboratory.files.recorder import load_events, load_log, stored_in
from hil.laboratory.metrics import body, column
from hil.laboratory.request import Request
from hil.laboratory.run import fly
from hil.laboratory.schedule import SCHEMA
from hil.live import window
from hil.live.feed import open_view
from hil.pictures import curves, scene
from hil.pictures.viewer.layout import EYE, blueprint, tunnel_view, views_of
from hil.pictures.viewer.plots import PLOTS, rates, refused
from hil.pictures.viewer.recording import RerunFlight, write_rrd, write_run_rrd
from hil.pictures.viewer.scene import HIDDEN, METRES_PER_NEWTON, PUSH_SHOWN_US, SEEN
from hil.pictures.viewer.swarm import write_swarm_rrd
from hil.pictures.viewer.track import FROM_RELEASE, FROM_START, timeline_of
from hil.world.config import GeometryConfig, NetConfig
from hil.world.floaty.drawing import flap_axes, look_of, marker_places, stand_lines
from hil.world.floaty.geometry import surfaces
from hil.world.floaty.shape import place_plates
from hil.world.scene import Part, VisualModel, ball, box
from hil.world.structs import Flaps

RELEASE_US = load_config().flight.release_us
angles = st.floats(-1.5, 1.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder: 1 s held, 0.5 s free, 150 rows."""
    folder = tmp_path_factory.mktemp("viewer") / "run"
    fly(Request.of(EXPERIMENTS["hover"], duration_s=0.5), folder)
    return folder


def chunks(path: Path, entity: str) -> list[pa.RecordBatch]:
    """The batches of an entity that move with time, in its order."""
    found = [chunk.to_record_batch() for chunk in RrdReader(path).stream() if chunk.entity_path == entity]
    moving = [batch for batch in found if FROM_RELEASE in batch.schema.names]
    return sorted(moving, key=lambda batch: batch.column(FROM_RELEASE)[0].value)


def values(path: Path, entity: str, component: str) -> NDArray[np.float64]:
    return np.array([row for batch in chunks(path, entity) for row in batch.column(component).to_pylist()])


def moments(path: Path, entity: str) -> list[int]:
    """The instants [ns] of an entity, on the flight's own clock: the viewer's has its zero at the release."""
    return [
        moment.value + 1000 * RELEASE_US
        for batch in chunks(path, entity)
        for moment in batch.column(FROM_RELEASE)
    ]


@pytest.mark.long
def test_a_recording_holds_every_row_of_the_log(folder: Path) -> None:
    log, path = load_log(folder), write_run_rrd(folder)
    assert log.num_rows == 150
    fast = ["robot", "robot/parts/flap_1", "robot/parts/flap_4", "goal", "goal/estimate", "drag", "flow"]
    plots = [name for name, plot in PLOTS.items() if plot.fits(log.column_names)]
    assert "link/loss/radio" in plots
    for entity in (*(f"/world/{name}" for name in fast), *(f"/plot/{name}" for name in plots)):
        assert moments(path, entity) == [1000 * t for t in log.column("t").to_pylist()], entity
    assert moments(path, "/world/trail") == [1000 * t for t in log.column("t").to_pylist()[1:]]
    truth = column(log, "truth.x", "truth.y", "truth.z")
    np.testing.assert_allclose(
        values(path, "/world/robot", "Transform3D:translation")[:, 0], truth, atol=1e-6
    )
    xyzw = column(log, "truth.qx", "truth.qy", "truth.qz", "truth.qw")
    np.testing.assert_allclose(values(path, "/world/robot", "Transform3D:quaternion")[:, 0], xyzw, atol=1e-6)
    held = [
        values(path, "/world/held", f"Transform3D:{what}")[:, 0] for what in ("translation", "quaternion")
    ]
    np.testing.assert_allclose(held[0], truth, atol=1e-6)
    assert (held[1] == (0.0, 0.0, 0.0, 1.0)).all(), "pushes along axes of the world"


@pytest.mark.long
def test_texts_and_changes_of_state_are_recorded_once(folder: Path) -> None:
    path = write_run_rrd(folder)
    states = values(path, "/state/supervisor", "StateChange:state")[:, 0].tolist()
    assert states == ["calibrating", "flying"] or states == ["calibrating", "waiting", "flying"]
    assert values(path, "/state/robot", "StateChange:state")[:, 0].tolist() == ["held", "free"]
    for event in load_events(folder):
        assert 1000 * event["t_us"] in moments(path, f"/text/{event['source']}")


@pytest.fixture(scope="module")
def marked(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with markers, of which three are hidden for a while."""
    folder = tmp_path_factory.mktemp("markers") / "run"
    request = Request.of(
        EXPERIMENTS["hover"],
        overrides=[MARKERS_ON],
        duration_s=0.5,
        faults=[parse("marker.hidden@0.2:0.1=3")],
    )
    fly(request, folder)
    return folder


@pytest.mark.long
def test_markers_change_colour_where_they_come_into_sight_or_go(marked: Path) -> None:
    path = write_run_rrd(marked)
    colours = values(path, "/world/robot/markers", "Points3D:colors")
    expected = [[HIDDEN] * n + [SEEN] * (8 - n) for n in (8, 0, 3, 0)]  # no exposure yet; all
    assert colours.tolist() == expected
    times_us = [250, 10_250, 1_210_250, 1_310_250]
    assert moments(path, "/world/robot/markers") == [1000 * t for t in times_us]
    still = [
        chunk.to_record_batch()
        for chunk in RrdReader(path).stream()
        if chunk.is_static and chunk.entity_path == "/world/robot/markers"
    ]
    (places,) = [batch for batch in still if "Points3D:positions" in batch.schema.names]
    np.testing.assert_allclose(
        places.column("Points3D:positions").to_pylist()[0],
        marker_places(GeometryConfig(), NetConfig()),
        atol=1e-7,
    )


def content(path: Path) -> dict[tuple[str, str], list[tuple[int, str]]]:
    """All values of a recording that move with time, by entity and component, with their instants."""
    found: dict[tuple[str, str], list[tuple[int, str]]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if FROM_RELEASE in batch.schema.names:
            times = [moment.value for moment in batch.column(FROM_RELEASE)]
            for name in (name for name in batch.schema.names if ":" in name):
                rows = zip(times, map(str, batch.column(name).to_pylist()), strict=True)
                found.setdefault((chunk.entity_path, name), []).extend(rows)
    return {key: sorted(rows) for key, rows in found.items()}


@pytest.mark.long
@pytest.mark.parametrize("size", [40, 7])
def test_a_flight_in_pieces_as_it_comes_live_has_the_recording_of_the_whole(
    marked: Path, tmp_path: Path, size: int
) -> None:
    log = load_log(marked)
    recording = rerun.RecordingStream("test")
    recording.save(tmp_path / "split.rrd")
    stage = RerunFlight(recording, log.schema)
    for start in range(0, log.num_rows, size):
        stage.add_rows(log.slice(start, size))
    recording.disconnect()
    assert content(tmp_path / "split.rrd") == content(staged(tmp_path / "whole.rrd", log))
    assert stage._past.num_rows == 100, "a second is enough"


def rows_by_entity(path: Path) -> Counter[str]:
    rows: Counter[str] = Counter()
    for chunk in RrdReader(path).stream():
        rows[chunk.entity_path] += chunk.to_record_batch().num_rows
    return rows


def live_sink(path: Path, port: int) -> "subprocess.Popen[bytes]":
    """A rerun server that writes what it receives, the headless stand-in for the window."""
    command = [*window.COMMAND, "--port", str(port), "--save", str(path)]
    return subprocess.Popen(
        command, env={**os.environ, "CI": "1", "RUST_LOG": "error"}, start_new_session=True
    )


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # the sink is interrupted
def test_a_live_flight_sends_what_the_file_holds(folder: Path, tmp_path: Path) -> None:
    whole, path = rows_by_entity(write_run_rrd(folder)), tmp_path / "live.rrd"
    assert "/state/task/KALMAN" in whole
    # The schedule and the station's record are there only after the flight.
    later = ("/state/task/", "/plot/age/stages")
    expected = Counter({name: rows for name, rows in whole.items() if not name.startswith(later)})
    port = window.free_port(0)
    sink = live_sink(path, port)
    try:
        while sink.poll() is None and not window.is_open(window.LOOPBACK, port):
            pass
        view = open_view(f"connect:{window.LOOPBACK}:{port}", "fly", [].append)
        for event in load_events(folder):
            view.note(event["t_us"], event["source"], event["text"])
        for batch in load_log(folder).combine_chunks().to_batches(max_chunksize=40):
            view.rows(batch)
        assert view.close(60) == 0
        seen: Counter[str] = Counter()
        for _ in range(300):
            with suppress(RuntimeError):  # read in the middle of a write
                seen = rows_by_entity(path)
            if seen == expected:
                break
            with suppress(subprocess.TimeoutExpired):
                sink.wait(0.1)
    finally:
        os.killpg(sink.pid, signal.SIGKILL)
        sink.wait()
    assert seen == expected


@pytest.mark.long
def test_an_empty_log_has_a_recording(folder: Path, tmp_path: Path) -> None:
    write_rrd(iter([load_log(folder).slice(0, 0)]), [], SCHEMA.empty_table(), tmp_path / "empty.rrd")
    assert rows_by_entity(tmp_path / "empty.rrd")["/world/robot/parts/flap_1"] == 1  # its mesh


def test_without_rerun_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    monkeypatch.delitem(sys.modules, "hil.pictures.viewer")
    with pytest.raises(LabError, match=r"pip install .*rerun-sdk"):
        importlib.import_module("hil.pictures.viewer")


SHAPES: tuple[dict[str, object], ...] = (
    {},
    {"kink_side": "x", "axis_azimuth": 0.9, "base_side": 0.05},
    {"dihedral": 0.2, "kink_angle": 1.2},
    {"outline": [(0.05, 0.0), (0.115, 0.02), (0.1, 0.11), (0.02, 0.09)], "strip_width": 0.03},
)


@pytest.mark.parametrize("shape", SHAPES)
@settings(max_examples=20)
@given(angles, st.integers(0, 3))
def test_a_drawn_flap_lies_where_the_plant_has_it(shape: dict[str, object], angle: float, flap: int) -> None:
    geometry, flaps = GeometryConfig.model_validate(shape), Flaps.allocate().fields
    place_plates(flaps, geometry, 0.4)
    part = look_of(geometry, NetConfig()).parts[1 + flap]
    turn = Rotation.from_quat(scene.turn_of(part, pa.table({part.angle: [angle]}))[0], scalar_first=True)
    turned = np.add(turn.apply(part.triangles.reshape(-1, 3)), part.place).reshape(-1, 3, 3)
    strip = len(surfaces(geometry)[-1].corners) - 2  # triangles, the last ones
    phi = -angle if flap % 2 == 0 else angle  # the plant's flaps 1 and 3 are mirror images
    series = np.array([1.0, np.cos(phi), np.sin(phi)])
    for plate, which in ((2 * flap, slice(-strip)), (2 * flap + 1, slice(-strip, None))):
        n, r = (series @ parts[plate].reshape(3, 3) for parts in (flaps.normal, flaps.centre))
        np.testing.assert_allclose(scene.centre_of(turned[which]), r, atol=1e-12)
        np.testing.assert_allclose(_area(turned[which]), flaps.area[plate], rtol=1e-12)
        normal = turn.apply(scene.normals_of(part)[which][0, 0])
        np.testing.assert_allclose(normal, n, atol=1e-12)


def _area(triangles: NDArray[np.float64]) -> float:
    a, b, c = np.moveaxis(triangles, 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_the_lowest_marker_sits_on_the_drawn_stand() -> None:
    geometry, ground = GeometryConfig(), NetConfig()
    lowest = min(marker_places(geometry, ground), key=lambda place: place[2])
    foot = stand_lines(geometry, ground)[0]
    along = [
        np.linalg.norm(lowest - a) + np.linalg.norm(lowest - b) - np.linalg.norm(b - a)
        for a, b in pairwise(foot)
    ]
    assert min(along) == pytest.approx(0.0, abs=1e-12)


def test_the_drawn_areas_are_the_papers() -> None:
    areas = [_area(part.triangles) for part in look_of(GeometryConfig(), NetConfig()).parts]
    assert areas == pytest.approx([0.0064, 0.0116, 0.0116, 0.0116, 0.0116], abs=5e-5)
    assert sum(areas) == pytest.approx(0.23**2)


@pytest.mark.long
def test_drag_acts_on_the_turned_flaps(folder: Path) -> None:
    log = load_log(folder)
    flaps = column(log, *(f"truth.flap_{number}" for number in (1, 2, 3, 4)))
    base, *parts = look_of(GeometryConfig(), NetConfig()).parts
    origins = scene.force_origin(base, scene.turn_of(base, log))
    np.testing.assert_allclose(origins, np.broadcast_to([0, 0, 0.07], origins.shape), atol=1e-12)
    for flap, part in enumerate(parts):
        turn = Rotation.from_rotvec(flaps[:, flap, None] * flap_axes(GeometryConfig())[flap])
        expected = np.add(turn.apply(scene.centre_of(part.triangles)), (0, 0, 0.07))
        np.testing.assert_allclose(scene.force_origin(part, scene.turn_of(part, log)), expected, atol=1e-12)
    path, (p_WB, q_WB) = write_run_rrd(folder), (body(log, "x", "y", "z"), body(log, "qw", "qx", "qy", "qz"))
    starts, forces = (values(path, "/world/drag", f"Arrows3D:{name}") for name in ("origins", "vectors"))
    for row, part in enumerate((base, *parts)):
        begins = p_WB + scene.rotated(q_WB, scene.force_origin(part, scene.turn_of(part, log)))
        np.testing.assert_allclose(starts[:, row], begins, atol=1e-6)
        force = column(log, *(f"{part.force}_{axis}" for axis in "xyz"))
        np.testing.assert_allclose(forces[:, row], METRES_PER_NEWTON * force, atol=1e-6)


def test_a_look_is_stored_and_read_back_equal() -> None:
    look = look_of(GeometryConfig(), NetConfig())
    again = VisualModel.read(json.loads(json.dumps(look.stored())))
    assert json.dumps(again.stored()) == json.dumps(look.stored())
    assert VisualModel.read({}).parts == ()


@pytest.mark.parametrize(("part", "area"), [(ball(0.1), 4 * np.pi * 0.01), (box((0.1, 0.2, 0.3)), 0.22)])
def test_closed_parts_have_their_area_and_turn_outwards(part: Part, area: float) -> None:
    assert _area(part.triangles) == pytest.approx(area, rel=0.12)
    outwards = (scene.normals_of(part)[:, 0] * part.triangles.mean(axis=1)).sum(axis=1)
    assert (outwards > 0.0).all()


def test_the_shares_of_the_processor_are_spent_time_over_time() -> None:
    rows = pa.table({"t": [0, 10_000, 30_000], "cpu.A": [0, 1_000, 2_000], "cpu.IDLE": [0, 9_000, 28_000]})
    load = curves.processor(rows.column_names)
    assert load.names == ("A",)
    assert load.read(rows)[:, 0].tolist() == [10.0, 5.0]


def test_the_latency_is_that_of_the_packets_that_arrived() -> None:
    sums, arrived = [0, 6_000, 6_000], [0, 3, 3]
    rows = pa.table(
        {f"link.{way}_latency_sum": sums for way in ("up", "down")}
        | {f"link.{way}_delivered": arrived for way in ("up", "down")}
    )
    np.testing.assert_array_equal(curves.latency(rows), [[2.0, 2.0], [np.nan, np.nan]])


def test_states_have_the_supervisors_names() -> None:
    assert curves.SUPERVISOR.names == (*(state.name.lower() for state in State), "unknown")


def staged(path: Path, table: pa.Table, events: list[dict] | None = None) -> Path:
    write_rrd(iter([table]), events or [], SCHEMA.empty_table(), path)
    return path


def real_log(rows: int = 30) -> pa.Table:
    """The log of a real flight whose cameras and board are silent for the first ten rows."""
    silent = np.arange(rows) < 10
    names = [f"cameras.{name}" for name in ("x", "y", "z", "qx", "qy", "qz")]
    names += [f"estimate.{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    names += [f"telemetry.flap_{number}" for number in (1, 2, 3, 4)]
    names += [f"control.u{number}" for number in (1, 2, 3, 4)] + ["estimator.pose_age_us"]
    names += [f"age.{stage}" for stage in ("camera", "processing", "network", "mocap", "station", "link")]
    columns = {name: np.where(silent, np.nan, 0.1) for name in names}
    columns |= {"cameras.qw": np.where(silent, np.nan, 1.0)}
    columns |= {f"goal.{name}": np.zeros(rows) for name in ("x", "y", "z", "yaw")}
    columns |= dict.fromkeys(("flight.free", "station.unusable", "station.malformed"), np.zeros(rows))
    columns |= dict.fromkeys(("station.frames", "station.samples"), np.arange(rows))
    columns |= {"t": 10_000 * np.arange(rows), "supervisor.state": np.full(rows, 2)}
    columns |= {"link.sent": np.arange(rows) // 2, "link.late": np.arange(rows) // 25}
    columns |= {"estimator.rejected": np.where(silent, np.nan, np.arange(rows) // 20)}
    request = json.dumps({"link": "udp://127.0.0.1:19850", "experiment": "hover"})
    look = json.dumps(look_of(GeometryConfig(), NetConfig()).stored())
    return pa.table(columns).replace_schema_metadata({"request": request, "look": look})


def test_a_recording_has_the_name_of_its_flight(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names: list[str] = []
    monkeypatch.setattr(rerun.RecordingStream, "send_recording_name", lambda _, name: names.append(name))
    for log in (load_log(folder), real_log()):
        RerunFlight(rerun.RecordingStream("name"), log.schema)
    assert names == ["hover, seed 1", "hover, real flight"]


def test_a_real_flight_has_the_same_scene_without_unknown_parts(tmp_path: Path) -> None:
    path = staged(tmp_path / "real.rrd", real_log())
    assert timeline_of(real_log().schema.metadata) == (FROM_START, 0)
    counted = rows_by_entity(path)
    for name in ("robot", "robot/parts/flap_1", "goal/estimate"):
        assert counted[f"/world/{name}"] - (name != "robot" and "flap" in name) == 20, name
    assert counted["/world/goal"] == 30
    assert counted["/world/trail"] == 19 + 1  # and its colour
    assert not {"/world/drag", "/world/tether"} & {entity for entity, rows in counted.items() if rows > 1}
    assert counted["/plot/position/marks/pose_refused_on_board"] == 1 + 1
    assert counted["/plot/position/marks/pose_too_late_for_the_link"] == 1 + 1


def test_the_goal_the_robot_and_the_tunnel_stand_where_they_are(folder: Path) -> None:
    still: dict[str, Any] = {}
    for chunk in RrdReader(write_run_rrd(folder)).stream():
        if chunk.is_static:
            batch = chunk.to_record_batch()
            still |= {
                (chunk.entity_path, name): batch.column(name).to_pylist()[0]
                for name in batch.schema.names
                if ":" in name
            }

    def lines(name: str) -> list[NDArray[np.float64]]:
        return [np.array(line) for line in still[f"/world/{name}", "LineStrips3D:strips"]]

    model = VisualModel.read(stored_in(load_log(folder).schema.metadata, "look"))
    expected: dict[str, list[Any]] = {
        "goal/estimate/ghost": [*model.outline],
        "goal/ghost": [*model.outline, [(0, 0, 0), (0.16, 0, 0)]],
        "goal/cross": [np.outer((-0.02, 0.02), axis) for axis in np.eye(3)],
        "goal/box": scene.box_lines(0.1), "robot/frame": [*model.frame], "tunnel/net": scene.net_lines(0.6, 0.0),
    }  # fmt: skip
    for name, wanted in expected.items():
        for line, one in zip(lines(name), wanted, strict=True):
            np.testing.assert_allclose(line, one, atol=1e-7, err_msg=name)
    low, high, *posts = lines("tunnel/nozzle")
    for ring, height in ((low, 0.0), (high, 1.8)):
        np.testing.assert_allclose(np.linalg.norm(ring[:, :2], axis=1), 0.6, rtol=1e-6)
        np.testing.assert_allclose(ring[:, 2], height)
    np.testing.assert_allclose([post[:, 2] for post in posts], [(0.0, 1.8)] * 4)
    flow = {
        name: still["/world/tunnel/flow", f"Cylinders3D:{name}"] for name in ("lengths", "radii", "centers")
    }
    assert flow == {
        "lengths": [pytest.approx(1.8)],
        "radii": [pytest.approx(0.2)],
        "centers": [[0.0, 0.0, pytest.approx(0.9)]],
    }
    for part in model.parts:
        (place,) = [still[f"/world/robot/parts/{part.name}", "Mesh3D:vertex_positions"]]
        np.testing.assert_allclose(place, part.triangles.reshape(-1, 3), atol=1e-7)
        if part.label:
            assert still[f"/world/robot/parts/{part.name}/number", "Points3D:labels"] == [part.label]


@pytest.mark.parametrize("fan_factor", [0.0, 0.5])
def test_tether_net_and_nozzle_are_those_of_the_flight_s_own_place(
    folder: Path, tmp_path: Path, fan_factor: float
) -> None:
    log = load_log(folder)
    config = stored_in(log.schema.metadata, "config")
    config["tunnel"] |= {"hover_height": 1.4, "fan_factor": fan_factor}
    config["plant"]["tether"]["anchor_height"], config["plant"]["ground"]["height"] = 2.0, 0.25
    log = log.replace_schema_metadata({**log.schema.metadata, b"config": json.dumps(config).encode()})
    path = staged(tmp_path / "elsewhere.rrd", log)
    (strip, *_) = values(path, "/world/tether", "LineStrips3D:strips")[0]
    np.testing.assert_allclose(strip[0], (0.0, 0.0, 3.4), atol=1e-6)
    entities = {
        chunk.entity_path: chunk.to_record_batch() for chunk in RrdReader(path).stream() if chunk.is_static
    }
    (net,) = entities["/world/tunnel/net"].column("LineStrips3D:strips").to_pylist()
    assert {round(z, 6) for line in net for _, _, z in line} == {0.25}
    assert ("/world/tunnel/nozzle" in entities, "/world/tunnel/flow" in entities) == (fan_factor > 0.0,) * 2


@pytest.mark.long
def test_the_goal_has_a_path_where_it_moves(tmp_path: Path) -> None:
    moving = np.where(np.arange(30) < 20, 0.0, 0.01 * np.arange(30))
    log = real_log()
    log = log.set_column(log.column_names.index("goal.x"), "goal.x", pa.array(moving))
    counted = rows_by_entity(staged(tmp_path / "moving.rrd", log))
    assert counted["/world/wanted"] == 9 + 1  # and its colour
    assert counted["/world/goal/ghost"] == 1
    assert rows_by_entity(staged(tmp_path / "still.rrd", real_log()))["/world/wanted"] == 1


def test_a_mark_is_at_the_row_whose_counter_is_larger_than_before() -> None:
    rows = pa.table({"a": [1, 1, 2, 2, 2, 5], "b": [0, 0, 0, 0, 1, 0]})
    assert refused(rows, ("a", "b", "none")).tolist() == [2, 4, 5]
    assert refused(rows, ("none",)).tolist() == []


def test_rates_are_those_of_the_second_before() -> None:
    rows = pa.table({"t": 10_000 * np.arange(300), "n": np.arange(300) // 2, "m": 3 * np.arange(300)})
    counters = curves.Curves(("n", "m"), ("", ""), "1/s", curves.plain("n", "m"))
    found = rates(rows, counters, np.array([0, 10, 100, 250]))
    assert np.isnan(found[0]).all()
    np.testing.assert_allclose(found[1:], [[50.0, 300.0]] * 3)


@pytest.mark.long
def test_the_stages_of_the_age_lie_on_one_another(folder: Path) -> None:
    ages = {"camera": 20e3, "processing": 18e3, "network": 1e3, "mocap": 39e3, "station": 100.0, "link": 2e3}
    table = pa.table({f"age.{name}": [age_us] for name, age_us in ages.items()})
    np.testing.assert_allclose(curves.AGE_STAGES.read(table), [[20.0, 38.0, 39.0, 39.1, 41.1]])
    counted = rows_by_entity(write_run_rrd(folder))
    tasks = {name.rpartition("/")[2] for name in counted if name.startswith("/state/task/")}
    assert "IDLE" not in tasks >= {"KALMAN", "STABILIZER"}, "what runs when nothing else does has no lane"
    assert counted["/plot/age/stages"] > 60  # by the station's own record, and their names


@pytest.mark.long
def test_faults_share_a_lane_and_a_push_is_an_arrow_that_can_be_seen(folder: Path, tmp_path: Path) -> None:
    texts = [
        "fault push.y@0.1=2 begins",
        "fault imu.noise@0.1:1=2 begins",
        "fault push.y@0.1=2 ends",
        "fault own.kind@1 begins",
        "fault imu.noise@0.4:1=3 begins",
        "fault imu.noise@0.1:1=2 ends",
    ]
    events = [
        {"t_us": 1_100_000 + 100_000 * row, "source": "lab", "text": text} for row, text in enumerate(texts)
    ]
    path = staged(tmp_path / "faults.rrd", load_log(folder), events)
    lane = values(path, "/state/faults", "StateChange:state")[:, 0].tolist()
    assert lane == ["push.y", "push.y + imu.noise", "imu.noise", "imu.noise + own.kind",
        "imu.noise + own.kind + imu.noise", "own.kind + imu.noise"]  # fmt: skip
    assert len(moments(path, "/plot/position/marks/fault")) == 4
    (arrow,) = [
        batch for batch in chunks(path, "/world/held/push_y") if "Arrows3D:vectors" in batch.schema.names
    ]
    size = pytest.approx(2 * METRES_PER_NEWTON)
    assert arrow.column("Arrows3D:vectors").to_pylist()[0] == [[0.0, size, 0.0]]
    assert (-np.array(arrow.column("Arrows3D:origins").to_pylist()[0])).tolist() == [[0.0, size, 0.0]], (
        "its tip is the robot"
    )
    begun, gone = moments(path, "/world/held/push_y")
    assert gone - begun == 1000 * PUSH_SHOWN_US


def test_a_view_is_in_the_blueprint_when_the_log_has_its_curves(folder: Path) -> None:
    simulated = load_log(folder).schema
    known = {path for _, path in views_of(simulated)}
    assert {"position", "processor", "battery", "link/rate", "queue"} <= known
    assert not {"link/air", "rotors", "motors"} & known
    rotors = [(f"rotor.{name}_{i}", pa.float32()) for name in ("thrust", "command") for i in (1, 2, 3, 4)]
    assert {"rotors", "motors"} <= {path for _, path in views_of(pa.schema(rotors))}
    real = {path for _, path in views_of(real_log().schema)}
    assert {"position", "flaps", "age", "link/rate", "link/loss"} <= real
    assert not {"processor", "battery", "queue"} & real


def test_every_view_of_a_flight_has_one_place_in_the_layout(folder: Path) -> None:
    schema = load_log(folder).schema

    def origins(part: Any) -> list[str]:
        return (
            [str(part.origin)]
            if hasattr(part, "origin")
            else [one for each in part.contents for one in origins(each)]
        )

    plots = [f"plot/{path}" for _, path in views_of(schema)]
    assert origins(blueprint(schema).root_container) == ["world", "state", "text", "legend", *plots]
    assert len(set(plots)) == len(plots) > 5


@pytest.mark.parametrize(
    ("origin", "name", "worlds"), [("world", "Wind tunnel", ["world"]), ("room", "Room", ["a", "b"])]
)
def test_a_scene_shows_four_seconds_of_path_and_the_goal_s_fifteen_to_either_side(
    origin: str, name: str, worlds: list[str]
) -> None:
    view = tunnel_view("from_release", origin, worlds, EYE)
    assert (view.name, view.origin) == (name, origin)
    shown = {
        path: one.ranges.as_arrow_array().to_pylist() for path, (one,) in view.visualizer_overrides.items()
    }
    spans = {"trail": (-4.0, 0.0), "wanted": (-15.0, 15.0)}
    assert shown == {
        f"{world}/{path}": [{"timeline": "from_release", "range": {"start": begin * 1e9, "end": end * 1e9}}]
        for world in worlds for path, (begin, end) in spans.items()
    }  # fmt: skip


def test_robots_that_flew_together_are_in_one_recording_each_at_its_place_with_its_texts(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hil.pictures.viewer.swarm.ROWS_AT_ONCE", 40)
    origins = ((1.0, 2.0, 3.0), (-4.0, 5.0, 6.0))
    request = SimpleNamespace(title="two robots")
    result: Any = SimpleNamespace(
        folder=tmp_path, robots=[SimpleNamespace(folder=folder)] * 2, origins=origins, request=request
    )
    path = write_swarm_rrd(result)
    assert (path, [one.name for one in tmp_path.iterdir()]) == (tmp_path / "flight.rrd", ["flight.rrd"])
    found = [(chunk.entity_path, chunk.to_record_batch()) for chunk in RrdReader(path).stream()]
    alone = rows_by_entity(write_run_rrd(folder))
    counted = rows_by_entity(path)
    texts = load_events(folder)
    for number, origin in enumerate(origins, 1):
        (place,) = [
            batch
            for entity, batch in found
            if entity == f"/room/{number}/world" and "Transform3D:translation" in batch.schema.names
        ]
        assert place.column("Transform3D:translation").to_pylist() == [[list(origin)]]
        (label,) = [batch for entity, batch in found if entity == f"/room/{number}/world/robot/number"]
        assert label.column("Points3D:labels").to_pylist() == [[str(number)]]
        for name in ("robot", "trail", "drag"):
            assert counted[f"/room/{number}/world/{name}"] == alone[f"/world/{name}"]
        told = [
            text for entity, batch in found if entity.startswith(f"/room/{number}/text/")
            for (text,) in batch.column("TextLog:text").to_pylist()
        ]  # fmt: skip
        assert sorted(told) == sorted(f"{number}: {one['source']}: {one['text']}" for one in texts)
