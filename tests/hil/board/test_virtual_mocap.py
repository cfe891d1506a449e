"""Laws of the virtual cameras: noise, lost frames, wrong frames."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ground_station.mocap import MocapFrame
from ground_station.unused import Reason
from hil.board.cameras import VirtualMocap
from hil.board.config import MarkersConfig, MocapConfig
from hil.board.markers import VirtualMarkers
from hil.world.floaty.plant import Plant
from support.still_plant import still_plant

TURN = Rotation.from_euler("ZYX", [1.0, 0.2, -0.3])
PLACE = (0.1, 0.2, 0.3)


def make_plant() -> Plant:
    plant = still_plant()
    plant.place(PLACE, TURN.as_quat(scalar_first=True))
    return plant


def frames(count: int, config: MocapConfig, seed: int = 1) -> list[MocapFrame]:
    plant, mocap = make_plant(), VirtualMocap(config, np.random.default_rng(seed))
    return [mocap.expose(5000 * i, plant)[0] for i in range(count)]


def test_frames_carry_the_exposure_and_white_noise_of_the_specification() -> None:
    seen = frames(4000, MocapConfig())
    assert [frame.t_us for frame in seen[:3]] == [0, 5000, 10000]
    assert all(frame.valid for frame in seen)
    error = np.array([frame.p_WB for frame in seen]) - PLACE
    assert error.std(axis=0) == pytest.approx(3 * [0.0005], rel=0.06)
    assert np.abs(error.mean(axis=0)).max() < 4e-5
    q_WB = np.array([frame.q_WB for frame in seen])
    assert np.linalg.norm(q_WB, axis=1) == pytest.approx(np.ones(4000))
    turned = (TURN.inv() * Rotation.from_quat(q_WB, scalar_first=True)).as_rotvec()
    assert turned.std(axis=0) == pytest.approx(3 * [0.004], rel=0.06)
    assert np.abs(turned.mean(axis=0)).max() < 3e-4
    together = np.corrcoef(np.hstack([error, turned]).T) - np.eye(6)
    assert np.abs(together).max() < 0.07


@pytest.mark.long
def test_share_of_lost_and_wrong_frames_is_the_configured_one() -> None:
    lost = sum(not frame.valid for frame in frames(4000, MocapConfig(dropout=0.2)))
    assert lost / 4000 == pytest.approx(0.2, abs=0.025)
    seen = frames(4000, MocapConfig(outlier=0.1, outlier_size=0.5))
    off = np.array([math.dist(frame.p_WB, PLACE) for frame in seen])
    assert (off > 0.1).mean() == pytest.approx(0.1, abs=0.02)
    assert off[off > 0.1] == pytest.approx(0.5, abs=0.004)


def test_faults_leave_the_other_frames_as_they_were() -> None:
    plain, broken = frames(500, MocapConfig()), frames(500, MocapConfig(dropout=0.3, outlier=0.1))
    untouched = [a == b for a, b in zip(plain, broken, strict=True)]
    assert 0.5 < np.mean(untouched) < 0.75


def test_lost_frames_leave_the_wrong_ones_as_they_were() -> None:
    wrong = frames(500, MocapConfig(outlier=0.2))
    both = frames(500, MocapConfig(outlier=0.2, dropout=0.3))
    seen = [(a, b) for a, b in zip(wrong, both, strict=True) if b.valid]
    assert 300 < len(seen) < 400
    assert all(a == b for a, b in seen)


def test_wrong_positions_lie_off_by_their_size_in_all_directions() -> None:
    plant, mocap = make_plant(), VirtualMocap(MocapConfig(), np.random.default_rng(1))
    mocap.wrong_by = 0.3
    off = np.array([mocap.expose(5000 * i, plant)[0].p_WB for i in range(500)]) - PLACE
    assert np.linalg.norm(off, axis=1) == pytest.approx(np.full(500, 0.3), abs=0.004)
    assert np.abs(off.mean(axis=0)).max() < 0.03
    mocap.wrong_by = 0.0
    assert math.dist(mocap.expose(2_500_000, plant)[0].p_WB, PLACE) < 0.004


def test_swapped_markers_turn_the_pose_about_its_own_z_and_shift_it_along_its_x() -> None:
    plant = make_plant()
    plain, swapped = (VirtualMocap(MocapConfig(), np.random.default_rng(1)) for _ in range(2))
    swapped.swapped_by = 0.1
    right, wrong = plain.expose(0, plant)[0], swapped.expose(0, plant)[0]
    q_WB, q_WS = (Rotation.from_quat(frame.q_WB, scalar_first=True) for frame in (right, wrong))
    between = (q_WB.inv() * q_WS).as_rotvec()
    assert np.abs(between) == pytest.approx([0, 0, math.pi], abs=1e-7)
    assert q_WB.inv().apply(np.subtract(wrong.p_WB, right.p_WB)) == pytest.approx([0.1, 0, 0], abs=1e-9)


def test_frozen_frames_repeat_the_last_pose_with_new_stamps_until_it_thaws_to_the_frames_of_always() -> None:
    plant = make_plant()
    plain, mocap = (VirtualMocap(MocapConfig(), np.random.default_rng(1)) for _ in range(2))
    expected = [plain.expose(5000 * i, plant)[0] for i in range(20)]
    seen = []
    for i in range(20):
        mocap.frozen = float(5 <= i < 15)
        seen.append(mocap.expose(5000 * i, plant)[0])
    assert seen[:5] + seen[15:] == expected[:5] + expected[15:]
    assert {(frame.p_WB, frame.q_WB) for frame in seen[4:15]} == {(seen[4].p_WB, seen[4].q_WB)}
    assert [frame.t_us for frame in seen] == [5000 * i for i in range(20)]
    # As a station judges OptiTrack's.
    assert [frame.valid for frame in seen[5:15]] == [True] * 2 + [False] * 8
    assert {frame.unused[0] for frame in seen[7:15]} == {Reason.FROZEN}
    markers = VirtualMarkers(MarkersConfig(), plant.markers, np.random.default_rng(1))
    mocap = VirtualMocap(MocapConfig(), np.random.default_rng(1), markers)
    mocap.expose(0, plant)
    kept = mocap.sighting
    mocap.frozen = 1.0
    mocap.expose(5000, plant)
    assert mocap.sighting is kept is not None


def test_a_system_that_freezes_without_the_body_does_not_see_it() -> None:
    plant, mocap = make_plant(), VirtualMocap(MocapConfig(dropout=1.0), np.random.default_rng(1))
    mocap.expose(0, plant)
    mocap.dropout, mocap.frozen = 0.0, 1.0
    for i in range(1, 6):
        frame, _ = mocap.expose(5000 * i, plant)
        assert (frame.valid, frame.unused[0]) == (False, Reason.NOT_TRACKED)


def test_frames_arrive_later_and_never_out_of_order() -> None:
    plant, mocap = make_plant(), VirtualMocap(MocapConfig(latency_us=38_000), np.random.default_rng(1))

    def arrival_us(now_us: int) -> int:
        frame, arrival_us = mocap.expose(now_us, plant)
        assert (frame.t_us, frame.received_us, frame.transmitted_us) == (now_us, now_us + 20_000, arrival_us)
        return arrival_us

    assert arrival_us(0) == 38_000
    mocap.more_latency_us = 20_000.0
    assert arrival_us(5_000) == 63_000
    mocap.more_latency_us = 0.0
    assert [arrival_us(t) for t in (10_000, 20_000, 30_000)] == [63_000, 63_000, 68_000]
