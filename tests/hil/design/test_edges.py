"""Edges of trim, authority, sweeps and margins: two trims at one speed, ends of ranges, phases beyond half a turn."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hil.config import load_config
from hil.design import sweeps
from hil.design.authority import single
from hil.design.linear import Point
from hil.design.margins import Margins, margins_of, worst
from hil.design.sweeps import HoverAngles
from hil.design.trim import OPENINGS, balanced, changed, coefficient_of, opening_at, scaled, speed_at
from hil.floaty.geometry import weigh
from support.geometries import geometries

G0, COEFFICIENT = load_config().geometry, coefficient_of(load_config())
PAPER = Point(G0, COEFFICIENT, math.radians(25.0), 0.0, 0.9)


def test_of_two_trims_at_one_speed_it_is_the_one_at_which_opening_makes_the_robot_sink() -> None:
    speeds = [speed_at(G0, COEFFICIENT, opening) for opening in OPENINGS.tolist()]
    slowest = int(np.argmin(speeds))
    assert slowest > 0, "the same speed carries the robot on both sides"
    speed = (speeds[slowest - 1] + speeds[slowest]) / 2
    found = opening_at(G0, COEFFICIENT, speed)
    assert found > OPENINGS[slowest]
    assert speed_at(G0, COEFFICIENT, found) == pytest.approx(speed)
    assert speed_at(G0, COEFFICIENT, found + 0.01) > speed


@pytest.mark.parametrize("geometry", [G0, *geometries(8)])
def test_a_balanced_robot_has_its_centre_of_mass_where_it_was_asked_for(geometry) -> None:
    assert weigh(balanced(geometry, 0.03)).axis_height == pytest.approx(0.03)
    mirrored = changed(geometry, masses=[one.model_dump() | {"mirrored": True} for one in geometry.masses])
    if mirrored.masses:
        assert weigh(balanced(mirrored, 0.03)).axis_height == pytest.approx(0.03)


@pytest.mark.parametrize("geometry", [G0, *geometries(8)])
def test_a_similar_robot_has_the_inertia_of_its_masses_and_lengths(geometry) -> None:
    before, after = weigh(geometry), weigh(scaled(geometry, 2.0, 3.0))
    assert after.mass == pytest.approx(3.0 * before.mass)
    assert after.axis_height == pytest.approx(2.0 * before.axis_height)
    assert after.inertia == pytest.approx(12.0 * np.array(before.inertia))


@pytest.mark.parametrize(
    ("opening", "far"),
    [(0.4, 0.4), (0.45, 0.45), (0.6, 0.3), (0.0, 0.0), (0.9, 0.0), (1.0, 0.0), (-0.1, 0.0)],
)
def test_the_reach_is_to_the_nearer_limit(opening: float, far: float) -> None:
    assert replace(PAPER, opening=opening).reach == pytest.approx(far)


def test_an_input_alone_takes_no_flap_beyond_its_limits() -> None:
    least, most = single(replace(PAPER, low=math.radians(15.0), high=math.radians(30.0)))["lift"]
    wide_least, wide_most = single(PAPER)["lift"]
    assert wide_least < least < 1.0 < most < wide_most
    assert most - 1.0 > 1.0 - least, "10 degrees to close and 5 to open"


def test_the_updrafts_are_those_whose_hover_leaves_the_reserve() -> None:
    low, high = sweeps.updrafts(PAPER)
    assert opening_at(G0, COEFFICIENT, low) == pytest.approx(PAPER.low + sweeps.RESERVE, abs=1e-6)
    assert opening_at(G0, COEFFICIENT, high) == pytest.approx(PAPER.high - sweeps.RESERVE, abs=1e-6)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_hover_angles_within_5_percent_of_the_best_are_as_good(scale: float) -> None:
    curve = np.zeros(len(sweeps.OPENINGS))
    curve[10:15] = scale * np.array([0.949, 0.951, 1.0, 0.96, 0.94])
    best, low, high = HoverAngles({}, {"a": curve}).best("a")
    assert (best, low, high) == pytest.approx(tuple(sweeps.OPENINGS[[12, 11, 13]]))


def test_roll_becomes_stable_where_its_stiffness_falls_through_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sweeps, "KINKS", np.radians([0.0, 30.0, 60.0, 90.0]))
    monkeypatch.setattr(sweeps, "HEIGHTS", np.array([0.03]))
    found = sweeps.stability(PAPER)
    stable = int(np.argmax(found.along <= 0.0))
    assert found.along[0] > 0.0 >= found.along[stable]
    assert sweeps.KINKS[stable - 1] < found.crossing < sweeps.KINKS[stable]
    assert sweeps._stiffness(PAPER, G0, found.crossing) == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize(
    ("degrees", "phase", "until"), [(-170.0, 10.0, 10.0), (170.0, 10.0, 350.0), (-90.0, 90.0, 90.0)]
)
def test_margins_take_the_nearer_phase_and_positive_delay(degrees: float, phase: float, until: float) -> None:
    w = np.geomspace(0.1, 10.0, 2001)
    found = margins_of(w, np.exp(1j * math.radians(degrees)) / w)
    assert found.phase == pytest.approx(math.radians(phase), abs=1e-6)
    assert found.delay == pytest.approx(math.radians(until), abs=1e-3)


def test_the_worst_of_several_loops_has_the_least_of_each_margin() -> None:
    one, two = Margins(True, 2.0, 0.5, 0.6, 0.01, 1.5), Margins(True, 3.0, 0.7, 0.4, 0.02, 1.2)
    assert worst([one, two]) == worst([two, one]) == Margins(True, 2.0, 0.7, 0.4, 0.01, 1.5)
    assert not worst([one, Margins(False, 1.0, 1.0, 0.0, 0.0, np.inf)]).stable
