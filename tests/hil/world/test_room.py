"""What a sensor sees in a room, against rays cast one by one and scipy's rotations."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hil.world.room import Room, to_body, to_world

ROOM = Room(floor=-0.1, walls=2.0, ceiling=2.5)
HALF = math.radians(13.5)
Q = (0.8, 0.1, -0.3, 0.51)  # w x y z
Q_UNIT = tuple(np.array(Q) / np.linalg.norm(Q))


def test_vectors_turn_as_scipy_turns_them_and_back() -> None:
    w, x, y, z = Q_UNIT
    turned = to_world(Q_UNIT, (1.0, 2.0, 3.0))
    assert turned == pytest.approx(Rotation.from_quat((x, y, z, w)).apply((1.0, 2.0, 3.0)))
    assert to_body(Q_UNIT, turned) == pytest.approx((1.0, 2.0, 3.0))


def cast(p: np.ndarray, direction: np.ndarray) -> float:
    """Return how far one ray goes."""
    low, high = np.array((-2.0, -2.0, -0.1)), np.array((2.0, 2.0, 2.5))
    with np.errstate(divide="ignore"):
        ways = np.where(direction > 0, (high - p) / direction, (low - p) / direction)
    return float(np.min(np.where(direction == 0, np.inf, ways)))


@pytest.mark.long
@pytest.mark.parametrize("axis", [(0, 0, -1), (0, 0, 1), (1, 0, 0), (0.6, -0.8, 0), (0.48, 0.36, -0.8)])
def test_distance_is_that_of_the_shortest_ray_in_the_cone(axis: tuple[float, float, float]) -> None:
    p, d = np.array((0.3, -0.7, 0.9)), np.array(axis, float)
    side = np.cross(d, (0.1, 0.9, 0.3))
    side /= np.linalg.norm(side)
    other = np.cross(d, side)
    rays = [
        math.cos(a) * d + math.sin(a) * (math.cos(b) * side + math.sin(b) * other)
        for a in np.linspace(0.0, HALF, 40)
        for b in np.linspace(0.0, 2 * math.pi, 180)
    ]
    assert ROOM.distance(p, d, math.cos(HALF)) == pytest.approx(min(cast(p, r) for r in rays), rel=1e-3)
    assert ROOM.distance(p, d, 1.0) == pytest.approx(cast(p, d))


@pytest.mark.parametrize(
    ("p", "axis"),
    [
        ((0.3, 0.2, -0.2), (0, 0, -1)), ((0.3, 0.2, 2.6), (0, 0, 1)), ((2.1, 0.2, 1), (1, 0, 0)),
        ((-2.1, 0.2, 1), (-1, 0, 0)), ((0.3, 2.1, 1), (0, 1, 0)), ((0.3, -2.1, 1), (0, -1, 0)),
    ],
)  # fmt: skip
def test_a_place_in_a_wall_is_at_no_distance_from_it(p: tuple[float, ...], axis: tuple[float, ...]) -> None:
    assert ROOM.distance(p, axis, 1.0) == ROOM.distance(p, axis, math.cos(HALF)) == 0.0
    back = tuple(-one for one in axis)
    assert ROOM.distance(p, back, 1.0) == pytest.approx(4.1 if axis[2] == 0 else 2.7)


def test_without_walls_there_is_nothing_to_see_but_the_floor() -> None:
    assert Room().distance((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), 1.0) == math.inf
    assert Room().distance((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), 1.0) == 1.0
