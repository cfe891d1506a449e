"""The design against the flown plant, the specification's printed figures, and the laws that every geometry obeys."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hil.commands import design
from hil.config import load_config
from hil.errors import LabError
from hil.research.design import analysis, sweeps
from hil.research.design.authority import attainable, pressure_at, single, wrenches
from hil.research.design.axes import PITCH, ROLL
from hil.research.design.claims import claims
from hil.research.design.linear import Linear, Point, linear, stiffness
from hil.research.design.margins import Margins, margins_of, worst
from hil.research.design.sweeps import HoverAngles
from hil.research.design.trim import OPENINGS, balanced, changed, coefficient_of, opening_at, scaled, speed_at
from hil.world.config import GeometryConfig, PlantConfig, PlantServoConfig, TunnelConfig
from hil.world.floaty.correction import PAPER_TABLE
from hil.world.floaty.geometry import weigh
from hil.world.floaty.plant import Plant
from support.command import Cli
from support.geometries import geometries

G0, COEFFICIENT = load_config().geometry, coefficient_of(load_config())
HOVER = math.radians(25.0)
PAPER = Point(G0, COEFFICIENT, HOVER, 0.0, 0.9)
UNIFORM = TunnelConfig(turbulence="none", profile_radius=5.0, height_slope=0.0)
HOME = (0.0, 0.0, UNIFORM.hover_height)
# Paper, eq. (input_signals): flap angles per u1..u4
MIX = np.array([[1, 1, -1, -1], [1, -1, -1, 1], [-1, -1, -1, -1], [-1, 1, -1, 1]], float)
SIGNS = np.array([1.0, -1.0, 1.0, -1.0])
# By a prototype of the isolated plates, apart from this code
PRINTED = {
    "roll_u1": 188.6, "roll_roll": -15.97, "roll_rate": -1.64, "y_u1": -3.55, "y_roll": -7.64, "pitch_u2": 78.7,
    "pitch_pitch": -119, "pitch_rate": -3.2, "x_u2": -3.87, "x_pitch": 8.09, "yaw_u3": 110.0, "yaw_rate": -0.46,
    "z_u4": 8.88, "z_vz": -1.962,
}  # fmt: skip
INSIDE = {"roll_u1", "roll_roll", "yaw_u3", "z_vz"}  # of the Table's uncertainty, the same column


def flown(geometry: GeometryConfig, speed: float, opening: float) -> Plant:
    config = PlantConfig(variant="plate", airspeed=speed, hover_angle=opening)
    tunnel = UNIFORM.model_copy(update={"speed": speed})
    return Plant(geometry, config, tunnel, PlantServoConfig(), np.random.default_rng(1))


def by_differences(plant: Plant, opening: float) -> NDArray[np.float64]:
    """Central differences of the flown plant's accelerations, (6, 13), by velocity, turn, rate and input."""
    step = 1e-5
    columns = []
    for cause in range(13):
        ends = []
        for sign in (1.0, -1.0):
            x = np.zeros(13)
            x[cause] = sign * step
            turn = Rotation.from_rotvec(x[3:6]).as_quat(scalar_first=True)
            plant.place(HOME, turn, x[:3], x[6:9], SIGNS * opening + MIX @ x[9:])
            ends.append(np.concatenate([plant.acceleration_W, plant.alpha_B]))
        columns.append((ends[0] - ends[1]) / (2 * step))
    return np.array(columns).T


@pytest.mark.long
@pytest.mark.parametrize("geometry", geometries(20))
def test_linearisation_is_the_central_difference_of_the_flown_plant(geometry: GeometryConfig) -> None:
    speed = speed_at(geometry, 1.3, HOVER)
    plant, model = flown(geometry, speed, HOVER), linear(geometry, speed, HOVER)
    seen = by_differences(plant, HOVER)
    ours = np.vstack([np.hstack([model.A[rows], model.B[rows]]) for rows in (slice(0, 3), slice(6, 9))])
    assert ours == pytest.approx(seen, rel=1e-5, abs=1e-6 * np.abs(seen).max())
    assert model.A[3:6, 6:] == pytest.approx(np.eye(3))
    for name, value in ((name, getattr(plant.linearise(), name)) for name in PRINTED):
        assert getattr(model.constants, name) == pytest.approx(value, rel=1e-9, abs=1e-9), name


def test_g0_has_the_constants_and_poles_that_the_specification_prints() -> None:
    model = PAPER.linear
    for name, value in PRINTED.items():
        assert getattr(model.constants, name) == pytest.approx(value, rel=0.012), name
    roll = model.poles(ROLL)
    assert roll[0] == pytest.approx(complex(-0.42, 3.91), abs=0.005)
    assert roll[1] == pytest.approx(roll[0].conjugate())
    assert roll[2] == pytest.approx(-1.01, abs=0.005)
    pitch = model.poles(PITCH)
    assert pitch == sorted(pitch, key=lambda pole: (-abs(pole.imag), -pole.real, -pole.imag))
    lone = Linear(np.diag([-3.0, 0, 0, 0, -1.0, 0, 0, -2.0, 0]), model.B).poles(PITCH)
    assert lone == [-1.0, -2.0, -3.0], "the slowest first"


def test_the_first_robot_falls_over_as_the_specification_prints() -> None:
    high = sweeps.flat_high(PAPER)
    assert high.linear.constants.roll_roll == pytest.approx(89.5, abs=0.05)
    light = changed(high.geometry, inertia=(1.16e-3, 1.16e-3, 1.47e-3))
    assert linear(light, high.speed, HOVER).constants.roll_roll == pytest.approx(100.3, abs=0.05)
    low = linear(changed(G0, kink_angle=0.0), 10.0, HOVER)
    assert low.constants.roll_roll == pytest.approx(56.5, abs=0.05)
    assert low.growth(ROLL) == pytest.approx(7.5, abs=0.05)


@pytest.mark.parametrize("geometry", [G0, *geometries(20)])
def test_size_and_mass_scale_every_geometry_exactly(geometry: GeometryConfig) -> None:
    length, mass = 0.6, 1.7
    other = scaled(geometry, length, mass)
    before, after = speed_at(geometry, 1.3, HOVER), speed_at(other, 1.3, HOVER)
    assert after / before == pytest.approx(math.sqrt(mass) / length, rel=1e-6)
    f, g = linear(geometry, before, HOVER).constants, linear(other, after, HOVER).constants
    for name in ("roll_u1", "pitch_u2", "yaw_u3", "roll_roll", "pitch_pitch"):
        assert getattr(g, name) == pytest.approx(getattr(f, name) / length, rel=1e-5, abs=1e-6), name
    for name in ("z_u4", "y_u1", "x_u2", "y_roll"):
        assert getattr(g, name) == pytest.approx(getattr(f, name), rel=1e-5, abs=1e-6), name


@pytest.mark.parametrize("geometry", geometries(20))
def test_plates_in_one_array_are_the_flown_ones(geometry: GeometryConfig) -> None:
    plant = flown(geometry, speed_at(geometry, 1.3, HOVER), HOVER)
    openings = np.random.default_rng(2).uniform(-0.4, 1.2, (5, 4))
    found = wrenches(geometry, openings, pressure_at(geometry, HOVER))
    for opening, wrench in zip(openings, found, strict=True):
        seen = np.concatenate(plant.mounted_wrench((SIGNS * opening).tolist()))
        assert wrench == pytest.approx(seen, rel=1e-9, abs=1e-12)


def test_hover_angle_and_speed_are_each_others_inverse() -> None:
    assert speed_at(G0, COEFFICIENT, HOVER) == pytest.approx(10.0, rel=1e-12)
    for speed in (9.3, 10.0, 11.7, 13.0):
        assert speed_at(G0, COEFFICIENT, opening_at(G0, COEFFICIENT, speed)) == pytest.approx(speed, rel=1e-9)


def test_an_updraft_that_carries_no_robot_is_refused_in_one_line() -> None:
    with pytest.raises(LabError, match=r"no hover at 8 m/s: .* carry 0\.34 kg at 9\.19 to") as caught:
        opening_at(G0, COEFFICIENT, 8.0)
    assert "\n" not in str(caught.value)


def test_the_centre_of_mass_moves_and_the_fitted_inertia_follows_the_masses() -> None:
    lower = balanced(G0, 0.09)
    assert weigh(lower).mass == weigh(G0).mass
    assert weigh(lower).axis_height == pytest.approx(0.09, abs=1e-9)
    old, new = (weigh(changed(one, inertia="masses")).inertia for one in (G0, lower))
    assert new[0] > old[0]
    assert new[2] == pytest.approx(old[2])
    grown = [b / a for a, b in zip(weigh(G0).inertia, weigh(lower).inertia, strict=True)]
    assert grown == pytest.approx([b / a for a, b in zip(old, new, strict=True)])
    assert weigh(balanced(G0, 0.09, keep_inertia=True)).inertia == weigh(G0).inertia
    assert weigh(balanced(G0, 0.07)).inertia == pytest.approx(weigh(G0).inertia)


def test_inputs_alone_end_at_the_flaps_limits() -> None:
    plant = flown(G0, 10.0, HOVER)

    def at(*openings: float) -> NDArray[np.float64]:
        force, torque = plant.mounted_wrench((SIGNS * openings).tolist())
        return np.array([*(torque / weigh(G0).inertia), force[2] / (0.34 * 9.81)])

    alone = single(PAPER)
    assert alone["lift"][0] == pytest.approx(at(*4 * (0.9,))[3])
    # Bent strips lie level then.
    assert alone["lift"][1] == pytest.approx(at(*4 * (math.radians(3.6),))[3], rel=1e-3)
    closed, opened = 0.0, 2 * HOVER
    # the supplement's Delta: u1 opens flap 1 and 4, u3 closes 1 and 3
    assert alone["roll"][1] == pytest.approx(at(opened, closed, closed, opened)[0])
    assert alone["pitch"][1] == pytest.approx(abs(at(opened, opened, closed, closed)[1]))
    assert alone["yaw"][1] == pytest.approx(at(closed, opened, closed, opened)[2])


def test_the_attainable_set_contains_what_single_inputs_do_and_is_mirror_symmetric() -> None:
    found = attainable(PAPER)
    alone = single(PAPER)
    for index, (least, most) in enumerate(alone.values()):
        assert found.all[:, index].min() <= least + 1e-9
        assert found.all[:, index].max() >= 0.95 * most  # on a grid
    assert np.abs(found.level[:, 3] - 1.0).max() < 0.02
    for index in range(3):
        assert found.all[:, index].max() == pytest.approx(-found.all[:, index].min())


@pytest.mark.long
def test_roll_stability_and_best_hover_angles_are_those_of_the_specification() -> None:
    stable = sweeps.stability(PAPER)
    assert math.degrees(stable.crossing) == pytest.approx(33.7, abs=0.05)
    assert stable.along[0] == pytest.approx(56.5, abs=0.05)
    angles = sweeps.hover_angles(PAPER)
    best = [math.degrees(angles.best(name)[0]) for name in angles.criteria]
    assert best[:2] == pytest.approx([25.0, 26.0], abs=0.75)  # paper: 20 to 25 deg is best
    assert np.interp(math.radians(17.5), sweeps.OPENINGS, angles.constants["pitch"]) == pytest.approx(
        0, abs=6
    )
    verdicts = {
        claim.title: claim.verdict for claim in claims(PAPER, stable, angles, sweeps.scaling(PAPER), 0.0)
    }
    inside = {name for name in PAPER_TABLE if verdicts[name.replace("_", " per ")] == "agrees"}
    assert inside == INSIDE
    assert verdicts["lateral forces cancel under u1 and u2"] == "differs"
    assert verdicts["airspeed over m / l²"] == "agrees"


@pytest.mark.long
def test_the_exponent_of_a_power_law_is_that_of_its_ends() -> None:
    for law in sweeps.scaling(PAPER):
        whole = law.x.argmax(), law.x.argmin()
        (x, last_x), (y, last_y) = law.x[[*whole]], law.y[[*whole]]
        assert y / last_y == pytest.approx((x / last_x) ** law.exponent, rel=1e-3), (law.quantity, law.cause)


def test_the_slowest_pole_is_never_hidden() -> None:
    spun = Linear(np.diag([0.0, -1.0, 0, 2.0, 0, 0, -3.0, 0, 0]), np.zeros((9, 4)))
    assert spun.growth(ROLL) == 2.0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--speed", "8"], "no hover at 8 m/s"),
        (["--speed", "10", "--angle", "25"], "one follows from the other"),
    ],
)
def test_bad_input_is_one_line(cli: Cli, arguments: list[str], text: str) -> None:
    assert cli("design", *arguments) == 2
    assert text in cli.err


# Edges: two trims at one speed, ends of ranges, phases beyond half a turn


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


@pytest.mark.parametrize(
    ("opening", "far"),
    [(0.4, 0.4), (0.45, 0.45), (0.6, 0.3), (0.0, 0.0), (0.9, 0.0), (1.0, 0.0), (-0.1, 0.0)],
)
def test_the_reach_is_to_the_nearer_limit(opening: float, far: float) -> None:
    assert replace(PAPER, opening=opening).reach == pytest.approx(far)


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
    hover = G0, speed_at(G0, COEFFICIENT, HOVER), HOVER
    assert stiffness(*hover) == pytest.approx(linear(*hover).constants.roll_roll, rel=1e-5)


def test_hover_angles_are_swept_with_constants_of_each_opening_and_three_readings_of_authority(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    openings = np.radians([12.0, 24.0, 36.0])
    monkeypatch.setattr(sweeps, "OPENINGS", openings)
    found = sweeps.hover_angles(PAPER)
    each = [replace(PAPER, opening=one).linear.constants for one in openings]
    signed = {"roll": "roll_u1", "pitch": "pitch_u2", "yaw": "yaw_u3", "lift": "z_u4"}
    assert {name: values.tolist() for name, values in found.constants.items()} == {
        name: [getattr(one, constant) for one in each] for name, constant in signed.items()}  # fmt: skip
    assert found.constants["pitch"][0] < 0.0, "a sign that no authority has"
    roll, pitch, yaw, lift = (np.maximum(found.constants[name], 0.0) for name in signed)
    four = [one / one.max() for one in (roll, pitch, yaw, lift)]
    reach = np.minimum(openings, 0.9 - openings)
    expected = {"√(yaw · lift)": np.sqrt(yaw * lift), "mean of four × flaps' reach": np.prod(four, axis=0) ** 0.25 * reach,
        "least of four, each by its largest": np.min(four, axis=0)}  # fmt: skip
    assert list(found.criteria) == list(expected)
    for name, curve in expected.items():
        assert found.criteria[name] == pytest.approx(curve / curve.max())


def test_size_and_mass_have_the_powers_of_their_quantities(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each law over its cause in SI units; airspeed over both sweeps; fitted and the paper's exponent."""
    monkeypatch.setattr(sweeps, "FACTORS", np.array([1.0, 2.0]))
    found = {(one.quantity, one.cause): one for one in sweeps.scaling(PAPER)}
    turns = dict.fromkeys((f"{name} acceleration per input" for name in ("roll", "pitch", "yaw")), -1.0)
    papers = {(name, "l"): power for name, power in (turns | {"lift acceleration per input": 0.0,
        "lift acceleration / l per input": -1.0, "Reynolds number": 0.0}).items()}  # fmt: skip
    papers |= {
        ("roll acceleration per input", "m"): 0.0,
        ("airspeed", "m / l²"): 0.5,
        ("Reynolds number", "m"): 0.5,
    }
    assert {key: one.paper for key, one in found.items()} == papers
    for (_, cause), law in found.items():
        first = {"l": G0.footprint, "m": 0.34, "m / l²": 0.34 / G0.footprint**2}[cause]
        assert law.x[:2] == pytest.approx([first, first * (0.25 if "/" in cause else 2.0)])
        assert law.exponent == pytest.approx(law.paper, abs=1e-4)
    f = PAPER.linear.constants
    values = [f.roll_u1, f.pitch_u2, f.yaw_u3, f.z_u4, f.z_u4 / G0.footprint, f.roll_u1, 10.0,
        *2 * [1.225 * 10.0 * G0.footprint / 1.81e-5]]  # fmt: skip
    assert [one.y[0] for one in found.values()] == pytest.approx(np.abs(values))
    assert len(found["airspeed", "m / l²"].x) == 4


def test_the_flown_plant_differs_from_the_plate_equations_by_what_is_wrong_in_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert analysis.model_error(PAPER) < 1e-12
    equations = analysis.wrenches
    for place, off in ((2, 0.25), (5, -0.5)):
        wrong = np.zeros((analysis.CHECKED, 6))
        wrong[123, place] = off
        monkeypatch.setattr(analysis, "wrenches", lambda *what, wrong=wrong: equations(*what) + wrong)
        assert analysis.model_error(PAPER) == pytest.approx(abs(off))


def test_an_analysis_names_inputs_by_their_units_and_its_pictures_by_what_they_draw(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = ("stability", "hover_angles", "scaling", "attainable")
    for name in names:
        monkeypatch.setattr(analysis, name, lambda point, name=name: name)
    ends = {"roll": (-1.0, 2.0), "pitch": (-3.0, 4.0), "yaw": (-5.0, 6.0), "lift": (0.25, 7.0)}
    monkeypatch.setattr(analysis, "single", lambda point: ends)
    monkeypatch.setattr(
        analysis, "authorities", lambda point: dict(zip(ends, (10.0, 20.0, 30.0, 40.0), strict=True))
    )
    monkeypatch.setattr(analysis, "model_error", lambda point: 0.5)
    monkeypatch.setattr(analysis, "claims", lambda *what: [what])
    for name in ("shape", "stability", "hover", "reach", "scale"):
        monkeypatch.setattr(analysis.figures, name, lambda *what, name=name: (name, *what))
    found = analysis.analyse(PAPER)
    assert found.inputs == [
        ("u1: roll", "-1 to 2 rad/s²", "± 10 rad/s²"), ("u2: pitch", "-3 to 4 rad/s²", "± 20 rad/s²"),
        ("u3: yaw", "-5 to 6 rad/s²", "± 30 rad/s²"), ("u4: lift", "0.25 to 7 weights", "± 40 m/s²")]  # fmt: skip
    assert {name: draw() for name, _, _, draw in found.pictures} == {
        "shape": ("shape", PAPER), "stability": ("stability", PAPER, "stability"),
        "hover_angle": ("hover", PAPER, "hover_angles"), "attainable": ("reach", PAPER, "attainable"),
        "scaling": ("scale", "scaling")}  # fmt: skip
    assert found.claims == [(PAPER, "stability", "hover_angles", "scaling", 0.5)]


@pytest.mark.long
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


def test_the_model_on_board_is_printed_for_other_tools(cli: Cli, empty_folder: Path) -> None:
    assert cli("design", "--json", "--set", "model.z_vz=-2.5") == 0
    axes = {axis["axis"]: axis for axis in json.loads(cli.out)["axes"]}
    assert list(axes) == ["roll, y", "pitch, x", "yaw", "height"]
    height, model = axes["height"], load_config().model
    assert height["states"] == ["position [m]", "velocity [m/s]", "flap [rad]"]
    rate = model.flap_rate
    assert height["A"] == [[0.0, 1.0, 0.0], [0.0, -2.5, model.z_u4], [0.0, 0.0, -rate]]
    assert height["B"] == [[0.0], [0.0], [rate]]
    assert not [*empty_folder.iterdir()]


def test_a_robot_may_hover_above_one_and_up_to_sixty_metres_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """As the profile that is written has it."""
    for speed, allowed in ((1.0, False), (math.nextafter(1.0, 2.0), True), (60.0, True), (60.1, False)):
        monkeypatch.setattr(Point, "speed", speed)
        if allowed:
            assert design.point_of("floaty", ()).opening == HOVER
        else:
            with pytest.raises(LabError, match=rf"^hover at 25 deg takes {speed:g} m/s: outside 1\.\.60"):
                design.point_of("floaty", ())
