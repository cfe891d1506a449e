"""Goal, box, and poses as they look from the goal: what scipy's rotations and the geometry of a cylinder say of them."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from firmware_py.core.structs import (
    GOAL_ABSOLUTE,
    GOAL_NONE,
    POSE_NO_CORRECTION,
    POSE_ON_TIME,
    SETPOINT_OUTSIDE,
    SETPOINT_POSITION,
)
from support.core_bench import Core

DRAWS = 200
HOME = np.array([0.3, -0.2, 1.5])  # [m] in W, each axis another
RADIUS, BELOW, ABOVE = 0.5, 0.7, 0.2  # [m]
INCH = 0.0254  # further from a border than float32 rounds


def in_box(p_W: NDArray[np.float64]) -> bool:
    across = np.hypot(*(p_W - HOME)[:2])
    return bool(across <= RADIUS and -BELOW <= p_W[2] - HOME[2] <= ABOVE)


def boxed() -> Core:
    core = Core(home=HOME, box_radius=RADIUS, box_below=BELOW, box_above=ABOVE)
    core.data.fields.goal_kind = GOAL_NONE
    return core


def admits(core: Core, p_W: object) -> bool:
    core.data.fields.setpoint[:3] = p_W
    return bool(core.call("admits"))


def test_a_set_point_is_admitted_inside_the_cylinder_around_home_and_nowhere_else() -> None:
    rng, core, found = np.random.default_rng(1), boxed(), []
    for _ in range(DRAWS):
        p_W = HOME + rng.uniform(-0.9, 0.9, 3)
        assert admits(core, p_W) == in_box(p_W), p_W
        found.append(in_box(p_W))
    assert 0.1 < np.mean(found) < 0.9


@pytest.mark.parametrize(
    ("goal", "nearer", "further"),
    [
        ((RADIUS + 0.2, 0.0, 0.0), (0.0, -RADIUS - 0.2 + INCH, 0.0), (0.0, RADIUS + 0.2 + INCH, 0.0)),
        ((0.0, 0.0, -BELOW - 0.2), (0.0, 0.0, ABOVE + 0.2 - INCH), (0.0, 0.0, ABOVE + 0.2 + INCH)),
        ((0.0, 0.0, ABOVE + 0.2), (RADIUS + 0.2 - INCH, 0.0, 0.0), (0.0, 0.0, -BELOW - 0.2 - INCH)),
    ],
    ids=["sideways", "below", "above"],
)
def test_from_outside_the_box_none_leads_further(goal: object, nearer: object, further: object) -> None:
    core = boxed()
    core.data.fields.goal_kind, core.data.fields.goal[:3] = GOAL_ABSOLUTE, HOME + goal
    assert admits(core, HOME + nearer)
    assert not admits(core, HOME + further)


def test_with_corrections_the_box_is_around_their_origin() -> None:
    core = boxed()
    core.data.fields.poses_absolute = 0
    assert admits(core, (0.0, 0.0, 0.0))
    assert not admits(core, HOME)


@pytest.mark.parametrize("yaw", [1.2, np.nan])
def test_a_set_point_becomes_the_goal_and_one_without_yaw_keeps_the_goals(yaw: float) -> None:
    core = boxed()
    data = core.data.fields
    data.setpoint_kind, data.goal[3] = SETPOINT_POSITION, 0.7
    data.setpoint[:], data.setpoint_velocity[:] = (*HOME, yaw), (0.1, 0.2, 0.3)
    assert core.call("follow") == SETPOINT_POSITION
    assert data.goal_kind == GOAL_ABSOLUTE
    assert data.goal == pytest.approx([*HOME, 0.7 if np.isnan(yaw) else yaw])
    assert data.goal_velocity == pytest.approx([0.1, 0.2, 0.3])
    data.setpoint[2] += ABOVE + INCH
    assert core.call("follow") == SETPOINT_OUTSIDE
    assert data.goal[:3] == pytest.approx(HOME)


@pytest.mark.long
def test_an_absolute_pose_is_filed_as_it_looks_from_the_goal() -> None:
    """The goal is upright at p_WG, turned by its yaw: R_GB = R_WG^-1 R_WB, p_GB = R_WG^-1 (p_WB - p_WG)."""
    rng, core = np.random.default_rng(2), Core()
    data = core.data.fields
    for _ in range(DRAWS):
        p_WG, yaw = rng.uniform(-2.0, 2.0, 3), rng.uniform(-3.1, 3.1)
        p_WB, R_WB = p_WG + rng.uniform(-0.3, 0.3, 3), Rotation.random(random_state=rng)
        R_WG = Rotation.from_euler("z", yaw)
        data.goal[:] = (*p_WG, yaw)
        core.pose(p_WB, R_WB.as_quat(scalar_first=True))
        assert data.pose_position == pytest.approx(R_WG.inv().apply(p_WB - p_WG), abs=1e-5)
        R_GB = Rotation.from_quat(data.pose_quaternion, scalar_first=True)
        assert (R_GB.inv() * R_WG.inv() * R_WB).magnitude() == pytest.approx(0.0, abs=2e-5)


def test_the_report_has_place_velocity_and_heading_in_w() -> None:
    """p_WB = p_WG + R_WG p_GB, and v_WB = v_WG + R_WG v_GB of a goal that moves."""
    rng, core = np.random.default_rng(4), Core()
    data = core.data.fields
    data.goal[:], data.goal_velocity[:] = (1.0, 2.0, 3.0, 0.6), (0.5, -0.4, 0.3)
    core.fields.x[:] = rng.uniform(-0.1, 0.1, 16)
    core.tick()
    R_WG, now, report = Rotation.from_euler("z", 0.6), core.now, core.report.fields
    assert report.position == pytest.approx(data.goal[:3] + R_WG.apply(now[:3]), abs=1e-5)
    assert report.velocity == pytest.approx(data.goal_velocity + R_WG.apply(now[3:6]), abs=1e-5)
    assert report.attitude == pytest.approx(now[6:9] + np.array((0.0, 0.0, 0.6)), abs=1e-5)


def test_a_correction_is_refused_that_is_larger_than_the_laboratory() -> None:
    """No further from the goal than 0.9 m sideways, 2 m below and 1 m above it."""
    near = [(0.89, 0.0, 0.0), (-0.6, 0.6, 0.0), (0.0, 0.0, -1.99), (0.0, 0.0, 0.99)]
    far = [(0.91, 0.0, 0.0), (-0.7, 0.7, 0.0), (0.0, 0.0, -2.01), (0.0, 0.0, 1.01)]
    core = Core()
    core.data.fields.poses_absolute = 0
    refused = [core.pose(p_GB) == POSE_NO_CORRECTION for p_GB in (*near, *far)]
    assert refused == [False] * 4 + [True] * 4


def test_without_a_goal_the_first_absolute_pose_is_where_the_robot_holds() -> None:
    """Its heading is the direction in which the body's x axis points, seen from above."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        core = Core()
        data = core.data.fields
        data.goal_kind, data.goal_velocity[:] = GOAL_NONE, 1.0
        for _ in range(20):
            core.tick()
        p_WB, R_WB = rng.uniform(-2.0, 2.0, 3), Rotation.random(random_state=rng)
        ahead_W = R_WB.apply([1.0, 0.0, 0.0])
        assert core.pose(p_WB, R_WB.as_quat(scalar_first=True)) == POSE_ON_TIME
        assert data.goal_kind == GOAL_ABSOLUTE
        assert data.goal == pytest.approx([*p_WB, np.arctan2(ahead_W[1], ahead_W[0])], abs=1e-4)
        assert data.goal_velocity == pytest.approx([0.0, 0.0, 0.0])
