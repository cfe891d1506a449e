"""Markers: where they sit, who sees them, what pose they make, and that labels cannot be confused unnoticed."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ground_station.mocap import MocapFrame
from hil.board.cameras import VirtualMocap
from hil.board.config import MarkersConfig, MocapConfig
from hil.board.markers import (
    COUNT,
    GHOST_REACH,
    NOISE_ROWS,
    TRUNK_RADIUS,
    WORST_PAIR,
    Cameras,
    MarkerBody,
    Sighting,
    VirtualMarkers,
)
from hil.config import load_config
from hil.errors import LabError
from hil.laboratory.experiments import EXPERIMENTS
from hil.laboratory.flight import Flight
from hil.laboratory.lockstep import lockstep_flight
from hil.laboratory.request import Request
from hil.world.config import GeometryConfig, PlantConfig
from hil.world.floaty.drawing import marker_places, markers_of
from hil.world.floaty.geometry import axis_of
from hil.world.floaty.shape import MIRRORS
from support.still_plant import still_plant

ON = MarkersConfig(enabled=True)
EXACT = MarkersConfig(enabled=True, noise=0.0)
GEOMETRY, GROUND = GeometryConfig(), PlantConfig().ground
AXIS_HEIGHT = 0.07  # [m] paper
PLACES = marker_places(GEOMETRY, GROUND)
HOME = np.array([0.0, 0.0, 1.15])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
ALL = np.ones(COUNT, bool)

Array = NDArray[np.float64]
number = st.floats(-1, 1)
places = st.tuples(number, number, number).map(np.array)
turns = st.tuples(number, number, number, number).filter(lambda q: sum(x * x for x in q) > 0.01).map(
    lambda q: Rotation.from_quat(q, scalar_first=True)
)  # fmt: skip


def markers(config: MarkersConfig = ON, seed: int = 1) -> VirtualMarkers:
    return VirtualMarkers(config, markers_of(GEOMETRY, GROUND), np.random.default_rng(seed))


def look(config: MarkersConfig, turn: Rotation | None = None, p_WB: Array = HOME, seed: int = 1) -> Sighting:
    q_WB = LEVEL if turn is None else turn.as_quat(scalar_first=True)
    return markers(config, seed).sighting_of(p_WB, q_WB)


def kabsch(points: Array, body: Array) -> tuple[Array, Array]:
    """p and R of the best fit by scipy: Kabsch's, from a singular value decomposition."""
    turn, _ = Rotation.align_vectors(points - points.mean(axis=0), body - body.mean(axis=0))
    R = turn.as_matrix()
    return points.mean(axis=0) - R @ body.mean(axis=0), R


# Where they sit


def test_four_markers_sit_where_no_flap_moves_them() -> None:
    for flap in range(4):
        on_axis = PLACES[flap] - (0, 0, AXIS_HEIGHT)
        assert np.cross(on_axis, axis_of(GEOMETRY) * MIRRORS[flap]) == pytest.approx(np.zeros(3), abs=1e-12)
        assert on_axis @ (axis_of(GEOMETRY) * MIRRORS[flap]) > 0.1
    assert len(PLACES) == COUNT


@pytest.mark.long
def test_no_other_assignment_of_labels_fits() -> None:
    """All 40319 of them, by a Kabsch of our own; the noise makes 1.5 mm, the limit is 5."""
    labels = np.array(list(itertools.permutations(range(COUNT))))[1:]
    around = PLACES - PLACES.mean(axis=0)
    mixed = around[labels]
    U, _, Vt = np.linalg.svd(np.einsum("ki,nkj->nij", around, mixed))
    proper = np.stack([np.ones(len(U)), np.ones(len(U)), np.sign(np.linalg.det(U @ Vt))], axis=1)
    R = np.einsum("nji,nj,nkj->nik", Vt, proper, U)
    error = np.linalg.norm(mixed - np.einsum("nij,kj->nki", R, around), axis=2).mean(axis=1)
    assert error.min() == pytest.approx(0.0187, abs=0.0005)
    assert error.min() > 2 * ON.max_error


def test_any_three_markers_are_far_from_one_line() -> None:
    for rows in itertools.combinations(range(COUNT), 3):
        around = PLACES[list(rows)] - PLACES[list(rows)].mean(axis=0)
        assert np.linalg.svd(around, compute_uv=False)[1] > 0.02


# The fit


@pytest.mark.long
@given(places, turns, st.integers(0, 2**32), st.sets(st.integers(0, COUNT - 1), min_size=3))
def test_noisy_points_give_scipys_kabsch_pose(p_WB: Array, turn: Rotation, seed: int, rows: set[int]) -> None:
    seen = np.isin(np.arange(COUNT), list(rows))
    points = turn.apply(PLACES) + p_WB + 0.002 * np.random.default_rng(seed).standard_normal((COUNT, 3))
    fit = MarkerBody(PLACES).fit(points, seen)
    assert fit is not None
    p, R = kabsch(points[seen], PLACES[seen])
    assert fit.p_WB == pytest.approx(p, abs=1e-9)
    assert Rotation.from_quat(fit.q_WB, scalar_first=True).as_matrix() == pytest.approx(R, abs=1e-7)


@pytest.mark.long
def test_the_noise_of_the_pose_is_that_of_the_specification() -> None:
    """`[mocap]` says 0.5 mm and 0.004 rad; what least squares makes of 1.1 mm is known in closed form."""
    turn = Rotation.from_euler("ZYX", [1.0, 0.2, -0.3])
    here, q_WB = markers(), turn.as_quat(scalar_first=True)
    seen = [here.sighting_of(HOME, q_WB) for _ in range(2000)]
    poses = [sighting.pose for sighting in seen if sighting.pose]
    assert len(poses) == 2000
    moved = turn.inv().apply(np.array([p for p, _ in poses]) - HOME)
    turned = (turn.inv() * Rotation.from_quat([q for _, q in poses], scalar_first=True)).as_rotvec()
    around = PLACES - PLACES.mean(axis=0)
    inertia = np.sum([r @ r * np.eye(3) - np.outer(r, r) for r in around], axis=0)
    of_turn = ON.noise**2 * np.linalg.inv(inertia)
    x, y, z = PLACES.mean(axis=0)
    lever = np.array([[0, z, -y], [-z, 0, x], [y, -x, 0]])
    of_place = ON.noise**2 / COUNT * np.eye(3) + lever @ of_turn @ lever.T
    assert moved.std(axis=0) == pytest.approx(np.sqrt(np.diag(of_place)), rel=0.06)
    assert turned.std(axis=0) == pytest.approx(np.sqrt(np.diag(of_turn)), rel=0.06)
    assert moved.std() == pytest.approx(0.0005, abs=0.0001)
    assert turned.std() == pytest.approx(0.004, abs=0.0002)
    assert np.abs(moved.mean(axis=0)).max() < 4e-5
    mean_error = np.mean([sighting.error for sighting in seen])
    assert mean_error == pytest.approx(ON.noise * math.sqrt(8 / math.pi) * math.sqrt(18 / 24), rel=0.02)


# Not tracked


def test_markers_on_a_line_give_no_pose() -> None:
    line = PLACES.copy()
    line[:4] = np.outer([0.0, 0.1, 0.2, 0.35], [0.6, 0.0, 0.8])
    for count in (0, 1, 2, 3, 4):
        assert MarkerBody(line).fit(line, np.arange(COUNT) < count) is None
    assert MarkerBody(line).fit(line, np.arange(COUNT) < 5) is not None


@pytest.mark.parametrize(
    ("hidden", "needed", "tracked"), [(5, 3, True), (6, 3, False), (8, 3, False), (3, 5, True), (4, 5, False)]
)
def test_too_few_markers_are_not_tracked(hidden: int, needed: int, tracked: bool) -> None:
    here = markers(MarkersConfig(enabled=True, min_markers=needed))
    here.hidden = hidden
    sighting = here.sighting_of(HOME, LEVEL)
    assert sighting.bits == 0xFF << hidden & 0xFF
    assert (sighting.pose is not None) is tracked
    assert (sighting.residuals != 0).tolist() == (sighting.seen.tolist() if tracked else [False] * COUNT)
    assert len(sighting.unlabelled) == (0 if tracked else COUNT - hidden)


def test_a_body_that_fits_badly_is_not_tracked() -> None:
    here = markers()
    here.noise_scale = 10.0
    sightings = [here.sighting_of(HOME, LEVEL) for _ in range(50)]
    assert all(sighting.error > ON.max_error and sighting.pose is None for sighting in sightings)
    here.noise_scale = 1.0
    assert here.sighting_of(HOME, LEVEL).pose is not None


def test_unseen_markers_are_placed_on_the_body() -> None:
    here = markers()
    here.hidden = 4
    sighting = here.sighting_of(HOME, LEVEL)
    assert sighting.pose is not None
    p, q = sighting.pose
    assert sighting.points[:4] == pytest.approx(
        Rotation.from_quat(q, scalar_first=True).apply(PLACES[:4]) + p, abs=1e-12
    )
    off = np.linalg.norm(
        sighting.points[4:] - Rotation.from_quat(q, scalar_first=True).apply(PLACES[4:]) - p, axis=1
    )
    assert sighting.residuals[4:] == pytest.approx(off, abs=1e-12)
    assert sighting.error == pytest.approx(off.mean(), abs=1e-12)


# Labels


@pytest.mark.long
@given(turns, st.sampled_from(list(itertools.combinations(range(COUNT), 2))))
def test_two_exchanged_labels_keep_the_pose_or_visibly_flip_it(turn: Rotation, pair: tuple[int, int]) -> None:
    points = turn.apply(PLACES)
    points[list(pair)] = points[list(pair[::-1])]
    fit = MarkerBody(PLACES).fit(points, ALL)
    assert fit is not None
    wrong = (turn.inv() * Rotation.from_quat(fit.q_WB, scalar_first=True)).magnitude()
    assert min(wrong, math.pi - wrong) < 1e-6
    assert np.linalg.norm(points - fit.points, axis=1).mean() > 2 * ON.max_error


def test_the_pair_of_the_fault_is_the_one_that_turns_the_body_over_at_the_smallest_error() -> None:
    found = {}
    for pair in itertools.combinations(range(COUNT), 2):
        points = PLACES.copy()
        points[list(pair)] = points[list(pair[::-1])]
        fit = MarkerBody(PLACES).fit(points, ALL)
        assert fit is not None
        if Rotation.from_quat(fit.q_WB, scalar_first=True).magnitude() > 3:
            found[pair] = np.linalg.norm(points - fit.points, axis=1).mean()
    assert min(found, key=lambda pair: found[pair]) == WORST_PAIR


def test_swapped_markers_are_refused_unless_the_limit_is_wide() -> None:
    for limit, turned in ((0.005, None), (0.2, math.pi)):
        here = markers(MarkersConfig(enabled=True, noise=0.0, max_error=limit))
        here.swapped = 1.0
        sighting = here.sighting_of(HOME, LEVEL)
        assert sighting.error == pytest.approx(0.0987, abs=0.0005)
        assert sighting.residuals.mean() == pytest.approx(sighting.error)
        if turned is None:
            assert sighting.pose is None
        else:
            assert sighting.pose is not None
            assert Rotation.from_quat(sighting.pose[1], scalar_first=True).magnitude() == pytest.approx(
                turned
            )
        here.hidden = 1.0  # marker 1, which has label 3
        assert np.flatnonzero(~here.sighting_of(HOME, LEVEL).seen).tolist() == [2]


@pytest.mark.long
def test_share_of_mislabelled_frames_is_the_configured_one_and_leaves_the_others_as_they_were() -> None:
    plain, wrong = markers(), markers(MarkersConfig(enabled=True, mislabelled=0.2))
    pairs = [(plain.sighting_of(HOME, LEVEL), wrong.sighting_of(HOME, LEVEL)) for _ in range(1000)]
    refused = [b.pose is None for _, b in pairs]
    assert np.mean(refused) == pytest.approx(0.2, abs=0.04)
    assert all(a.pose == b.pose for (a, b), lost in zip(pairs, refused, strict=True) if not lost)


# Who sees them


def ray_hits(marker: Array, camera: Array) -> set[bool]:
    """Whether the robot is in between, by walking along the ray; with a body a little smaller and a little larger."""
    steps = np.linspace(1e-6, 1, 4000)[:, None]
    way = marker + steps * (camera - marker)
    height = way[:, 2] - AXIS_HEIGHT
    through = np.flatnonzero(np.sign(height[:-1]) * np.sign(height[1:]) < 0)
    hits = set()
    for more in (-0.002, 0.002):
        plate = (np.abs(way[through, :2]) < GEOMETRY.footprint / 2 + more).all(axis=1).any()
        trunk = (np.linalg.norm(way, axis=1) < TRUNK_RADIUS + more).any()
        hits.add(bool(plate or trunk))
    return hits


@pytest.mark.long
@settings(max_examples=40)
@given(
    turns,
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.1, 1.9)),
    st.integers(2, 6),
    st.floats(1, 4),
    st.floats(0, 4),
    st.data(),
)
def test_a_marker_is_seen_when_enough_rays_are_free(
    turn: Rotation,
    p: tuple[float, float, float],
    cameras: int,
    away: float,
    height: float,
    data: st.DataObject,
) -> None:
    config = MarkersConfig(
        enabled=True, cameras=cameras, camera_distance=away, camera_height=height,
        min_cameras=data.draw(st.integers(2, cameras)),
    )  # fmt: skip
    row = data.draw(st.integers(0, COUNT - 1))
    free = []
    for azimuth in 2 * np.pi * np.arange(cameras) / cameras:
        camera = np.array([away * np.cos(azimuth), away * np.sin(azimuth), height])
        hits = ray_hits(PLACES[row], turn.inv().apply(camera - p))
        assume(len(hits) == 1)  # not by a hair
        free.append(not hits.pop())
    seen = Cameras(config, markers_of(GEOMETRY, GROUND)).see(np.array(p), turn.as_matrix())
    assert seen[row] == (sum(free) >= config.min_cameras)


@pytest.mark.long
@pytest.mark.parametrize(("tilt", "fewest"), [(0, 8), (10, 8), (20, 8), (90, 7), (180, 6)])
def test_hovering_shows_all_markers_and_lying_on_the_side_hides_some(tilt: int, fewest: int) -> None:
    seen = []
    for azimuth in np.radians(range(0, 360, 15)):
        turn = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        seen.append(look(EXACT, turn).bits.bit_count())
    assert min(seen) == fewest


def test_as_many_cameras_as_must_see_a_marker_are_there() -> None:
    with pytest.raises(LabError, match="min_cameras = 6 of 5 cameras never see anything"):
        load_config("floaty", ["markers.min_cameras=6"])


# Ghosts


@pytest.mark.long
def test_ghosts_lie_near_the_body_have_no_label_and_do_not_change_its_pose() -> None:
    plain, haunted = markers(), markers(MarkersConfig(enabled=True, ghosts=7))
    for _ in range(NOISE_ROWS + 1):
        without, seen = plain.sighting_of(HOME, LEVEL), haunted.sighting_of(HOME, LEVEL)
        assert without.pose == seen.pose
    assert seen.unlabelled.shape == (7, 3)
    assert 0.1 < np.abs(seen.unlabelled - HOME).max() < GHOST_REACH
    assert without.unlabelled.shape == (0, 3)


# In the cameras


def frames(count: int, seed: int = 1, **knobs: float) -> list[tuple[MocapFrame, Sighting | None]]:
    plant, mocap = still_plant(), VirtualMocap(MocapConfig(), np.random.default_rng(seed), markers(seed=seed))
    for name, value in knobs.items():
        setattr(mocap, name, value)
    return [(mocap.expose(5000 * i, plant)[0], mocap.sighting) for i in range(count)]


def test_a_frame_carries_the_pose_that_the_markers_make() -> None:
    for frame, sighting in frames(20):
        assert frame.valid
        assert sighting is not None
        assert (frame.p_WB, frame.q_WB) == sighting.pose
        assert math.dist(frame.p_WB, HOME) < 0.003


def test_faults_of_whole_poses_act_on_those_of_markers_too() -> None:
    plain = [frame for frame, _ in frames(200)]
    lost = frames(200, dropout=0.3)
    for frame, (got, sighting) in zip(plain, lost, strict=True):
        assert sighting is not None
        assert len(sighting.unlabelled) == (0 if got.valid else COUNT)
        assert got == frame if got.valid else sighting.pose is None
    assert 30 < sum(not frame.valid for frame, _ in lost) < 90
    for frame, (got, _) in zip(plain, frames(200, wrong_by=0.3), strict=True):
        assert math.dist(frame.p_WB, got.p_WB) == pytest.approx(0.3)
    plant, mocap = still_plant(), VirtualMocap(MocapConfig(), np.random.default_rng(1), markers())
    seen = []
    for mocap.frozen in (0.0, 1.0, 1.0, 0.0):
        mocap.expose(5000 * len(seen), plant)
        seen.append(mocap.sighting)
    assert seen[0] is seen[1] is seen[2] is not seen[3] is not None  # markers freeze with the pose


@pytest.mark.long
def test_markers_leave_all_other_randomness_as_it_was() -> None:
    """The air around the held robot, the gyro's noise, and which frames are lost."""
    seen: list[list[object]] = []
    for on in ("false", "true"):
        settings = [f"markers.enabled={on}", "mocap.dropout=0.5"]
        flight = lockstep_flight(Request.of(EXPERIMENTS["hover"], overrides=settings, duration_s=0.1))
        rows: list[object] = []
        for moment_us in range(10_000, 1_000_000, 45_000):
            flight.events.at(moment_us, lambda _, flight=flight, rows=rows: rows.append(random_parts(flight)))
        flight.run()
        seen.append(rows)
    assert seen[0] == seen[1]


def random_parts(flight: Flight) -> tuple[object, ...]:
    return flight.robot.body.flow_W.tolist(), flight.robot.board.imu.tolist(), flight.line.radio.up.sent
