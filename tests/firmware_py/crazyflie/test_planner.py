"""The planner's polynomials against numpy's linear algebra and scipy's Bezier curves; its paths by their laws."""

import struct
from errno import EBUSY, ENOEXEC
from math import pi, tau
from types import SimpleNamespace

import numpy as np
import pytest
from cflib.crazyflie.mem.trajectory_memory import CompressedSegment, CompressedStart, Poly4D
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from scipy.interpolate import BPoly

from firmware_py.crazyflie.high_level_commander import FINISHED, HighLevelCommander
from firmware_py.crazyflie.planner import (
    Path,
    PathPoint,
    Phase,
    Piece,
    Planner,
    Spiral,
    between,
    bezier,
    go_to,
    spiral,
    straight_up,
)
from firmware_py.crazyflie.trajectories import COMPRESSED, LOCATION_MEMORY, POLYNOMIALS, decode_trajectory
from firmware_py.wire import WireError
from firmware_py.wire.high_level import Define, PathCommand

NUMBERS = st.floats(-2.0, 2.0)
VECTORS = st.tuples(NUMBERS, NUMBERS, NUMBERS)
MOTIONS = st.builds(PathPoint, VECTORS, NUMBERS, VECTORS, VECTORS, NUMBERS)
DURATIONS = st.floats(0.3, 8.0)
POINTS = st.lists(NUMBERS, min_size=1, max_size=8)
REST = PathPoint((0.1, -0.2, 0.3), 0.4)


def coefficients(
    begin: tuple[float, float, float], end: tuple[float, float, float], duration: float
) -> Polynomial:
    """The polynomial of 7th degree with these values and first two derivatives at both ends, the third 0."""
    rows, wanted = [], [*begin, 0.0, *end, 0.0]
    for t in (0.0, duration):
        for order in range(4):
            rows.append([Polynomial.basis(k).deriv(order)(t) if order else t**k for k in range(8)])
    return Polynomial(np.linalg.solve(np.array(rows), np.array(wanted)))


@pytest.mark.long
@given(MOTIONS, MOTIONS, DURATIONS)
@settings(max_examples=15, deadline=None)
def test_motions_are_joined_without_jerk_at_ends(begin: PathPoint, end: PathPoint, duration: float) -> None:
    path = between(begin, end, duration)
    for axis in range(3):
        states = [(m.position[axis], m.velocity[axis], m.acceleration[axis]) for m in (begin, end)]
        expected = coefficients(*states, duration)
        for t in np.linspace(0.0, duration * 0.999, 7):
            motion = path.at(float(t))
            ours = motion.position[axis], motion.velocity[axis], motion.acceleration[axis]
            theirs = [(expected.deriv(order) if order else expected)(t) for order in range(3)]
            assert ours == pytest.approx(theirs, abs=1e-6 * (1 + 1 / duration**2))
    yaw = coefficients((begin.yaw, begin.yaw_rate, 0.0), (end.yaw, end.yaw_rate, 0.0), duration)
    assert path.at(0.4 * duration).yaw == pytest.approx(yaw(0.4 * duration), abs=1e-6)
    assert path.at(0.4 * duration).yaw_rate == pytest.approx(yaw.deriv()(0.4 * duration), abs=1e-5)


@pytest.mark.long
@given(POINTS, DURATIONS)
@settings(max_examples=50, deadline=None)
def test_a_bezier_curve_is_scipys(points: list[float], duration: float) -> None:
    ours, theirs = Polynomial(bezier(points, duration)), BPoly(np.array(points)[:, None], [0.0, duration])
    for t in np.linspace(0.0, duration, 9):
        assert ours(t) == pytest.approx(float(theirs(t)), abs=1e-7)


def test_trajectories_are_read_as_cflib_packs_them_at_any_place_of_the_memory() -> None:
    rng, memory = np.random.default_rng(2), bytearray(4096)
    axes = rng.normal(size=(2, 4, 8)).astype(np.float32).tolist()
    packed = b"".join(Poly4D(0.5 + n, *map(Poly4D.Poly, axes[n])).pack() for n in (0, 1))
    memory[132 : 132 + len(packed)] = packed
    path = decode_trajectory(memory, Define(1, LOCATION_MEMORY, POLYNOMIALS, 132, 2))
    for t, number, begin in ((0.3, 0, 0.0), (1.7, 1, 0.5)):
        expected = [Polynomial(axis)(t - begin) for axis in axes[number]]
        assert (*path.at(t).position, path.at(t).yaw) == pytest.approx(expected)
    parts = [
        CompressedStart(0.1, -0.2, 0.3, 0.5),
        CompressedSegment(1.0, [0.2], [-0.2, 0.0, 0.0], [], [1.5]),
        CompressedSegment(0.5, [], [], [0.4] * 7, []),
        CompressedSegment(0.0, [], [], [], []),
    ]
    packed = b"".join(part.pack() for part in parts)
    memory[40 : 40 + len(packed)] = packed
    path = decode_trajectory(memory, Define(2, LOCATION_MEMORY, COMPRESSED, 40, 2))
    assert path.duration == pytest.approx(1.5)
    for t, place in (
        (0.5, (0.15, -0.1, 0.3, 1.0)),
        (1.49999, (0.2, 0.0, 0.4, 1.5)),
    ):  # a Bezier curve's middle, the end
        assert (*path.at(t).position, path.at(t).yaw) == pytest.approx(place, abs=1e-3)


@pytest.mark.parametrize("durations", [(), (0.0,), (1.0, 0.0), (-1.0, 1.0)])
def test_a_trajectory_of_no_pieces_or_one_that_takes_no_time_is_none(durations: tuple[float, ...]) -> None:
    axes = [Poly4D.Poly([0.0] * 8)] * 4
    memory = b"".join(Poly4D(duration, *axes).pack() for duration in durations)
    with pytest.raises(WireError, match="has no pieces, or one that takes no time"):
        decode_trajectory(memory, Define(1, LOCATION_MEMORY, POLYNOMIALS, 0, len(durations)))


def test_a_compressed_trajectory_is_neither_scaled_nor_reversed_nor_turned() -> None:
    """As by crtp_commander_high_level.c; one of polynomials is all of that."""
    packed = b"".join(
        part.pack()
        for part in (
            CompressedStart(0.0, 0.0, 0.0, 0.0), CompressedSegment(1.0, [0.2], [], [], []),
            CompressedSegment(0.0, [], [], [], []),
        )
    )  # fmt: skip
    line = Poly4D(1.0, *map(Poly4D.Poly, ([0.0, 0.2] + [0.0] * 6, *([0.0] * 8,) * 3))).pack()
    board = SimpleNamespace(estimate=lambda: REST, admits=lambda places: True)
    for kind, content in ((COMPRESSED, packed), (POLYNOMIALS, line)):
        for scale, reverse, turned in ((1.0, 0, 0), (1.0, 0, 1), (2.0, 0, 0), (1.0, 1, 0)):
            commander = HighLevelCommander(board, lambda kind, text: None)
            commander.block(False)
            commander.memory[: len(content)] = content
            up = struct.pack("<BBff?f", PathCommand.TAKE_OFF, 0, 1.0, pi / 2, False, 0.5)
            assert commander.execute(up, 0.0) == 0
            commander.setpoint(1.0)
            assert commander.execute(struct.pack("<BBBBIB", PathCommand.DEFINE, 1, 1, kind, 0, 1), 1.0) == 0
            start = struct.pack("<BB???Bf", PathCommand.START, 0, True, turned, reverse, 1, scale)
            plain = kind == POLYNOMIALS or (scale, reverse) == (1.0, 0)
            assert commander.execute(start, 1.0) == (0 if plain else ENOEXEC)
            goal = commander.planner.goal(1.0 + 0.5 * scale)
            assert goal is not None
            moved = np.subtract(goal.position[:2], REST.position[:2]) if plain else (0.0, 0.0)
            along = (0.0, 0.1) if turned and kind == POLYNOMIALS else (-0.1 if reverse else 0.1, 0.0)
            assert moved == pytest.approx(along if plain else (0.0, 0.0), abs=1e-4)


def wavy(pieces: int = 3) -> Path:
    rng = np.random.default_rng(1)
    return Path(
        tuple(
            Piece(0.5 + 0.25 * number, tuple(tuple(row) for row in rng.normal(size=(4, 8)).tolist()))  # type: ignore[arg-type]
            for number in range(pieces)
        )
    )


def test_pieces_follow_one_another_and_the_end_is_held_at_rest() -> None:
    path = wavy()
    assert path.duration == 0.5 + 0.75 + 1.0
    x = Polynomial(path.pieces[1].axes[0])
    assert path.at(0.5 + 0.3).position[0] == pytest.approx(x(0.3))
    assert path.at(0.5 + 0.3).velocity[0] == pytest.approx(x.deriv()(0.3))
    end = PathPoint(
        tuple(Polynomial(axis)(1.0) for axis in path.pieces[2].axes[:3]),
        Polynomial(path.pieces[2].axes[3])(1.0),
    )  # type: ignore[arg-type]
    for t in (2.25, 100.0):
        assert path.at(t).position == pytest.approx(end.position)
        assert path.at(t).velocity == path.at(t).acceleration == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize("timescale", [0.5, 1.0, 3.0])
def test_a_slower_path_is_the_same_path_and_a_reversed_one_runs_back(timescale: float, reverse: bool) -> None:
    path = wavy()
    other = Path(path.pieces, timescale, reverse)
    assert other.duration == pytest.approx(timescale * path.duration)
    for t in (0.2, 0.9, 1.7):
        ours, there = other.at(timescale * (path.duration - t if reverse else t)), path.at(t)
        rate = (-1 if reverse else 1) / timescale
        assert ours.position == pytest.approx(there.position)
        assert ours.velocity == pytest.approx([v * rate for v in there.velocity])
        assert ours.acceleration == pytest.approx([a * rate * rate for a in there.acceleration])
        assert ours.yaw_rate == pytest.approx(there.yaw_rate * rate)


@pytest.mark.parametrize("reverse", [False, True])
def test_a_relative_path_begins_where_the_robot_is(reverse: bool) -> None:
    path = Path(wavy().pieces, 1.0, reverse)
    begin, moved = path.at(0.0), path.begun_at((1.0, 2.0, 3.0), None)
    assert moved.at(0.0).position == pytest.approx((1.0, 2.0, 3.0))
    assert moved.at(0.0).yaw == pytest.approx(begin.yaw)
    offset = np.array(path.at(0.8).position) - begin.position
    assert np.array(moved.at(0.8).position) - (1, 2, 3) == pytest.approx(offset)


def test_a_turned_path_turns_about_its_origin_and_a_reversed_one_does_not_turn() -> None:
    path, here = wavy(), (1.0, 2.0, 3.0)
    begin, there = path.at(0.0), path.at(0.8)
    turned = path.begun_at(here, begin.yaw + 0.5 * pi).at(0.8)
    x, y, z = there.position
    assert turned.position == pytest.approx(np.array((-y, x, z)) + here - begin.position)
    assert turned.yaw == pytest.approx(there.yaw + 0.5 * pi)
    for flown, along in ((turned.velocity, there.velocity), (turned.acceleration, there.acceleration)):
        assert flown == pytest.approx((-along[1], along[0], along[2]))
    assert turned.yaw_rate == there.yaw_rate
    back = Path(path.pieces, reverse=True)
    assert back.begun_at(here, 2.0).at(0.8).position == pytest.approx(
        back.begun_at(here, None).at(0.8).position
    )


@pytest.mark.parametrize("sideways", [False, True])
@pytest.mark.parametrize("clockwise", [False, True])
def test_a_spiral_s_ends_are_on_circles_about_one_centre(sideways: bool, clockwise: bool) -> None:
    wish = Spiral(sideways, clockwise, 1.2, 0.3, 0.5, 0.4, 2.0)
    begin = PathPoint((0.2, -0.1, 1.0), 0.7)
    path = spiral(begin, wish)
    first, last = path.at(0.0), path.at(2.0 - 1e-9)
    turn = -1.2 if clockwise else 1.2
    assert last.yaw - first.yaw == pytest.approx(turn, abs=1e-6)
    assert last.position[2] == pytest.approx(1.4, abs=1e-6)
    sense, aside = (1.0 if clockwise else -1.0), (0.0 if sideways else -0.5 * pi)
    ahead = np.array([(np.cos(m.yaw + aside), np.sin(m.yaw + aside)) for m in (first, last)])
    centres = [
        np.array(m.position[:2]) + sense * r * a
        for m, r, a in zip((first, last), (0.3, 0.5), ahead, strict=True)
    ]
    assert centres[0] == pytest.approx(centres[1], abs=1e-6)
    for motion, radius, a in zip((first, last), (0.3, 0.5), ahead, strict=True):
        radial = -sense * a
        assert np.dot(motion.velocity[:2], radial) == pytest.approx(0.1, abs=1e-6)  # (0.5 - 0.3) m in 2 s
        rate, along = turn / 2.0, (-radial[1], radial[0])
        assert np.dot(motion.velocity[:2], along) == pytest.approx(radius * rate, abs=1e-6)
        assert np.dot(motion.acceleration[:2], radial) == pytest.approx(-radius * rate * rate, abs=1e-5)
        assert np.dot(motion.acceleration[:2], along) == pytest.approx(2.0 * 0.1 * rate, abs=1e-5)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_a_spiral_turns_once_at_most_and_has_no_negative_radius(sense: float) -> None:
    begin = PathPoint((0.2, -0.1, 1.0), 0.7)
    wild, tame = (
        Spiral(True, True, sense * 9.0, -0.1, -0.2, 0.4, 2.0),
        Spiral(True, True, sense * tau, 0.0, 0.0, 0.4, 2.0),
    )
    assert spiral(begin, wild) == spiral(begin, tame)


def test_up_and_down_keep_the_place_and_turn_on_the_shorter_side() -> None:
    path = straight_up(PathPoint((0.1, 0.2, 0.3), 3.0), 1.5, -3.0, 2.0)
    assert path.at(2.0).position == pytest.approx((0.1, 0.2, 1.5))
    assert path.at(1.0).position == pytest.approx((0.1, 0.2, 0.9))
    assert path.at(2.0).yaw == pytest.approx(2 * pi - 3.0)


@pytest.mark.parametrize("duration", [0.0, 5e-324, 2.9e-59, 0.9e-3])
@pytest.mark.parametrize("linear", [False, True])
def test_a_path_without_time_is_its_end(duration: float, linear: bool) -> None:
    begin = PathPoint((0.0, 0.0, 1.0), 0.0)
    for path in (
        straight_up(begin, 2.0, 0.5, duration),
        go_to(begin, (0.0, 0.0, 2.0), 0.5, duration, relative=False, linear=linear),
    ):
        assert (path.at(0.0).position, path.at(0.0).yaw) == ((0.0, 0.0, 2.0), 0.5)
        assert path.duration == 0.0


def test_going_there_is_absolute_or_relative_smooth_or_straight() -> None:
    smooth = go_to(REST, (1.0, 0.0, 0.0), 0.0, 2.0, relative=False, linear=False)
    assert smooth.at(2.0).position == pytest.approx((1.0, 0.0, 0.0))
    assert smooth.at(0.0).velocity == (0.0, 0.0, 0.0)
    relative = go_to(REST, (1.0, 0.0, 0.0), 0.5, 2.0, relative=True, linear=False)
    assert relative.at(2.0).position == pytest.approx((1.1, -0.2, 0.3))
    assert relative.at(2.0).yaw == pytest.approx(0.9)
    straight = go_to(REST, (1.1, -0.2, 0.3), 0.4, 2.0, relative=False, linear=True)
    for t in (0.0, 0.5, 1.9):
        assert straight.at(t).position == pytest.approx((0.1 + 0.5 * t, -0.2, 0.3))
        assert straight.at(t).velocity == pytest.approx((0.5, 0.0, 0.0))
    assert go_to(REST, (1.0, 2.0, 3.0), 0.0, 0.0, relative=False, linear=True).at(0.0).position == (
        1.0,
        2.0,
        3.0,
    )


def test_a_landing_ends_idle_and_everything_else_goes_on() -> None:
    planner = Planner()
    assert planner.rests
    assert planner.goal(0.0) is None
    planner.follow(straight_up(REST, 1.0, 0.0, 2.0), 1.0)
    goal = planner.goal(9.0)
    assert planner.phase is Phase.FLYING
    assert goal is not None
    assert goal.position[2] == pytest.approx(1.0)
    planner.follow(straight_up(goal, 0.2, 0.0, 2.0), 9.0, landing=True)
    assert planner.goal(10.999) is not None
    assert planner.phase is Phase.LANDING
    assert planner.goal(11.0) is None
    assert planner.phase is Phase.IDLE


@pytest.mark.parametrize(
    ("phase", "command", "status"),
    [
        (Phase.IDLE, 7, 0),
        (Phase.IDLE, 8, 0),
        (Phase.FLYING, 7, 1),
        (Phase.FLYING, 8, 0),
        (Phase.LANDING, 7, 1),
        (Phase.LANDING, 8, 1),
    ],
)
def test_only_at_rest_it_takes_off_and_only_once_it_lands(phase: Phase, command: int, status: int) -> None:
    """By plan_takeoff and plan_land of planner.c."""
    board = SimpleNamespace(estimate=lambda: REST, admits=lambda places: True)
    commander = HighLevelCommander(board, lambda kind, text: None)
    commander.block(False)
    if phase is not Phase.IDLE:
        commander.planner.follow(straight_up(REST, 1.0, 0.0, 2.0), 0.0, landing=phase is Phase.LANDING)
    assert commander.execute(struct.pack("<BBff?f", command, 0, 0.5, 0.0, True, 2.0), 1.0) == status


def test_a_commander_takes_commands_from_its_first_release_until_it_is_blocked_again() -> None:
    board = SimpleNamespace(estimate=lambda: REST, admits=lambda places: True)
    commander = HighLevelCommander(board, lambda kind, text: None)
    take_off = struct.pack("<BBff?f", PathCommand.TAKE_OFF, 0, 0.5, 0.0, True, 2.0)
    for _ in range(2):
        assert commander.execute(take_off, 1.0) == EBUSY
        commander.block(False)
        assert commander.execute(take_off, 1.0) == 0
        commander.block(True)


def test_a_path_in_flight_begins_at_the_goal_of_its_instant_between_two_set_points() -> None:
    board = SimpleNamespace(estimate=lambda: REST, admits=lambda places: True)
    commander = HighLevelCommander(board, lambda kind, text: None)
    commander.block(False)
    commander.planner.follow(straight_up(REST, 1.0, 0.0, 2.0), 0.0)
    commander.setpoint(0.79)
    before = commander.planner.goal(0.799)
    assert (
        commander.execute(struct.pack("<4B5f", PathCommand.GO_TO, 0, 0, 0, 1.0, 2.0, 3.0, 0.0, 2.0), 0.799)
        == 0
    )
    after = commander.planner.goal(0.799)
    assert before is not None
    assert after is not None
    assert (*after.position, *after.velocity) == pytest.approx((*before.position, *before.velocity), abs=1e-9)


@pytest.mark.parametrize("mask", [0, 1, 6])
def test_a_command_to_groups_moves_the_robots_whose_mask_has_one_of_them(mask: int) -> None:
    board = SimpleNamespace(estimate=lambda: REST, admits=lambda places: True)
    for groups in range(8):
        commander = HighLevelCommander(board, lambda kind, text: None)
        assert commander.execute(bytes((PathCommand.SET_GROUP_MASK, 7)), 0.0) == 0
        assert commander.execute(bytes((PathCommand.SET_GROUP_MASK, mask)), 0.0) == 0, "also when blocked"
        assert commander.defaults.groups == mask
        commander.block(False)
        take_off = struct.pack("<BBff?f", PathCommand.TAKE_OFF, groups, 0.5, 0.0, True, 2.0)
        assert commander.execute(take_off, 1.0) == 0
        assert commander.planner.rests == (groups != 0 and not groups & mask)


@pytest.mark.parametrize("relative", [False, True])
@pytest.mark.parametrize("velocity", [0.0, -1.0])
def test_without_a_velocity_a_take_off_and_a_landing_have_each_their_own(
    relative: bool, velocity: float
) -> None:
    board = SimpleNamespace(estimate=lambda: PathPoint((0.1, 0.2, 0.0), 0.0), admits=lambda places: True)
    commander = HighLevelCommander(board, lambda kind, text: None)
    commander.block(False)
    commander.defaults.take_off_velocity, commander.defaults.landing_velocity = 0.25, 2.0
    t = 0.0
    for command, height, by, duration in ((9, 1.0, 1.0, 4.0), (10, 0.4, 0.6, 0.3)):
        data = struct.pack("<BBf?f?f", command, 0, by if relative else height, relative, 0.0, True, velocity)
        assert commander.execute(data, t) == 0
        goal = commander.planner.goal(t + 0.99 * duration)
        assert goal is not None
        assert goal.position[2] == pytest.approx(height, abs=1e-4)
        finished = [bool(commander.bits(t + duration * share) & FINISHED) for share in (0.99, 1.01)]
        assert finished == [False, True]
        t += duration + 1.0
        commander.setpoint(t)
