"""Poses that repeat: those of a robot at rest are used, those of a frozen source are not."""

import numpy as np
import pytest
from cflib.utils.encoding import compress_quaternion
from scipy.spatial.transform import Rotation

from firmware_py.core import repetition
from firmware_py.core.structs import POSE_FROZEN, POSE_ON_TIME
from firmware_py.core.subset import i32
from support.core_bench import LEVEL, Core, counts, quaternion

PLACE = (0.1, -0.2, 0.3)
STILL = (0.0, 0.0, 0.0)
DEGREE = np.radians(1.0)
PERIOD = 2  # ticks between poses


def answers(core: Core, ticks: int, omega: object = STILL, age_us: int = 40_000, noise: int = 0) -> list[int]:
    """Send one pose at 50 Hz while the body turns at `omega` [rad/s]; return what became of each."""
    found, rng = [], np.random.default_rng(1)
    for tick in range(ticks):
        if tick % PERIOD == 0:
            found.append(core.pose(PLACE, LEVEL, age_us))
        core.tick(np.array(counts(omega)) + rng.integers(-noise, noise + 1, 3))
    return found


@pytest.mark.long
@pytest.mark.parametrize("rate", [0.0, 5.0])
@pytest.mark.parametrize("axis", range(3))
def test_the_pose_of_a_robot_at_rest_may_repeat_even_with_a_wrong_zero_of_the_gyro(
    rate: float, axis: int
) -> None:
    omega = np.eye(3)[axis] * rate * DEGREE
    core = Core()
    assert POSE_FROZEN not in answers(core, 1000, omega, noise=90)  # ten samples of twice the noise
    assert core.fields.fused > 490


@pytest.mark.long
@pytest.mark.parametrize("omega", [*(np.eye(3) * 50 * DEGREE), *(np.eye(3) * -8 * DEGREE)])
@pytest.mark.parametrize("age_us", [0, 40_000, 100_000])
def test_a_pose_that_stays_the_same_while_the_robot_turns_is_refused_until_any_bit_differs(
    omega: object, age_us: int
) -> None:
    core = Core()
    assert answers(core, 100, age_us=age_us)[-1] == POSE_ON_TIME
    while_turning = answers(core, 40, omega, age_us)
    assert while_turning == sorted(while_turning)  # used, then refused
    after = answers(core, 200, age_us=age_us)
    assert set(after) == {POSE_FROZEN}  # although it no longer turns
    refused = while_turning.count(POSE_FROZEN) + len(after)
    assert core.fields.frozen == core.fields.invalid == refused
    above = np.nextafter(np.float32(PLACE), np.float32(1))
    for changed in (place for row in np.where(np.eye(3), above, PLACE) for place in (row, PLACE)):
        assert core.pose(changed, LEVEL, age_us) == POSE_ON_TIME
        core.tick()
    assert core.pose(PLACE, quaternion(roll=1e-6), age_us) == POSE_ON_TIME


@pytest.mark.long
@pytest.mark.parametrize(("age_us", "known"), [(40_000, True), (100_000, True), (-1, False)])
def test_poses_from_before_the_turn_are_used(age_us: int, known: bool) -> None:
    core = Core()
    answers(core, 100, age_us=age_us)
    kicked = answers(core, 40, (0.0, 200 * DEGREE, 0.0), age_us)  # by 2 degrees in each tick
    first_us = 10_000 * PERIOD * kicked.index(POSE_FROZEN)
    oldest_us = age_us if known else 120_000
    assert oldest_us <= first_us <= oldest_us + 20_000


@pytest.mark.parametrize(
    ("ticks", "age_us", "frozen"),
    [(0, 0, False), (4, 40_000, True), (4, 40_001, False), (12, -1, False), (13, -1, True)],
)
def test_a_repeated_pose_is_frozen_when_it_was_exposed_after_the_turn(
    ticks: int, age_us: int, frozen: bool
) -> None:
    core = Core()
    sampling = core.sampling.fields
    core.data.fields.pose_age_us, sampling.turned_ticks = i32(age_us), i32(ticks)
    assert repetition.frozen(core.data.fields, sampling) == frozen
    core.data.fields.gyro_bias[:] = 2000.0
    core.data.fields.gyro_sum[:], core.data.fields.gyro_samples = 20_000, i32(10)  # its zero is no turn
    repetition.add_turn(core.parameters.fields, core.data.fields, sampling)
    assert sampling.turned_ticks == (min(ticks + 1, 13) if ticks else 0), (
        "no more are counted than may matter"
    )


@pytest.mark.long
def test_a_turn_by_half_of_the_limit_changes_the_coarsest_pose() -> None:
    rng = np.random.default_rng(1)
    for _ in range(2000):
        before = Rotation.random(rng=rng)
        turn = rng.normal(size=3)
        after = before * Rotation.from_rotvec(0.5 * DEGREE * turn / np.linalg.norm(turn))
        packed = [compress_quaternion(tuple(one.as_quat())) for one in (before, after)]
        assert packed[0] != packed[1], before.as_quat()


def test_a_pose_that_is_none_does_not_count_as_frozen() -> None:
    core = Core()
    answers(core, 40, (0.0, 50 * DEGREE, 0.0))
    frozen = core.fields.frozen
    assert core.pose((np.nan, 0, 0)) != POSE_FROZEN
    assert core.pose(PLACE, (0, 0, 0, 0)) != POSE_FROZEN
    assert core.fields.frozen == frozen
    assert core.pose(PLACE) == POSE_FROZEN
